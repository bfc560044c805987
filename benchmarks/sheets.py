"""Sheets of three photographs: how many are cut right, and which single photographs are cut.

    python benchmarks/sheets.py --data DIR

Puts the photographs of each of `DIR/triads` on sheets: in rows and columns with bands of several
widths and colours or none, as a pyramid, on slides with a title, with round corners, shadows and
gradients, in a window with a sidebar; each at several JPEG qualities. Then looks for sheets among
all single photographs of `DIR`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # stages

from stages.views.sheets import photographs_in

Picture = npt.NDArray[np.uint8]

QUALITIES = (95, 70, 40)
SINGLE = ("triads/*/*.jpg", "series/*/*.jpg", "teeth_labelled/*/*.jpg", "dental_photos_a/images/*",
          "castle/images/*", "berlin/images/*", "scan_video_a/frames/*")  # fmt: skip
WHITE, BLACK = 255, 0


def filling(picture: Picture, width: int, height: int) -> Picture:
    """The middle of a picture at a size."""
    scale = max(width / picture.shape[1], height / picture.shape[0])
    size = [
        max(least, round(n * scale))
        for n, least in zip(picture.shape[1::-1], (width, height), strict=True)
    ]
    large = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    top, left = (large.shape[0] - height) // 2, (large.shape[1] - width) // 2
    return np.asarray(large[top : top + height, left : left + width])


def grid(rows: Sequence[Sequence[Picture]], band: int, grey: int, rim: int = 0) -> Picture:
    """Pictures of one size in rows, each in the middle, with bands between and around them."""
    height, width = rows[0][0].shape[:2]
    across = max(len(row) for row in rows) * (width + band) - band
    sheet = np.full((len(rows) * (height + band) - band, across, 3), grey, np.uint8)
    for i, row in enumerate(rows):
        start = (across - len(row) * (width + band) + band) // 2
        for j, picture in enumerate(row):
            top, left = i * (height + band), start + j * (width + band)
            sheet[top : top + height, left : left + width] = picture
    return np.asarray(
        cv2.copyMakeBorder(sheet, rim, rim, rim, rim, cv2.BORDER_CONSTANT, value=(grey,) * 3)
    )


def slide(
    pictures: Sequence[Picture], *, title: bool = False, round_corners: bool = False,
    shadows: bool = False, gradient: bool = False, sidebar: bool = False,
) -> Picture:  # fmt: skip
    """Three pictures side by side on a slide or in a window of 1920 x 1080 pixels."""
    blank = np.full((1080, 1920, 3), 40 if sidebar else WHITE, np.uint8)
    width, start, step = (500, 330, 525) if sidebar else (560, 40, 620)
    if gradient:
        blank[:] = np.linspace(120, 250, 1920).astype(np.uint8)[None, :, None]
    if title:
        cv2.putText(blank, "Right, front, left: 12.03.", (300, 120), 0, 2.5, (30, 30, 30), 5)
    for line in range(12 if sidebar else 0):
        cv2.putText(blank, f"Case {line}", (20, 90 + 60 * line), 0, 1, (220, 220, 220), 2)
    page = blank.astype(np.float32)
    for k, picture in enumerate(pictures):
        cell = filling(picture, width, width * 3 // 4)
        height, left, top = cell.shape[0], start + k * step, 330
        shape = np.zeros(page.shape[:2], np.float32)
        shape[top : top + height, left : left + width] = 1
        if shadows:
            shade = cv2.GaussianBlur(np.roll(shape, (8, 8), (0, 1)), (0, 0), 6)
            page *= 1 - 0.4 * shade[..., None]
        if round_corners:
            ellipse = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (49, 49))
            shape = cv2.morphologyEx(shape, cv2.MORPH_OPEN, ellipse)
        inside = shape[top : top + height, left : left + width, None]
        place = page[top : top + height, left : left + width]
        place[:] = place * (1 - inside) + cell * inside
    return page.astype(np.uint8)


def in_cells(make: Callable[..., Picture]) -> Callable[[Sequence[Picture]], Picture]:
    """`make` of the pictures at one size."""
    return lambda pictures: make(*(filling(picture, 640, 480) for picture in pictures))


#: Name -> what makes the sheet.
LAYOUTS: dict[str, Callable[[Sequence[Picture]], Picture]] = {
    "row, bands of 2": in_cells(lambda *p: grid([p], 2, WHITE)),
    "row, black bands of 6": in_cells(lambda *p: grid([p], 6, BLACK)),
    "row, bands of 20 and around": in_cells(lambda *p: grid([p], 20, WHITE, rim=20)),
    "row, touching": in_cells(lambda *p: grid([p], 0, WHITE)),
    "column, black bands of 5": in_cells(lambda *p: grid([[q] for q in p], 5, BLACK)),
    "column, touching": in_cells(lambda *p: grid([[q] for q in p], 0, BLACK)),
    "pyramid": in_cells(lambda r, f, l: grid([[f], [r, l]], 8, WHITE)),
    "slide with a title": lambda p: slide(p, title=True),
    "slide, round corners": lambda p: slide(p, round_corners=True),
    "slide, shadows": lambda p: slide(p, shadows=True),
    "slide, gradient": lambda p: slide(p, gradient=True),
    "window with a sidebar": lambda p: slide(p, sidebar=True),
}


def triads(data: Path) -> Iterator[list[Picture]]:
    for folder in sorted((data / "triads").iterdir()):
        if folder.is_dir():
            yield [np.asarray(cv2.imread(str(path))) for path in sorted(folder.glob("*.jpg"))]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    data = parser.parse_args().data
    cases = list(triads(data))
    for name, make in LAYOUTS.items():
        cut = total = 0
        for pictures in cases:
            sheet = make(pictures)
            for quality in QUALITIES:
                packed = cv2.imencode(".jpg", sheet, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
                decoded = np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR))
                cut += len(photographs_in(decoded)) == len(pictures)
                total += 1
        print(f"{name:28} of {total} cut into three: {cut}")
    paths = [path for pattern in SINGLE for path in sorted(data.glob(pattern))]
    counts: list[int] = []
    borders = 0
    for path in paths:
        single = cv2.imread(str(path))
        if single is None:
            continue
        found = photographs_in(np.asarray(single))
        counts.append(len(found))
        borders += len(found) == 1 and found[0] != (0, 0, *single.shape[:2])
    cut = sum(count > 1 for count in counts)
    print(f"{len(counts)} single photographs: {cut} cut, {borders} less a border")


if __name__ == "__main__":
    main()
