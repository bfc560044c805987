"""Where a photograph of one visit shows the spots that a photograph of the other shows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.studies.register.visit import Floats, Labels, Look

Array = npt.NDArray[np.float64]

#: Window of the local contrast, pixels of a picture 512 wide.
CONTRAST = 4.0
#: Highlights: brighter than what is beside them by this (0..1), and half as wide (pixels) at most.
SHINE, SHINE_SIZE = 0.08, 6
#: Pixels around a crown that move with it when pictures are laid over each other.
AROUND = 14
#: So many pixels inside its outline a crown's own surface is sure to be what moves: at the outline
#: itself, gum and neighbours cover and uncover it.
INSET = 4.0
#: The middle of an outline is off by so many pixels of a picture 512 wide.
OUTLINE = 2.0
#: What is not compared, in pictures of local contrast.
GREY = np.uint8(128)
#: Contrast beyond this (squared, structure tensor) says no more: single edges must not decide.
MOST_CONTRAST = 0.01
#: What lies so far behind the nearest surface is hidden, mm.
HIDDEN = 1.2
#: Least correlation of a spot's surroundings, and their half width in pixels.
LEAST_LIKENESS, WINDOW = 0.5, 7
#: Every so many pixels of a crown are used.
STRIDE = 2
#: A crown needs so many of them in a pair of photographs, and so many are enough.
LEAST_SPOTS, MOST_SPOTS = 25, 150


@dataclass(frozen=True)
class Spots:
    """Spots of one tooth in a pair of photographs.

    Attributes:
        tooth: FDI number.
        first, second: indices of the photographs, of the first and the second visit.
        points: [N, 3] in the frame of the first visit as it was then, mm.
        pixels: [N, 2] where the second visit's photograph shows them.
        information: [N, 2, 2] inverse covariance of `pixels` but for a common factor: contrast.
        likeness: correlation of the surroundings, median over all of the crown's visible pixels.
        seen: how many pixels that is.
    """

    tooth: int
    first: int
    second: int
    points: Array
    pixels: Array
    information: Array
    likeness: float
    seen: int


def pairs_of(
    first: list[Camera], second: list[Camera], most: int, widest: float
) -> list[tuple[int, int]]:
    """Which photographs are compared: for each of either visit the nearest by viewing direction.

    Args:
        first, second: cameras in one frame.
        most: partners of each photograph.
        widest: degrees between viewing directions at most (but one partner each at least).
    """
    axes_a, axes_b = (np.array([c.rotation[2] for c in cameras]) for cameras in (first, second))
    angle = np.degrees(np.arccos(np.clip(axes_a @ axes_b.T, -1, 1)))
    found = set()
    for table, turned in ((angle, False), (angle.T, True)):
        for i, row in enumerate(table):
            for rank, j in enumerate(np.argsort(row, kind="stable")[:most]):
                if row[j] <= widest or (rank == 0 and row[j] <= 2 * widest):
                    found.add((int(j), i) if turned else (i, int(j)))
    return sorted(found)


@dataclass(frozen=True)
class Prepared:
    """A photograph ready to be compared: what stays the same whatever it is compared with.

    Attributes:
        look: the photograph.
        contrast: [H, W] uint8, locally normalised.
        owner: [H, W] uint8 the tooth whose motion a pixel shares, 0: none's.
        core: [H, W] uint8 the tooth well inside whose crown a pixel lies.
        tensor: [H, W, 2, 2] structure tensor of `contrast`.
    """

    look: Look
    contrast: npt.NDArray[np.uint8]
    owner: Labels
    core: Labels
    tensor: Floats


def prepare(look: Look) -> Prepared:
    """Get a photograph ready (see `Prepared`)."""
    from stages.flow.estimate import local_contrast

    scale = max(look.image.shape) / 512
    dull, shiny = without_shine(look.without_hardware, scale)
    gray = np.clip(np.rint(dull * 255), 0, 255).astype(np.uint8)
    contrast = local_contrast(gray, CONTRAST * scale)
    labels = look.enamel
    distance, nearest = cv2.distanceTransformWithLabels(
        (labels == 0).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.zeros(int(nearest.max()) + 1, np.uint8)
    of_label[nearest[labels > 0]] = labels[labels > 0]
    owner = np.where(distance <= AROUND * scale, of_label[nearest], 0).astype(np.uint8)
    core = cores(look, shiny, inside_crowns(labels))
    return Prepared(look, contrast, owner, core, structure(contrast))


def inside_crowns(labels: Labels) -> Floats:
    """[H, W] pixels from each pixel of a crown to where the crown ends; 0 beside crowns."""
    found = np.zeros(labels.shape, np.float32)
    for number in (int(n) for n in np.unique(labels) if n):
        crown = (labels == number).astype(np.uint8)
        x, y, width, height = cv2.boundingRect(crown)
        around = slice(max(y - 1, 0), y + height + 1), slice(max(x - 1, 0), x + width + 1)
        found[around] += cv2.distanceTransform(crown[around], cv2.DIST_L2, 5)
    return found


def cores(look: Look, shiny: npt.NDArray[np.bool_], inside: Floats) -> Labels:
    """[H, W] the tooth well inside whose crown a pixel lies, where its depth is known.

    Args:
        look: the photograph.
        shiny: [H, W] highlights.
        inside: [H, W] see `inside_crowns`.
    """
    sure = (inside > INSET * max(inside.shape) / 512) & (look.depth > 0) & look.valid & ~shiny
    return np.where(sure, look.enamel, 0).astype(np.uint8)


def without_shine(image: Floats, scale: float) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """A grey picture [H, W] in 0..1 without highlights, and [H, W] where there were some.

    Highlights stay with the light, not with the tooth. They are narrow and bright: what an opening
    takes away.

    Args:
        scale: pixels per pixel of a picture 512 wide.
    """
    size = 2 * round(SHINE_SIZE * scale) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    smooth = cv2.GaussianBlur(image, (0, 0), 0.7)
    opened = cv2.morphologyEx(smooth, cv2.MORPH_OPEN, kernel)
    shiny = cv2.dilate((smooth - opened > SHINE).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    dull = np.where(shiny, cv2.GaussianBlur(opened, (0, 0), 1.5), image)
    return np.asarray(dull, np.float32), shiny


def structure(contrast: npt.NDArray[np.uint8]) -> Floats:
    """[H, W, 2, 2] structure tensor of a picture [H, W], over about 5 pixels."""
    image = contrast.astype(np.float32) / 40
    dx = cv2.Scharr(image, cv2.CV_32F, 1, 0) / 32
    dy = cv2.Scharr(image, cv2.CV_32F, 0, 1) / 32
    xx, xy, yy = (cv2.GaussianBlur(p, (0, 0), 1.2) for p in (dx * dx, dx * dy, dy * dy))
    tensor = np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)
    return np.asarray(tensor / (1 + (xx + yy) / MOST_CONTRAST)[..., None, None], np.float32)


def spots_between(
    a: Prepared, b: Prepared, camera: Camera, motions: Mapping[int, Array], first: int, second: int
) -> list[Spots]:
    """Find the spots of one photograph in another, tooth by tooth.

    The second photograph is laid over the first by the first's depth, the cameras and what the
    teeth are thought to have done; what is left is found by optical flow (DIS) on local contrast.

    Args:
        a, b: photographs of the first and the second visit.
        camera: of b, in the frame of a's visit, mm.
        motions: FDI number -> [4, 4] what the tooth did, in that frame; identity where missing.
        first, second: indices of the photographs.
    """
    height, width = a.contrast.shape
    world = a.look.points
    table = np.tile(np.eye(4)[:3], (256, 1, 1))
    for number, matrix in motions.items():
        table[number] = matrix[:3]
    each = table[a.owner]  # [H, W, 3, 4]
    moved = (each[..., :3] @ world[..., None])[..., 0] + each[..., 3]
    known = a.look.depth > 0
    pixels, z = camera.project(moved.reshape(-1, 3))
    pixels, z = pixels.reshape(height, width, 2), z.reshape(height, width)
    inside = known & (z > 1) & camera.shows(pixels, z)
    x, y = np.moveaxis((pixels - 0.5).astype(np.float32), -1, 0)
    laid = cv2.remap(b.contrast, x, y, cv2.INTER_LINEAR)
    # Outlines, gum and highlights move in ways of their own: only what both photographs show well
    # inside a crown is compared, everything else is the same grey in both.
    common = inside & (a.core > 0) & (cv2.remap(b.core, x, y, cv2.INTER_NEAREST) > 0)
    one, other = np.where(common, a.contrast, GREY), np.where(common, laid, GREY)
    flow = _dis().calc(one, other, None)
    own_y, own_x = np.mgrid[:height, :width].astype(np.float32)
    to_x, to_y = own_x + flow[..., 0], own_y + flow[..., 1]
    found = np.stack([cv2.remap(part, to_x, to_y, cv2.INTER_LINEAR) for part in (x, y)], -1)
    carried = np.asarray(cv2.remap(other, to_x, to_y, cv2.INTER_LINEAR), np.uint8)
    likeness = correlation(one, carried)
    visible = common & ~hidden(pixels, z, inside, camera)
    column, row = (np.clip(found[..., k].round().astype(int), 0, size - 1)
                   for k, size in ((0, camera.width), (1, camera.height)))  # fmt: skip
    there = b.look.enamel[row, column]
    visible &= b.look.valid[row, column]
    result = []
    for number in (int(n) for n in np.unique(a.core[visible]) if n):
        crown = visible & (a.core == number)
        names = there[crown]
        if len(names) < LEAST_SPOTS or not names.any():
            continue
        # Numbers may differ between visits; crowns don't.
        crown &= there == np.bincount(names[names > 0]).argmax()
        seen = int(crown.sum())
        typical = float(np.median(likeness[crown])) if seen else -1.0
        crown &= likeness > LEAST_LIKENESS
        crown[np.arange(height) % STRIDE != 0] = False
        crown[:, np.arange(width) % STRIDE != 0] = False
        if crown.sum() < LEAST_SPOTS:
            if seen >= LEAST_SPOTS * STRIDE**2:
                result.append(_none(number, first, second, typical, seen))
            continue
        # A spot's error in b: the flow's, carried over by how b's picture is turned and stretched.
        count = int(crown.sum())
        flat = np.column_stack([own_x[crown], own_y[crown], np.ones(count)]).astype(np.float64)
        goal = np.column_stack([x[crown], y[crown]]).astype(np.float64)
        turn = np.linalg.lstsq(flat, goal, rcond=None)[0][:2].T
        if abs(np.linalg.det(turn)) < 0.05:
            continue
        inverse = np.linalg.inv(turn)
        information = inverse.T @ a.tensor[crown].astype(np.float64) @ inverse
        every = np.linspace(0, len(information) - 1, min(len(information), MOST_SPOTS)).astype(int)
        result.append(
            Spots(
                number, first, second, world[crown][every],
                found[crown][every].astype(np.float64) + 0.5,
                information[every] * (len(information) / len(every)), typical, seen,
            )
        )  # fmt: skip
    return result


def outlines_between(
    a: Prepared, b: Prepared, camera: Camera, motions: Mapping[int, Array], first: int, second: int
) -> list[Spots]:
    """Where crowns of one photograph are in another by their outlines alone: a start.

    Each crown goes as a whole to where the middle of the crown with its number is.

    Args:
        a, b, camera, motions, first, second: see `spots_between`.
    """
    found = []
    height, width = b.look.labels.shape
    for number in (int(n) for n in np.unique(a.look.labels) if n):
        mine = (a.look.labels == number) & (a.look.depth > 0)
        theirs = b.look.labels == number
        if mine.sum() < LEAST_SPOTS or theirs.sum() < LEAST_SPOTS:
            continue
        points = a.look.points[mine]
        points = points[np.linspace(0, len(points) - 1, LEAST_SPOTS).astype(int)]
        motion = motions.get(number, np.eye(4))
        pixels, _ = camera.project(points @ motion[:3, :3].T + motion[:3, 3])
        row, column = np.nonzero(theirs)
        if (
            row.min() == 0
            or column.min() == 0
            or row.max() == height - 1
            or column.max() == width - 1
        ):
            continue  # cut by the border: its middle is not the crown's
        middle = np.array([column.mean(), row.mean()]) + 0.5
        shift = middle - pixels.mean(0)
        if np.linalg.norm(shift) > 0.6 * np.sqrt(theirs.sum()):
            continue  # more than half a crown: another one's number
        size = OUTLINE * max(b.look.labels.shape) / 512
        information = np.tile(np.eye(2) / size**2 / len(points), (len(points), 1, 1))
        found.append(Spots(number, first, second, points, pixels + shift, information, 0.0, 0))
    return found


def _none(number: int, first: int, second: int, likeness: float, seen: int) -> Spots:
    """A crown that both photographs should show, without a spot that they share."""
    return Spots(
        number, first, second, np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 2, 2)), likeness,
        seen,
    )  # fmt: skip


def _dis() -> Any:
    made = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    made.setFinestScale(0)
    return made


def correlation(first: npt.NDArray[np.uint8], second: npt.NDArray[np.uint8]) -> Floats:
    """[H, W] correlation of the surroundings of each pixel of two pictures, -1..1."""
    a, b = first.astype(np.float32) - 128, second.astype(np.float32) - 128
    size = (2 * WINDOW + 1, 2 * WINDOW + 1)
    ma, mb = cv2.blur(a, size), cv2.blur(b, size)
    va, vb = cv2.blur(a * a, size) - ma * ma, cv2.blur(b * b, size) - mb * mb
    joint = cv2.blur(a * b, size) - ma * mb
    return np.asarray(joint / np.sqrt(np.maximum(va, 1) * np.maximum(vb, 1)), np.float32)


def hidden(
    pixels: Array, z: Array, known: npt.NDArray[np.bool_], camera: Camera
) -> npt.NDArray[np.bool_]:
    """[H, W] where the surface at `pixels` [H, W, 2], `z` [H, W] lies behind another part of it."""
    cell = 3
    size = (camera.height // cell + 1, camera.width // cell + 1)
    row, column = ((pixels[..., k] // cell).astype(int) for k in (1, 0))
    row, column = np.clip(row, 0, size[0] - 1), np.clip(column, 0, size[1] - 1)
    nearest = np.full(size, np.inf)
    np.minimum.at(nearest, (row[known], column[known]), z[known])
    return np.asarray(z > nearest[row, column] + HIDDEN)
