"""What a fit works on: photographs, cameras and points in a frame where the depth is about 1."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.flow import Flow
from pipeline.artifacts.points import Points
from pipeline.artifacts.views import View
from stages.fit.arrays import Array, Bools, Floats
from stages.fit.config import FitSettings
from stages.fit.inputs.initial import (
    Cloud,
    Frame,
    choose_frame,
    initial_gaussians,
    smooth_normals,
    thin,
)
from stages.fit.inputs.targets import Target, make_pyramids, point_depth
from stages.fit.parts.start import coarse_factors
from stages.fit.trainer import Trainer

Flows = dict[int, list[tuple[int, Floats, Bools]]]

#: scene extent: this times the largest distance of a camera from their middle (3DGS), at least
#: MIN_EXTENT of the scene's depth (cameras that hardly move must not freeze the positions)
EXTENT_MARGIN = 1.1
MIN_EXTENT = 0.25
#: where fewer of the points than this share are trusted, confidence means something else
MIN_TRUSTED = 0.02
#: how far behind measured points a filled one may be, as a share of the depth, to be taken for the
#: same surface (and left out)
SAME_SURFACE = 0.03
#: surfaces are looked up at this fraction of the image size: measured points are not everywhere
COARSE_DEPTH = 4


@dataclass(frozen=True)
class Scene:
    """Attributes:
    views: the placed ones.
    cameras: one each, in the frame.
    cloud: all points, in the frame.
    trusted: [N] which of them were measured, not filled in.
    frame: of the fit, in the world.
    targets: per view, factor -> what the fit compares with.
    """

    views: tuple[View, ...]
    cameras: tuple[Camera, ...]
    cloud: Cloud
    trusted: Bools
    frame: Frame
    targets: list[dict[int, Target]]

    def trainer(self, settings: FitSettings, lit: bool) -> Trainer:
        """A fit of the scene from its points, with a light beside the lens or with harmonics."""
        cloud, packed = None, np.empty((0, 14), np.float32)
        if not settings.progressive:
            cloud = self.start(settings)
            # a shading that is not drawn yet would not be fitted either
            plain = lit or settings.sh_degree_interval > 0
            packed = initial_gaussians(
                cloud, self.cameras, opacity=settings.initial_opacity,
                scale=settings.initial_scale, scale_max_px=settings.initial_scale_max_px,
                degree=0 if plain else settings.sh_degree, headlight=settings.headlight,
                shoulder=settings.headlight_shoulder,
            )  # fmt: skip
        extent, middle = self.extent()
        poses = np.array([camera.cam_from_world[:3] for camera in self.cameras])
        return Trainer(settings, packed, poses, middle, self.targets, extent, lit, self, cloud)

    def extent(self) -> tuple[float, int]:
        """Size of the scene that the position rate is relative to, and the view in the middle."""
        centres = np.array([camera.centre for camera in self.cameras])
        distance = np.linalg.norm(centres - centres.mean(0), axis=1)
        return max(EXTENT_MARGIN * float(distance.max()), MIN_EXTENT), int(distance.argmin())

    def start(self, settings: FitSettings) -> Cloud:
        """The points that become Gaussians, measured ones and a limited share filled in."""
        trusted, fill = self.cloud.select(self.trusted), self.cloud.select(~self.trusted)
        count = settings.initial_points
        # however large a share is allowed, what was measured keeps its own
        room = int(count * min(settings.fill_share, len(fill) / max(len(self.cloud), 1)))
        fill = thin(fill, room) if room else fill.select(np.zeros(len(fill), bool))
        measured = thin(trusted, count - len(fill))
        measured = smooth_normals(measured, settings.normal_neighbours)
        cloud = Cloud(
            *(
                np.concatenate([getattr(measured, name), getattr(fill, name)])
                for name in ("positions", "colors", "normals", "weight")
            )
        )
        # neighbours side by side: what is looked up for one is still in the cache for the next
        return cloud.select(cKDTree(cloud.positions).indices) if len(cloud) else cloud

    def reduced(self, factor: int) -> Scene:
        """With images that are already small."""
        return replace(self, targets=[{1: target[factor]} for target in self.targets])

    def without(self, some: Sequence[int]) -> Scene:
        """All views but some."""
        rest = [index for index in range(len(self.views)) if index not in some]
        return replace(
            self,
            views=tuple(self.views[index] for index in rest),
            cameras=tuple(self.cameras[index] for index in rest),
            targets=[self.targets[index] for index in rest],
        )


def prepare(
    views: Sequence[View],
    cameras: Sequence[Camera],
    points: Points,
    flow: Flow | None,
    settings: FitSettings,
) -> Scene:
    """The scene that a fit works on; arguments as `fitting.fit` has them."""
    frame = choose_frame(points.positions.astype(np.float64), cameras)
    local = tuple(in_frame(camera, frame) for camera in cameras)
    cloud = Cloud(
        frame.points(points.positions), points.colors.astype(np.float64),
        points.normals.astype(np.float64), np.maximum(points.confidence, 1).astype(np.float64),
    )  # fmt: skip
    trusted = trusted_points(cloud, settings.trusted_confidence)
    if not trusted.all():
        keep = trusted | ~out_of_place(
            cloud.positions, cloud.positions[trusted], local, SAME_SURFACE
        )
        cloud, trusted = cloud.select(keep), trusted[keep]
    flows = flows_between(views, flow) if settings.lambda_flow > 0 else {}
    factors = {1, *coarse_factors(settings)}
    if settings.light == "auto":
        factors.add(settings.light_trial_factor)
    targets = make_pyramids(
        [view.image for view in views], [view.valid() for view in views], local, sorted(factors),
        cloud.positions[trusted] if settings.lambda_depth > 0 else None, flows,
    )  # fmt: skip
    return Scene(tuple(views), local, cloud, trusted, frame, targets)


def trusted_points(cloud: Cloud, confidence: float) -> Bools:
    """[N] points that were measured, not filled in; all where that would leave next to none."""
    trusted = cloud.weight >= confidence
    return trusted if trusted.mean() > MIN_TRUSTED else np.ones(len(cloud), bool)


def out_of_place(
    positions: Array, surface: Array, cameras: Sequence[Camera], tolerance: float
) -> Bools:
    """[N] points filled in where a view knows better, or that no view needs.

    Args:
        positions: [N, 3]; surface: [M, 3] points that were measured.
        cameras: in the same frame.
        tolerance: a point may be so far behind what a view sees at its pixel, relative to the
            depth, and still count as an attempt at the same surface.
    """
    wrong, needed = np.zeros((2, len(positions)), bool)
    for camera in cameras:
        width, height = camera.width // COARSE_DEPTH, camera.height // COARSE_DEPTH
        front = point_depth(surface, camera, width, height)
        pixels, depth = camera.resized(width, height).project(positions)
        column, row = np.floor(pixels[:, 0]).astype(int), np.floor(pixels[:, 1]).astype(int)
        seen = (depth > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        limit = np.zeros(len(positions))
        limit[seen] = front[row[seen], column[seen]]
        wrong |= seen & (depth < limit * (1 + tolerance))
        needed |= seen & (limit == 0)
    return wrong | ~needed


def in_frame(camera: Camera, frame: Frame) -> Camera:
    matrix = np.eye(4)
    matrix[:3] = frame.pose(camera.cam_from_world)
    return replace(camera, cam_from_world=matrix)


def flows_between(views: Sequence[View], flow: Flow | None) -> Flows:
    """For each placed view its flow to other placed ones: (index of that, flow, mask)."""
    index = {view.name: position for position, view in enumerate(views)}
    found: Flows = {}
    for pair in flow.pairs if flow is not None else ():
        i, j = index.get(pair.name_i), index.get(pair.name_j)
        if i is not None and j is not None and pair.mask_forward.any():
            found.setdefault(i, []).append((j, pair.forward, pair.mask_forward))
    return found
