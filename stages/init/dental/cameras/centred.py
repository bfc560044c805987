"""Photographs as a camera would have taken them whose principal point is the middle.

The dental path knows one focal length per photograph and a principal point in its middle. Known
cameras may have it elsewhere, or pixels that are not square: the photograph is shifted (onto a
larger canvas, nothing is cut off) and stretched in height, and what is found comes back the same
way. Depths along the optical axis don't change on the way.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.views import View
from pipeline.geometry.models.known_cameras import resampled

Array = npt.NDArray[np.float64]
Map = npt.NDArray[np.float32]

#: A principal point this near the middle (pixels) and pixels this near to squares stay as they are.
NEGLIGIBLE_SHIFT, NEGLIGIBLE_STRETCH = 0.01, 1e-5


@dataclass(frozen=True)
class CentredView:
    """A photograph, centred.

    Attributes:
        view: its image and mask; the principal point is the middle of the image.
        focal: pixels.
        centred_from_view: [3, 3] affine map of pixels (centres at .5) from the photograph as it
            was; shift and stretch along the axes only.
    """

    view: View
    focal: float
    centred_from_view: Array

    def point(self, x: float, y: float) -> tuple[float, float]:
        """A pixel of the photograph in the centred one."""
        moved = self.centred_from_view @ (x, y, 1.0)
        return float(moved[0]), float(moved[1])

    def back(self, values: Map, width: int, height: int) -> Map:
        """Maps [H, W(, C)] of the centred photograph on the pixels of the photograph: the nearest,
        so that nothing is averaged across the edge of a tooth."""
        scale, shift = np.diag(self.centred_from_view)[:2], self.centred_from_view[:2, 2]
        x = scale[0] * (np.arange(width) + 0.5) + shift[0] - 0.5
        y = scale[1] * (np.arange(height) + 0.5) + shift[1] - 0.5
        columns = np.clip(np.rint(x).astype(np.int64), 0, values.shape[1] - 1)
        rows = np.clip(np.rint(y).astype(np.int64), 0, values.shape[0] - 1)
        return np.ascontiguousarray(values[np.ix_(rows, columns)])

    def forth(self, values: Map) -> Map:
        """A map [H, W] of the photograph on the centred one, 0 beyond it: the nearest as well."""
        size = self.view.width, self.view.height
        affine = self.centred_from_view.copy()
        affine[:2, 2] += np.diag(affine)[:2] / 2 - 0.5  # OpenCV has pixel centres at 0
        return np.asarray(cv2.warpAffine(values, affine[:2], size, flags=cv2.INTER_NEAREST))


def centre_view(view: View, camera: Camera) -> CentredView:
    """Centre a photograph.

    Args:
        view: the photograph, free of distortion.
        camera: its camera.
    """
    stretch = camera.fx / camera.fy
    size = np.array([view.width, view.height], np.float64)
    middle = np.array([camera.cx, camera.cy])
    shift = np.abs(middle - size / 2).max()
    if shift < NEGLIGIBLE_SHIFT and abs(stretch - 1) < NEGLIGIBLE_STRETCH:
        return CentredView(view, camera.fx, np.eye(3))
    scale = np.array([1.0, stretch])
    half = np.ceil(np.maximum(middle, size - middle) * scale).astype(int)
    centred_from_view = np.diag([*scale, 1.0])
    centred_from_view[:2, 2] = half - scale * middle
    x = (np.arange(2 * half[0]) + 0.5 - centred_from_view[0, 2]) / scale[0] - 0.5
    y = (np.arange(2 * half[1]) + 0.5 - centred_from_view[1, 2]) / scale[1] - 0.5
    source = np.stack(np.meshgrid(x, y), axis=-1)
    inside = resampled(view, source)
    return CentredView(inside, camera.fx, centred_from_view)
