"""Millimetres from a length that the user knows."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import PurePath

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.views import View, Views
from pipeline.errors import RequestError, nearest

Array = npt.NDArray[np.float64]


def photo_named(views: Views, name: str) -> View:
    """The photograph that the user means: by its file's name, by that without suffix, or, where no
    file is so called, by the name of its view.

    Raises:
        RequestError: there is none, or several are called so.
    """
    ways: tuple[Callable[[View], str], ...] = (
        lambda view: view.source_name,
        lambda view: PurePath(view.source_name).stem,
        lambda view: view.name,
    )
    found = next(filter(None, ([v for v in views.views if way(v) == name] for way in ways)), [])
    if len(found) == 1:
        return found[0]
    if found:
        raise RequestError(
            f"init.length.photo: {len(found)} photographs are called '{name}' "
            f"({', '.join(view.source_name for view in found[:3])}). Give one whole name."
        )
    names = [way(view) for way in ways for view in views.views]
    raise RequestError(f"init.length.photo: there is no photograph '{name}'.{nearest(name, names)}")


#: How far from the true spot people click, in pixels of the working image (standard deviation
#: along the length): a pixel or two of a screen that shows the whole photograph.
CLICK_DEVIATION = 1.5
#: What a length in millimetres is read off with, such as a caliper's at a tooth.
MM_DEVIATION = 0.1
#: By what share of itself the depth of two spots is wrong against each other, at least: what dense
#: stereo is off by on average on our scenes with known depth.
DEPTH_DEVIATION = 0.003
#: A median absolute deviation times this is the standard deviation of a normal distribution.
_FROM_MEDIAN = 1.4826


def mm_per_unit(
    view: View, camera: Camera, depth: npt.NDArray[np.float32], start: tuple[float, float],
    end: tuple[float, float], mm: float,
    in_depth: Callable[[Array], Array] = lambda pixel: pixel,
) -> tuple[float, float]:  # fmt: skip
    """How many millimetres one unit of the world is, and how sure that is.

    The uncertainty is that of the length as it was clicked: `CLICK_DEVIATION` across and along the
    surface, `MM_DEVIATION`, and the depth where it begins and ends. A focal length or poses that
    are wrong are not in it.

    Args:
        view: the photograph in which the length was measured.
        camera, depth: its camera, and z-depth [H, W], 0 where unknown.
        start, end: where the length begins and ends, x and y in pixels of the upright photograph.
        mm: its length.
        in_depth: from a pixel of the view to that of `depth` which shows the same.

    Returns:
        Millimetres per unit, and their relative standard deviation.

    Raises:
        RequestError: the points are outside the photograph, the same, or have no depth.
    """
    rays, depths, unsure = [], [], []
    for name, point in (("start", start), ("end", end)):
        pixel = view.working_place(point)
        if not (0 <= pixel[0] < view.width and 0 <= pixel[1] < view.height):
            raise RequestError(
                f"init.length.{name}: {point[0]:g}, {point[1]:g} is outside the photograph "
                f"{view.source_name or view.name}."
            )
        pixel = in_depth(pixel)
        known = depths_near(depth, pixel)
        if not len(known):
            raise RequestError(
                f"init.length.{name}: nothing is known of the depth at {point[0]:g}, {point[1]:g} "
                f"in {view.source_name or view.name}. Choose a place with texture that other "
                "photographs show too."
            )
        z = float(np.median(known))
        rays.append(
            np.array([(pixel[0] - camera.cx) / camera.fx, (pixel[1] - camera.cy) / camera.fy, 1])
        )
        depths.append(z)
        # Where the surface slopes, a click beside the spot is at another depth.
        spread = _FROM_MEDIAN * float(np.median(np.abs(known - z)))
        unsure.append(float(np.hypot(spread, DEPTH_DEVIATION * z)))
    across = rays[1] * depths[1] - rays[0] * depths[0]
    length = float(np.linalg.norm(across))
    if length <= 0:
        raise RequestError("init.length: start and end are the same place.")
    along = across / length
    shares = [MM_DEVIATION / mm]
    for ray, z, deviation in zip(rays, depths, unsure, strict=True):
        shares.append(float(along @ ray) * deviation / length)
        pixel_mm = z * np.array([along[0] / camera.fx, along[1] / camera.fy])
        shares.append(CLICK_DEVIATION * float(np.linalg.norm(pixel_mm)) / length)
    return mm / length, float(np.linalg.norm(shares))


def depth_near(depth: npt.NDArray[np.float32], pixel: Array, radius: int = 3) -> float | None:
    """Median depth within `radius` pixels, or None where nothing is known."""
    known = depths_near(depth, pixel, radius)
    return float(np.median(known)) if len(known) else None


def depths_near(
    depth: npt.NDArray[np.float32], pixel: Array, radius: int = 3
) -> npt.NDArray[np.float32]:
    """[K] the known depths within `radius` pixels."""
    column, row = int(pixel[0]), int(pixel[1])
    window = depth[
        max(row - radius, 0) : row + radius + 1, max(column - radius, 0) : column + radius + 1
    ]
    return np.asarray(window[window > 0])
