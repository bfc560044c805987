"""The optimisation: Gaussians and camera poses against photographs."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.errors import ReconstructionError
from stages.fit.checkpoint import Arrays, load_checkpoint, save_checkpoint
from stages.fit.density import DensityStatistics, choose, grow
from stages.fit.poses import PoseOptimizer
from stages.fit.settings import FitSettings
from stages.fit.targets import Target
from stages.splatting.adam import Adam
from stages.splatting.rasterizer import Rendering, Viewpoint, rasterize

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]

#: where less light than this is stopped, depth and flow are of what lies behind as well
MIN_ALPHA = 0.5


class Trainer:
    """One fit, in a frame where the scene's depth is about 1.

    Attributes:
        packed: [N, 11 + 3 K] float32 Gaussians.
        poses: the cameras' optimiser, which holds the poses.
        iteration: steps taken.
        psnr, loss: running means over recent iterations.
    """

    def __init__(
        self,
        packed: Floats,
        poses: Array,
        held: int,
        targets: Sequence[dict[int, Target]],
        extent: float,
        settings: FitSettings,
    ) -> None:
        """
        Args:
            packed: [N, 11 + 3 K] initial Gaussians.
            poses: [V, 3, 4] cam_from_frame.
            held: the camera whose pose is not refined.
            targets: per view, factor -> target.
            extent: size of the scene that the position rate is relative to.
            settings: all constants.
        """
        self.settings = settings
        self.targets = targets
        self.extent = extent
        self.packed = packed
        self.poses = PoseOptimizer(poses, held)
        self.adam = Adam(packed.shape, 0.9, 0.999, 1e-15)
        self.statistics = DensityStatistics.empty(len(packed))
        # one gain and one bias per channel and view
        self.exposure = np.tile(np.array([[1.0], [0.0]]), (len(poses), 1, 3))
        self.exposure_moments = np.zeros((2, *self.exposure.shape))
        self.random = np.random.Generator(np.random.PCG64(settings.seed))
        self.queue: list[int] = []
        self.iteration = 0
        self.loss = self.psnr = 0.0
        shape = (packed.shape, poses.shape, [sorted(t) for t in targets])
        # how often a checkpoint is written says nothing about what is in it
        constants = replace(settings, checkpoint_every=1)
        content = hashlib.sha256(repr((constants, extent, held, shape)).encode())
        content.update(packed.tobytes())
        content.update(poses.tobytes())
        self.fingerprint = content.hexdigest()

    def viewpoint(self, view: int, target: Target) -> Viewpoint:
        pose = np.ascontiguousarray(self.poses.poses[view], np.float32)
        return Viewpoint(pose, target.intrinsics, target.width, target.height)

    def degree(self) -> int:
        """Degree of the harmonics now: all of them, or one more every interval."""
        every = self.settings.sh_degree_interval
        if every <= 0:
            return self.settings.sh_degree
        return min(self.settings.sh_degree, self.iteration // every)

    def render(self, view: int, factor: int = 1) -> Rendering:
        """The view as the Gaussians stand now, colour only."""
        target = self.targets[view][factor]
        return rasterize(
            self.packed, self.viewpoint(view, target), degree=self.settings.sh_degree,
            near=self.settings.near,
        )  # fmt: skip

    def composited(self, view: int, rendering: Rendering) -> Floats:
        """[3, H, W] colour over the background, with the view's exposure."""
        image = rendering.planes[:3]
        if any(self.settings.background):
            behind = np.asarray(self.settings.background, np.float32)[:, None, None]
            image = image + rendering.transmittance * behind
        if self.settings.exposure:
            gain, bias = self.exposure[view].astype(np.float32)
            image = image * gain[:, None, None] + bias[:, None, None]
        return np.ascontiguousarray(image)

    def step(self) -> None:
        """One iteration: one view."""
        s = self.settings
        if not self.queue:
            self.queue = [int(v) for v in self.random.permutation(len(self.targets))]
        view = self.queue.pop()
        self.iteration += 1
        coarse = self.iteration <= s.coarse_fraction * s.iterations
        target = self.targets[view][s.coarse_factor if coarse else 1]
        flow = target.flow if s.lambda_flow > 0 else None
        # the depth prior on every other iteration, twice as heavy: it costs a channel and changes
        # slowly
        with_depth = s.lambda_depth > 0 and self.iteration % 2 == 0 and bool(target.depth.any())
        following = None
        if flow is not None:
            following = self.viewpoint(
                flow.to, self.targets[flow.to][s.coarse_factor if coarse else 1]
            )
        rendering = rasterize(
            self.packed, self.viewpoint(view, target), degree=self.degree(), near=s.near,
            depth=with_depth, flow_to=following,
        )  # fmt: skip
        image = self.composited(view, rendering)
        colour = target.colour(image, s.lambda_dssim)
        loss = colour.loss
        d_planes = np.zeros_like(rendering.planes)
        d_transmittance = np.zeros_like(rendering.transmittance)
        d_image = colour.gradient
        if s.exposure:
            d_image = self._step_exposure(view, rendering, d_image)
        d_planes[:3] = d_image
        if any(s.background):
            behind = np.asarray(s.background, np.float32)[:, None, None]
            d_transmittance += (d_image * behind).sum(0)
        if with_depth:
            loss += 2 * s.lambda_depth * depth_loss(
                rendering, target.depth, 2 * s.lambda_depth, d_planes[3], d_transmittance
            )  # fmt: skip
        if flow is not None:
            first = 3 + int(with_depth)
            loss += s.lambda_flow * flow_loss(
                rendering.planes[first:], rendering.transmittance, flow.flow, flow.mask,
                s.lambda_flow, d_planes[first:], d_transmittance,
            )  # fmt: skip
        gradients = rendering.backward(d_planes, d_transmittance)
        if not np.isfinite(loss) or not np.isfinite(gradients.pose).all():
            raise ReconstructionError(
                f"The fit diverged at iteration {self.iteration} of {s.iterations} (view "
                f"{view}): its loss is not a number any more. Lower the learning rates "
                "(fit.feature_lr, fit.scaling_lr, fit.pose_lr_init), or look at the cameras and "
                "the points that it started from ('pipeline status'). The last good state is kept "
                "as a checkpoint."
            )
        self.adam.step(self.packed, gradients.packed, self.rates())
        if s.optimize_poses and self.iteration >= s.pose_from_iter:
            rate = interpolate(s.pose_lr_init, s.pose_lr_final, self.iteration / s.iterations)
            self.poses.step(view, gradients.pose, rate)
            if flow is not None:
                self.poses.step(flow.to, gradients.next_pose, rate)
        if s.densify:
            self.statistics.add(
                gradients.centres, gradients.absolute, rendering.visible, target.width,
                target.height,
            )  # fmt: skip
            self._control_density()
        # running means over about the last 20 iterations, and the plain mean before
        share = max(1 / self.iteration, 0.05)
        self.loss += share * (loss - self.loss)
        self.psnr += share * (colour.psnr - self.psnr)

    def rates(self) -> Floats:
        """[D] learning rate of each column now."""
        s = self.settings
        rates = np.empty(self.packed.shape[1], np.float32)
        done = self.iteration / s.iterations
        rates[0:3] = self.extent * interpolate(s.position_lr_init, s.position_lr_final, done)
        rates[3:7] = s.rotation_lr
        rates[7:10] = s.scaling_lr
        rates[10] = s.opacity_lr
        rates[11:14] = s.feature_lr
        rates[14:] = s.feature_rest_lr
        return rates

    def _control_density(self) -> None:
        s = self.settings
        now = self.iteration
        within = s.densify_from_iter <= now <= s.densify_until_iter
        if within and now % s.densification_interval == 0:
            largest = np.exp(self.packed[:, 7:10]).max(1)
            clone, split = choose(
                self.statistics, largest, small=s.percent_dense * self.extent, absgrad=s.absgrad,
                grad_threshold=s.densify_grad_threshold,
                abs_grad_threshold=s.densify_abs_grad_threshold,
                room=s.max_gaussians - len(self.packed),
            )  # fmt: skip
            keep = self.packed[:, 10] > logit(s.prune_opacity)
            self.replace(*grow(self.packed, clone, split, keep, self.random))
        if s.opacity_reset_interval > 0 and now % s.opacity_reset_interval == 0:
            ceiling = np.float32(logit(2 * s.prune_opacity))
            self.packed[:, 10] = np.minimum(self.packed[:, 10], ceiling)
            self.adam.first[:, 10] = 0
            self.adam.second[:, 10] = 0

    def replace(
        self, packed: Floats, source: npt.NDArray[np.int64], fresh: npt.NDArray[np.bool_]
    ) -> None:
        """Put other rows in place; the optimiser's rows follow `source`."""
        self.packed = packed
        self.adam.select(source, fresh)
        self.statistics = DensityStatistics.empty(len(packed))

    def _step_exposure(self, view: int, rendering: Rendering, d_image: Floats) -> Floats:
        """Move a view's gain and bias; returns the gradient of the image before them."""
        gain = self.exposure[view, 0].astype(np.float32)
        by_gain = (d_image * rendering.planes[:3]).sum((1, 2), dtype=np.float64)
        gradient = np.stack([by_gain, d_image.sum((1, 2), dtype=np.float64)])
        first, second = self.exposure_moments[:, view]
        first[:] = 0.9 * first + 0.1 * gradient
        second[:] = 0.999 * second + 0.001 * gradient**2
        # the same number of steps for every view, to within one
        steps = 1 + (self.iteration - 1) // len(self.targets)
        mean, spread = first / (1 - 0.9**steps), np.sqrt(second / (1 - 0.999**steps))
        self.exposure[view] -= self.settings.exposure_lr * mean / (spread + 1e-15)
        # a gain common to all views is the scene's brightness
        self.exposure[:, 0] /= self.exposure[:, 0].mean(0)
        self.exposure[:, 1] -= self.exposure[:, 1].mean(0)
        return np.asarray(d_image * gain[:, None, None], np.float32)

    def run(
        self, checkpoint: Path | None, report: Callable[[int, float, float, int], None]
    ) -> None:
        """Step until the last iteration, from the checkpoint if there is a usable one.

        Args:
            checkpoint: file to save to and start from, or None.
            report: called with iteration, loss, PSNR and number of Gaussians.
        """
        if checkpoint is not None:
            self.restore(checkpoint)
        total = self.settings.iterations
        while self.iteration < total:
            self.step()
            now = self.iteration
            if now % 10 == 0 or now == total:
                report(now, self.loss, self.psnr, len(self.packed))
            due = now % self.settings.checkpoint_every == 0 or now == total
            if checkpoint is not None and due and np.isfinite(self.packed).all():
                self.save(checkpoint)

    def save(self, path: Path) -> None:
        """Write the whole state."""
        arrays: Arrays = {
            "packed": self.packed,
            "first": self.adam.first,
            "second": self.adam.second,
            "signed": self.statistics.signed,
            "absolute": self.statistics.absolute,
            "seen": self.statistics.seen,
            "poses": self.poses.poses,
            "pose_first": self.poses.first,
            "pose_second": self.poses.second,
            "pose_steps": self.poses.steps,
            "exposure": self.exposure,
            "exposure_moments": self.exposure_moments,
        }
        facts = {
            "fingerprint": self.fingerprint,
            "iteration": self.iteration,
            "adam_steps": self.adam.steps,
            "queue": self.queue,
            "random": self.random.bit_generator.state,
            "loss": self.loss,
            "psnr": self.psnr,
        }
        save_checkpoint(path, arrays, facts)

    def restore(self, path: Path) -> bool:
        """Take up a saved state; False where there is none of this very fit."""
        loaded = load_checkpoint(path)
        if loaded is None or loaded[1].get("fingerprint") != self.fingerprint:
            return False
        arrays, facts = loaded
        self.packed = arrays["packed"]
        self.adam.first, self.adam.second = arrays["first"], arrays["second"]
        self.adam.steps = facts["adam_steps"]
        self.statistics = DensityStatistics(arrays["signed"], arrays["absolute"], arrays["seen"])
        self.poses.poses = arrays["poses"]
        self.poses.first, self.poses.second = arrays["pose_first"], arrays["pose_second"]
        self.poses.steps = arrays["pose_steps"]
        self.exposure, self.exposure_moments = arrays["exposure"], arrays["exposure_moments"]
        state: Any = facts["random"]
        self.random.bit_generator.state = state
        self.queue, self.iteration = facts["queue"], facts["iteration"]
        self.loss, self.psnr = facts["loss"], facts["psnr"]
        return True

    def training_scores(self) -> tuple[Array, Array]:
        """PSNR [V] in dB and SSIM [V] of every view at full size."""
        results = []
        for view, target in enumerate(self.targets):
            image = np.clip(self.composited(view, self.render(view)), 0, 1)
            result = target[1].colour(image, self.settings.lambda_dssim)
            results.append((result.psnr, result.ssim))
        psnr, ssim = np.array(results).T
        return psnr, ssim


def logit(probability: float) -> float:
    return float(np.log(probability / (1 - probability)))


def interpolate(start: float, end: float, done: float) -> float:
    """Exponential from `start` (done = 0) to `end` (done = 1); linear where one of them is 0."""
    if start <= 0 or end <= 0:
        return start + (end - start) * done
    return float(start * (end / start) ** done)


def depth_loss(
    rendering: Rendering, depth: Floats, weight: float, d_plane: Floats, d_transmittance: Floats
) -> float:
    """Mean |depth / alpha - target| where points are seen; adds `weight` times its gradient."""
    alpha = np.maximum(1 - rendering.transmittance, np.float32(1e-3))
    seen = (depth > 0) & (alpha > MIN_ALPHA)
    count = max(int(seen.sum()), 1)
    mean = rendering.planes[3] / alpha
    error = (mean - depth) * seen
    by_mean = np.sign(error) * np.float32(weight / count)
    d_plane += by_mean / alpha
    d_transmittance += by_mean * mean / alpha
    return float(np.abs(error).sum(dtype=np.float64)) / count


def flow_loss(
    planes: Floats, transmittance: Floats, flow: Floats, mask: Floats, weight: float,
    d_planes: Floats, d_transmittance: Floats,
) -> float:  # fmt: skip
    """Mean length of the flow error in px over the mask; adds `weight` times its gradient.

    Composited flow is divided by alpha: the weights of GaussianFlow are normalised. Gradients reach
    the weights as well.
    """
    alpha = np.maximum(1 - transmittance, np.float32(1e-3))
    trusted = (mask > 0) & (alpha > MIN_ALPHA)
    count = max(int(trusted.sum()), 1)
    mean = planes / alpha
    error = (mean - flow) * trusted
    length = np.sqrt((error**2).sum(0) + np.float32(1e-8))
    by_mean = error / length * np.float32(weight / count)
    d_planes += by_mean / alpha
    d_transmittance += (by_mean * mean).sum(0) / alpha
    return float((length * trusted).sum(dtype=np.float64)) / count
