"""The size at which teeth are read, numbered and placed, whatever the photographs' own.

What is found does not depend on how large the photographs are: they are reduced to one size first,
and what was found is brought back to theirs.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.teeth import Crown, Dentition, filled, moved_polygons
from pipeline.artifacts.views import View, to_uint8

Array = npt.NDArray[np.float64]

#: Longer side of a photograph, pixels; smaller ones stay as they are.
WORKING_SIDE = 512
#: Decimals of the pixels of the smaller photograph, as in `teeth.json`: what was enlarged and
#: written comes back the same.
_DECIMALS = 2


def working_scale(width: int, height: int) -> float:
    """By how much a photograph is reduced, at most 1."""
    return min(1.0, WORKING_SIDE / max(width, height))


def working_view(view: View, scale: float | None = None) -> View:
    """A photograph reduced; itself where it is small already.

    Args:
        view: the photograph.
        scale: by how much, at most 1; None: to `WORKING_SIDE`.
    """
    scale = working_scale(view.width, view.height) if scale is None else scale
    if scale >= 1:
        return view
    width, height = max(1, round(view.width * scale)), max(1, round(view.height * scale))
    mask = None
    if view.mask is not None:
        mask = _shrunk(view.mask.astype(np.float32), (width, height)) >= 0.5
    shrink = np.diag([width / view.width, height / view.height, 1.0])
    # In 8 bits, as a photograph is reduced on its way in: the same bytes come out.
    image = _shrunk(to_uint8(view.image), (width, height))
    return replace(
        view,
        image=image.astype(np.float32) / np.float32(255),
        mask=mask,
        working_from_source=shrink @ view.working_from_source,
        focal_px=None if view.focal_px is None else view.focal_px * scale,
    )


def resized_dentition(dentition: Dentition, size: tuple[int, int]) -> Dentition:
    """The teeth in the same photograph at another size (width, height), pixels."""
    if dentition.size == size:
        return dentition
    factor = np.array(size) / np.array(dentition.size)
    smaller = factor.max() < 1

    def moved(values: Array) -> Array:
        if smaller:
            return np.round(values * factor, _DECIMALS)
        return np.round(values, _DECIMALS) * factor

    def perhaps(point: Array | None) -> Array | None:
        return None if point is None else moved(point)

    def resized(crown: Crown) -> Crown:
        width, height = moved(np.array([crown.width, crown.height]))
        return replace(
            crown,
            zenith=moved(crown.zenith),
            tip=moved(crown.tip),
            papilla_left=perhaps(crown.papilla_left),
            papilla_right=perhaps(crown.papilla_right),
            embrasure_left=perhaps(crown.embrasure_left),
            embrasure_right=perhaps(crown.embrasure_right),
            width=float(width),
            height=float(height),
            outline=moved(crown.outline),
        )

    return replace(
        dentition,
        size=size,
        upper=tuple(resized(crown) for crown in dentition.upper),
        lower=tuple(resized(crown) for crown in dentition.lower),
        on_jaws=moved_polygons(dentition.on_jaws, moved),
        band_height=float(moved(np.array([0.0, dentition.band_height]))[1]),
    )


def outline_in_view(outline: Array, size: tuple[int, int], view: View) -> Array:
    """An outline [K, 2] as the teeth were read, in pixels of the view as it is now.

    Its image may have been undistorted after the teeth were read (`View.lens_taken_out`), or be of
    another size.

    Args:
        outline: pixels of the image that the teeth were read from.
        size: width and height of that image.
        view: as it is now.
    """
    scaled = outline * (np.array([view.width, view.height]) / np.array(size))
    if not view.lens_taken_out:
        return np.asarray(scaled, np.float64)
    from pipeline.geometry.models.known_cameras import (
        lens_of,
        pinhole_camera,
        working_pixels_from_lens,
    )

    known = lens_of(view, view.lens_taken_out)
    camera = pinhole_camera(view, known)
    lens_from_working = np.linalg.inv(working_pixels_from_lens(view, known, "teeth.json"))
    pixels = scaled @ lens_from_working[:2, :2].T + lens_from_working[:2, 2]
    rays = np.column_stack([known.lens.cam_from_img(pixels), np.ones(len(pixels))])
    # `pinhole_camera` turns the lens's axes to those of the upright image.
    straight, _ = camera.project(rays)
    return straight


def labels_in_view(
    dentition: Dentition, view: View, labels: Iterable[int]
) -> npt.NDArray[np.int32]:
    """[H, W] the label of the crown that a view shows at each pixel, of all crowns; 0: none."""
    size = view.width, view.height
    shown = np.zeros(size[::-1], np.int32)
    for crown, label in zip(dentition.all_crowns, labels, strict=True):
        if label and len(crown.outline) >= 3:
            outline = outline_in_view(crown.outline, dentition.size, view)
            shown[filled((replace(crown, outline=outline),), size)] = label
    return shown


def _shrunk(pixels: npt.NDArray[Any], size: tuple[int, int]) -> npt.NDArray[Any]:
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA))
