"""The optimisation: Gaussians and camera poses against photographs."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from math import isqrt
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from pipeline.errors import ReconstructionError
from stages.fit.arrays import Array, Bools, Floats, Indices
from stages.fit.config import PARTS, FitSettings
from stages.fit.inputs.targets import Target
from stages.fit.parts.base import Part, Step, interpolate, restore_state, state_of
from stages.fit.parts.camera import PoseOptimizer, SharedFocal
from stages.fit.parts.start import reduction
from stages.fit.records import load_checkpoint, save_checkpoint, write_curve, write_preview
from stages.splatting.adam import Adam
from stages.splatting.kernels.projection import HARMONICS
from stages.splatting.rasterizer import Rendering, Viewpoint, rasterize

if TYPE_CHECKING:
    from stages.fit.inputs.initial import Cloud
    from stages.fit.inputs.scene import Scene

P = TypeVar("P", bound=Part)

#: iterations between reports; the loss is a mean over several views
REPORT_EVERY = 10
#: iterations after which the loss is expected to have come down
SETTLED = 100


class Trainer:
    """One fit, in a frame where the scene's depth is about 1.

    Attributes:
        parts: what it is made of, in the order of `config.PARTS`.
        packed: [N, 11 + 3 K] float32 Gaussians.
        poses: the cameras' optimiser, which holds the poses; focal: that of their focal length.
        rasterize: what steps are taken with (see `backend`).
        views: those that take part; queue: those whose turn it still is.
        iteration: steps taken, of `iterations`, which `Extension` may raise.
        haste: factor of the rates of positions and harmonics, from `Extension`.
        psnr, loss: running means over recent iterations.
    """

    #: what a checkpoint holds beside the parts' states
    kept = (
        "packed", "adam.first", "adam.second", "adam.steps", "poses.poses", "poses.first",
        "poses.second", "poses.steps", "focal.log_factor", "focal.first", "focal.second",
        "focal.steps", "iteration", "iterations", "haste", "loss", "psnr", "best_loss", "resized",
        "curve",
    )  # fmt: skip

    def __init__(
        self,
        settings: FitSettings,
        packed: Floats,
        poses: Array,
        held: int,
        targets: Sequence[dict[int, Target]],
        extent: float,
        lit: bool,
        scene: Scene,
        cloud: Cloud | None,
    ) -> None:
        """
        Args:
            settings: all of them.
            packed: [N, 11 + 3 K] initial Gaussians (K = 1 with a light).
            poses: [V, 3, 4] cam_from_frame.
            held: the camera whose pose is not refined.
            targets: per view, factor -> target.
            extent: size of the scene that the position rate is relative to.
            lit: by a light beside the lens, in place of harmonics.
            scene: that it is a fit of.
            cloud: the points that became Gaussians; None where they are found view by view.
        """
        self.settings, self.packed, self.targets, self.extent = settings, packed, targets, extent
        self.lit, self.scene, self.cloud = lit, scene, cloud
        self.poses, self.focal = PoseOptimizer(poses, held), SharedFocal()
        self.parts = [part for kind in PARTS if (part := kind.of(self)) is not None]
        self.adam = Adam(self.packed.shape)
        self.rasterize: Callable[..., Any] = rasterize
        self.random = np.random.Generator(np.random.PCG64(self.settings.seed))
        # a view of which the mask leaves nothing has nothing to say, and no error
        shown = [v for v, target in enumerate(targets) if target[1].colour.mask.any()]
        self.views = shown or list(range(len(targets)))
        self.queue: list[int] = []
        self.iteration, self.iterations, self.haste = 0, settings.iterations, 1.0
        self.loss = self.psnr = 0.0
        self.best_loss = np.inf
        self.resized = 0
        self.curve: Array = np.empty((0, 4))
        self.fingerprint = self._fingerprint()
        # harmonics still to come cost time; frames still to come bring some of their own
        self.narrow = not self.settings.progressive and not self.lit
        self._use_harmonics()

    def step(self) -> None:
        """One iteration: one view."""
        for part in self.parts:
            part.begin(self)
        step = self._next()
        for part in self.parts:
            part.ask(self, step)
        self.shade(step.viewpoint)
        step.rendering = self.rasterize(
            self.packed, step.viewpoint, degree=self.degree(), near=self.settings.near,
            depth=step.depth, flow_to=step.following,
        )  # fmt: skip
        self._compare(step)
        for part in self.parts:
            part.guide(self, step)
        if not np.isfinite(step.loss) or not np.isfinite(step.by_pose).all():
            raise self.diverged(f"its loss is not a number any more (view {step.view})")
        step.rates = self.rates()
        for part in self.parts:
            part.pace(step)
        self.adam.step(self.packed, step.gradients.packed, step.rates)
        for part in self.parts:
            part.follow(self, step)
        for part in self.parts:
            part.populate(self, step)
        # running means over about the last 20 iterations, and the plain mean before
        share = max(1 / self.iteration, 0.05)
        self.loss += share * (step.loss - self.loss)
        self.psnr += share * (step.psnr - self.psnr)

    def _next(self) -> Step:
        """The view whose turn it is."""
        if not self.queue:
            self.queue = [int(view) for view in self.random.permutation(self.views)]
        view = self.queue.pop()
        self.iteration += 1
        self._use_harmonics()
        factor = self.reduction(self.iteration)
        target = self.targets[view][factor]
        done = self.iteration / self.iterations
        return Step(view, factor, target, self.viewpoint(view, target), done)

    def reduction(self, iteration: int) -> int:
        """By which factor images are reduced in an iteration."""
        return reduction(self.settings, iteration, self.iterations)

    def _compare(self, step: Step) -> None:
        """Loss, PSNR, and the gradients of a rendered view."""
        s, rendering = self.settings, step.rendering
        image = self.composited(step.view, rendering)
        colour = step.target.colour(image, s.lambda_dssim, s.saturation)
        step.loss, step.psnr, step.d_planes = colour.loss, colour.psnr, colour.gradient
        if len(rendering.planes) > len(image):
            step.d_planes = np.zeros_like(rendering.planes)
            step.d_planes[:3] = colour.gradient
        step.d_transmittance = np.zeros_like(rendering.transmittance)
        for part in self.parts:
            part.compare(self, step)
        step.gradients = rendering.backward(step.d_planes, step.d_transmittance)
        step.by_pose = step.gradients.pose

    def rates(self) -> Floats:
        """[D] learning rate of each column now."""
        s = self.settings
        rates = np.empty(self.packed.shape[1], np.float32)
        done = self.iteration / self.iterations
        rates[0:3] = self.extent * interpolate(s.position_lr_init, s.position_lr_final, done)
        rates[3:7] = s.rotation_lr
        rates[7:10] = s.scaling_lr
        rates[10] = s.opacity_lr
        rates[11:14] = s.feature_lr
        rates[14:] = s.feature_rest_lr
        rates[0:3] *= self.haste
        rates[11:] *= self.haste
        return rates

    def degree(self) -> int:
        """Degree of the harmonics now: all of them, or one more every interval."""
        every, most = self.settings.sh_degree_interval, 0 if self.lit else self.settings.sh_degree
        return most if every <= 0 else min(most, self.iteration // every)

    def _use_harmonics(self) -> None:
        """Add what the degree needs by now."""
        used = HARMONICS + 3 * (self.degree() + 1) ** 2
        missing = used - self.packed.shape[1]
        if self.narrow and missing > 0:
            self.packed = np.pad(self.packed, ((0, 0), (0, missing)))
            self.adam.resize(used)

    def replace(self, packed: Floats, source: Indices, fresh: Bools) -> None:
        """Put other rows in place; the optimiser's rows and the parts follow `source`."""
        self.packed = packed
        self.adam.select(source, fresh)
        for part in self.parts:
            part.select(source, fresh)

    def find(self, kind: type[P]) -> P | None:
        """The part of a kind, if the fit has it."""
        return next((part for part in self.parts if isinstance(part, kind)), None)

    def viewpoint(self, view: int | Array, target: Target) -> Viewpoint:
        """Where a view, or a camera of another pose [3, 4], sees a target from."""
        pose = view if isinstance(view, np.ndarray) else self.poses.poses[view]
        local, intrinsics = np.ascontiguousarray(pose, np.float32), target.intrinsics
        return Viewpoint(local, self.focal.apply(intrinsics), target.width, target.height)

    def render(self, view: int, factor: int = 1) -> Rendering:
        """A view as the Gaussians stand now, colour only."""
        return self.look(self.viewpoint(view, self.targets[view][factor]))

    def look(self, viewpoint: Viewpoint) -> Rendering:
        """The Gaussians from anywhere, colour only."""
        self.shade(viewpoint)
        terms = (self.packed.shape[1] - HARMONICS) // 3
        degree = 0 if self.lit else min(self.settings.sh_degree, isqrt(terms) - 1)
        return rasterize(self.packed, viewpoint, degree=degree, near=self.settings.near)

    def draw(self, viewpoint: Viewpoint, colours: Floats) -> Rendering:
        """Colours [N, 3] as they are, in place of those of the Gaussians."""
        return rasterize(
            self.packed, viewpoint, degree=None, near=self.settings.near,
            features=np.ascontiguousarray(colours, np.float32),
        )  # fmt: skip

    def missing(self, view: int, factor: int = 1) -> tuple[Rendering, Floats]:
        """A view as it is now, and [3, H, W] what its photograph shows beyond."""
        rendering, colour = self.render(view, factor), self.targets[view][factor].colour
        error = colour.target - self.composited(view, rendering)
        # what the camera clipped may be brighter
        error[(colour.target >= self.settings.saturation) & (error < 0)] = 0
        return rendering, error

    def shade(self, viewpoint: Viewpoint) -> None:
        """Bring the colours up to date with where they are seen from."""
        for part in self.parts:
            part.shade(self.packed, viewpoint)

    def composited(self, view: int | None, rendering: Rendering) -> Floats:
        """[3, H, W] colour as it arrives at a view, or at none of them."""
        return self._shown(view, rendering.planes[:3], rendering.transmittance)

    def without_gaussians(self, view: int) -> Floats:
        """[3, H, W] what arrives at a view where no Gaussian stands before the background."""
        target = self.targets[view][1]
        clear = np.ones((target.height, target.width), np.float32)
        return self._shown(view, np.zeros((3, *clear.shape), np.float32), clear)

    def _shown(self, view: int | None, image: Floats, transmittance: Floats) -> Floats:
        for part in reversed(self.parts):
            image = part.show(view, image, transmittance)
        return np.ascontiguousarray(image)

    def diverged(self, what: str) -> ReconstructionError:
        return ReconstructionError(
            f"The fit diverged at iteration {self.iteration} of {self.iterations}: "
            f"{what}. Lower the learning rates (fit.feature_lr, fit.scaling_lr, "
            "fit.pose_lr_init), or look at the cameras and the points that it started from "
            "('pipeline status'). The last good state is kept as a checkpoint."
        )

    def run(
        self,
        checkpoint: Path | None,
        report: Callable[[int, int, float, float, int], None],
        diary: Path | None = None,
    ) -> None:
        """Step until the last iteration, from the checkpoint if there is a usable one.

        Args:
            checkpoint: file to save to and start from, or None.
            report: called with iteration, of how many, loss, PSNR and number of Gaussians.
            diary: folder for the loss curve and previews, or None.

        Raises:
            ReconstructionError: the fit diverged.
        """
        if checkpoint is not None:
            self.restore(checkpoint)
        s = self.settings
        while self.iteration < self.iterations:
            self.step()
            now, last = self.iteration, self.iteration == self.iterations
            if now % REPORT_EVERY == 0 or last:
                self._check()
                figures = (self.loss, self.psnr, len(self.packed))
                self.curve = np.concatenate([self.curve, [(now, *figures)]])
                report(now, self.iterations, *figures)
            if diary is not None and s.preview_every > 0 and (now % s.preview_every == 0 or last):
                write_curve(diary, self.curve.tolist())
                view = self.poses.held
                image = self.composited(view, self.render(view))
                write_preview(diary, now, self.targets[view][1].colour.target, image)
            # a fit that is killed after its last step repeats those since the last checkpoint; all
            # others are spared the time to write one more
            due = now % s.checkpoint_every == 0 and not last
            if checkpoint is not None and due and np.isfinite(self.packed).all():
                self.save(checkpoint)
        if not np.isfinite(self.packed).all():
            raise self.diverged("some Gaussians are not finite")

    def _check(self) -> None:
        """Raises where the loss has grown beyond what any good moment explains."""
        s = self.settings
        # what explains small images perfectly starts anew at a larger size
        factor = self.reduction(self.iteration)
        if factor != self.reduction(max(1, self.iteration - REPORT_EVERY)):
            self.resized = self.iteration
        started = max(self.resized, *(part.latest for part in self.parts))
        if self.iteration - started < SETTLED:
            self.best_loss = np.inf
            return
        self.best_loss = min(self.best_loss, self.loss)
        if self.loss > s.divergence_factor * self.best_loss:
            raise self.diverged(
                f"its loss has grown from {self.best_loss:.4f} to {self.loss:.4f} "
                "(fit.divergence_factor)"
            )

    def training_scores(self) -> tuple[Array, Array]:
        """PSNR [V] in dB and SSIM [V] of every view that takes part, at full size."""
        results = []
        for view in self.views:
            image = np.clip(self.composited(view, self.render(view)), 0, 1)
            result = self.targets[view][1].colour(image, self.settings.lambda_dssim)
            results.append((result.psnr, result.ssim))
        psnr, ssim = np.array(results).T
        return psnr, ssim

    def _fingerprint(self) -> str:
        """What this fit is, and no other."""
        # how often a checkpoint is written says nothing about what is in it
        constants = self.settings.but(checkpoint_every=1)
        sizes = [sorted(target) for target in self.targets]
        content = hashlib.sha256(repr((constants, self.extent, self.poses.held, sizes)).encode())
        states = [state_of(self, ("packed", "poses.poses")), *(p.arrays() for p in self.parts)]
        for array in (array for state in states for array in state.values()):
            content.update(repr(array.shape).encode() + array.tobytes())
        return content.hexdigest()

    def save(self, path: Path) -> None:
        """Write the whole state."""
        arrays = state_of(self, self.kept)
        for part in self.parts:
            arrays |= {f"{part.name}:{name}": array for name, array in part.arrays().items()}
        facts = {
            "fingerprint": self.fingerprint, "queue": self.queue,
            "random": self.random.bit_generator.state,
        }  # fmt: skip
        save_checkpoint(path, arrays, facts)

    def restore(self, path: Path) -> bool:
        """Take up a saved state; False where there is none of this very fit."""
        loaded = load_checkpoint(path)
        if loaded is None or loaded[1].get("fingerprint") != self.fingerprint:
            return False
        arrays, facts = loaded
        restore_state(self, self.kept, arrays)
        for part in self.parts:
            own = f"{part.name}:"
            part.restore({n.removeprefix(own): a for n, a in arrays.items() if n.startswith(own)})
        self.queue, self.random.bit_generator.state = facts["queue"], facts["random"]
        return True
