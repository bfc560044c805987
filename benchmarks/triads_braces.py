"""The triads with braces drawn onto their teeth: for `triads.py --data`.

    python benchmarks/triads_braces.py --data DIR --runs RUNS --out OUT [--sorts steel,dark,tied]

Of the twelve patients one wears braces. Here the others do: a bracket stands on each crown and a
wire runs from one to the next, in 3D, as the scene of the patient's own run has it, and are drawn
into the three photographs with its cameras. RUNS/CASE are workspaces, run up to `init`; cases
without one, those of primary teeth, and those that wear braces are left out. Writes
OUT/triads/CASE__SORT/ with three photographs, as large as the run took them, and their truth.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import workspaces
from triads_data import SLOTS

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.dental.fdi import JAWS, is_primary, teeth_of
from pipeline.artifacts.views import View
from stages.dentition.working import labels_in_view
from stages.init.dental.numbering.colours import BAND
from stages.init.dental.surface.photos.braces import braces_in

Array = npt.NDArray[np.float64]
Picture = npt.NDArray[np.uint8]
#: Colours (sRGB) of a bracket, of what ties the wire to it, and of the wire.
SORTS = {
    "steel": ((155, 152, 150), (125, 122, 120), (178, 175, 175)),
    "dark": ((65, 60, 60), (28, 25, 25), (122, 120, 120)),
    "tied": ((155, 152, 150), (40, 90, 190), (178, 175, 175)),
}
#: Half width and height of a bracket, how far it stands out and is sunk in, and the wire's
#: thickness (mm).
HALF_WIDTH, HALF_HEIGHT, OUT, SUNK, WIRE = 1.6, 1.5, 2.1, 0.3, 0.45
#: A crown has a bracket if a photograph shows so many pixels of it, and a photograph shows it if
#: the crown's surface there is no nearer than this (mm).
LEAST_PIXELS, HIDDEN = 150, 2.0
#: Points are as wide as so many pixels.
AROUND = 5
#: Photographs are drawn so many times finer.
FINER = 2


@dataclass(frozen=True)
class Shown:
    """Attributes:
    view: the photograph; camera: its camera, in mm.
    labels: [H, W] FDI numbers; depth: [H, W] mm, 0 where unknown.
    """

    view: View
    camera: Camera
    labels: npt.NDArray[np.int32]
    depth: Array


@dataclass(frozen=True)
class Bracket:
    """Attributes: middle: [3] on the crown, mm; out, along, up: [3] unit vectors."""

    middle: Array
    out: Array
    along: Array
    up: Array

    def at(self, x: float, y: float, z: float) -> Array:
        """[3] a point, from -1 to 1 along and up, and mm before the crown."""
        return self.middle + x * HALF_WIDTH * self.along + y * HALF_HEIGHT * self.up + z * self.out


def photographs(workspace: Path) -> list[Shown]:
    """What a run has placed: right, frontal, left."""
    from pipeline.studies.register.visit import in_frame, scale_of

    views, cameras = workspaces.views(workspace), workspaces.load(workspace, "init", "cameras")
    teeth = workspaces.load(workspace, "init", "teeth").by_name()
    frame = np.asarray(cameras.input_from_world, np.float64)
    points = workspaces.load(workspace, "init", "points").positions
    shown = []
    for camera in cameras.cameras:
        view, dentition = views[camera.name], teeth[camera.name]
        numbers = [crown.number for crown in dentition.all_crowns]
        labels = labels_in_view(dentition, view, numbers)
        depth = scale_of(frame) * depth_of(points, camera)
        shown.append(Shown(view, in_frame(camera, frame), labels, depth))
    return shown


def depth_of(points: npt.NDArray[np.float32], camera: Camera) -> Array:
    """[H, W] depth of the nearest of points [N, 3] around each pixel; 0 where there is none."""
    pixels, depth = camera.project(points)
    x, y = np.floor(pixels).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height) & (depth > 0)
    nearest = np.full((camera.height, camera.width), np.inf)
    np.minimum.at(nearest, (y[inside], x[inside]), depth[inside])
    nearest = cv2.erode(nearest, np.ones((AROUND, AROUND)), borderType=cv2.BORDER_REPLICATE)
    return np.where(np.isfinite(nearest), nearest, 0)


def brackets_on(shown: list[Shown]) -> list[list[Bracket | None]]:
    """Of each jaw those of its teeth, from the patient's right; None where no crown is shown."""
    rows: list[list[Bracket | None]] = []
    for jaw in JAWS:
        middles: list[Array | None] = []
        for tooth in teeth_of(jaw):
            best = max(shown, key=lambda photo: int((photo.labels == tooth).sum()))
            crown = (best.labels == tooth) & (best.depth > 0)
            known = crown.sum() >= LEAST_PIXELS
            points = best.camera.unproject(best.depth.astype(np.float32))[crown] if known else None
            middles.append(None if points is None else np.median(points, axis=0))
        rows.append([_bracket(middles, k) for k in range(len(middles))])
    return rows


def _bracket(middles: list[Array | None], k: int) -> Bracket | None:
    middle = middles[k]
    near = [m for m in middles[max(k - 1, 0) : k + 2] if m is not None]
    if middle is None or len(near) < 2:
        return None
    up = np.array([0.0, 1.0, 0.0])
    along = near[-1] - near[0]
    along -= (along @ up) * up
    along /= np.linalg.norm(along)
    out = np.cross(along, up)
    return Bracket(middle, out, along, up)


def faces(bracket: Bracket, camera: Camera) -> Iterator[tuple[Array, Array]]:
    """Corners [4, 3] and normal [3] of the sides of a bracket that a camera looks at."""
    line = camera.centre - bracket.middle
    x, y, z = np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), np.array([0, 0, OUT])
    base = -SUNK / OUT
    for normal, middle, one, other, low in (
        (bracket.out, z, x, y, -1.0),
        (bracket.along, x, y, z, base),
        (-bracket.along, -x, y, z, base),
        (bracket.up, y, x, z, base),
        (-bracket.up, -y, x, z, base),
    ):
        if normal @ line > 0:
            corners = [(-1, low), (1, low), (1, 1), (-1, 1)]
            yield (
                np.array([bracket.at(*(middle + a * one + b * other)) for a, b in corners]),
                normal,
            )


def drawn(
    photo: Shown, rows: list[list[Bracket | None]], colours: tuple[tuple[int, ...], ...]
) -> Picture:
    """[H, W, 3] uint8 RGB: the photograph with braces."""
    body, tie, wire = (np.array(colour, np.float64) for colour in colours)
    camera = photo.camera
    pieces: list[tuple[float, Array, Array, bool]] = []  # distance, points, colour, line

    def add(points: Array, colour: Array, nearer: float = 0.0, line: bool = False) -> None:
        distance = float(np.linalg.norm(points.mean(0) - camera.centre)) - nearer
        pieces.append((distance, points, np.clip(colour, 0, 255), line))

    for row in rows:
        seen = [b if b is not None and _sees(photo, b) else None for b in row]
        for bracket in filter(None, seen):
            line = camera.centre - bracket.middle
            line /= np.linalg.norm(line)
            for corners, normal in faces(bracket, camera):
                add(corners, body * (0.45 + 0.75 * (normal @ line) ** 2))
            for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
                wing = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
                square = [bracket.at(0.55 * x + 0.3 * a, 0.55 * y + 0.3 * b, OUT) for a, b in wing]
                add(np.array(square), tie, 0.1)
        placed = [bracket for bracket in seen if bracket is not None]
        for first, second in pairwise(placed):
            ends = np.array([first.at(0, 0, 0.8 * OUT), second.at(0, 0, 0.8 * OUT)])
            add(ends, wire, OUT, line=True)
    picture = np.rint(photo.view.image * 255).astype(np.uint8)
    size = FINER * photo.view.width, FINER * photo.view.height
    large = np.ascontiguousarray(cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC))
    for distance, points, colour, line in sorted(pieces, key=lambda piece: -piece[0]):
        pixels = np.rint(FINER * camera.project(points)[0]).astype(np.int32)
        ink = tuple(float(channel) for channel in colour)
        if line:
            thick = max(round(FINER * WIRE * camera.fx / distance), 1)
            cv2.line(large, tuple(pixels[0]), tuple(pixels[1]), ink, thick, cv2.LINE_AA)
        else:
            cv2.fillConvexPoly(large, cv2.convexHull(pixels), ink, cv2.LINE_AA)
    return np.asarray(cv2.resize(large, picture.shape[1::-1], interpolation=cv2.INTER_AREA))


def _sees(photo: Shown, bracket: Bracket) -> bool:
    """Whether a photograph shows a bracket, if only its flank."""
    front = bracket.at(0, 0, OUT)
    line = photo.camera.centre - front
    if line @ bracket.out < -0.2 * np.linalg.norm(line):
        return False
    pixel, distance = photo.camera.project(front[None])
    x, y = (int(value) for value in pixel[0])
    height, width = photo.depth.shape
    if not (0 <= x < width and 0 <= y < height):
        return False
    there = float(photo.depth[y, x])
    return there == 0 or there > float(distance[0]) - HIDDEN


def main() -> None:
    """Draw them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder with triads/")
    parser.add_argument("--runs", type=Path, required=True, help="workspaces named as the cases")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--sorts", default=",".join(SORTS))
    args = parser.parse_args()
    for case in sorted((args.data / "triads").iterdir()):
        if not (args.runs / case.name).is_dir():
            print(f"{case.name}: no run", flush=True)
            continue
        shown = photographs(args.runs / case.name)
        numbers = {int(number) for photo in shown for number in np.unique(photo.labels) if number}
        teeth = workspaces.load(args.runs / case.name, "init", "teeth").by_name()
        densities = [teeth[photo.view.name].band_height / BAND for photo in shown]
        crowns, pictures = [p.labels > 0 for p in shown], [p.view.image for p in shown]
        if any(map(is_primary, numbers)) or braces_in(pictures, crowns, densities):
            print(f"{case.name}: primary teeth, or braces", flush=True)
            continue
        rows = brackets_on(shown)
        for sort in args.sorts.split(","):
            folder = args.out / "triads" / f"{case.name}__{sort}"
            folder.mkdir(parents=True, exist_ok=True)
            shutil.copy(case / "truth.json", folder)
            for slot, photo in zip(SLOTS, shown, strict=True):
                picture = drawn(photo, rows, SORTS[sort])
                file = str(folder / f"{slot}.jpg")
                cv2.imwrite(file, picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
        print(case.name, flush=True)


if __name__ == "__main__":
    main()
