"""Cameras and sparse points of a COLMAP model, as they are: no matching, no dense stereo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.artifacts.space.scale import Scale
from pipeline.artifacts.views import Views
from pipeline.errors import ReconstructionError, RequestError
from pipeline.geometry.models.known_cameras import KnownCamera, as_pinhole
from pipeline.geometry.models.model_points import as_points, read_model_points
from pipeline.stage import StageContext
from stages.init.config import CAMERAS, InitConfig
from stages.init.place import photo_name
from stages.init.placement import Placement
from stages.init.write import save_all


def from_model(
    context: StageContext, views: Views, known: dict[str, KnownCamera], scale: Scale
) -> None:
    """Write a model's cameras and points, in a normalised world, and no pointmaps.

    Args:
        known: name of a view -> its camera in the model.
        scale: of the model's world.

    Raises:
        RequestError: a length is to be measured, which takes dense depths.
        ReconstructionError: the model has no points.
    """
    config: InitConfig = context.config
    if config.length.mm is not None:
        raise RequestError(
            "init.length needs dense stereo to measure in, which init.points=model leaves out. "
            "Give only one of them."
        )
    without = [photo_name(view) for view in views.views if view.name not in known]
    if without:
        context.warn(f"The model has no camera of {', '.join(without)}; left out.")
    sparse = read_model_points(next(iter(context.sources.values())).parent)
    if len(sparse) == 0:
        raise ReconstructionError(
            f"The model {config.cameras} has cameras but no points to start from. Leave "
            "init.points=model out, so that dense stereo finds them."
        )
    pairs = [
        as_pinhole(view, known[view.name], CAMERAS) for view in views.views if view.name in known
    ]
    placement = Placement(
        views=tuple(view for view, _ in pairs), cameras=tuple(camera for _, camera in pairs),
        points=sparse.positions,
        seen=tuple(sparse.observed[known[view.name].name] for view, _ in pairs),
        weights={}, scale=scale, given=True,
    ).normalised()  # fmt: skip
    cameras = {known[camera.name].name: camera for camera in placement.cameras}
    points = as_points(placement.points, sparse.colors, sparse.observed, cameras)
    if not points.colors.any():  # a model that was made without them
        points = replace(points, colors=_colours(placement))
    save_all(
        context, views, placement.views,
        placement.placed(), [], points, [],
    )  # fmt: skip
    lengths = sparse.track_lengths()
    context.summarize(sparse_points=len(sparse), track_length=round(float(lengths.mean()), 2))


def _colours(placement: Placement) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """[P, 3] mean colour of the views that observe each point."""
    total, count = np.zeros((len(placement.points), 3)), np.zeros(len(placement.points))
    for view, camera, seen in zip(placement.views, placement.cameras, placement.seen, strict=True):
        pixels = np.floor(camera.project(placement.points[seen])[0]).astype(np.int64)
        column, row = np.clip(pixels, 0, (camera.width - 1, camera.height - 1)).T
        total[seen] += view.image[row, column]
        count[seen] += 1
    return (total / np.maximum(count, 1)[:, None]).astype(np.float32)
