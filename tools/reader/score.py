"""How well the shipped reader does on photographs that it has not learned from.

    python tools/reader/score.py --data teeth_labelled [--split valid] [--sheet sheet.png]

Prints the overlap (IoU) of all teeth, crowns found at IoU .5, and, where numbers are known, jaws
and numbers by one photograph alone.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from pipeline.artifacts.dental.fdi import is_upper, permanent_of
from pipeline.artifacts.teeth import Crown, Dentition, filled
from stages.teeth.read import read_photograph

#: Crowns of fewer pixels are not counted on either side.
LEAST_PIXELS = 40
LEAST_SIDE = 60


def matched(
    dentition: Dentition, truth: npt.NDArray[np.uint8]
) -> Iterator[tuple[int, Crown | None]]:
    """Each true crown with the found one that overlaps it by at least half, and (0, crown) for each
    found one that overlaps none."""
    masks = [(crown, filled((crown,), dentition.size)) for crown in dentition.all_crowns]
    used: set[int] = set()
    for number in np.unique(truth)[1:]:
        mine = truth == number
        if mine.sum() < LEAST_PIXELS:
            continue
        best, best_iou = None, 0.5
        for k, (_, mask) in enumerate(masks):
            both = (mask & mine).sum()
            iou = both / max(1, (mask | mine).sum()) if both else 0.0
            if k not in used and iou >= best_iou:
                best, best_iou = k, iou
        if best is not None:
            used.add(best)
        yield int(number), None if best is None else masks[best][0]
    for k, (crown, mask) in enumerate(masks):
        if k not in used and mask.sum() >= LEAST_PIXELS:
            yield 0, crown


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--split", default="valid")
    parser.add_argument("--sheet", type=Path, help="write a contact sheet here")
    arguments = parser.parse_args()
    known = json.loads((arguments.data / "fdi.json").read_text())
    ious, seconds, tiles = [], [], []
    hit = missed = extra = 0
    jaws, places, sides = [], [], []
    for path in sorted((arguments.data / arguments.split).glob("*.png")):
        image = cv2.imread(str(path.with_suffix(".jpg")))
        truth = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if min(image.shape[:2]) < LEAST_SIDE:
            continue
        picture = image[..., ::-1].astype(np.float32) / 255
        started = time.perf_counter()
        valid = np.ones(truth.shape, bool)
        dentition = read_photograph(picture, valid, path.stem).dentition
        seconds.append(time.perf_counter() - started)
        mask = dentition.mask if dentition.all_crowns else np.zeros(truth.shape, bool)
        ious.append((mask & (truth > 0)).sum() / max(1, (mask | (truth > 0)).sum()))
        label = known.get(f"{arguments.split}/{path.stem}", {"fdi": {}, "unsure": []})
        for number, crown in matched(dentition, truth):
            hit += number > 0 and crown is not None
            missed += number > 0 and crown is None
            extra += number == 0
            tooth = label["fdi"].get(str(number))
            if tooth and crown is not None:
                jaws.append(is_upper(tooth) == (crown.jaw == "upper"))
                if number not in label["unsure"]:
                    places.append(tooth == crown.number)
                    sides.append(permanent_of(tooth) == permanent_of(crown.number or 1))
        if arguments.sheet:
            tiles.append(tile(image, dentition, f"{path.stem} {ious[-1]:.2f}"))
    f1 = 2 * hit / (2 * hit + missed + extra)
    print(
        f"{len(ious)} photographs: IoU median {np.median(ious):.3f}, 10th percentile "
        f"{np.quantile(ious, 0.1):.3f}; crowns F1 {f1:.3f} (precision {hit / (hit + extra):.3f}, "
        f"recall {hit / (hit + missed):.3f}); {np.median(seconds):.3f} s each"
    )
    print(
        f"jaw {np.mean(jaws):.3f} of {len(jaws)}; number {np.mean(places):.3f} of {len(places)} "
        f"(primary or permanent left open: {np.mean(sides):.3f})"
    )
    if arguments.sheet:
        rows = [np.hstack(tiles[k : k + 6]) for k in range(0, len(tiles) - len(tiles) % 6, 6)]
        cv2.imwrite(str(arguments.sheet), np.vstack(rows))


def tile(image: npt.NDArray[np.uint8], dentition: Dentition, text: str) -> npt.NDArray[np.uint8]:
    """A small picture with outlines and numbers."""
    size = (320, 220)
    scale = min(size[0] / image.shape[1], size[1] / image.shape[0])
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    canvas = np.zeros((size[1], size[0], 3), np.uint8)
    canvas[: small.shape[0], : small.shape[1]] = small
    for crown in dentition.all_crowns:
        colour = (0, 255, 0) if crown.jaw == "upper" else (0, 200, 255)
        cv2.polylines(canvas, [np.int32(crown.outline * scale)], True, colour, 1, cv2.LINE_AA)
        place = np.int32(crown.outline.mean(axis=0) * scale - [7, -4])
        ink = (0, 0, 255) if crown.doubt > 0.3 else (255, 0, 0)
        cv2.putText(canvas, str(crown.number), tuple(map(int, place)), 0, 0.33, ink, 1, cv2.LINE_AA)
    cv2.putText(canvas, f"{text} {dentition.kind}", (3, 214), 0, 0.35, (0, 255, 255), 1)
    return canvas


if __name__ == "__main__":
    main()
