"""Where the cameras stand around the scene, and smooth paths between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.interpolate import PchipInterpolator

from pipeline.artifacts.cameras import Camera

Array = npt.NDArray[np.float64]

#: A path has at most this many knots; more cameras than that are smoothed (a hand shakes).
MOST_KNOTS = 7
#: Cameras closer than this in azimuth share a knot.
KNOT_SPACING = np.radians(2.0)
#: A path is at least this wide, even if all photographs were taken from one spot.
LEAST_SPAN = np.radians(12.0)
#: A picture that is to hold a scene may leave out so much of it, and has so much around it.
_OUTSIDE, _MARGIN = 0.0005, 0.03


@dataclass(frozen=True)
class Orbit:
    """A frame about which one can walk around the scene.

    Attributes:
        centre: [3] what the cameras look at.
        up: [3] unit, the patient's where that is known; else upwards as the photographs show it.
        front: [3] unit, at right angles to `up`, from the centre towards the middle camera.
        radius: half the width that the photographs frame at the centre's depth.
        azimuths, elevations, distances: [N] of the cameras about the centre; radians, azimuth about
            `up` from `front` towards `up` x `front`; world units.
        targets: [N, 3] point on each camera's optical axis abreast of the centre.
    """

    centre: Array
    up: Array
    front: Array
    radius: float
    azimuths: Array
    elevations: Array
    distances: Array
    targets: Array

    @property
    def side(self) -> Array:
        """[3] unit, completes `up` and `front`."""
        return np.cross(self.up, self.front)

    def span(self) -> tuple[float, float]:
        """Least and greatest azimuth, at least `LEAST_SPAN` apart."""
        low, high = float(self.azimuths.min()), float(self.azimuths.max())
        lacking = max(0.0, LEAST_SPAN - (high - low)) / 2
        return low - lacking, high + lacking

    def middle(self) -> int:
        """Index of the camera nearest to the middle of the arch."""
        low, high = self.span()
        return int(np.abs(self.azimuths - (low + high) / 2).argmin())


def unit(vector: npt.ArrayLike) -> Array:
    array = np.asarray(vector, np.float64)
    return array / max(float(np.linalg.norm(array)), 1e-12)


def central_depth(depth: npt.NDArray[np.floating], alpha: npt.NDArray[np.floating]) -> float | None:
    """Median of a depth map [H, W] in the middle half of the picture; None if nothing is there."""
    height, width = depth.shape
    middle = (
        slice(height // 4, max(height - height // 4, 1)),
        slice(width // 4, max(width - width // 4, 1)),
    )
    solid = depth[middle][(alpha[middle] > 0.5) & (depth[middle] > 0)]
    return float(np.median(solid)) if solid.size else None


def find_orbit(
    cameras: Sequence[Camera], known_depths: Sequence[float | None], upwards: Array | None = None
) -> Orbit:
    """Find the frame about which the cameras are arranged.

    Args:
        cameras: N >= 1 placed cameras.
        known_depths: N depths of what is in the middle of each picture, None where unknown.
        upwards: [3] unit, where it is known; else it is what the photographs have up on average.
    """
    eyes = np.stack([camera.centre for camera in cameras])
    forwards = np.stack([camera.rotation[2] for camera in cameras])
    found = [depth for depth in known_depths if depth is not None]
    usual = float(np.median(found)) if found else 1.0
    depths = np.array([usual if depth is None else depth for depth in known_depths])
    centre = (eyes + forwards * depths[:, None]).mean(0)

    if upwards is None:
        upwards = -np.stack([camera.rotation[1] for camera in cameras]).mean(0)
    up = unit(upwards)
    away = eyes - centre
    distances = np.linalg.norm(away, axis=1)
    flat = away - np.outer(away @ up, up)
    front = unit((flat / np.maximum(distances, 1e-12)[:, None]).mean(0))
    if np.linalg.norm(front) < 0.5:  # cameras evenly all around, or straight above
        front = unit(np.cross(np.cross(up, -forwards[0]), up))
    if np.linalg.norm(front) < 0.5:
        front = unit(np.cross(np.eye(3)[np.abs(up).argmin()], up))
    side = np.cross(up, front)
    half_widths = [d * c.width / c.fx / 2 for d, c in zip(depths, cameras, strict=True)]
    ahead = np.maximum(((centre - eyes) * forwards).sum(1), 0.05 * distances)
    return Orbit(
        centre=centre,
        up=up,
        front=front,
        radius=float(np.median(half_widths)),
        azimuths=np.arctan2(away @ side, away @ front),
        elevations=np.arcsin(np.clip(away @ up / np.maximum(distances, 1e-12), -1, 1)),
        distances=distances,
        targets=eyes + forwards * ahead[:, None],
    )


def look_at(eye: Array, target: Array, up: Array) -> Array:
    """[4, 4] cam_from_world of a camera at `eye` that sees `target` in its middle, `up` upwards."""
    forward = unit(target - eye)
    right = unit(np.cross(forward, up))
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ eye
    return pose


def _knots(orbit: Orbit) -> tuple[Array, Array]:
    """Azimuths [K] ascending, and [K, 5] elevation, log distance, target, smoothed if many."""
    values = np.column_stack([orbit.elevations, np.log(orbit.distances), orbit.targets])
    order = np.argsort(orbit.azimuths, kind="stable")
    azimuths, values = orbit.azimuths[order], values[order]
    group = np.concatenate([[0], np.cumsum(np.diff(azimuths) > KNOT_SPACING)])
    if group[-1] < MOST_KNOTS:
        members = [group == index for index in range(group[-1] + 1)]
        return (
            np.array([azimuths[member].mean() for member in members]),
            np.stack([values[member].mean(0) for member in members]),
        )
    knots = np.linspace(azimuths[0], azimuths[-1], MOST_KNOTS)
    width = (azimuths[-1] - azimuths[0]) / (MOST_KNOTS - 1) / 2
    weights = np.exp(-0.5 * ((knots[:, None] - azimuths) / width) ** 2)
    weights += 1e-9  # a gap between the cameras must not divide by zero
    return knots, weights @ values / weights.sum(1, keepdims=True)


def path_poses(orbit: Orbit, azimuths: Array, raised: Array) -> list[Array]:
    """Poses on the smooth path through the cameras.

    Elevation, distance and target are interpolated over the azimuth by a monotone cubic (no
    overshoot between distant photographs); the rotation follows from looking at the target.

    Args:
        orbit: frame of the cameras.
        azimuths: [K] radians; outside the cameras' span the nearest one's values are kept.
        raised: [K] radians added to the elevation.

    Returns:
        K matrices [4, 4] cam_from_world.
    """
    knots, values = _knots(orbit)
    inside = np.clip(azimuths, knots[0], knots[-1])
    if len(knots) == 1:
        smooth = np.repeat(values, len(azimuths), 0)
    else:
        smooth = np.asarray(PchipInterpolator(knots, values, axis=0)(inside))
    poses = []
    for azimuth, rise, row in zip(azimuths, raised, smooth, strict=True):
        elevation = float(np.clip(row[0] + rise, -1.4, 1.4))
        level = np.cos(azimuth) * orbit.front + np.sin(azimuth) * orbit.side
        away = np.cos(elevation) * level + np.sin(elevation) * orbit.up
        poses.append(look_at(orbit.centre + np.exp(row[1]) * away, row[2:], orbit.up))
    return poses


def lens(cameras: Sequence[Camera], width: int, height: int) -> Camera:
    """A camera of the given size with the mean field of view of `cameras`, at the origin."""
    focal = float(np.median([c.fx / c.width for c in cameras])) * width
    return Camera("", width, height, focal, focal, width / 2, height / 2, np.eye(4))


def there_and_back(
    orbit: Orbit, cameras: Sequence[Camera], size: tuple[int, int], count: int, sway: float
) -> tuple[list[Camera], list[int]]:
    """A path through all cameras and back that loops without a jolt, and back as there.

    Args:
        orbit: frame of the cameras.
        cameras: whose mean field of view is taken.
        size: (width, height) in pixels.
        count: frames in one loop.
        sway: amplitude of the slow rise and fall, radians.

    Returns:
        The places from one end to the other, and the place of each frame (about two each).
    """
    swing = np.sin(2 * np.pi * np.arange(count) / count)
    places, place_of_frame = np.unique(np.round(swing, 9), return_inverse=True)
    low, high = orbit.span()
    azimuths = np.asarray((low + high) / 2 + (high - low) / 2 * places, np.float64)
    poses = path_poses(orbit, azimuths, np.asarray(sway * np.sin(np.pi * places), np.float64))
    return _cameras(poses, lens(cameras, *size)), place_of_frame.tolist()


def widened(cameras: Sequence[Camera], points: Array) -> list[Camera]:
    """The cameras with a field of view as wide, all the same, as it takes to see the points.

    Photographs of a mouth rarely hold all of it: on a path along their places, parts would leave
    the picture and come back.

    Args:
        cameras: whose pictures are of one size, with the middle of the picture on the axis.
        points: [N, 3]; a few of them may stay outside.

    Returns:
        Cameras with the focal lengths as they were, or shorter.
    """
    reach = 1e-6
    for camera in cameras:
        pixels, depth = camera.project(points)
        away = np.abs(pixels - (camera.cx, camera.cy)) / (camera.width / 2, camera.height / 2)
        ahead = away.max(axis=1)[depth > 0]
        if len(ahead):
            reach = max(reach, float(np.quantile(ahead, 1 - _OUTSIDE)))
    zoom = min(1.0, (1 - _MARGIN) / reach)
    return [replace(camera, fx=zoom * camera.fx, fy=zoom * camera.fy) for camera in cameras]


def between(orbit: Orbit, cameras: Sequence[Camera], count: int) -> list[Camera]:
    """`count` evenly spread cameras along the path, with the size of the first camera.

    One alone stands in the middle.
    """
    low, high = float(orbit.azimuths.min()), float(orbit.azimuths.max())
    azimuths = np.linspace(low, high, count) if count > 1 else np.array([(low + high) / 2])
    poses = path_poses(orbit, azimuths, np.zeros(count))
    return _cameras(poses, lens(cameras, cameras[0].width, cameras[0].height))


def _cameras(poses: list[Array], model: Camera) -> list[Camera]:
    return [
        replace(model, name=f"path_{index:04d}", cam_from_world=pose)
        for index, pose in enumerate(poses)
    ]
