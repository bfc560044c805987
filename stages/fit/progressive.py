"""Frames placed one after another, as in CF-3DGS (Fu et al. 2024): only the first pose is given.

In viewing order: fit the first frame; then, for each next frame, find its pose with the Gaussians
frozen, add Gaussians where it shows what no frame before it did, and fit all frames so far.

Departures from the original, nearly all in its favour:
- Depth: the original gives every frame that of a learned monocular model, with a scale of its own
  in each. Here a frame gets the depth of the input points that its camera in the init sees, which
  agrees between frames. It is carried by the pose estimated here, never by the one that init found.
- A pose turns about the middle of the scene while it is sought. About the camera, as in the
  original, frames more than a degree or two apart are not found (measured on a sweep of 8 degrees a
  frame: it ends where it starts; about the middle it ends .2 degrees from the truth).
- A pose is sought with all Gaussians so far, not with a separate set for the last frame, and
  compared only where they cover the image.
- New Gaussians are added where the image is uncovered; the original leaves that to densification.
- The viewing order comes from the init's cameras (original: from the video), the lenses too
  (original: 79 degrees).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.views import View
from pipeline.geometry.order import viewing_order
from stages.fit.initial import Cloud, initial_gaussians, thin
from stages.fit.objectives import interpolate
from stages.fit.settings import FitSettings
from stages.fit.targets import point_depth

if TYPE_CHECKING:
    from stages.fit.trainer import Trainer

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]

#: where Gaussians let more light through than this, they don't show what a frame sees
UNCOVERED = 0.5


class Progressive:
    """Which frames take part yet, and how the next one is added.

    Attributes:
        order: of the views.
        placed: how many of them take part.
        latest: iteration at which the last of those was added.
    """

    def __init__(
        self,
        views: Sequence[View],
        cameras: Sequence[Camera],
        positions: Array,
        settings: FitSettings,
    ) -> None:
        """
        Args:
            views: to be placed.
            cameras: lenses, order and depth come from these; of the poses, only the first one's.
            positions: [N, 3] points, in the frame of the cameras.
            settings: all constants.
        """
        self.settings = settings
        self.order = viewing_order(np.array([camera.centre for camera in cameras]))
        self.cameras = cameras
        self.clouds = [
            thin(seen_by(view, camera, positions), settings.initial_points)
            for view, camera in zip(views, cameras, strict=True)
        ]
        self.placed, self.latest = 1, 0

    def first_gaussians(self) -> Floats:
        """Packed Gaussians of the first frame."""
        first = self.order[0]
        return self._gaussians(first, self.cameras[first].cam_from_world[:3])

    def advance(self, trainer: Trainer) -> list[int]:
        """Place the frames that are due before the next iteration; all that take part in it."""
        while self.placed < self._due(trainer.iteration):
            self._place(trainer, self.order[self.placed])
        return self.order[: self.placed]

    def _due(self, iteration: int) -> int:
        """How many frames take part in the iteration after `iteration`; at the end, all of them."""
        s, count = self.settings, len(self.order)
        if iteration + 1 >= s.iterations:
            return count
        interval = min(float(s.progressive_iterations), s.iterations / count)
        return min(count, 1 + int(iteration / interval))

    def _place(self, trainer: Trainer, view: int) -> None:
        s = self.settings
        trainer.poses.poses[view] = next_pose(trainer.poses.poses[self.order[: self.placed]])
        for step in range(s.progressive_pose_iterations):
            done = step / s.progressive_pose_iterations
            rate = interpolate(s.progressive_pose_lr_init, s.progressive_pose_lr_final, done)
            trainer.find_pose(view, rate, UNCOVERED)
        self._grow(trainer, view)
        self.placed += 1
        self.latest = trainer.iteration
        trainer.queue = []

    def _grow(self, trainer: Trainer, view: int) -> None:
        """Add the Gaussians of a frame at pixels that those so far leave uncovered."""
        room = max(self.settings.max_gaussians - len(trainer.packed), 0)
        transmittance = trainer.render(view).transmittance
        height, width = transmittance.shape
        pixels, _ = replace(self.cameras[view], cam_from_world=np.eye(4)).project(
            self.clouds[view].positions
        )
        column, row = np.clip(pixels.astype(np.int64), 0, (width - 1, height - 1)).T
        new = np.flatnonzero(transmittance[row, column] > UNCOVERED)[:room]
        added = self._gaussians(view, trainer.poses.poses[view])[new]
        count = len(trainer.packed)
        trainer.replace(
            np.ascontiguousarray(np.concatenate([trainer.packed, added])),
            np.concatenate([np.arange(count), np.zeros(len(added), np.int64)]),
            np.arange(count + len(added)) >= count,
        )

    def _gaussians(self, view: int, pose: Array) -> Floats:
        """Packed Gaussians of a frame's points, seen from a pose [3, 4]."""
        s, cloud = self.settings, self.clouds[view]
        camera = replace(self.cameras[view], cam_from_world=np.vstack([pose, [0, 0, 0, 1]]))
        there = replace(cloud, positions=(cloud.positions - pose[:, 3]) @ pose[:, :3])
        return initial_gaussians(
            there, [camera], opacity=s.initial_opacity, scale=s.initial_scale,
            scale_max_px=s.initial_scale_max_px, degree=s.sh_degree, headlight=s.headlight,
        )  # fmt: skip

    def state(self) -> list[int]:
        return [self.placed, self.latest]

    def restore(self, state: Any) -> None:
        """Take up what `state` gave."""
        self.placed, self.latest = state


def seen_by(view: View, camera: Camera, positions: Array) -> Cloud:
    """The points that a camera sees, one per pixel at most, in its own coordinates.

    Their colours are the photograph's; they have no normals.
    """
    depth = point_depth(positions, camera, view.width, view.height)
    seen = (depth > 0) & view.valid()
    local = replace(camera.resized(view.width, view.height), cam_from_world=np.eye(4))
    found = local.unproject(depth)[seen]
    colors = view.image[seen].astype(np.float64)
    return Cloud(found, colors, np.zeros_like(found), np.ones(len(found)))


def next_pose(poses: Array) -> Array:
    """[3, 4] where the camera is next: it goes on moving as between the last two of [K, 3, 4]."""
    if len(poses) < 2:
        return np.array(poses[-1])
    before, last = (np.vstack([pose, [0, 0, 0, 1]]) for pose in poses[-2:])
    return np.asarray((last @ np.linalg.inv(before) @ last)[:3])
