"""Photometric refinement of a camera before a finished scene: the Gaussians stay as they are.

InstantSplat and CF-3DGS do this for test photographs by several hundred steps of Adam. The
objective here is theirs (mean absolute colour error where something is rendered, the best pose
kept); it is minimised by reweighted Gauss-Newton steps over an image pyramid, which take a tenth of
the renders. The derivative by the six motions of the camera is a difference of renders.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.geometry.rigid import moved_by
from pipeline.kernels import kernel

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]
Bools = npt.NDArray[np.bool_]

#: Motion of the picture, in pixels, that a derivative is the difference over.
_PROBE = 0.3
#: Sides of a picture that still tells something, in pixels.
SMALLEST_SIDE = 16
#: Errors below this count squared: half a step of 8 bits.
_SMALLEST_ERROR = 0.002
#: Damping of the steps, as a share of the mean curvature, and by what it grows and shrinks. A turn
#: and a shift that undo each other hardly show: without damping they run away.
_DAMPING, _GROWTH, _MOST_DAMPING = 0.03, 5.0, 1e4
#: It never gets less than this.
_LEAST_DAMPING = 1e-4
#: Sizes, coarse to fine, as divisors of the full size. In pictures coarser than `_SHIFTS_FROM` the
#: camera only turns: a shift looks like a turn there, and both together run away.
_FACTORS, _SHIFTS_FROM = (8, 4, 2, 1), 2
#: Gauss-Newton steps at each size. The last one moves the picture by less than so many pixels, or
#: lessens the error by less than such a share.
_STEPS, _TOLERANCE, _LEAST_GAIN = 20, 0.01, 2e-4
#: The pyramid is gone through again, at most so often, while that lessens the error by a share.
_ROUNDS, _ROUND_GAIN = 5, 0.05
#: Alpha above which something is rendered, and the share of what is at the start that must stay.
_RENDERED, _LEAST_COVERED = 0.5, 0.8


class Picture(Protocol):
    """What a renderer returns."""

    @property
    def image(self) -> Floats:
        """[H, W, 3]."""

    @property
    def alpha(self) -> Floats:
        """[H, W]."""


@dataclass(frozen=True)
class Refined:
    """Attributes:
    camera: with the best pose.
    before, after: mean absolute error where something is rendered, in 0..1.
    renders: how many pictures were rendered.
    """

    camera: Camera
    before: float
    after: float
    renders: int


class _Level:
    """One size of the photograph."""

    def __init__(
        self, render: Callable[[Camera], Picture], photo: Floats, valid: Bools, camera: Camera,
        factor: int,
    ) -> None:  # fmt: skip
        width, height = max(1, camera.width // factor), max(1, camera.height // factor)
        self.size = (width, height)
        self.blurred = factor > 1
        #: motions that are solved for: shifts are the first three, turns the others
        self.motions = range(6) if factor <= _SHIFTS_FROM else range(3, 6)
        self.draw = render
        self.renders = 0
        share = cv2.resize(valid.astype(np.float32), self.size, interpolation=cv2.INTER_AREA)
        self.valid = np.asarray(share > 0.99)
        small = cv2.resize(photo, self.size, interpolation=cv2.INTER_AREA)
        self.photo = self._smooth(np.asarray(small, np.float32))

    def _smooth(self, image: Floats) -> Floats:
        """Coarse pictures are blurred: their slopes must reach farther than a pixel."""
        if not self.blurred:
            return image
        return np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0), np.float32)

    def render(self, camera: Camera) -> tuple[Floats, Bools]:
        """The picture [H, W, 3], and where [H, W] it is compared."""
        self.renders += 1
        picture = self.draw(camera.resized(*self.size))
        seen = np.asarray(picture.alpha) > _RENDERED
        return self._smooth(np.clip(picture.image, 0, 1)), self.valid & seen

    def error(self, image: Floats, counted: Bools) -> float:
        if not counted.any():
            return np.inf
        return float(np.abs(image - self.photo)[counted].mean(dtype=np.float64))


def refine_camera(
    render: Callable[[Camera], Picture],
    photo: Floats,
    valid: Bools,
    camera: Camera,
    depth: float,
) -> Refined:
    """Move a camera so that its picture of the scene is most like the photograph.

    Args:
        render: draws the scene as a camera sees it, at the camera's size.
        photo: [H, W, 3] float32 in 0..1; valid: [H, W] pixels that count.
        camera: to start from, of the photograph's size.
        depth: of the scene before it, in world units: translations are relative to it.
    """
    full = _Level(render, photo, valid, camera, 1)
    image, counted = full.render(camera)
    before, covered = full.error(image, counted), int(counted.sum())
    best, least, renders = camera, before, 1
    levels = [_Level(render, photo, valid, camera, factor) for factor in _FACTORS]
    last = np.inf
    for level in levels * _ROUNDS:
        if level is levels[0]:
            if least > (1 - _ROUND_GAIN) * last:
                break
            last = least
        if min(level.size) < SMALLEST_SIDE:
            continue
        # a coarse picture's best is not quite the sharp one's: it is left where that is no better
        found = _descend(level, best, depth)
        image, counted = full.render(found)
        error = full.error(image, counted)
        renders += 1
        if error < least and counted.sum() >= _LEAST_COVERED * covered:
            best, least = found, error
    renders += sum(level.renders for level in levels)
    return Refined(best, before, least, renders)


def _descend(level: _Level, camera: Camera, depth: float) -> Camera:
    """Damped Gauss-Newton steps on the reweighted squares at one size.

    The derivative serves for several steps, until one of them does not help.
    """
    image, counted = level.render(camera)
    error, covered = level.error(image, counted), int(counted.sum())
    # what moves the picture by about a pixel: shifts in the first three, turns in the others
    pixel = camera.width / (level.size[0] * camera.fx)
    unit = np.array([depth, depth, depth, 1, 1, 1]) * pixel
    damping, slopes, fresh = _DAMPING, None, False
    for _ in range(_STEPS):
        if not np.isfinite(error):
            break
        if slopes is None:
            slopes, fresh = _slopes(level, camera, image, unit), True
        matrix, vector = normal_equations(slopes, image - level.photo, counted)
        ridge = damping * float(np.trace(matrix)) / len(vector) + 1e-12
        step = np.zeros(6)
        step[level.motions] = -np.linalg.solve(matrix + ridge * np.eye(len(vector)), vector)
        moved = replace(camera, cam_from_world=moved_by(step * unit, camera.cam_from_world))
        trial, seen = level.render(moved)
        value = level.error(trial, seen)
        if value < error and seen.sum() >= _LEAST_COVERED * covered:
            gain = 1 - value / error
            camera, image, counted, error = moved, trial, seen, value
            damping, fresh = max(damping / _GROWTH, _LEAST_DAMPING), False
            if np.abs(step).max() < _TOLERANCE or gain < _LEAST_GAIN:
                break
        elif not fresh:
            slopes = None
        else:
            damping *= _GROWTH
            if damping > _MOST_DAMPING or np.abs(step).max() < _TOLERANCE:
                break
    return camera


def _slopes(level: _Level, camera: Camera, image: Floats, unit: Array) -> list[Floats]:
    """Pictures [H, W, 3]: change by each motion of the camera, per `unit`."""
    slopes = []
    for index in level.motions:
        twist = np.zeros(6)
        twist[index] = _PROBE * unit[index]
        moved = replace(camera, cam_from_world=moved_by(twist, camera.cam_from_world))
        probe, _ = level.render(moved)
        slopes.append((probe - image) / np.float32(_PROBE))
    return slopes


def normal_equations(slopes: list[Floats], residual: Floats, counted: Bools) -> tuple[Array, Array]:
    """[M, M] and [M] of the step that lessens the weighted squares most.

    Args:
        slopes: M pictures [H, W, 3], change of the render by each motion.
        residual: [H, W, 3] render less photograph; a pixel's weight is the inverse of its size.
        counted: [H, W] pixels that are compared.
    """
    size = len(slopes) + 1
    pictures, sums = np.stack([*slopes, residual]), np.zeros((size, size))
    _add_products(
        pictures.reshape(*pictures.shape[:2], -1), counted, np.float32(_SMALLEST_ERROR), sums
    )
    sums = np.tril(sums) + np.tril(sums, -1).T
    return sums[:-1, :-1], sums[:-1, -1]


@kernel(fastmath=True, nogil=True)
def _add_products(pictures: Floats, counted: Bools, smallest: np.float32, sums: Array) -> None:
    """Add the sums of products of every two pictures over the size of the last one.

    Args:
        pictures: [M, H, W * 3], the last one the errors.
        counted: [H, W] pixels that are summed over.
        smallest: errors count as at least so large.
        sums: [M, M], whose lower half is added to.
    """
    number, height, width = pictures.shape
    weighted = np.empty(width, np.float32)
    weight = np.empty(width, np.float32)
    for y in range(height):
        for x in range(width):
            error = max(abs(pictures[number - 1, y, x]), smallest)
            weight[x] = 1 / error if counted[y, x // 3] else np.float32(0)
        for a in range(number):
            weighted[:] = pictures[a, y] * weight
            for b in range(a + 1):
                total = np.float32(0)
                for x in range(width):
                    total += weighted[x] * pictures[b, y, x]
                sums[a, b] += total
