"""Refinement of cameras: a twist per step and view, one held; one factor of the focal length."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipeline.geometry.rigid import moved_by
from stages.fit.parts.base import Array, Floats, Part, Step, interpolate
from stages.fit.settings import AutoFloat, PartSettings, Positive, Whole, automatic

if TYPE_CHECKING:
    from stages.fit.trainer import Trainer


class Poses(Part, switch="optimize_poses", on=True, off=False):
    """Camera poses are refined with the Gaussians."""

    class Settings(PartSettings):
        optimize_poses: bool = True
        """refine the camera poses as well"""
        pose_lr_init: AutoFloat = automatic({3: 3e-4})
        """learning rate of pose increments at the start, radians and units of the scene's depth"""
        pose_lr_final: AutoFloat = automatic({3: 3e-6})
        """learning rate of pose increments at the end"""
        pose_from_iter: Whole = 0
        """first iteration that refines poses"""

    def follow(self, fit: Trainer, step: Step) -> None:
        s = self.settings
        if fit.iteration < s.pose_from_iter:
            return
        rate = interpolate(s.pose_lr_init, s.pose_lr_final, step.done)
        fit.poses.step(step.view, step.by_pose, rate)
        if step.flow is not None:
            fit.poses.step(step.flow.to, step.gradients.next_pose, rate)


class Focal(Part, switch="optimize_focal", on=True, off=False):
    """The focal length is refined, by one factor that all views share."""

    class Settings(PartSettings):
        optimize_focal: bool = False
        """refine the focal length as well, by one factor that all views share"""
        focal_lr: Positive = 1e-4
        """learning rate of that factor's logarithm"""

    def follow(self, fit: Trainer, step: Step) -> None:
        rate = self.settings.focal_lr
        fit.focal.step(step.gradients.focal, step.viewpoint.intrinsics, rate)


class PoseOptimizer:
    """Adam on the poses.

    Attributes:
        poses: [V, 3, 4] float64 cam_from_world.
        first, second: [V, 6] moments.
        steps: [V] steps taken.
        held: index of the camera that stays where it is: the gauge.
    """

    def __init__(self, poses: Array, held: int) -> None:
        self.poses = poses.copy()
        self.first = np.zeros((len(poses), 6))
        self.second = np.zeros((len(poses), 6))
        self.steps = np.zeros(len(poses), np.int64)
        self.held = held

    def step(self, view: int, gradient: Array, rate: float, pivot: Array | None = None) -> None:
        """Move one view's pose against the gradient [6] of its twist.

        Args:
            pivot: [3] in the camera, what the camera turns about; None: itself. A camera that
                turns about what it looks at hardly moves the image, so that a long way round
                a scene is a few easy steps and not a narrow valley between turning and shifting.
        """
        if view == self.held:
            return
        if pivot is not None:
            gradient = gradient + np.concatenate([np.zeros(3), np.cross(gradient[:3], pivot)])
        self.steps[view] += 1
        step = int(self.steps[view])
        self.first[view] = 0.9 * self.first[view] + 0.1 * gradient
        self.second[view] = 0.999 * self.second[view] + 0.001 * gradient**2
        mean = self.first[view] / (1 - 0.9**step)
        spread = np.sqrt(self.second[view] / (1 - 0.999**step))
        twist = -rate * mean / (spread + 1e-15)
        if pivot is not None:
            twist[:3] += np.cross(pivot, twist[3:])
        self.poses[view] = moved_by(twist, self.poses[view])


class SharedFocal:
    """Adam on one factor of all focal lengths.

    Attributes:
        log_factor: its logarithm.
    """

    def __init__(self) -> None:
        self.log_factor = self.first = self.second = 0.0
        self.steps = 0

    def apply(self, intrinsics: Floats) -> Floats:
        """[4] fx, fy, cx, cy with the factor."""
        if self.log_factor == 0:
            return intrinsics
        factor = np.float32(np.exp(self.log_factor))
        return intrinsics * np.array([factor, factor, 1, 1], np.float32)

    def step(self, gradient: Array, intrinsics: Floats, rate: float) -> None:
        """Move against the gradient [2] of fx and fy of a view whose intrinsics [4] were used."""
        by_log = float(gradient @ intrinsics[:2].astype(np.float64))
        self.steps += 1
        self.first = 0.9 * self.first + 0.1 * by_log
        self.second = 0.999 * self.second + 0.001 * by_log**2
        mean = self.first / (1 - 0.9**self.steps)
        spread = (self.second / (1 - 0.999**self.steps)) ** 0.5
        self.log_factor -= rate * mean / (spread + 1e-15)
