"""Known cameras and few wide photographs of teeth: the dense surface of the teeth, cameras held."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.confidence import FILLED, MEASURED
from pipeline.artifacts.pictures import Pictures
from pipeline.artifacts.points import Points
from pipeline.artifacts.space.scale import said_by_cameras
from pipeline.artifacts.teeth import Dentition
from pipeline.artifacts.views import Views
from pipeline.errors import ReconstructionError, RequestError
from pipeline.geometry import cloud
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
    neighbours,
    numbered_otherwise,
    surface_options,
    tooth_counts,
)
from stages.init.dental.read import labelled_teeth
from stages.init.dental.reconstruct import Reconstruction, reconstruct_teeth
from stages.init.dental.surface.options import SweepRound
from stages.init.place import photo_name
from stages.init.placement import Placement
from stages.init.write import save_all
from stages.stereo import DenseOptions, DenseView
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
#: Matches that are seen at a low angle (cosine) are still worth more than none. Gum may be further
#: from the usual colour: what is no gum at all does not match.
LEAST_FACING, GUM_DEVIATIONS = 0.2, 5.0
#: Where no photographs agree, the charts are still mm and not cm off, unlike what is filled in
#: around them: a guess, half way from `FILLED` to `MEASURED` (confidence is 1 + exp of this).
GUESS = float(np.log((FILLED + MEASURED) / 2 - 1))


def neighbour_angle(cameras: list[Camera]) -> float:
    """Median over the cameras of the angle to the nearest other one, in degrees.

    Seen from the point that is nearest to all optical axes; 0 where all look the same way.
    """
    if len(cameras) < 2:
        return 0.0
    ahead = np.stack([camera.rotation[2] for camera in cameras])
    centres = np.stack([camera.centre for camera in cameras])
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    system = across.sum(0)
    if np.linalg.cond(system) > 1e6:
        return 0.0
    target = np.linalg.solve(system, np.einsum("vij,vj->i", across, centres))
    lines = centres - target
    lines /= np.maximum(np.linalg.norm(lines, axis=1, keepdims=True), 1e-12)
    cosine = np.clip(lines @ lines.T, -1, 1)
    np.fill_diagonal(cosine, -1)
    return float(np.median(np.degrees(np.arccos(cosine.max(axis=1)))))


def from_known_teeth(
    context: StageContext, views: Views, known: dict[str, KnownCamera], units: str
) -> None:
    """Make the surface of the teeth in front of known cameras, and write what came out.

    Args:
        known: name of a view -> its camera; views without one are left out.
        units: of the world of these cameras.

    Raises:
        ReconstructionError: no teeth, or they are doubtful, or don't fit the cameras.
        RequestError: the settings of `init.dental` don't fit the photographs.
    """
    config: InitConfig = context.config
    pairs = [
        as_pinhole(view, known[view.name], CAMERAS) for view in views.views if view.name in known
    ]
    placed, cameras = [view for view, _ in pairs], [camera for _, camera in pairs]
    centred = [centre_view(view, camera) for view, camera in pairs]
    names = [photo_name(view) for view in placed]
    arch = arch_options(config.dental, replace(views, views=tuple(placed)))
    by_name = labelled_teeth(context, views).by_name()
    if turned := [photo_name(view) for view, _ in pairs if _mirrored(by_name.get(view.name))]:
        raise RequestError(
            f"{', '.join(turned)} {'is' if len(turned) == 1 else 'are'} said to be mirrored, but "
            "init.cameras gives a camera for the picture as it is. Take `mirrored` out of the "
            "corrections, or leave init.cameras out."
        )
    chosen = [
        moved(by_name[view.name], found)
        if view.name in by_name and by_name[view.name].all_crowns
        else None
        for (view, _), found in zip(pairs, centred, strict=True)
    ]
    surface = replace(
        surface_options(config.dental), gum_trust=GUM_TRUST, guess=GUESS, rounds=ROUNDS,
        least_facing=LEAST_FACING, least_showing=LEAST_FACING / 2, gum_deviations=GUM_DEVIATIONS,
        carve=True, past_row=None, only_clear=False,
    )  # fmt: skip
    if config.dental.gum_height is None:
        surface = replace(surface, gum_height=GUM_HEIGHT)
    teeth = reconstruct_teeth(
        [found.view for found in centred], names, chosen, [found.focal for found in centred],
        arch, surface, accept_doubtful=config.dental.accept_doubtful, threads=context.threads,
        progress=context.progress, cameras=[camera.cam_from_world for camera in cameras],
        scales=[working_scale(view.width, view.height) for view in placed],
    )  # fmt: skip
    without = [name for name, view in zip(names, teeth.fit.views, strict=True) if view is None]
    if without:
        raise ReconstructionError(
            f"No two rows of teeth could be made out in {', '.join(without)}.", teeth.pictures
        )
    for doubt in (*teeth.fit.doubts, *numbered_otherwise(teeth, config.dental.min_margin)):
        context.warn(doubt)
    left_out = [photo_name(view) for view in views.views if view.name not in known]
    if left_out:
        context.warn(f"The model has no camera of {', '.join(left_out)}; left out.")
    _write(context, views, teeth, centred, Placement(
        views=tuple(placed), cameras=tuple(cameras), points=np.zeros((0, 3)), seen=(), weights={},
        scale=said_by_cameras(units), given=True,
    ))  # fmt: skip


def _mirrored(dentition: Dentition | None) -> bool:
    return bool(dentition and dentition.mirrored)


def moved(dentition: Dentition, centred: CentredView) -> Dentition:
    """A photograph's crowns in the pixels of the picture that was made of it."""
    outlines = [
        replace(
            outline_of(crown),
            polygon=np.array([centred.point(float(x), float(y)) for x, y in crown.outline]),
        )
        for crown in dentition.all_crowns
    ]
    size = (centred.view.width, centred.view.height)
    return dentition_of(outlines, dentition.name, size, dentition.kind, dentition.roll)


def _write(
    context: StageContext, views: Views, teeth: Reconstruction, centred: list[CentredView],
    placement: Placement,
) -> None:  # fmt: skip
    config: InitConfig = context.config
    surface = teeth.surface
    # The arch's frame lies before the cameras as the fit has put it.
    arch_cameras = [
        replace(camera, cam_from_world=found.cam_from_world)
        for camera, found in zip(placement.cameras, teeth.fit.views, strict=True)
        if found is not None
    ]
    scale, turn, shift = similarity_between(arch_cameras, placement.cameras)
    positions = scale * surface.positions.astype(np.float64) @ turn.T + shift
    placement = replace(placement, points=positions).normalised()
    cameras = placement.cameras
    scale, turn, _ = similarity_between(arch_cameras, cameras)
    dense = _completed(context, teeth, centred, placement, scale, turn)
    masks = config.dental.mask_rest is True  # unlike with estimated cameras, not by default
    points = Points(
        positions=placement.points.astype(np.float32),
        colors=surface.colors,
        normals=(surface.normals @ turn.T).astype(np.float32),
        confidence=surface.confidence,
        scale=np.full(len(surface.positions), config.dental.cloud_spacing * scale, np.float32),
    )
    clouds = [points]
    if config.fill_step and not masks:
        clouds += [
            cloud.depth_points(
                view.image, np.where(found.depth > 0, np.float32(0), found.filled), found.normal,
                found.confidence, camera, config.fill_step,
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
        for i, j in neighbours(cameras)
    ]
    shown = tuple(
        masked(view, found.depth) if masks else view
        for view, found in zip(placement.views, dense, strict=True)
    )
    save_all(
        context, views, shown, placement.placed(), depths,
        cloud.thinned(cloud.joined(clouds), config.max_points, context.seed), pairs,
    )  # fmt: skip
    context.save(Pictures(teeth.pictures))
    context.summarize(dense="teeth", dense_points=len(points), **tooth_counts(teeth))


def _completed(
    context: StageContext, teeth: Reconstruction, centred: list[CentredView], placement: Placement,
    scale: float, turn: Array,
) -> list[DenseView]:  # fmt: skip
    """The surface as each photograph sees it, in units of the cameras, and what lies around it."""
    config: InitConfig = context.config
    depths, confidences, normals = [], [], []
    for found, there, view in zip(teeth.surface.views, centred, placement.views, strict=True):
        assert found is not None
        size = view.width, view.height
        known = there.back(found.depth, *size) * np.float32(scale)
        depths.append(np.where(view.valid(), known, 0).astype(np.float32))
        confidences.append(there.back(found.confidence, *size))
        normals.append(there.back(found.normal, *size) @ turn.T.astype(np.float32))
    options = DenseOptions(**{**config.dense.model_dump(), "method": "sweep"})
    dense = complete_depths(
        [view.image for view in placement.views], [view.valid() for view in placement.views],
        list(placement.cameras), depths, confidences, options, context.threads,
    )  # fmt: skip
    return [
        replace(
            view,
            normal=np.where((view.depth > 0)[..., None], normal, view.normal).astype(np.float32),
        )
        for view, normal in zip(dense, normals, strict=True)
    ]
