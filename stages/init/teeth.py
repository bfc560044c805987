"""From the dental path's result to what the stage writes."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera, Cameras
from pipeline.artifacts.pictures import Pictures
from pipeline.artifacts.points import Points
from pipeline.artifacts.views import View, Views
from pipeline.errors import RequestError
from pipeline.stage import StageContext
from stages.init import cloud
from stages.init.config import DentalConfig, InitConfig
from stages.init.dental.anatomy import LOWER_TEETH, UPPER_TEETH
from stages.init.dental.numbering.arch_options import ArchOptions, ToothHint
from stages.init.dental.photo import PhotoOptions
from stages.init.dental.reconstruct import Teeth, reconstruct_teeth
from stages.init.dental.scale import scale_from_widths
from stages.init.dental.surface.options import SurfaceOptions
from stages.init.geometry import Pair
from stages.init.place import photo_name, with_focals
from stages.init.placement import Placement
from stages.init.scale import photo_named, working_pixel
from stages.init.write import save_all

Map = npt.NDArray[np.float32]


def from_teeth(context: StageContext, views: Views) -> None:
    """Place the views by their teeth, and write what came out.

    Raises:
        ReconstructionError: no teeth, or a doubtful result, with labelled pictures.
        RequestError: the settings of `init.dental` don't fit the photographs.
    """
    config: InitConfig = context.config
    names = [photo_name(view) for view in views.views]
    teeth = reconstruct_teeth(
        list(views.views), names, with_focals(views.views, config.focal), PhotoOptions(),
        arch_options(config.dental, views), surface_options(config.dental),
        accept_doubtful=config.dental.accept_doubtful, seed=context.seed,
        threads=context.threads, progress=context.progress,
    )  # fmt: skip
    for doubt in teeth.fit.doubts:
        context.warn(doubt)
    _write(context, views, teeth)


def _write(context: StageContext, views: Views, teeth: Teeth) -> None:
    config: InitConfig = context.config
    surface = teeth.surface
    order = [number for number, placed in enumerate(teeth.fit.views) if placed is not None]
    mm, uncertainty = scale_from_widths(teeth.fit, config.dental.tooth_widths)
    mask = config.dental.mask_rest is not False
    placement = Placement(
        views=tuple(_masked(views.views[k], teeth, k, mask) for k in order),
        cameras=tuple(_camera(views.views[k], teeth, k) for k in order),
        points=surface.positions.astype(np.float64), seen=(), weights={},
        input_from_world=np.diag([mm, mm, mm, 1.0]), units="mm",
    ).normalised()  # fmt: skip
    scale = mm / np.cbrt(np.linalg.det(placement.input_from_world[:3, :3]))
    world_from_mm = np.linalg.inv(placement.input_from_world) @ np.diag([mm, mm, mm, 1.0])
    rotation = world_from_mm[:3, :3] / scale
    maps = [surface.views[k] for k in order]
    depths = [(found.depth * scale).astype(np.float32) for found in maps if found]
    confidences = [found.confidence for found in maps if found]
    points = Points(
        positions=placement.points.astype(np.float32),
        colors=surface.colors,
        normals=(surface.normals @ rotation.T).astype(np.float32),
        confidence=surface.confidence,
        scale=np.full(len(surface.positions), config.dental.cloud_spacing * scale, np.float32),
    )
    cameras = placement.cameras
    pairs = [
        cloud.pointmap_pair(
            cameras[i], cameras[j], depths[i], depths[j], confidences[i], confidences[j]
        )
        for i, j in neighbours(cameras)
    ]
    save_all(
        context, views, placement.views,
        Cameras(cameras, placement.input_from_world, "mm"), depths, points, pairs,
    )  # fmt: skip
    context.save(Pictures(teeth.pictures))
    context.summarize(
        method="dental", **tooth_counts(teeth),
        scale_uncertainty_percent=round(100 * uncertainty, 1),
    )  # fmt: skip
    if config.length.mm is None and not config.dental.tooth_widths:
        context.warn(
            f"Millimetres come from textbook teeth and may be {100 * uncertainty:.0f} % off; pass "
            "a known width, as in --set 'init.dental.tooth_widths={11: 8.6}', for a true scale."
        )


def _camera(view: View, teeth: Teeth, number: int) -> Camera:
    placed = teeth.fit.views[number]
    assert placed is not None
    return Camera(
        view.name, view.width, view.height, placed.focal, placed.focal,
        view.width / 2, view.height / 2, placed.cam_from_world,
    )  # fmt: skip


def _masked(view: View, teeth: Teeth, number: int, mask_rest: bool) -> View:
    """The view with what is not teeth or gum masked out."""
    found = teeth.surface.views[number]
    if not mask_rest or found is None:
        return view
    return masked(view, found.depth)


def masked(view: View, depth: Map) -> View:
    """The view with what has no depth masked out."""
    return replace(view, mask=(depth > 0) & view.valid())


def tooth_counts(teeth: Teeth) -> dict[str, float]:
    """Figures of the teeth found, for the summary."""
    placed = [view for view in teeth.fit.views if view is not None]
    return {
        "upper_teeth": len({tooth for view in placed for tooth in view.upper if tooth}),
        "lower_teeth": len({tooth for view in placed for tooth in view.lower if tooth}),
        "label_margin": round(teeth.fit.margin, 1),
        "landmark_error_px": round(float(np.median([view.error for view in placed])), 2),
    }


def neighbours(cameras: tuple[Camera, ...]) -> list[Pair]:
    """Each camera with the next one around the arch, as pairs of positions."""
    sideways = [camera.centre[0] for camera in cameras]
    around = sorted(range(len(cameras)), key=lambda number: (sideways[number], number))
    return sorted((min(i, j), max(i, j)) for i, j in pairwise(around))


def arch_options(config: DentalConfig, views: Views) -> ArchOptions:
    """The settings of the arch fit, with hints in pixels of the working images.

    Raises:
        RequestError: an order or a label that doesn't fit the photographs.
    """
    if config.order is not None and len(config.order) != len(views):
        raise RequestError(
            f"init.dental.order names {len(config.order)} photographs "
            f"({','.join(config.order)}), but there are {len(views)}."
        )
    hints = []
    for label in config.labels:
        if label.tooth not in UPPER_TEETH + LOWER_TEETH:
            raise RequestError(
                f"init.dental.labels: there is no tooth {label.tooth} here; FDI numbers are 11-17, "
                "21-27, 31-37 and 41-47 (wisdom teeth are left out)."
            )
        view = photo_named(views, label.photo, "init.dental.labels")
        x, y = working_pixel(view, (label.x, label.y))
        number = next(k for k, other in enumerate(views.views) if other.name == view.name)
        hints.append(ToothHint(number, float(x), float(y), label.tooth))
    shared = set(DentalConfig.model_fields) & set(ArchOptions.__dataclass_fields__)
    settings = {name: getattr(config, name) for name in shared - {"labels"}}
    return ArchOptions(labels=tuple(hints), **settings)


def surface_options(config: DentalConfig) -> SurfaceOptions:
    """The settings of the dense surface."""
    shared = set(DentalConfig.model_fields) & set(SurfaceOptions.__dataclass_fields__)
    settings = {name: getattr(config, name) for name in sorted(shared)}
    return SurfaceOptions(**{name: value for name, value in settings.items() if value is not None})
