"""The Gaussians that a fit starts from: a point cloud, thinned, with shading along its normals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from pipeline.artifacts.cameras import Camera
from stages.fit.arrays import AnyArray, Array, Bools, Floats, Indices
from stages.splatting.threads import workers

SH_C0, SH_C1 = 0.28209479177387814, 0.4886025119029199
#: Brightness (sRGB, 0..1) from which on tone curves press colours together: the brighter, the less
#: a colour loses by turning away. Between photographs of twelve patients, 45 degrees apart, the
#: share of light that turns away is .70, .72, .60, .52, .45 and .40 for colours around .3, .5, .6,
#: .75, .85 and .94 that face the camera (medians).
SHOULDER = 0.45


@dataclass(frozen=True)
class Cloud:
    """Attributes:
    positions, colors, normals: [N, 3] float64; normals unit or 0.
    weight: [N] float64, raw confidence, >= 1.
    """

    positions: Array
    colors: Array
    normals: Array
    weight: Array

    def __len__(self) -> int:
        return len(self.positions)

    def select(self, index: Bools | Indices) -> Cloud:
        return Cloud(
            self.positions[index], self.colors[index], self.normals[index], self.weight[index]
        )


@dataclass(frozen=True)
class Frame:
    """The frame in which a fit works: the scene's middle at 0, its median depth 1.

    So rates, thresholds and the near plane mean the same for every scene, and float32 is enough.

    Attributes:
        centre: [3] in the world.
        scale: world units per unit of the frame.
    """

    centre: Array
    scale: float

    def points(self, positions: AnyArray) -> Array:
        """[N, 3] from the world."""
        return (np.asarray(positions, np.float64) - self.centre) / self.scale

    def pose(self, cam_from_world: Array) -> Array:
        """[3, 4] cam_from_frame, with camera coordinates in units of the frame."""
        rotation, translation = cam_from_world[:3, :3], cam_from_world[:3, 3]
        moved = (rotation @ self.centre + translation) / self.scale
        return np.concatenate([rotation, moved[:, None]], 1)

    def cam_from_world(self, pose: Array) -> Array:
        """[4, 4], the inverse of `pose`."""
        result = np.eye(4)
        result[:3, :3] = pose[:, :3]
        result[:3, 3] = self.scale * pose[:, 3] - pose[:, :3] @ self.centre
        return result


def choose_frame(positions: Array, cameras: Sequence[Camera]) -> Frame:
    """Median position of the points; median of their depths in the cameras that see them."""
    sample = positions[:: max(1, len(positions) // 20000)]
    depths = []
    for camera in cameras:
        pixels, depth = camera.project(sample)
        depths.append(depth[camera.shows(pixels, depth)])
    every = np.concatenate(depths)
    scale = float(np.median(every)) if len(every) else 1.0
    return Frame(np.median(positions, axis=0), scale if scale > 0 else 1.0)


def thin(cloud: Cloud, target: int) -> Cloud:
    """Average the points of a cloud in voxels, so that about `target` are left."""
    if len(cloud) <= target:
        return cloud
    origin = cloud.positions.min(0)
    # what lies far out must not decide the voxel size
    low, high = np.quantile(cloud.positions, [0.02, 0.98], axis=0)
    largest = float(np.linalg.norm(high - low)) or 1.0
    smallest = largest * 1e-5

    def cells(size: float) -> Indices:
        index = np.floor((cloud.positions - origin) / size)
        grid = np.clip(index, 0, 2**20).astype(np.int64)
        return (grid[:, 0] << 42) | (grid[:, 1] << 21) | grid[:, 2]

    for _ in range(24):
        size = float(np.sqrt(smallest * largest))
        count = len(np.unique(cells(size)))
        if abs(count - target) <= 0.01 * target:
            break
        smallest, largest = (size, largest) if count > target else (smallest, size)
    unique, cell = np.unique(cells(size), return_inverse=True)
    mass = np.asarray(np.bincount(cell, cloud.weight, len(unique)), np.float64)

    def mean(values: Array) -> Array:
        sums = [np.bincount(cell, cloud.weight * column, len(unique)) for column in values.T]
        return np.stack(sums, 1) / mass[:, None]

    normals = mean(cloud.normals)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 0.2, normals / np.maximum(length, 1e-12), 0)
    confidence = mean(cloud.weight[:, None])[:, 0]
    return Cloud(mean(cloud.positions), mean(cloud.colors), normals, confidence)


def neighbour_spacing(positions: Array) -> Array:
    """[N] root mean square distance to the three nearest neighbours (3DGS's initialisation)."""
    if len(positions) < 4:
        return np.full(len(positions), 1e-2)
    distance, _ = cKDTree(positions).query(positions, k=4, workers=workers())
    return np.sqrt(np.maximum((distance[:, 1:] ** 2).mean(1), 1e-7 * np.median(distance) ** 2))


def smooth_normals(cloud: Cloud, neighbours: int, every: int = 1) -> Cloud:
    """Normals averaged over so many neighbours, weighted by confidence; 0 or 1: as they are.

    Of `every` so many points one is returned; all are neighbours.
    """
    some = cloud.select(np.arange(len(cloud)) % every == 0)
    if neighbours < 2 or len(cloud) < neighbours:
        return some
    tree = cKDTree(cloud.positions)
    _, index = tree.query(some.positions, k=neighbours, workers=workers())
    weight = cloud.weight[index]
    # what looks away is another surface
    weight = weight * ((cloud.normals[index] * some.normals[:, None]).sum(-1) > 0.3)
    mean = (cloud.normals[index] * weight[..., None]).sum(1)
    length = np.linalg.norm(mean, axis=1, keepdims=True)
    normals = np.where(length > 1e-9, mean / np.maximum(length, 1e-9), some.normals)
    return Cloud(some.positions, some.colors, normals, some.weight)


def facing(positions: Array, normals: Array, cameras: Sequence[Camera]) -> Array:
    """[N] mean cosine between normal and direction to the cameras that see the point, in .2 .. 1.

    Weighted by the cosine itself: a camera that looks straight at a surface has most of its pixels.
    """
    total, mass = np.zeros(len(positions)), np.zeros(len(positions))
    for camera in cameras:
        pixels, depth = camera.project(positions)
        inside = camera.shows(pixels, depth)
        towards = camera.centre - positions
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        cosine = np.clip((towards * normals).sum(1), 0, 1) * inside
        total += cosine**2
        mass += cosine
    return np.clip(total / np.maximum(mass, 1e-9), 0.2, 1)


def initial_gaussians(
    cloud: Cloud,
    cameras: Sequence[Camera],
    *,
    opacity: float,
    scale: float,
    scale_max_px: float,
    degree: int,
    headlight: float,
    shoulder: float,
) -> Floats:
    """Packed Gaussians [N, 11 + 3 K] from a cloud in the cameras' frame.

    Args:
        cloud: the points.
        cameras: the placed views.
        opacity: of every Gaussian.
        scale: standard deviation as a multiple of the neighbours' spacing.
        scale_max_px: its largest value, in pixels of the nearest camera.
        degree: of the harmonics.
        headlight, shoulder: share of the light that comes from the camera (see `camera_share`).
    """
    count, terms = len(cloud), (degree + 1) ** 2
    spacing = neighbour_spacing(cloud.positions)
    pixel = np.full(count, np.inf)
    for camera in cameras:
        distance = np.linalg.norm(cloud.positions - camera.centre, axis=1)
        pixel = np.minimum(pixel, distance / max(camera.fx, camera.fy))
    sigma = np.clip(scale * spacing, 0.02 * pixel, scale_max_px * pixel)
    packed = np.zeros((count, 11 + 3 * terms))
    packed[:, 0:3] = cloud.positions
    packed[:, 3] = 1
    packed[:, 7:10] = np.log(sigma)[:, None]
    packed[:, 10] = np.log(opacity / (1 - opacity))
    cosine = facing(cloud.positions, cloud.normals, cameras)
    share = camera_share(cloud.colors, headlight, shoulder)
    sh = headlight_harmonics(cloud.colors, cloud.normals, cosine, share, degree)
    packed[:, 11:] = sh.reshape(count, -1)
    return np.ascontiguousarray(packed, np.float32)


def camera_share(colors: Array, headlight: float, shoulder: float) -> Array:
    """[N, 3] by how much colours [N, 3] seem lit from the camera, channel by channel.

    Args:
        colors: as seen, sRGB 0..1.
        headlight: that share up to a brightness of `SHOULDER`.
        shoulder: by how much less of itself it is, for each unit of brightness above.
    """
    return headlight * (1 - shoulder * np.clip(colors - SHOULDER, 0, 1 - SHOULDER))


def headlight_harmonics(
    colors: Array, normals: Array, cosine: Array, share: Array, degree: int
) -> Array:
    """Spherical harmonics [N, K, 3] of a matte surface lit from the camera.

    Colour = albedo (1 - k + k n.v) is exactly of degree 1 in the direction of view.

    Args:
        colors: [N, 3] as seen at `cosine` [N].
        normals: [N, 3] unit, or 0 where unknown: the same colour from everywhere.
        share: [N, 3], k (see `camera_share`).
        degree: of the harmonics; at 0 the colours as they are.
    """
    sh = np.zeros((len(colors), (degree + 1) ** 2, 3))
    constant = colors - 0.5
    if degree > 0:
        known = (np.abs(normals).sum(1) > 0)[:, None]
        cosine = cosine[:, None]
        directed = np.where(known, share * colors / (1 - share + share * cosine), 0)
        constant = constant - directed * cosine
        # basis of degree 1 along d = -v is (-y, z, -x) C1, and n.v = -n.d
        sh[:, 1] = directed * normals[:, 1:2] / SH_C1
        sh[:, 2] = -directed * normals[:, 2:3] / SH_C1
        sh[:, 3] = directed * normals[:, 0:1] / SH_C1
    sh[:, 0] = constant / SH_C0
    return sh
