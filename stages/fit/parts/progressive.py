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

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import ReconstructionError
from pipeline.geometry.order import viewing_order
from stages.fit.arrays import Array, Floats
from stages.fit.parts.base import Part, interpolate
from stages.fit.parts.camera import PoseOptimizer
from stages.fit.settings import Count, PartSettings

if TYPE_CHECKING:
    from pipeline.artifacts.cameras import Camera
    from pipeline.artifacts.views import View
    from stages.fit.inputs.initial import Cloud
    from stages.fit.trainer import Trainer

#: where Gaussians let more light through than this, they don't show what a frame sees
UNCOVERED = 0.5
#: learning rates of the pose at the first and the last of the steps that place a view
POSE_RATES = 3e-3, 3e-5


class Progressive(Part, switch="progressive", on=True, off=False, kept=("placed", "latest")):
    """Which frames take part yet, and how the next one is added.

    Attributes:
        order: of the views; those that see no point are not placed, and stay where they are.
        placed: how many of them take part.
        latest: iteration at which the last of those was added.
    """

    class Settings(PartSettings):
        progressive: bool = False
        """bring in the views one after another in viewing order, each placed by the Gaussians of
        those before it (CF-3DGS); of the poses found before, only the first one's is used"""
        progressive_iterations: Count = 100
        """progressive: iterations per view until the next one is placed"""
        progressive_pose_iterations: Count = 300
        """progressive: steps that place a view, with the Gaussians frozen"""

    def __init__(self, fit: Trainer) -> None:
        """From here on the fit knows of the first frame only.

        Lenses, order and depth come from the scene's cameras; of the poses, only the first one's.
        """
        from stages.fit.inputs.initial import thin

        super().__init__(fit)
        self.cameras = fit.scene.cameras
        self.clouds = [
            thin(seen_by(view, camera, fit.scene.cloud.positions), self.settings.initial_points)
            for view, camera in zip(fit.scene.views, self.cameras, strict=True)
        ]
        order = viewing_order(np.array([camera.centre for camera in self.cameras]))
        self.order = [view for view in order if len(self.clouds[view])]
        if not self.order:
            raise ReconstructionError(
                "No photograph shows any of the points where its masks leave it, so there is "
                "nothing to begin with (fit.progressive). Look at what align and sap made."
            )
        self.placed = 1
        held = self.order[0]
        poses = fit.poses.poses
        fit.packed = self._gaussians(held, poses[held])
        poses[self.order] = poses[held]
        fit.poses = PoseOptimizer(poses, held)

    def begin(self, fit: Trainer) -> None:
        """Place the frames that are due before the next iteration."""
        while self.placed < self._due(fit.iteration):
            self._place(fit, self.order[self.placed])
        fit.views = self.order[: self.placed]

    def _due(self, iteration: int) -> int:
        """How many frames take part in the iteration after `iteration`; at the end, all of them."""
        s, count = self.settings, len(self.order)
        if iteration + 1 >= s.iterations:
            return count
        interval = min(float(s.progressive_iterations), s.iterations / count)
        return min(count, 1 + int(iteration / interval))

    def _place(self, fit: Trainer, view: int) -> None:
        s = self.settings
        fit.poses.poses[view] = next_pose(fit.poses.poses[self.order[: self.placed]])
        for step in range(s.progressive_pose_iterations):
            done = step / s.progressive_pose_iterations
            rate = interpolate(*POSE_RATES, done)
            self._find_pose(fit, view, rate)
        self._grow(fit, view)
        self.placed += 1
        self.latest = fit.iteration
        fit.queue = []

    def _find_pose(self, fit: Trainer, view: int, rate: float) -> None:
        """One step of a view's pose alone, by what the Gaussians cover of its image."""
        from stages.splatting.rasterizer import rasterize

        s, target = self.settings, fit.targets[view][1]
        viewpoint = fit.viewpoint(view, target)
        rendering = rasterize(fit.packed, viewpoint, degree=fit.degree(), near=s.near)
        colour = target.colour(fit.composited(view, rendering), s.lambda_dssim)
        d_planes = colour.gradient * (rendering.transmittance <= UNCOVERED)
        gradients = rendering.backward(d_planes, np.zeros_like(rendering.transmittance))
        # the frame's origin is in the middle of the scene
        fit.poses.step(view, gradients.pose, rate, pivot=fit.poses.poses[view][:, 3].copy())

    def _grow(self, fit: Trainer, view: int) -> None:
        """Add the Gaussians of a frame at pixels that those so far leave uncovered."""
        room = max(self.settings.max_gaussians - len(fit.packed), 0)
        transmittance = fit.render(view).transmittance
        height, width = transmittance.shape
        pixels, _ = replace(self.cameras[view], cam_from_world=np.eye(4)).project(
            self.clouds[view].positions
        )
        column, row = np.clip(pixels.astype(np.int64), 0, (width - 1, height - 1)).T
        new = np.flatnonzero(transmittance[row, column] > UNCOVERED)[:room]
        added = self._gaussians(view, fit.poses.poses[view])[new]
        count = len(fit.packed)
        fit.replace(
            np.ascontiguousarray(np.concatenate([fit.packed, added])),
            np.concatenate([np.arange(count), np.zeros(len(added), np.int64)]),
            np.arange(count + len(added)) >= count,
        )

    def _gaussians(self, view: int, pose: Array) -> Floats:
        """Packed Gaussians of a frame's points, seen from a pose [3, 4]."""
        from stages.fit.inputs.initial import initial_gaussians

        s, cloud = self.settings, self.clouds[view]
        camera = replace(self.cameras[view], cam_from_world=np.vstack([pose, [0, 0, 0, 1]]))
        there = replace(cloud, positions=(cloud.positions - pose[:, 3]) @ pose[:, :3])
        return initial_gaussians(
            there, [camera], opacity=s.initial_opacity, scale=s.initial_scale,
            scale_max_px=s.initial_scale_max_px, degree=s.sh_degree, headlight=s.headlight,
            shoulder=s.headlight_shoulder,
        )  # fmt: skip


def seen_by(view: View, camera: Camera, positions: Array) -> Cloud:
    """The points that a camera sees, one per pixel at most, in its own coordinates.

    Their colours are the photograph's; they have no normals.
    """
    from stages.fit.inputs.initial import Cloud
    from stages.fit.inputs.targets import point_depth

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
