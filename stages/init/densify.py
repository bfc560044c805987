"""Dense depth before the cameras found: stereo, completed by the shape of teeth.

Of three photographs the outer ones show flanks of the arch that no other sees: stereo ends
there, and what goes on smoothly from its rim is no tooth. Crown shapes before the same cameras,
bent to what stereo has measured, go on along the arch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.confidence import FILLED
from pipeline.artifacts.views import Views
from pipeline.errors import ReconstructionError, RequestError
from pipeline.geometry import cloud
from pipeline.geometry.graph import spanning_pairs
from pipeline.stage import StageContext
from stages.init.config import InitConfig
from stages.init.dental.place_known import as_seen, held_teeth, world_from_arch
from stages.init.dental.read import labelled_teeth
from stages.init.dental.surface.dense import completed_surface
from stages.init.placement import Placement
from stages.init.write import save_all, save_matches
from stages.stereo import DenseOptions, DenseView, dense_depths
from stages.stereo.reconstruct import complete_depths

#: Of so many photographs; of more every flank is seen twice, and unseen views are better without.
COMPLETED_VIEWS = 3


def densify(context: StageContext, views: Views, placement: Placement) -> None:
    """Dense stereo from the cameras found, and everything written."""
    config: InitConfig = context.config
    cameras, points = placement.cameras, placement.points
    images = [view.image for view in placement.views]
    settings = config.dense.model_dump()
    settings["method"] = "sgbm" if config.dense.method == "sgbm" else "sweep"
    options = DenseOptions(**settings)
    valid = [view.valid() for view in placement.views]
    placed = replace(views, views=placement.views)
    by_teeth = options.fill and few_of_teeth(context, placed)
    dense = dense_depths(
        images, valid, list(cameras),
        [points[seen].astype(np.float32) for seen in placement.seen],
        replace(options, fill=options.fill and not by_teeth), context.threads,
        lambda done, total: context.progress("dense stereo", done, total),
    )  # fmt: skip
    if by_teeth:
        known = completed_by_teeth(context, placed, cameras, dense)
        context.summarize(completed_by_teeth=known is not None)
        known = known or dense
        dense = complete_depths(
            images, valid, list(cameras), [found.depth for found in known],
            [found.confidence for found in known], options, context.threads,
        )  # fmt: skip
    clouds = [
        cloud.depth_points(image, found.depth, found.normal, found.confidence, camera)
        for image, found, camera in zip(images, dense, cameras, strict=True)
    ]
    dense_count = sum(len(found) for found in clouds)
    if dense_count < config.min_dense_points:
        context.warn(
            f"Dense stereo found only {dense_count} points; the {len(points)} points of the sparse "
            "reconstruction are added. The surface will have holes."
        )
        clouds.append(cloud.sparse_points(points, images, list(cameras)))
    if config.fill_step:
        for image, found, camera in zip(images, dense, cameras, strict=True):
            rest = np.where(found.depth > 0, np.float32(0), found.filled)
            clouds.append(
                cloud.depth_points(
                    image, rest, found.normal, found.confidence, camera, config.fill_step
                )
            )
    result = cloud.thinned(cloud.joined(clouds), config.max_points, context.seed)
    depths = [np.where(found.depth > 0, found.depth, found.filled) for found in dense]
    tree = spanning_pairs(placement.weights)
    pairs = [
        cloud.pointmap_pair(
            cameras[i], cameras[j], depths[i], depths[j], dense[i].confidence, dense[j].confidence
        )
        for i, j in cloud.pointmap_edges(placement.weights, tree, len(cameras))
    ]
    save_all(
        context, views, placement.views,
        placement.placed(), depths, result, pairs,
    )  # fmt: skip
    if placement.links is not None and config.match_pictures:
        save_matches(context, placement.links, config.match_pictures)
    context.summarize(sparse_points=len(points), dense_points=dense_count, **placement.figures)


def few_of_teeth(context: StageContext, views: Views) -> bool:
    """Are these three photographs, all of teeth, that are to be completed by them?"""
    config: InitConfig = context.config
    if not (
        config.dental.complete_depth and context.has("teeth") and len(views) == COMPLETED_VIEWS
    ):
        return False
    chosen = labelled_teeth(context, views).chosen
    shown = {found.name for found in chosen if found.all_crowns and not found.mirrored}
    return shown >= {view.name for view in views.views}


def completed_by_teeth(
    context: StageContext, views: Views, cameras: Sequence[Camera], dense: Sequence[DenseView]
) -> list[DenseView] | None:
    """What stereo measured, and the shape of the teeth and their gum where it did not.

    Args:
        views: the placed photographs, `few_of_teeth`.
        cameras: of each.
        dense: of each, not completed.

    Returns:
        Each with more depth and its confidence, for `complete_depths`; None where the teeth do not
        lie where stereo has measured, or what a person has said of them leads nowhere: the cameras
        do not rest on it.
    """
    held = held_teeth(context, views, cameras)
    try:
        # A wrong number does no harm here: the crowns have to lie where the depth is.
        teeth = held.placed(context, views, cameras, accept_doubtful=True)
        scale, turn, _ = world_from_arch(teeth.fit, cameras)
        sizes = [(view.width, view.height) for view in teeth.small.views]
        measured = [
            cv2.resize(there.forth(found.depth), size, interpolation=cv2.INTER_NEAREST)
            / np.float32(scale)
            for found, there, size in zip(dense, held.centred, sizes, strict=True)
        ]
        surface = completed_surface(
            [view.image for view in teeth.small.views],
            [view.valid() for view in teeth.small.views],
            teeth.small.dentitions, teeth.small.fit, measured, held.surface, context.threads,
            teeth.full,
        )  # fmt: skip
    except (ReconstructionError, RequestError):
        return None
    seen = as_seen(surface, held.centred, views.views, scale, turn)
    return [
        replace(
            found,
            depth=np.where(found.depth > 0, found.depth, there.depth),
            confidence=np.where(
                (found.depth == 0) & (there.depth > 0), np.float32(FILLED), found.confidence
            ),
        )
        for found, there in zip(dense, seen, strict=True)
    ]
