"""The stage `init`: photographs in, cameras, a first dense cloud and pointmaps out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.artifacts.cameras import Cameras
from pipeline.artifacts.pointmaps import Pointmaps
from pipeline.artifacts.views import View, Views
from pipeline.errors import RequestError, nearest
from pipeline.stage import Stage, StageContext
from stages.init.config import InitConfig

if TYPE_CHECKING:
    from stages.init.options import ClassicalOptions
    from stages.init.placement import Placement


class InitStage(Stage):
    """Views -> cameras, points, pointmaps."""

    name = "init"
    version = 2
    summary = "find the cameras and a first dense cloud"
    Config = InitConfig
    requires = ("views",)
    provides = ("cameras", "points", "pointmaps")
    may_provide = ("views", "pictures")  # undistorted; labelled teeth
    libraries = ("pycolmap", "opencv-contrib-python-headless", "numpy", "scipy", "numba")
    methods = {  # noqa: RUF012
        "auto": "known where init.cameras is given, else colmap, else dental if teeth are found",
        "known": "cameras from a COLMAP model or transforms.json (init.cameras); dense stereo",
        "colmap": "yaw-compensated SIFT, COLMAP's mappers, plane-sweep stereo; no network needed",
    }

    def sources(self, config: Any, request: Mapping[str, Any]) -> Mapping[str, Path]:
        from stages.init.known import model_files

        if config.cameras is None:
            if config.method == "known":
                raise RequestError(
                    "init.method is known, but no cameras are given. Pass --set init.cameras=PATH "
                    "with the folder of a COLMAP model or a transforms.json."
                )
            return {}
        if config.method not in ("auto", "known"):
            raise RequestError(
                f"init.cameras is given, but init.method={config.method} would not use it. Leave "
                "one of them out."
            )
        return model_files(Path(config.cameras))

    def run(self, context: StageContext) -> None:
        """Place the views, densify, and write what came out.

        Raises:
            ReconstructionError: the photographs don't allow it; the message says why.
        """
        from stages.init.place import place_classical, with_focals

        config: InitConfig = context.config
        views: Views = context.load("views")
        if config.length.mm is not None:
            _photo(views, config.length.photo)  # a wrong name is said before the work is done
        options = _classical_options(config)
        if context.sources:
            placement = _place_known(context, views, options)
        else:
            from stages.init.diagnosis import least_views

            placement = place_classical(
                list(views.views), with_focals(views.views, config.focal),
                config.focal is not None, views.ordered,
                least_views(len(views), config.min_views_fraction), options,
                seed=context.seed, threads=context.threads, scratch=context.scratch,
                progress=context.progress, warn=context.warn,
            )  # fmt: skip
        _densify(context, views, placement.normalised())


def _classical_options(config: InitConfig) -> ClassicalOptions:
    from stages.init.options import ClassicalOptions

    return ClassicalOptions(
        **{name: getattr(config, name) for name in ClassicalOptions.__dataclass_fields__}
    )


def _place_known(context: StageContext, views: Views, options: ClassicalOptions) -> Placement:
    from stages.init.known import matching_cameras, read_cameras
    from stages.init.place import place_known

    config: InitConfig = context.config
    cameras, units = read_cameras(context.sources.values())
    return place_known(
        list(views.views), matching_cameras(cameras, views.views),
        units if config.units == "auto" else config.units, views.ordered, options,
        threads=context.threads, progress=context.progress, warn=context.warn,
    )  # fmt: skip


def _photo(views: Views, name: str) -> View:
    """The photograph that the user means.

    Raises:
        RequestError: there is none.
    """
    names = {view.source_name: view for view in views.views}
    names |= {Path(view.source_name).stem: view for view in views.views} | views.by_name() | names
    if name not in names:
        raise RequestError(
            f"init.length.photo: there is no photograph '{name}'.{nearest(name, names)}"
        )
    return names[name]


def _densify(context: StageContext, views: Views, placement: Placement) -> None:
    """Dense stereo from the cameras found, and everything written."""
    from stages.init import cloud
    from stages.init.dense import DenseOptions, dense_depths
    from stages.init.geometry import spanning_tree

    config: InitConfig = context.config
    cameras, points = placement.cameras, placement.points
    images = [view.image for view in placement.views]
    dense = dense_depths(
        images,
        [view.valid() for view in placement.views],
        list(cameras),
        [points[seen].astype(np.float32) for seen in placement.seen],
        DenseOptions(**config.dense.model_dump()),
        context.threads,
        lambda done, total: context.progress("dense stereo", done, total),
    )
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
    tree = spanning_tree(placement.weights, len(cameras))
    pairs = [
        cloud.pointmap_pair(
            cameras[i], cameras[j], depths[i], depths[j], dense[i].confidence, dense[j].confidence
        )
        for i, j in cloud.pointmap_edges(placement.weights, tree, len(cameras))
    ]
    _save_cameras(context, views, placement, depths)
    context.save(result)
    context.save(Pointmaps(pairs))
    context.summarize(
        views_registered=len(cameras),
        views_total=len(views),
        focal=round(float(np.median([c.fx / max(c.width, c.height) for c in cameras])), 4),
        sparse_points=len(points),
        dense_points=dense_count,
        points=len(result),
        **placement.figures,
    )


def _save_cameras(
    context: StageContext, views: Views, placement: Placement, depths: list[Any]
) -> None:
    """Write the cameras with the scale that is known, and the views if they were undistorted."""
    from stages.init.scale import mm_per_unit

    length = context.config.length
    input_from_world, units = placement.input_from_world, placement.units
    if length.mm is not None:
        view = _photo(views, length.photo)
        number = next((k for k, v in enumerate(placement.views) if v.name == view.name), None)
        if number is None:
            raise RequestError(
                f"init.length.photo: {length.photo} could not be placed, so that nothing can be "
                "measured in it. Name another photograph."
            )
        factor = mm_per_unit(
            view, placement.cameras[number], depths[number], length.start, length.end, length.mm
        )
        scale = np.cbrt(np.linalg.det(input_from_world[:3, :3]))
        input_from_world = np.diag([factor / scale] * 3 + [1.0]) @ input_from_world
        units = "mm"
        context.summarize(mm_per_unit=round(factor, 4))
    context.save(Cameras(placement.cameras, input_from_world, units))
    changed = {
        view.name: view
        for view in placement.views
        if view.image is not views.by_name()[view.name].image
    }
    if changed:
        context.save(replace(views, views=tuple(changed.get(v.name, v) for v in views.views)))
        context.summarize(undistorted=len(changed))
