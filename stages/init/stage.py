"""The stage `init`: photographs in, cameras, a first dense cloud and pointmaps out."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

from pipeline.artifacts.cameras import Cameras
from pipeline.artifacts.views import Views
from pipeline.errors import ReconstructionError, RequestError
from pipeline.stage import Parts, Stage, StageContext
from stages.init.config import CAMERAS, InitConfig

if TYPE_CHECKING:
    from pipeline.geometry.models.known_cameras import KnownCamera
    from pipeline.stage import Finding
    from stages.init.sfm.options import ClassicalOptions
    from stages.pointmaps.options import PointmapOptions


class InitStage(Stage):
    """Views -> cameras, points, pointmaps."""

    name = "init"
    version = 65
    summary = "find the cameras and a first dense cloud"
    Config = InitConfig
    requires = ("views",)
    optional = ("teeth",)
    provides = ("cameras", "points", "pointmaps")
    may_provide = ("views", "pictures", "teeth")  # undistorted; matches or labels; numbered
    libraries = ("pycolmap", "opencv-contrib-python-headless", "numpy", "scipy", "numba")
    rehearsals = ("stages.init.rehearsal:teeth", "stages.init.rehearsal:features")
    methods = {  # noqa: RUF012
        "auto": "known where init.cameras is given; a model where init.pointmap.checkpoint is "
        "given and one is installed; else colmap, or dental where features fail on teeth",
        "known": "cameras from a COLMAP model or transforms.json (init.cameras); dense stereo, or "
        "the surface of the teeth where few wide photographs show some",
        "colmap": "yaw-compensated SIFT, COLMAP's mappers, plane-sweep stereo; no network needed",
        "dental": "wide photographs of teeth: the teeth are the landmarks; a dense surface of them",
        "mapanything": "MapAnything, if installed",
        "vggt": "VGGT, if installed",
        "must3r": "MUSt3R, if installed",
        "mast3r": "MASt3R, if installed",
        "dust3r": "DUSt3R, if installed",
        "files": "pointmaps made elsewhere, as .npz (init.pointmap.files)",
    }

    def sources(self, config: Any, request: Mapping[str, Any]) -> Mapping[str, Path]:
        from pipeline.artifacts.dental.corrections import (
            CORRECTIONS,
            corrections_beside,
            corrections_file,
            read_corrections,
        )

        files = dict(_inputs(config))
        said = corrections_file(config.dental.labels, request, "init.dental.labels")
        if said:
            read_corrections(said)  # a wrong file is said before any work is done
            files[CORRECTIONS] = said
        elif beside := corrections_beside(request):
            request["tell"](
                f"{beside} is not used: it lies beside the photographs. Put it into the workspace, "
                f"or name it: --set {quote(f'init.dental.labels={beside}')}"
            )
        return files

    def backend(self, config: Any) -> str:
        options = _pointmap_options(config) if config.cameras is None else None
        if options is None:
            return ""
        from stages.pointmaps.predict import model_code

        return model_code(options)

    def findings(self) -> Iterable[Finding]:
        from pipeline.stage import Finding
        from stages.pointmaps.predict import available, cards

        installed = set(available())
        for card in cards():
            there = card.name in installed
            yield Finding(
                f"init.method {card.name}", "ok" if there else "note",
                f"{card.title} is {'installed' if there else 'not installed (optional)'}; weights: "
                f"{card.weights_licence}",
                f"--set init.method={card.name} --set init.pointmap.checkpoint=FILE" if there
                else card.install,
            )  # fmt: skip

    def report(self) -> Parts:
        from stages.init.report import PARTS

        return PARTS

    def run(self, context: StageContext) -> None:
        """Place the views, densify, and write what came out.

        Raises:
            ReconstructionError: the photographs don't allow it; the message says why.
        """
        from stages.init.scale import photo_named

        config: InitConfig = context.config
        views: Views = context.load("views")
        if config.length.mm is not None:
            photo_named(views, config.length.photo)  # a wrong name is said before the work is done
        if config.cameras is not None:
            _from_known_cameras(context, views)
        elif pointmaps := _pointmap_options(config):
            _from_pointmaps(context, views, pointmaps)
        elif config.method == "dental":
            from stages.init.dental.place import from_teeth

            from_teeth(context, views)
        else:
            _from_features(context, views)


def _inputs(config: InitConfig) -> Mapping[str, Path]:
    """The files that the settings name: cameras, or pointmaps and weights."""
    from pipeline.geometry.models.known_cameras import model_files

    if config.cameras is not None:
        if config.method not in ("auto", "known", "dental"):
            raise RequestError(
                f"init.cameras is given, but init.method={config.method} would not use it. "
                "Leave one of them out."
            )
        files = model_files(Path(config.cameras), CAMERAS)
        if config.points == "model" and not any("points3D" in label for label in files):
            raise RequestError(
                f"init.points=model: {config.cameras} holds no points. Give the folder of a "
                "COLMAP model with points3D.bin or points3D.txt, or leave init.points out."
            )
        return files
    if config.points == "model":
        raise RequestError(
            "init.points=model takes the points of a COLMAP model, but none is given. Pass "
            "--set init.cameras=FOLDER too."
        )
    if config.method == "known":
        raise RequestError(
            "init.method is known, but no cameras are given. Pass --set init.cameras=PATH with "
            "the folder of a COLMAP model or a transforms.json."
        )
    options = _pointmap_options(config)
    if options is None:
        return {}
    from stages.pointmaps.predict import source_files

    return source_files(options)


def _camera_files(sources: Mapping[str, Path]) -> list[Path]:
    """The sources without what a person has said of the teeth."""
    from pipeline.artifacts.dental.corrections import CORRECTIONS

    return [path for label, path in sources.items() if label != CORRECTIONS]


def _pointmap_options(config: InitConfig) -> PointmapOptions | None:
    """How to ask a pointmap model, or None where the method is another."""
    from stages.pointmaps.options import METHODS, PointmapOptions
    from stages.pointmaps.predict import available

    method: str = config.method
    if method == "auto" and config.pointmap.checkpoint is not None:
        found = available()
        if len(found) > 1:
            raise RequestError(
                f"Several pointmap models are installed ({', '.join(found)}). Say whose weights "
                f"init.pointmap.checkpoint are, as in --set init.method={found[0]}."
            )
        method = found[0] if found else "colmap"
    if method not in METHODS:
        return None
    settings = config.pointmap.model_dump() | config.pointmap.paths
    return PointmapOptions(method=method, **settings)


def _from_features(context: StageContext, views: Views) -> None:
    """By features, or by teeth where these link photographs that features don't."""
    from pipeline.kernels.threads import side_by_side
    from stages.init.dental.choice import ByTeeth, neither
    from stages.init.dental.odd_ones import SeveralMouthsError
    from stages.init.dental.read import turned_as_said, without_left_out
    from stages.init.place import place_classical, with_focals
    from stages.init.sfm.diagnosis import least_views
    from stages.init.sfm.options import RefinementOptions

    config: InitConfig = context.config
    free = config.method == "auto"
    by_teeth, options = ByTeeth(context, views), _classical_options(config)
    upright = without_left_out(context, turned_as_said(context, views))
    focals = with_focals(upright.views, config.focal)
    told: list[str] = []
    # what either way needs is loaded meanwhile; pycolmap in this thread, where signals can wait
    teeth_first, dense = side_by_side(
        lambda: free and by_teeth.is_first(upright.views, focals, options),
        lambda: import_module("stages.init.densify"),
        context.threads,
    )
    if teeth_first:
        context.progress("features do not link the photographs; trying the teeth", 0, 1)
        with suppress(ReconstructionError):
            by_teeth.place()
            return
    refinement = RefinementOptions(**config.refinement.model_dump())
    if refinement.unroll and by_teeth.upright():
        refinement = replace(refinement, unroll=False)
    try:
        placement = place_classical(
            list(upright.views), focals, config.focal is not None, views.ordered,
            least_views(len(upright), config.min_views_fraction), options, refinement,
            seed=context.seed, threads=context.threads,
            scratch=context.scratch, progress=context.progress, warn=told.append,
            pictures=config.match_pictures, plain_features=by_teeth.features,
        )  # fmt: skip
    except ReconstructionError as unplaced:
        if not free:
            raise
        if not by_teeth.to_try():
            raise by_teeth.with_what_was_set_aside(unplaced) from unplaced
        context.progress("features do not link the photographs; trying the teeth", 0, 1)
        try:
            by_teeth.place()
        except SeveralMouthsError:
            raise  # between two mouths there is no texture in common
        except ReconstructionError as doubtful:
            raise neither(unplaced, doubtful) from doubtful
        return
    if free and by_teeth.knows_more({camera.name for camera in placement.cameras}):
        context.progress("features link few of the photographs; trying the teeth", 0, 1)
        try:
            by_teeth.place()
            return
        except ReconstructionError as doubtful:
            told.append(f"The teeth do not place more of the photographs: {doubtful}")
    for text in told:
        context.warn(text)
    if config.dental.order is not None:
        context.warn("init.dental.order was not used: texture places these photographs, not teeth.")
    dense.densify(context, views, placement.normalised())


def _classical_options(config: InitConfig) -> ClassicalOptions:
    from stages.init.sfm.options import ClassicalOptions

    return ClassicalOptions(
        **{name: getattr(config, name) for name in ClassicalOptions.__dataclass_fields__}
    )


def _from_known_cameras(context: StageContext, views: Views) -> None:
    from pipeline.artifacts.space.scale import said_by_cameras
    from pipeline.geometry.models.known_cameras import matching_cameras, read_cameras
    from stages.init.densify import densify
    from stages.init.dental.read import refuse_mirrored
    from stages.init.place import place_known

    config: InitConfig = context.config
    cameras, scale = read_cameras(_camera_files(context.sources), CAMERAS)
    known = matching_cameras(cameras, views.views, CAMERAS)
    refuse_mirrored(context, views, known)
    if config.units not in ("auto", scale.units):
        scale = said_by_cameras(config.units)
    if config.points == "model":
        from stages.init.model_start import from_model

        from_model(context, views, known, scale)
        return
    if config.method == "dental" or _teeth_are_wide_apart(context, views, known):
        from stages.init.dental.place_known import from_known_teeth

        try:
            from_known_teeth(context, views, known, scale)
            return
        except ReconstructionError as doubtful:
            if config.method == "dental":
                raise
            context.warn(
                "The surface of the teeth could not be made with the cameras given; dense stereo "
                f"is used instead, which knows less of it. {doubtful}"
            )
    placement = place_known(
        list(views.views), known, scale, views.ordered,
        _classical_options(config), threads=context.threads, progress=context.progress,
        warn=context.warn, scratch=context.scratch,
    )  # fmt: skip
    densify(context, views, placement.normalised())


def _teeth_are_wide_apart(
    context: StageContext, views: Views, known: dict[str, KnownCamera]
) -> bool:
    """Few photographs of teeth with known cameras, too far apart for dense stereo."""
    from pipeline.geometry.models.known_cameras import pinhole_camera
    from pipeline.geometry.order import neighbour_angle
    from stages.init.dental.choice import ByTeeth

    config: InitConfig = context.config
    if config.dense.method != "auto":
        return False
    posed = tuple(view for view in views.views if view.name in known)
    angle = neighbour_angle([pinhole_camera(view, known[view.name], CAMERAS) for view in posed])
    wide = angle > config.dental.wide_angle
    return wide and bool(ByTeeth(context, replace(views, views=posed)).to_try())


def _from_pointmaps(context: StageContext, views: Views, options: PointmapOptions) -> None:
    from stages.init.dental.read import turned_as_said, without_left_out
    from stages.init.place import photo_name, with_focals
    from stages.init.write import save_all
    from stages.pointmaps.predict import predict_pointmaps
    from stages.pointmaps.quick_start import quick_start

    config: InitConfig = context.config
    given, views = views, without_left_out(context, turned_as_said(context, views))
    pairs = predict_pointmaps(
        views.views, views.ordered, options, context.progress, context.threads
    )
    focals = {
        view.name: focal
        for view, focal in zip(views.views, with_focals(views.views, config.focal), strict=True)
        if focal
    }
    start = quick_start(pairs, views.views, focals, max_points=config.max_points, seed=context.seed)
    by_name = views.by_name()
    if start.unplaced:
        context.warn(
            f"{len(start.unplaced)} of {len(views)} photographs could not be placed and are left "
            f"out: {', '.join(photo_name(by_name[name]) for name in start.unplaced)}."
        )
    # A focal length that is known is written with the views, so that `align` holds it.
    placed = tuple(
        replace(view, focal_px=focals[view.name]) if config.focal else view
        for view in (by_name[camera.name] for camera in start.cameras)
    )
    cameras = Cameras(start.cameras, provisional=True)  # `align` makes them better
    save_all(context, given, placed, cameras, list(start.depths), start.points, pairs)
    context.summarize(method=options.method, pairs=len(pairs))
