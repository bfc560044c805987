"""The stage `align`: pairwise pointmaps to one world, and one coloured cloud."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from pipeline.artifacts.confidence import FILLED
from pipeline.errors import ReconstructionError
from pipeline.stage import Stage, StageContext
from stages.align.config import AlignConfig

if TYPE_CHECKING:
    from pipeline.artifacts.cameras import Camera, Cameras

#: So few photographs of a mouth, no further apart than this (degrees): what is completed counts
#: like what is measured.
FEW_VIEWS, NEAR = 5, 30.0
#: From so many views on, matches also correct focal lengths.
MATCHED_FOCALS = 6


class AlignStage(Stage):
    """Bring all pointmaps into one world and fuse them."""

    name = "align"
    version = 11
    summary = "pairwise pointmaps to one world: cameras and one dense coloured cloud"
    Config = AlignConfig
    requires = ("views", "pointmaps")
    optional = ("cameras", "points")  # points: kept where there are no pointmaps to fuse
    provides = ("cameras", "points")
    libraries = ("numpy", "scipy", "numba", "opencv-contrib-python-headless", "pycolmap")
    rehearsals = ("stages.align.rehearsal:fusion",)

    def run(self, context: StageContext) -> None:
        import numpy as np

        from pipeline.artifacts.cameras import Cameras
        from pipeline.artifacts.points import Points
        from pipeline.geometry.depths import view_depths
        from pipeline.geometry.start import start_from_cameras, start_from_tree
        from pipeline.geometry.world import move_camera, normalising_similarity
        from stages.align.fusion import FusionOptions, fuse

        config: AlignConfig = context.config
        views = context.load("views")
        by_name = views.by_name()
        pairs = [
            pair
            for pair in context.load("pointmaps")
            if pair.name_i in by_name and pair.name_j in by_name
        ]
        if not pairs and len(context.load("pointmaps")) == 0 and _kept(context):
            return
        if not pairs:
            raise ReconstructionError(
                "There are no pointmaps of these photographs: no two of them could be matched. "
                "Take photographs that overlap more, 10 to 20 degrees apart, in focus."
            )
        pairs = [_checked(pair, by_name) for pair in pairs]
        given = context.load("cameras") if context.has("cameras") else None
        if given is not None and len(given) == 0:
            given = None
        context.progress("start", 0, 1, pairs=len(pairs))
        start = (
            start_from_tree(pairs) if given is None else start_from_cameras(pairs, given.by_name())
        )
        figures: dict[str, float | int] = {}
        provisional = given is None or given.provisional
        refine = config.refine == "always" or (config.refine == "auto" and provisional)
        match = config.matches == "always" or (config.matches == "auto" and provisional and refine)
        first = start
        if start.cameras and refine:
            start, figures["alignment_residual"] = _optimised(context, views, pairs, start)
        if start.cameras and match:
            start = _matched(context, views, pairs, start, figures)
        if start is not first and given is not None:
            start = _back_in_world(start, given)
        merged = view_depths(pairs, start)
        if len(merged) < 2:
            raise ReconstructionError(
                "The pointmaps do not connect two views: nowhere do two photographs agree on a "
                "surface. Take photographs that overlap more, 10 to 20 degrees apart, in focus."
            )
        names = [view.name for view in views.views if view.name in merged]
        # of what has no camera from before an earlier stage has told
        told = set(by_name) - set(given.by_name()) if given is not None else set()
        missing = [
            view.source_name or view.name
            for view in views.views
            if view.name not in {*start.cameras, *told}
        ]
        if missing:
            context.warn(
                f"Not in the scene, as no pointmap ties them to the others: "
                f"{', '.join(missing)}. Photographs between them and the others would."
            )
        masked = {
            name: np.where(by_name[name].valid(), merged[name].confidence, np.float32(1))
            for name in names
        }
        cloud = fuse(
            [merged[name].depth for name in names],
            [masked[name] for name in names],
            [by_name[name].image for name in names],
            [start.cameras[name] for name in names],
            FusionOptions(
                _fill_confidence(config, given, [start.cameras[name] for name in names]),
                config.relative_depth, config.front, config.min_agreeing, config.merge,
            ),
            context.threads,
            lambda done, total: context.progress("fuse", done, total),
        )  # fmt: skip
        if len(cloud) == 0:
            raise ReconstructionError(
                "No part of the scene is seen alike by two photographs, so there is no surface to "
                "show. Take photographs that overlap more, 10 to 20 degrees apart, in focus."
            )
        placed = [start.cameras[v.name] for v in views.views if v.name in start.cameras]
        positions, normals = cloud.positions, cloud.normals
        if given is None:
            motion = normalising_similarity(placed, positions)
            placed = [move_camera(camera, motion) for camera in placed]
            moved = motion[0] * positions.astype(np.float64) @ motion[1].T + motion[2]
            positions = moved.astype(np.float32)
            normals = (normals @ motion[1].T).astype(np.float32)
            cameras = Cameras(tuple(placed))
        else:
            cameras = replace(given, cameras=tuple(placed), provisional=False)
        context.save(cameras)
        context.save(
            Points(
                positions, cloud.colors, normals, cloud.confidence,
                np.zeros(len(cloud), np.float32),
            )
        )  # fmt: skip
        if np.isfinite(cloud.residual):
            figures["depth_residual_percent"] = round(100 * cloud.residual, 3)
        context.summarize(
            points=len(cloud), fill_points=cloud.fill, views_registered=len(placed),
            views_total=len(views), **figures,
        )  # fmt: skip


def _fill_confidence(
    config: AlignConfig, given: Cameras | None, cameras: Sequence[Camera]
) -> float:
    """What `fill_confidence: auto` comes to.

    What few photographs show of a mouth is to a good part completed. Between near ones that is
    seldom off by much, and left out it is missed; between wide ones it gets in the way of what is
    right. From six on it hardly matters, and elsewhere (a street) it gained nothing.
    """
    from pipeline.geometry.order import neighbour_angle

    if config.fill_confidence != "auto":
        return config.fill_confidence
    if given is None or given.provisional or given.mouth_from_world is None:
        return FILLED
    near = len(cameras) <= FEW_VIEWS and neighbour_angle(cameras) <= NEAR
    return 1.0 if near else FILLED


def _kept(context: StageContext) -> bool:
    """Pass on cameras and points as they are, where they came without pointmaps."""
    if not (context.has("cameras") and context.has("points")):
        return False
    cameras, points = context.load("cameras"), context.load("points")
    if len(cameras) < 2 or len(points) == 0:
        return False
    for setting in ("refine", "matches"):
        if getattr(context.config, setting) == "always":
            context.warn(
                f"align.{setting}=always changes nothing: there are no pointmaps to refine the "
                "cameras by. The cameras and points stay as init has them."
            )
    context.save(cameras)
    context.save(points)
    context.summarize(points=len(points), views=len(cameras), kept="as given, without pointmaps")
    return True


def _optimised(context, views, pairs, start):  # type: ignore[no-untyped-def]
    """The start, improved, and the mean residual."""
    from stages.align.optimise import AlignOptions, optimise

    config: AlignConfig = context.config
    hold_focals, shared = _focal_rules(config, views, start)
    options = AlignOptions(
        iterations=config.iterations,
        samples=config.samples,
        free_focals=not hold_focals,
        free_poses=not config.hold_poses,
        shared_focal=shared,
    )
    better, residual = optimise(
        pairs, start, options,
        lambda done, total, loss: context.progress("align", done, total, residual=loss),
    )  # fmt: skip
    return better, round(residual, 5)


def _focal_rules(config, views, start):  # type: ignore[no-untyped-def]
    """Whether focal lengths are held, and whether there is one for all."""
    # Cameras whose focal length is what the photograph's own data say.
    stated = [
        view.name in start.cameras
        and view.focal_px is not None
        and abs(start.cameras[view.name].fx / view.focal_px - 1) < 1e-6
        for view in views.views
    ]
    hold = all(stated) if config.hold_focals == "auto" else config.hold_focals == "always"
    shared = views.ordered if config.shared_focal == "auto" else config.shared_focal == "always"
    return hold, shared


def _matched(context, views, pairs, start, figures):  # type: ignore[no-untyped-def]
    """The start with cameras that sparse matches have refined, where there are enough of them."""
    from pipeline.geometry.depths import view_depths
    from pipeline.geometry.start import start_from_cameras
    from stages.align.bundle import BundleOptions, refine_with_matches
    from stages.align.optimise import AlignOptions, optimise

    config: AlignConfig = context.config
    depths = view_depths(pairs, start)
    if config.hold_poses or len(depths) < 2:
        return start
    hold_focals, shared = _focal_rules(config, views, start)
    context.progress("match", 0, 1)
    bundle = refine_with_matches(
        {view.name: view.gray() for view in views.views},
        {view.name: view.valid() for view in views.views},
        start.cameras,
        depths,
        BundleOptions(
            features=config.match_features,
            min_matches=config.match_min,
            free_focals=not hold_focals and len(start.cameras) >= MATCHED_FOCALS,
            shared_focal=shared,
        ),
    )
    context.progress("match", 1, 1)
    figures["matched_points"] = bundle.tracks
    if bundle.reason:
        if config.matches == "always":
            titles = {view.name: view.source_name or view.name for view in views.views}
            why = f"{bundle.reason} {titles.get(bundle.view, '')}".strip()
            context.warn(
                f"The {bundle.tracks:,} matched points change no camera: {why} "
                "(align.matches=always, align.match_min)."
            )
        return start
    figures["reprojection_error_px"] = round(bundle.after, 3)
    options = AlignOptions(
        iterations=config.iterations, samples=config.samples, free_focals=False, free_poses=False
    )
    return optimise(pairs, start_from_cameras(pairs, bundle.cameras), options)[0]


def _back_in_world(start, given):  # type: ignore[no-untyped-def]
    """Optimised cameras in the world of those given: the frame that is known of it still holds."""
    from pipeline.geometry.start import Start
    from pipeline.geometry.world import move_camera, similarity_between

    known = given.by_name()
    names = sorted(start.cameras)
    motion = similarity_between(
        [start.cameras[name] for name in names], [known[name] for name in names]
    )
    scale, turn, shift = motion
    pairs = [
        pair and (scale * pair[0], turn @ pair[1], scale * turn @ pair[2] + shift)
        for pair in start.pair_from
    ]
    cameras = {name: move_camera(start.cameras[name], motion) for name in names}
    return Start(cameras, pairs)


def _checked(pair, by_name):  # type: ignore[no-untyped-def]
    """Refuse pointmaps whose size is not that of their view."""
    from pipeline.errors import RequestError

    for name, confidence in ((pair.name_i, pair.confidence_i), (pair.name_j, pair.confidence_j)):
        view = by_name[name]
        if confidence.shape != (view.height, view.width):
            both = [by_name[n].source_name or n for n in (pair.name_i, pair.name_j)]
            raise RequestError(
                f"The pointmap of the pair {both[0]}, {both[1]} has "
                f"{confidence.shape[1]}x{confidence.shape[0]} pixels for "
                f"{view.source_name or name}, whose image is {view.width}x{view.height}. Give "
                "pointmaps at the working size, or set views.long_side to theirs."
            )
    return pair
