"""Dense depth before the cameras found: stereo, completed by the shape of teeth.

Of three photographs the outer ones show flanks of the arch that no other sees: stereo ends
there, and what goes on smoothly from its rim is no tooth. Crown shapes before the same cameras,
bent to what stereo has measured, go on along the arch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.confidence import FILLED
from pipeline.artifacts.views import Views
from pipeline.errors import ReconstructionError, RequestError
from pipeline.geometry import cloud
from pipeline.geometry.graph import spanning_pairs
from pipeline.kernels import kernel_threads
from pipeline.kernels.threads import side_by_side
from pipeline.stage import StageContext
from stages.init.config import InitConfig
from stages.init.dental.place_known import as_seen, held_teeth, world_from_arch
from stages.init.dental.read import labelled_teeth
from stages.init.dental.reconstruct import PlacedTeeth
from stages.init.dental.surface.dense import StartedSurface, completed_surface, started_surface
from stages.init.placement import Placement
from stages.init.write import save_all, save_matches
from stages.stereo.appearance import to_gray
from stages.stereo.fill import continued
from stages.stereo.options import DenseOptions, DenseView
from stages.stereo.reconstruct import complete_depths, dense_depths

Array = npt.NDArray[np.float32]

#: Of so many photographs; of more every flank is seen twice, and unseen views are better without.
COMPLETED_VIEWS = 3
#: With fewer dense points the sparse ones are added.
LEAST_DENSE = 5000
#: By how much stereo measured off the crown shapes, they are off beside it, ever less over half a
#: crown; where that is more than this, one of them is of something else (mm). With it shapes are
#: off by .19 to .32 mm in the median on the samples, whose depth is known, without by .34 to .53; a
#: third of the reach gives most of that, more than twice as much costs unseen views of the scan .1.
CONTINUED, SAME_SURFACE = 4.0, 2.0


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

    def stereo() -> list[DenseView]:
        return dense_depths(
            images, valid, list(cameras),
            [points[seen].astype(np.float32) for seen in placement.seen],
            replace(options, fill=options.fill and not by_teeth), context.threads,
            lambda done, total: context.progress("dense stereo", done, total),
        )  # fmt: skip

    if by_teeth:
        known, completed = completed_by_teeth(context, placed, cameras, stereo)
        context.summarize(completed_by_teeth=completed)
        dense = complete_depths(
            images, valid, list(cameras), [found.depth for found in known],
            [found.confidence for found in known], options, context.threads,
        )  # fmt: skip
    else:
        dense = stereo()
    clouds = [
        cloud.depth_points(image, found.depth, found.normal, found.confidence, camera)
        for image, found, camera in zip(images, dense, cameras, strict=True)
    ]
    dense_count = sum(len(found) for found in clouds)
    if dense_count < LEAST_DENSE:
        advice = ""
        if options.method == "sgbm":
            advice = (
                " init.dense.method=sgbm sees little between cameras far apart, and nothing where "
                "one stands ahead of the other. Leave it out: the plane sweep does."
            )
        context.warn(
            f"Dense stereo found only {dense_count} points; the {len(points)} points of the sparse "
            f"reconstruction are added. The surface will have holes.{advice}"
        )
        clouds.append(cloud.sparse_points(points, images, list(cameras)))
    for image, found, camera in zip(images, dense, cameras, strict=True):
        rest = np.where(found.depth > 0, np.float32(0), found.filled)
        clouds.append(
            cloud.depth_points(image, rest, found.normal, found.confidence, camera, cloud.FILL_STEP)
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
    shown = {found.name for found in chosen if found.all_crowns}
    return shown >= {view.name for view in views.views}


def completed_by_teeth(
    context: StageContext, views: Views, cameras: Sequence[Camera],
    stereo: Callable[[], list[DenseView]],
) -> tuple[list[DenseView], bool]:  # fmt: skip
    """What stereo measured, and the shape of the teeth and their gum where it did not.

    Args:
        views: the placed photographs, `few_of_teeth`.
        cameras: of each.
        stereo: measures each, and completes none.

    Returns:
        Each with more depth and its confidence, for `complete_depths`, and whether it has more: not
        where the teeth do not lie where stereo has measured, or what a person has said of them
        leads nowhere. The cameras do not rest on it.
    """
    held = held_teeth(context, views, cameras)

    def shaped() -> tuple[PlacedTeeth, StartedSurface] | None:
        # A wrong number does no harm here: the crowns have to lie where the depth is.
        try:
            teeth = held.placed(context, views, cameras, accept_doubtful=True, quickly=True)
        except (ReconstructionError, RequestError):
            return None
        small = teeth.small
        images, valid = [v.image for v in small.views], [v.valid() for v in small.views]
        start = started_surface(images, valid, small.dentitions, small.fit, held.surface, 1)
        return teeth, start

    dense, shapes = side_by_side(stereo, shaped, context.threads)
    if shapes is None:
        return dense, False
    teeth, start = shapes
    scale, turn, _ = world_from_arch(teeth.fit, cameras)
    sizes = [(view.width, view.height) for view in teeth.small.views]
    measured = [
        cv2.resize(there.forth(found.depth), size, interpolation=cv2.INTER_NEAREST)
        / np.float32(scale)
        for found, there, size in zip(dense, held.centred, sizes, strict=True)
    ]
    try:
        surface = completed_surface(start, measured, context.threads, teeth.full)
    except ReconstructionError:
        return dense, False
    seen = as_seen(surface, held.centred, views.views, scale, turn)
    with kernel_threads(context.threads):
        completed = [
            _with_shape(found, there.depth, view.image, camera, scale)
            for found, there, view, camera in zip(dense, seen, views.views, cameras, strict=True)
        ]
    return completed, True


def _with_shape(
    found: DenseView, shape: Array, image: Array, camera: Camera, scale: float
) -> DenseView:
    """What stereo found of a photograph [H, W, 3], and elsewhere the depth [H, W] of crown shapes.

    Args:
        scale: of a millimetre in units of the depth.
    """
    if not (shape > 0).any():
        return found
    per_mm = camera.fx * scale / float(np.median(shape[shape > 0]))
    shape = continued(
        shape, found.depth, to_gray(image), SAME_SURFACE * scale, CONTINUED * per_mm
    )  # fmt: skip
    new = (found.depth == 0) & (shape > 0)
    return replace(
        found,
        depth=np.where(new, shape, found.depth),
        confidence=np.where(new, np.float32(FILLED), found.confidence),
    )
