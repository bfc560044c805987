"""Teeth in the labelled photographs that nobody outlined, as the reader that ships finds them.

    python tools/reader/unlabelled.py --data teeth_labelled --out FOLDER

For each photograph of `train/`, FOLDER gets `NAME.png`: 255 where the reader finds a crown that
nobody outlined. Such places are left out of training: a reader that is told long enough that they
are no teeth stops finding back teeth.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from samples import LEAST_SIDE

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from pipeline.artifacts.teeth import filled
from stages.teeth.read import read_photograph

#: A crown of which outlines cover less than this has none.
COVERED = 0.2
#: Its border is as unsure as itself: pixels.
MARGIN = 3


def without_outline(
    image: npt.NDArray[np.uint8], labels: npt.NDArray[np.uint8], name: str
) -> npt.NDArray[np.uint8]:
    """[H, W] 255 where a crown is found that has no outline, of a photograph [H, W, 3] RGB."""
    valid = np.ones(labels.shape, bool)
    dentition = read_photograph(image.astype(np.float32) / 255, valid, name).dentition
    found = np.zeros(labels.shape, np.uint8)
    for crown in dentition.all_crowns:
        mask = filled((crown,), dentition.size)
        if (labels[mask] > 0).mean() < COVERED:
            found[mask] = 255
    found = cv2.dilate(found, np.ones((2 * MARGIN + 1,) * 2, np.uint8))
    found[labels > 0] = 0
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder of teeth_labelled")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    count = 0
    for path in sorted((arguments.data / "train").glob("*.png")):
        image = cv2.imread(str(path.with_suffix(".jpg")))
        labels = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None or min(image.shape[:2]) < LEAST_SIDE:
            continue
        mask = without_outline(image[..., ::-1], labels, path.stem)
        count += bool(mask.any())
        cv2.imwrite(str(arguments.out / path.name), mask)
    print(f"{count} photographs show teeth without an outline")


if __name__ == "__main__":
    main()
