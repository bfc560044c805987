"""Millimetres from a length that the user knows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.views import View, Views
from pipeline.errors import RequestError, nearest

Array = npt.NDArray[np.float64]


def photo_named(views: Views, name: str, setting: str = "init.length.photo") -> View:
    """The photograph that the user means.

    Raises:
        RequestError: there is none.
    """
    names = {view.source_name: view for view in views.views}
    names |= {Path(view.source_name).stem: view for view in views.views} | views.by_name() | names
    if name not in names:
        raise RequestError(f"{setting}: there is no photograph '{name}'.{nearest(name, names)}")
    return names[name]


def mm_per_unit(
    view: View, camera: Camera, depth: npt.NDArray[np.float32], start: tuple[float, float],
    end: tuple[float, float], mm: float,
) -> float:  # fmt: skip
    """How many millimetres one unit of the world is.

    Args:
        view: the photograph in which the length was measured.
        camera, depth: its camera, and z-depth [H, W], 0 where unknown.
        start, end: where the length begins and ends, x and y in pixels of the upright photograph.
        mm: its length.

    Raises:
        RequestError: the points are outside the photograph, the same, or have no depth.
    """
    places = []
    for name, point in (("start", start), ("end", end)):
        pixel = working_pixel(view, point)
        if not (0 <= pixel[0] < view.width and 0 <= pixel[1] < view.height):
            raise RequestError(
                f"init.length.{name}: {point[0]:g}, {point[1]:g} is outside the photograph "
                f"{view.source_name or view.name}."
            )
        z = depth_near(depth, pixel)
        if z is None:
            raise RequestError(
                f"init.length.{name}: nothing is known of the depth at {point[0]:g}, {point[1]:g} "
                f"in {view.source_name or view.name}. Choose a place with texture that other "
                "photographs show too."
            )
        local = np.array(
            [(pixel[0] - camera.cx) / camera.fx, (pixel[1] - camera.cy) / camera.fy, 1]
        )
        places.append(local * z)
    length = float(np.linalg.norm(places[1] - places[0]))
    if length <= 0:
        raise RequestError("init.length: start and end are the same place.")
    return mm / length


def working_pixel(view: View, point: tuple[float, float]) -> Array:
    """[2] pixel of the view for a pixel of the upright photograph."""
    width, height = view.upright_size
    return np.array([point[0] * view.width / width, point[1] * view.height / height])


def depth_near(depth: npt.NDArray[np.float32], pixel: Array, radius: int = 3) -> float | None:
    """Median depth within `radius` pixels, or None where nothing is known."""
    column, row = int(pixel[0]), int(pixel[1])
    window = depth[
        max(row - radius, 0) : row + radius + 1, max(column - radius, 0) : column + radius + 1
    ]
    known = window[window > 0]
    return float(np.median(known)) if len(known) else None
