"""What lies between Gaussians and photographs: background, exposure, poses, focal length."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.geometry.rigid import moved_by
from stages.fit import numerics
from stages.fit.arrays import Array, Floats
from stages.fit.parts.base import Figures, Part, Step, interpolate
from stages.fit.settings import (
    AUTO,
    AutoColour,
    AutoFloat,
    PartSettings,
    Weight,
    Whole,
    automatic,
)

if TYPE_CHECKING:
    from stages.fit.trainer import Trainer

#: learning rate of the logarithm of the factor that all views' focal lengths share
FOCAL_RATE = 1e-4


class Background(
    Part, switch="", absent={"background": (0.0, 0.0, 0.0)}, kept=("values", "moments", "steps")
):
    """What no Gaussian stands before still has a colour: a dark throat, a cheek out of focus.

    Where part of the photographs is masked out, nobody knows what is behind, and it stays black.

    Attributes:
        values: [3] float64 sRGB in 0..1, with Adam on it.
        learned: whether it is found by the fit, or given.
    """

    class Settings(PartSettings):
        background: AutoColour = automatic(
            "found by the fit; black where photographs are partly masked out", ge=None
        )
        """colour behind everything, sRGB 0..1"""
        background_lr: Weight = 1e-2
        """learning rate of that colour"""

    def __init__(self, fit: Trainer) -> None:
        super().__init__(fit)
        given: Any = self.settings.background
        free = given == AUTO
        whole = all(bool(view[min(view)].colour.mask.all()) for view in fit.targets)
        # a view that is still to be placed must not find what is missing painted behind
        self.learned = free and whole and not self.settings.progressive
        self.values = np.zeros(3) if free else np.array(given, np.float64)
        self.moments, self.steps = np.zeros((2, 3)), 0

    def show(self, view: int | None, image: Floats, transmittance: Floats) -> Floats:
        return (
            numerics.background.behind(image, transmittance, self.values)
            if self.values.any()
            else image
        )

    def compare(self, fit: Trainer, step: Step) -> None:
        if not (self.learned or self.values.any()):
            return
        gradient = numerics.background.pulled_back(
            step.d_planes[:3], step.rendering.transmittance, self.values, step.d_transmittance
        )
        if not self.learned:
            return
        self.steps += 1
        move, *moments = numerics.moments.adam_step(
            gradient,
            self.moments[0],
            self.moments[1],
            self.steps,
            self.settings.background_lr,
            0.99,
        )
        self.moments[:] = moments
        self.values = np.clip(self.values - move, 0, 1)


class Exposure(Part, switch="exposure", on=True, off=False, kept=("values", "moments", "steps")):
    """A gain and a bias per view and channel, so that exposure does not become geometry.

    Adam on them; their means over the views stay 1 and 0.

    Attributes:
        values: [V, 2, 3] gain and bias.
        moments: [2, V, 2, 3].
        steps: [V] of each view: some come later, and what is masked wholly never.
        before: [3, H, W] the image last shown, as the scene has it.
    """

    class Settings(PartSettings):
        exposure: bool = False
        """fit a gain and a bias per view and channel, for cameras that change exposure; the scene
        has their mean, and is evaluated as it is"""
        # on a held surface each of three views has some fifty steps
        exposure_lr: AutoFloat = automatic({3: 1e-3}, held=0.01, ge=None, gt=0)
        """learning rate of exposure"""

    def __init__(self, fit: Trainer) -> None:
        super().__init__(fit)
        self.values = np.tile(np.array([[1.0], [0.0]]), (len(fit.targets), 1, 3))
        self.moments = np.zeros((2, *self.values.shape))
        self.steps = np.zeros(len(fit.targets), np.int64)
        self.before: Floats = np.empty((3, 0, 0), np.float32)

    def show(self, view: int | None, image: Floats, transmittance: Floats) -> Floats:
        if view is None:
            return image
        self.before = image
        gain, bias = self.values[view].astype(np.float32)
        return np.asarray(image * gain[:, None, None] + bias[:, None, None], np.float32)

    def compare(self, fit: Trainer, step: Step) -> None:
        self.steps[step.view] += 1
        d_image = step.d_planes[:3]
        gain = self.values[step.view, 0].astype(np.float32)
        by_gain = (d_image * self.before).sum((1, 2), dtype=np.float64)
        gradient = np.stack([by_gain, d_image.sum((1, 2), dtype=np.float64)])
        first, second = self.moments[:, step.view]
        move, *moments = numerics.moments.adam_step(
            gradient, first, second, int(self.steps[step.view]), self.settings.exposure_lr
        )
        self.moments[:, step.view] = moments
        self.values[step.view] -= move
        # a gain common to all views is the scene's brightness
        self.values[:, 0] /= self.values[:, 0].mean(0)
        self.values[:, 1] -= self.values[:, 1].mean(0)
        d_image *= gain[:, None, None]

    def summary(self) -> Figures:
        gains = self.values[:, 0]
        return {"exposure_gains": f"{gains.min():.2f} to {gains.max():.2f}"}


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

    def follow(self, fit: Trainer, step: Step) -> None:
        found = [(step.gradients.focal, step.viewpoint)]
        if step.following is not None:  # flow leads from one view to another, and both have it
            found.append((step.gradients.next_focal, step.following))
        by_log = sum(float(by @ view.intrinsics[:2].astype(np.float64)) for by, view in found)
        fit.focal.step(by_log, FOCAL_RATE)


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
        move, self.first[view], self.second[view] = numerics.moments.adam_step(
            gradient, self.first[view], self.second[view], int(self.steps[view]), rate
        )
        twist = -move
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

    def step(self, by_log: float, rate: float) -> None:
        """Move against the gradient by the factor's logarithm."""
        self.steps += 1
        move, self.first, self.second = numerics.moments.adam_step(
            by_log, self.first, self.second, self.steps, rate
        )
        self.log_factor -= float(move)
