"""The colours that mouths mostly have at each lightness: the table of `stages/teeth/grey.py`.

    python tools/reader/tint.py --data teeth_labelled

Each photograph that the reader learned from counts the same.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from stages.teeth.grey import TINT


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    count = TINT.shape[1]
    total, pixels = np.zeros((2, count)), np.zeros(count)
    for path in sorted((parser.parse_args().data / "train").glob("*.jpg")):
        image = cv2.imread(str(path), cv2.IMREAD_REDUCED_COLOR_4)
        if image is None:
            continue
        lab = cv2.cvtColor(np.float32(image / 255), cv2.COLOR_BGR2Lab).reshape(-1, 3)
        place = np.rint(lab[:, 0] / 100 * (count - 1)).astype(np.int64)
        pixels += np.bincount(place, minlength=count) / len(lab)
        for row, values in zip(total, lab[:, 1:].T, strict=True):
            row += np.bincount(place, values, count) / len(lab)
    print(np.round(total / pixels, 1).tolist())


if __name__ == "__main__":
    main()
