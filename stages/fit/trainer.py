"""The optimisation: Gaussians and camera poses against photographs."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import isqrt
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.errors import ReconstructionError
from stages.fit.background import Background
from stages.fit.density import DensityStatistics, choose, grow
from stages.fit.diary import write_curve, write_preview
from stages.fit.exposure import Exposure
from stages.fit.lens_light import LensLight
from stages.fit.mcmc import add_noise, add_regularisers, relocate
from stages.fit.objectives import depth_loss, flow_loss, interpolate, logit
from stages.fit.poses import PoseOptimizer, SharedFocal
from stages.fit.progressive import Progressive
from stages.fit.settings import FitSettings
from stages.fit.state import restore_state, save_state
from stages.fit.surface import HeldSurface
from stages.fit.targets import Target
from stages.fit.total_variation import TotalVariation
from stages.fit.warp import Warp, turned
from stages.splatting.adam import Adam
from stages.splatting.kernels.features import C0
from stages.splatting.kernels.projection import HARMONICS
from stages.splatting.rasterizer import Gradients, Rendering, Viewpoint, rasterize

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]

#: iterations between reports; the loss is a mean over several views
REPORT_EVERY = 10
#: iterations after which the loss is expected to have come down
SETTLED = 100


class Trainer:
    """One fit, in a frame where the scene's depth is about 1.

    Attributes:
        packed: [N, 11 + 3 K] float32 Gaussians.
        poses: the cameras' optimiser, which holds the poses.
        rasterize: what steps are taken with (see `backend`).
        variation: draws the colours of neighbours together.
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
        light: LensLight | None = None,
        held_surface: HeldSurface | None = None,
        warp: Warp | None = None,
        progressive: Progressive | None = None,
    ) -> None:
        """
        Args:
            packed: [N, 11 + 3 K] initial Gaussians (K = 1 with a light).
            poses: [V, 3, 4] cam_from_frame.
            held: the camera whose pose is not refined.
            targets: per view, factor -> target.
            extent: size of the scene that the position rate is relative to.
            settings: all constants.
            light: gives the colours, in place of the harmonics.
            held_surface: draws Gaussians back to where they started.
            warp: bends the surface that they started on.
            progressive: brings in the views one after another.
        """
        self.settings = settings
        self.light = light
        self.held_surface = held_surface
        self.warp = warp
        self.progressive = progressive
        self.targets = targets
        self.extent = extent
        self.packed = packed
        self.poses = PoseOptimizer(poses, held)
        self.adam = Adam(packed.shape, 0.9, 0.999, 1e-15)
        self.rasterize: Callable[..., Any] = rasterize
        s = settings
        self.variation = TotalVariation(s.lambda_tv, s.tv_neighbours, s.tv_tolerance)
        self.statistics = DensityStatistics.empty(len(packed))
        self.exposure = Exposure(len(poses))
        self.background = Background(settings, targets)
        self.focal = SharedFocal()
        self.random = np.random.Generator(np.random.PCG64(settings.seed))
        self.queue: list[int] = []
        self.iteration = 0
        self.loss = self.psnr = 0.0
        self.best_loss = np.inf
        self.curve: list[tuple[int, float, float, int]] = []
        shape = (packed.shape, poses.shape, [sorted(t) for t in targets])
        # how often a checkpoint is written says nothing about what is in it
        constants = replace(settings, checkpoint_every=1)
        content = hashlib.sha256(repr((constants, extent, held, shape)).encode())
        content.update(packed.tobytes())
        content.update(poses.tobytes())
        if light is not None:
            content.update(light.material.tobytes())
        if held_surface is not None:
            content.update(held_surface.anchor.tobytes())
        self.fingerprint = content.hexdigest()
        self._use_harmonics()

    def viewpoint(self, view: int, target: Target) -> Viewpoint:
        pose = np.ascontiguousarray(self.poses.poses[view], np.float32)
        intrinsics = self.focal.apply(target.intrinsics)
        return Viewpoint(pose, intrinsics, target.width, target.height)

    def degree(self) -> int:
        """Degree of the harmonics now: all of them, or one more every interval."""
        if self.light is not None:
            return 0
        every = self.settings.sh_degree_interval
        if every <= 0:
            return self.settings.sh_degree
        return min(self.settings.sh_degree, self.iteration // every)

    def _use_harmonics(self) -> None:
        """Keep what the degree needs by now: harmonics still to come are 0, and cost time."""
        used = HARMONICS + 3 * (self.degree() + 1) ** 2
        missing = used - self.packed.shape[1]
        free = self.light is None and self.progressive is None
        if missing and free and not self.packed[:, used:].any():
            self.packed = np.pad(self.packed[:, :used], ((0, 0), (0, max(0, missing))))
            self.adam.resize(used)

    def picture(self, pose: Array, target: Target) -> Floats:
        """[3, H, W] what a camera that is none of the fit's sees, without exposure."""
        local = np.ascontiguousarray(pose, np.float32)
        intrinsics = self.focal.apply(target.intrinsics)
        rendering = self.look(Viewpoint(local, intrinsics, target.width, target.height))
        image = self.background.behind(rendering.planes[:3], rendering.transmittance)
        return np.ascontiguousarray(image)

    def render(self, view: int, factor: int = 1) -> Rendering:
        """A view as the Gaussians stand now, colour only."""
        return self.look(self.viewpoint(view, self.targets[view][factor]))

    def look(self, viewpoint: Viewpoint) -> Rendering:
        """The Gaussians from anywhere, colour only."""
        if self.light is not None:
            self.light.shade(self.packed, viewpoint)
        terms = (self.packed.shape[1] - HARMONICS) // 3
        degree = 0 if self.light is not None else min(self.settings.sh_degree, isqrt(terms) - 1)
        return rasterize(self.packed, viewpoint, degree=degree, near=self.settings.near)

    def composited(self, view: int, rendering: Rendering) -> Floats:
        """[3, H, W] colour over the background, with the view's exposure."""
        image = self.background.behind(rendering.planes[:3], rendering.transmittance)
        if self.settings.exposure:
            image = self.exposure.apply(view, image)
        return np.ascontiguousarray(image)

    def step(self) -> None:
        """One iteration: one view."""
        s = self.settings
        views = list(range(len(self.targets)))
        if self.progressive is not None:
            views = self.progressive.advance(self)
        if not self.queue:
            self.queue = [int(v) for v in self.random.permutation(views)]
        view = self.queue.pop()
        self.iteration += 1
        self._use_harmonics()
        factor = s.coarse_factor if self.iteration <= s.coarse_fraction * s.iterations else 1
        target = self.targets[view][factor]
        flow = target.flow if self._with_flow() else None
        following = None if flow is None else self.viewpoint(flow.to, self.targets[flow.to][factor])
        viewpoint = self.viewpoint(view, target)
        if self.light is not None:
            self.light.shade(self.packed, viewpoint)
        rendering = self.rasterize(
            self.packed, viewpoint, degree=self.degree(), near=s.near,
            depth=self._with_depth(target), flow_to=following,
        )  # fmt: skip
        loss, psnr, gradients = self._compare(view, target, rendering)
        by_pose = gradients.pose
        done = self.iteration / s.iterations
        if self.light is not None:
            by_pose = by_pose + self.light.step(
                self.packed, viewpoint, gradients, self.variation, done
            )
        if not np.isfinite(loss) or not np.isfinite(by_pose).all():
            raise self.diverged(f"its loss is not a number any more (view {view})")
        self._step_gaussians(gradients)
        if s.optimize_poses and self.iteration >= s.pose_from_iter:
            rate = interpolate(s.pose_lr_init, s.pose_lr_final, done)
            self.poses.step(view, by_pose, rate)
            if flow is not None:
                self.poses.step(flow.to, gradients.next_pose, rate)
        if s.optimize_focal:  # never on a card
            self.focal.step(gradients.focal, viewpoint.intrinsics, s.focal_lr)
        if s.densify and s.strategy == "default":
            self.statistics.add(
                gradients.centres, gradients.absolute, rendering.visible, target.width,
                target.height,
            )  # fmt: skip
        if s.densify:
            self._control_density()
        # running means over about the last 20 iterations, and the plain mean before
        share = max(1 / self.iteration, 0.05)
        self.loss += share * (loss - self.loss)
        self.psnr += share * (psnr - self.psnr)

    def find_pose(self, view: int, rate: float, uncovered: float) -> None:
        """One step of a view's pose alone, by what the Gaussians cover of its image.

        Args:
            rate: of learning, radians and units of the frame.
            uncovered: pixels that let more light through than this say nothing.
        """
        target, s = self.targets[view][1], self.settings
        viewpoint = self.viewpoint(view, target)
        rendering = rasterize(self.packed, viewpoint, degree=self.degree(), near=s.near)
        colour = target.colour(self.composited(view, rendering), s.lambda_dssim)
        d_planes = colour.gradient * (rendering.transmittance <= uncovered)
        gradients = rendering.backward(d_planes, np.zeros_like(rendering.transmittance))
        # the frame's origin is in the middle of the scene
        self.poses.step(view, gradients.pose, rate, pivot=self.poses.poses[view][:, 3].copy())

    def _with_depth(self, target: Target) -> bool:
        """Depth and flow take turns, each twice as heavy: they change slowly, and cost channels."""
        wanted = self.settings.lambda_depth > 0 and self.iteration % 2 == 0
        return wanted and bool(target.depth.any())

    def _with_flow(self) -> bool:
        return self.settings.lambda_flow > 0 and self.iteration % 2 == 1

    def _compare(
        self, view: int, target: Target, rendering: Rendering
    ) -> tuple[float, float, Gradients]:
        """Loss, PSNR, and the gradients of a rendered view."""
        s = self.settings
        image = self.composited(view, rendering)
        colour = target.colour(image, s.lambda_dssim, s.saturation)
        loss, d_image = colour.loss, colour.gradient
        d_transmittance = np.zeros_like(rendering.transmittance)
        if s.exposure:
            # the same number of steps for every view, to within one
            steps = 1 + (self.iteration - 1) // len(self.targets)
            unexposed = self.background.behind(rendering.planes[:3], rendering.transmittance)
            d_image = self.exposure.step(view, unexposed, d_image, s.exposure_lr, steps)
        self.background.step(d_image, rendering.transmittance, d_transmittance)
        d_planes = d_image
        if len(rendering.planes) > len(d_image):
            d_planes = np.zeros_like(rendering.planes)
            d_planes[:3] = d_image
        with_depth = self._with_depth(target)
        if with_depth:
            loss += 2 * s.lambda_depth * depth_loss(
                rendering, target.depth, 2 * s.lambda_depth, d_planes[3], d_transmittance
            )  # fmt: skip
        if target.flow is not None and self._with_flow():
            loss += 2 * s.lambda_flow * flow_loss(
                rendering.planes[3:], rendering.transmittance, target.flow.flow,
                target.flow.mask, 2 * s.lambda_flow, d_planes[3:], d_transmittance,
            )  # fmt: skip
        return loss, colour.psnr, rendering.backward(d_planes, d_transmittance)

    def _step_gaussians(self, gradients: Gradients) -> None:
        s = self.settings
        gradient = gradients.packed
        add_regularisers(self.packed, gradient, s.opacity_reg, s.scale_reg)
        if self.light is None:
            self.variation.add(
                self.packed[:, :3],
                self.packed,
                HARMONICS,
                self.packed.shape[1],
                gradient,
                float(C0),
            )
        if s.isotropic:
            gradient[:, 7:10] = gradient[:, 7:10].mean(1, keepdims=True)
        rates = self.rates()
        self._bend(gradient)
        self.adam.step(self.packed, gradient, rates)
        if s.densify and s.strategy == "mcmc":
            add_noise(self.packed, s.noise_lr * float(rates[0]), self.random)
        if self.held_surface is not None:
            self.held_surface.pull(self.packed)

    def _bend(self, gradient: Floats) -> None:
        """Let the surface as a whole follow the gradients of the Gaussians on it."""
        s, light, warp = self.settings, self.light, self.warp
        done = self.iteration / s.iterations
        frozen = self.held_surface is not None and done < s.hold_colors_until
        if warp is None or frozen:
            return
        warp.collect(gradient[:, :3], None if light is None else light.by_normal)
        before = warp.facing
        bent = warp.move(interpolate(s.warp_lr_init, s.warp_lr_final, done))
        if bent is None:
            return
        self.packed[:, :3] += bent.move
        self.packed[:, 3:7] = turned(self.packed[:, 3:7], before, warp.facing)
        if light is not None:
            light.material[:, 3:] += bent.lean
        if self.held_surface is not None:
            self.held_surface.follow(bent.move, warp.facing)

    def diverged(self, what: str) -> ReconstructionError:
        return ReconstructionError(
            f"The fit diverged at iteration {self.iteration} of {self.settings.iterations}: "
            f"{what}. Lower the learning rates (fit.feature_lr, fit.scaling_lr, "
            "fit.pose_lr_init), or look at the cameras and the points that it started from "
            "('pipeline status'). The last good state is kept as a checkpoint."
        )

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
        if s.isotropic:
            rates[3:7] = 0
        if self.held_surface is not None and done < s.hold_colors_until:
            rates[:11] = 0
        return rates

    def _control_density(self) -> None:
        s = self.settings
        now = self.iteration
        within = s.densify_from_iter <= now <= s.densify_until_iter
        due = within and now % s.densification_interval == 0
        if due and s.strategy == "mcmc":
            self.replace(*relocate(self.packed, s.prune_opacity, s.max_gaussians, self.random))
        elif due:
            largest = np.exp(self.packed[:, 7:10]).max(1)
            clone, split = choose(
                self.statistics, largest, small=s.percent_dense * self.extent, absgrad=s.absgrad,
                grad_threshold=s.densify_grad_threshold,
                abs_grad_threshold=s.densify_abs_grad_threshold,
                room=s.max_gaussians - len(self.packed),
            )  # fmt: skip
            keep = self.packed[:, 10] > logit(s.prune_opacity)
            self.replace(*grow(self.packed, clone, split, keep, self.random))
        resets = s.strategy == "default" and s.opacity_reset_interval > 0
        if resets and now % s.opacity_reset_interval == 0:
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
        self.variation.forget()
        if self.light is not None:
            self.light.select(source, fresh)
        if self.held_surface is not None:
            self.held_surface.select(source)
        if self.warp is not None:
            self.warp.select(source)
        self.statistics = DensityStatistics.empty(len(packed))

    def run(
        self,
        checkpoint: Path | None,
        report: Callable[[int, float, float, int], None],
        diary: Path | None = None,
    ) -> None:
        """Step until the last iteration, from the checkpoint if there is a usable one.

        Args:
            checkpoint: file to save to and start from, or None.
            report: called with iteration, loss, PSNR and number of Gaussians.
            diary: folder for the loss curve and previews, or None.

        Raises:
            ReconstructionError: the fit diverged.
        """
        if checkpoint is not None:
            restore_state(self, checkpoint)
        s = self.settings
        while self.iteration < s.iterations:
            self.step()
            now, last = self.iteration, self.iteration == s.iterations
            if now % REPORT_EVERY == 0 or last:
                self._check()
                self.curve.append((now, self.loss, self.psnr, len(self.packed)))
                report(*self.curve[-1])
            if diary is not None and s.preview_every > 0 and (now % s.preview_every == 0 or last):
                write_curve(diary, self.curve)
                view = self.poses.held
                image = self.composited(view, self.render(view))
                write_preview(diary, now, self.targets[view][1].colour.target, image)
            due = (now % s.checkpoint_every == 0 or last) and np.isfinite(self.packed).all()
            if checkpoint is not None and due:
                save_state(self, checkpoint)
        if not np.isfinite(self.packed).all():
            raise self.diverged("some Gaussians are not finite")

    def _check(self) -> None:
        """Raises where the loss has grown beyond what any good moment explains."""
        s = self.settings
        full_size = int(s.coarse_fraction * s.iterations)
        # what explains small images perfectly starts anew at full size
        started = full_size if self.iteration > full_size else 0
        if self.progressive is not None:
            started = max(started, self.progressive.latest)
        if self.iteration - started < SETTLED:
            self.best_loss = np.inf
            return
        self.best_loss = min(self.best_loss, self.loss)
        if self.loss > self.settings.divergence_factor * self.best_loss:
            raise self.diverged(
                f"its loss has grown from {self.best_loss:.4f} to {self.loss:.4f} "
                "(fit.divergence_factor)"
            )

    def training_scores(self) -> tuple[Array, Array]:
        """PSNR [V] in dB and SSIM [V] of every view at full size."""
        results = []
        for view, target in enumerate(self.targets):
            image = np.clip(self.composited(view, self.render(view)), 0, 1)
            result = target[1].colour(image, self.settings.lambda_dssim)
            results.append((result.psnr, result.ssim))
        psnr, ssim = np.array(results).T
        return psnr, ssim
