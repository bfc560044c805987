"""`fit`: optimise Gaussians and camera poses against the photographs."""

from __future__ import annotations

import shutil
from dataclasses import replace
from typing import Any, ClassVar

from pipeline.artifacts.cameras import Cameras
from pipeline.artifacts.flow import Flow
from pipeline.artifacts.points import Points
from pipeline.artifacts.views import Views
from pipeline.errors import ReconstructionError
from pipeline.stage import Parts, Stage, StageConfig, StageContext
from stages.fit.config import FitConfig, resolve


class FitStage(Stage):
    """views + cameras + points (+ flow) -> gaussians + refined cameras."""

    name: ClassVar[str] = "fit"
    version: ClassVar[int] = 28
    summary: ClassVar[str] = "optimise Gaussians and camera poses against the photographs"
    Config: ClassVar[type[StageConfig]] = FitConfig
    requires: ClassVar[tuple[str, ...]] = ("views", "cameras", "points")
    optional: ClassVar[tuple[str, ...]] = ("flow",)
    provides: ClassVar[tuple[str, ...]] = ("gaussians", "cameras")
    may_provide: ClassVar[tuple[str, ...]] = ("pictures",)
    libraries: ClassVar[tuple[str, ...]] = (
        "numba",
        "numpy",
        "opencv-contrib-python-headless",
        "scipy",
    )
    rehearsals: ClassVar[tuple[str, ...]] = (
        "stages.fit.rehearsal:rasterizer",
        "stages.fit.rehearsal:whole_fits",
    )

    def backend(self, config: Any) -> str:
        from stages.fit.backend import expected_backend

        return expected_backend(config)

    def report(self) -> Parts:
        from stages.fit.report import PARTS

        return PARTS

    def run(self, context: StageContext) -> None:
        from stages.fit.fitting import fit
        from stages.fit.parts.surface import worth_holding

        views: Views = context.load("views")
        cameras: Cameras = context.load("cameras")
        points: Points = context.load("points")
        flow: Flow | None = context.load("flow") if context.has("flow") else None
        by_name = cameras.by_name()
        placed = [view for view in views.views if view.name in by_name]
        if len(placed) < 2:
            raise ReconstructionError(
                f"Only {len(placed)} of {len(views)} photographs could be placed in space; a fit "
                "needs two. Take photographs that overlap more, or more of them."
            )
        if len(points) < 100:
            raise ReconstructionError(
                f"There are only {len(points)} points to start from; a fit needs 100. The "
                "photographs hardly match each other: take them closer together and in focus, or "
                "loosen what the earlier stages prune (sap, align)."
            )
        placed_cameras = [by_name[view.name] for view in placed]
        held = worth_holding(placed_cameras, points.positions.astype(float))
        pixels = max(view.image.shape[0] * view.image.shape[1] for view in placed)
        settings = resolve(context.config, len(placed), context.seed, held, pixels)

        first, last = settings.densify_from_iter, settings.densify_until_iter
        if context.config.densify is True and first > last:
            context.warn(
                f"fit.densify is on and comes to nothing: it would begin at iteration {first} "
                f"(fit.densify_from_iter) and end at {last} (fit.densify_until_iter) of "
                f"{settings.iterations}. Give the fit more iterations, or let it begin earlier."
            )

        def report(done: int, of: int, loss: float, psnr: float, gaussians: int) -> None:
            figures = {"loss": round(loss, 5), "psnr": round(psnr, 2), "gaussians": gaussians}
            context.progress("fit", done, of, **figures)

        diary = context.scratch / "diary"
        diary.mkdir(parents=True, exist_ok=True)
        context.progress("preparing", 0, 1)
        result = fit(
            placed, placed_cameras, points, flow, settings,
            threads=context.threads, checkpoint=context.scratch / "fit.npz", report=report,
            diary=diary,
        )  # fmt: skip
        if result.backend_note:
            context.warn(result.backend_note)
        if settings.exposure:
            context.warn(
                "In the fit each photograph has an exposure of its own (gains of "
                f"{result.figures['exposure_gains']}, fit.exposure); the scene has none. So its "
                "PSNR of the photographs may be far lower in evaluate than in the fit (train_psnr)."
            )
        refined = {camera.name: camera for camera in result.cameras}
        every = tuple(refined.get(camera.name, camera) for camera in cameras.cameras)
        context.save(result.gaussians)
        context.save(replace(cameras, cameras=every))
        if settings.preview_every > 0:
            pictures = context.output("pictures")
            for path in sorted(diary.iterdir()):
                if path.suffix in (".csv", ".png"):
                    shutil.copyfile(path, pictures / path.name)
        context.summarize(**result.figures)
