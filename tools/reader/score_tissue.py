"""How well the shipped reader tells teeth and gum from lips, cheeks and what holds them.

    python tools/reader/score_tissue.py --data FOLDER [--sheet sheet.png]

FOLDER holds `teeth_labelled/` and `triads/`. Scored are photographs that nothing was learned from:
those of `valid`, and three each of twelve patients; their truth is drawn by hand (`tissue.json`).
Near the teeth, up to half a crown's height, is what becomes surface: `taken` is something else
that is taken for gum there, `lost` is gum that is not found, both over the area of the teeth.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from samples import UNTOLD, drawn_tissue

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from stages.teeth.read import read_photograph

#: Photographs are read at this size, as `teeth` does.
LONG_SIDE = 512
#: Share of a crown's height up to which gum is near.
NEAR = 0.5
#: Size of a picture on the sheet.
TILE = (260, 340)


def read(path: Path) -> npt.NDArray[np.uint8]:
    """A photograph [H, W, 3], BGR."""
    image = cv2.imread(str(path))
    if image is None:
        raise FileNotFoundError(path)
    scale = LONG_SIDE / max(image.shape[:2])
    if scale >= 1:
        return image
    return cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def tile(
    image: npt.NDArray[np.uint8], found: npt.NDArray[np.bool_], truth: npt.NDArray[np.bool_],
    text: str,
) -> npt.NDArray[np.uint8]:  # fmt: skip
    """A small picture: what is not found is blue, the truth's outline green."""
    shown = image.copy()
    shown[~found] = shown[~found] // 2 + np.array([100, 0, 0], np.uint8)
    contours, _ = cv2.findContours(truth.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(shown, contours, -1, (0, 255, 0), 1)
    scale = min(TILE[0] / shown.shape[0], TILE[1] / shown.shape[1])
    shown = cv2.resize(shown, None, fx=scale, fy=scale)
    canvas = np.zeros((*TILE, 3), np.uint8)
    canvas[: shown.shape[0], : shown.shape[1]] = shown
    cv2.putText(canvas, text, (3, TILE[0] - 5), 0, 0.4, (0, 255, 255), 1)
    return canvas


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--sheet", type=Path, help="write a contact sheet here")
    arguments = parser.parse_args()
    drawn = json.loads(Path(__file__).with_name("tissue.json").read_text())
    tiles = []
    for name, folder in (("valid", "teeth_labelled"), ("triads", ".")):
        scores = []
        for key, entry in drawn.items():
            if not key.startswith(name):
                continue
            image = read(arguments.data / folder / f"{key}.jpg")
            size = image.shape[:2]
            valid = np.ones(size, bool)
            picture = image[..., ::-1].astype(np.float32) / 255
            dentition = read_photograph(picture, valid, key).dentition
            told = drawn_tissue(entry, np.zeros(size, np.uint8))
            known, truth, found = told != UNTOLD, told == 1, dentition.on_jaws_mask
            tooth = dentition.mask
            if not tooth.any():
                print(f"{key}: no teeth found")
                continue
            height = np.median([crown.height for crown in dentition.all_crowns])
            away = cv2.distanceTransform((~tooth).astype(np.uint8), cv2.DIST_L2, 5)
            near = (away < NEAR * height) & ~tooth & known
            iou = (found & truth & known).sum() / max(1, ((found | truth) & known).sum())
            taken = (near & found & ~truth).sum() / tooth.sum()
            lost = (near & truth & ~found).sum() / tooth.sum()
            scores.append((iou, taken, lost))
            if arguments.sheet:
                text = f"{key[-30:]} {100 * taken:.0f}/{100 * lost:.0f}"
                tiles.append(tile(image, found, truth, text))
        iou, taken, lost = np.array(scores).T
        print(
            f"{name}: {len(scores)} photographs, IoU median {np.median(iou):.3f}, 10th percentile "
            f"{np.quantile(iou, 0.1):.3f}; of the teeth's area {100 * taken.mean():.1f} % taken "
            f"(at most {100 * taken.max():.1f}), {100 * lost.mean():.1f} % lost "
            f"(at most {100 * lost.max():.1f})"
        )
    if arguments.sheet:
        tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % 6)
        rows = [np.hstack(tiles[k : k + 6]) for k in range(0, len(tiles), 6)]
        cv2.imwrite(str(arguments.sheet), np.vstack(rows))


if __name__ == "__main__":
    main()
