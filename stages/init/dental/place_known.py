"""Known cameras and few wide photographs of teeth: the dense surface of the teeth, cameras held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.confidence import FILLED, MEASURED
from pipeline.artifacts.pictures import Pictures
from pipeline.artifacts.points import Points
from pipeline.artifacts.space.scale import Scale
from pipeline.artifacts.teeth import Dentition, moved_polygons
from pipeline.artifacts.views import View, Views
from pipeline.errors import ReconstructionError
from pipeline.geometry import cloud
from pipeline.geometry.graph import Pair
from pipeline.geometry.models.known_cameras import KnownCamera, as_pinhole
from pipeline.geometry.world import similarity_between
from pipeline.stage import StageContext
from stages.dentition.crowns import dentition_of, outline_of
from stages.dentition.working import working_scale
from stages.init.config import CAMERAS, InitConfig
from stages.init.dental.cameras.centred import CentredView, centre_view
from stages.init.dental.place import (
    arch_options,
    masked,
    numbered_otherwise,
    surface_options,
    tooth_counts,
)
from stages.init.dental.read import teeth_to_place_by
from stages.init.dental.reconstruct import (
    PlacedTeeth,
    Progress,
    Reconstruction,
    evidence,
    place_teeth,
    with_surface,
)
from stages.init.dental.solution import ArchFit
from stages.init.dental.surface.chart.looks import SurfaceView
from stages.init.dental.surface.options import SurfaceOptions, SweepRound
from stages.init.place import photo_name
from stages.init.placement import Placement
from stages.init.write import save_all
from stages.stereo.options import DenseOptions, DenseView
from stages.stereo.reconstruct import complete_depths

Array = npt.NDArray[np.float64]

#: With cameras that are exact the gum can be followed this far beyond the crowns (mm), and what
#: photographs agree on there is believed as it is on the crowns.
GUM_HEIGHT, GUM_TRUST = 20.0, 1.0
#: Nor does a match have to be near where the crown shapes expect it: back teeth that one landmark
#: each has placed may be several mm off. Small windows and less stiffness follow.
ROUNDS = (
    SweepRound(reach=8.0, step=0.15, window=1.2, prior=0.1, stiffness=10.0),
    SweepRound(reach=2.5, step=0.075, window=0.8, prior=0.1, stiffness=12.0),
    SweepRound(reach=1.5, step=0.05, window=0.6, prior=0.1, stiffness=4.0),
    SweepRound(reach=1.0, step=0.05, window=0.5, prior=0.1, stiffness=4.0),
)
#: Matches that are seen at a low angle (cosine) are still worth more than none.
LEAST_FACING = 0.2
#: Where no photographs agree, the charts are still mm and not cm off, unlike what is filled in
#: around them: a guess, half way from `FILLED` to `MEASURED` (confidence is 1 + exp of this).
GUESS = float(np.log((FILLED + MEASURED) / 2 - 1))


def from_known_teeth(
    context: StageContext, views: Views, known: dict[str, KnownCamera], scale: Scale
) -> None:
    """Make the surface of the teeth in front of known cameras, and write what came out.

    Args:
        known: name of a view -> its camera; views without one are left out.
        scale: of the world of these cameras.

    Raises:
        ReconstructionError: no teeth, or they are doubtful, or don't fit the cameras.
        RequestError: the settings of `init.dental` don't fit the photographs.
    """
    config: InitConfig = context.config
    pairs = [
        as_pinhole(view, known[view.name], CAMERAS) for view in views.views if view.name in known
    ]
    placed, cameras = [view for view, _ in pairs], [camera for _, camera in pairs]
    posed = replace(views, views=tuple(placed))
    held = held_teeth(context, posed, cameras)
    jaws = None
    if config.dental.mask_rest is not True:  # the scene goes on beyond the gum
        jaws = [d.on_jaws_mask if d else None for d in held.dentitions]
        held = replace(held, dentitions=[d and replace(d, on_jaws=None) for d in held.dentitions])
    # with cameras that are exact the charts may go on as far as they are
    teeth = with_surface(
        held.placed(context, posed, cameras, config.dental.accept_doubtful),
        replace(held.surface, past_row=None), context.threads, context.progress, jaws,
    )  # fmt: skip
    for doubt in (*teeth.fit.doubts, *numbered_otherwise(teeth)):
        context.warn(doubt)
    left_out = [photo_name(view) for view in views.views if view.name not in known]
    if left_out:
        context.warn(f"The model has no camera of {', '.join(left_out)}; left out.")
    _write(context, views, teeth, held.centred, Placement(
        views=tuple(placed), cameras=tuple(cameras), points=np.zeros((0, 3)), seen=(), weights={},
        scale=scale, given=True,
    ))  # fmt: skip


@dataclass(frozen=True)
class HeldTeeth:
    """Photographs before cameras that stay, as `place_teeth` takes them.

    Attributes:
        centred: the photographs with the principal point in the middle.
        names: how the user knows them.
        dentitions: the crowns of each, in pixels of `centred`; None: it shows none.
        surface: settings of a surface where cameras are right.
    """

    centred: list[CentredView]
    names: list[str]
    dentitions: list[Dentition | None]
    surface: SurfaceOptions

    def placed(
        self, context: StageContext, views: Views, cameras: Sequence[Camera],
        accept_doubtful: bool, quickly: bool = False,
    ) -> PlacedTeeth:  # fmt: skip
        """Which tooth is which before these cameras, of these photographs.

        Args:
            quickly: without matching photographs on the arch, which speaks for or against numbers
                and cameras, in silence, and on this thread alone.

        Raises:
            ReconstructionError: no teeth, or they are doubtful, or don't fit the cameras.
        """
        options = arch_options(context, views, self.dentitions)
        progress: Progress = context.progress
        if quickly:
            options, progress = replace(options, dense_rounds=0), lambda *_: None
        teeth = place_teeth(
            [found.view for found in self.centred], self.names, self.dentitions,
            [found.focal for found in self.centred], options,
            accept_doubtful=accept_doubtful, threads=1 if quickly else context.threads,
            progress=progress,
            cameras=[camera.cam_from_world for camera in cameras],
            scales=[working_scale(view.width, view.height) for view in views.views],
        )  # fmt: skip
        placed = zip(self.names, teeth.fit.views, strict=True)
        if without := [name for name, view in placed if view is None]:
            raise ReconstructionError(
                f"No two rows of teeth could be made out in {', '.join(without)}.",
                evidence(teeth.labelled),
            )
        return teeth


def held_teeth(context: StageContext, views: Views, cameras: Sequence[Camera]) -> HeldTeeth:
    """The teeth that were read in photographs whose cameras stay."""
    config: InitConfig = context.config
    by_name = teeth_to_place_by(context, views).by_name()
    centred = [centre_view(view, camera) for view, camera in zip(views.views, cameras, strict=True)]
    dentitions = [
        moved(by_name[view.name], found)
        if view.name in by_name and by_name[view.name].all_crowns
        else None
        for view, found in zip(views.views, centred, strict=True)
    ]
    surface = replace(
        surface_options(config.dental), gum_trust=GUM_TRUST, guess=GUESS, rounds=ROUNDS,
        least_facing=LEAST_FACING, least_showing=LEAST_FACING / 2,
        carve=True, only_clear=False,
    )  # fmt: skip
    if config.dental.gum_height is None:
        surface = replace(surface, gum_height=GUM_HEIGHT)
    return HeldTeeth(centred, [photo_name(view) for view in views.views], dentitions, surface)


def moved(dentition: Dentition, centred: CentredView) -> Dentition:
    """A photograph's crowns in the pixels of the picture that was made of it."""

    def shown(polygon: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return np.array([centred.point(float(x), float(y)) for x, y in polygon])

    outlines = [
        replace(outline_of(crown), polygon=shown(crown.outline)) for crown in dentition.all_crowns
    ]
    size = (centred.view.width, centred.view.height)
    made = dentition_of(outlines, dentition.name, size, dentition.kind, dentition.roll)
    return replace(made, on_jaws=moved_polygons(dentition.on_jaws, shown))


def _write(
    context: StageContext, views: Views, teeth: Reconstruction, centred: list[CentredView],
    placement: Placement,
) -> None:  # fmt: skip
    config: InitConfig = context.config
    surface = teeth.surface
    scale, turn, shift = world_from_arch(teeth.fit, placement.cameras)
    positions = scale * surface.positions.astype(np.float64) @ turn.T + shift
    placement = replace(placement, points=positions).normalised()
    cameras = placement.cameras
    scale, turn, _ = world_from_arch(teeth.fit, cameras)
    dense = _completed(
        context, as_seen(surface.views, centred, placement.views, scale, turn), placement
    )
    masks = config.dental.mask_rest is True  # unlike with estimated cameras, not by default
    points = Points(
        positions=placement.points.astype(np.float32),
        colors=surface.colors,
        normals=(surface.normals @ turn.T).astype(np.float32),
        confidence=surface.confidence,
        scale=np.full(len(surface.positions), config.dental.cloud_spacing * scale, np.float32),
    )
    clouds = [points]
    if not masks:
        clouds += [
            cloud.depth_points(
                view.image, np.where(found.depth > 0, np.float32(0), found.filled), found.normal,
                found.confidence, camera, cloud.FILL_STEP,
            )
            for view, found, camera in zip(placement.views, dense, cameras, strict=True)
        ]  # fmt: skip
    depths = [
        found.depth if masks else np.where(found.depth > 0, found.depth, found.filled)
        for found in dense
    ]
    pairs = [
        cloud.pointmap_pair(
            cameras[i], cameras[j], depths[i], depths[j], dense[i].confidence, dense[j].confidence
        )
        for i, j in _neighbours(cameras)
    ]
    shown = tuple(
        masked(view, found.depth) if masks else view
        for view, found in zip(placement.views, dense, strict=True)
    )
    save_all(
        context, views, shown, placement.placed(), depths,
        cloud.thinned(cloud.joined(clouds), config.max_points, context.seed), pairs,
    )  # fmt: skip
    context.save(Pictures({"surface_turned": teeth.turned}))
    context.summarize(dense="teeth", dense_points=len(points), **tooth_counts(teeth))


def _neighbours(cameras: tuple[Camera, ...]) -> list[Pair]:
    """Each camera with the next one around the arch, as pairs of positions."""
    sideways = [camera.centre[0] for camera in cameras]
    around = sorted(range(len(cameras)), key=lambda number: (sideways[number], number))
    return sorted((min(i, j), max(i, j)) for i, j in pairwise(around))


def world_from_arch(fit: ArchFit, cameras: Sequence[Camera]) -> tuple[float, Array, Array]:
    """Scale, rotation and shift by which the arch lies before the cameras as the fit has put it."""
    arch_cameras = [
        replace(camera, cam_from_world=found.cam_from_world)
        for camera, found in zip(cameras, fit.views, strict=True)
        if found is not None
    ]
    return similarity_between(arch_cameras, cameras)


def as_seen(
    surface: Sequence[SurfaceView | None], centred: Sequence[CentredView], views: Sequence[View],
    scale: float, turn: Array,
) -> list[SurfaceView]:  # fmt: skip
    """The surface as each photograph sees it, in units and directions of the cameras.

    Args:
        surface: of each photograph as it was centred, none of them None.
        centred, views: of each.
        scale, turn: of `world_from_arch`.
    """
    seen = []
    for found, there, view in zip(surface, centred, views, strict=True):
        assert found is not None
        size = view.width, view.height
        known = there.back(found.depth, *size) * np.float32(scale)
        seen.append(SurfaceView(
            depth=np.where(view.valid(), known, 0).astype(np.float32),
            normal=there.back(found.normal, *size) @ turn.T.astype(np.float32),
            confidence=there.back(found.confidence, *size),
        ))  # fmt: skip
    return seen


def _completed(
    context: StageContext, seen: list[SurfaceView], placement: Placement
) -> list[DenseView]:
    """The surface as each photograph sees it, and what lies around it."""
    options = DenseOptions(**{**context.config.dense.model_dump(), "method": "sweep"})
    dense = complete_depths(
        [view.image for view in placement.views], [view.valid() for view in placement.views],
        list(placement.cameras), [there.depth for there in seen],
        [there.confidence for there in seen], options, context.threads,
    )  # fmt: skip
    return [
        replace(
            view,
            normal=np.where((view.depth > 0)[..., None], there.normal, view.normal).astype(
                np.float32
            ),
        )
        for view, there in zip(dense, seen, strict=True)
    ]
