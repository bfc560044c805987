"""The `flow` stage: optical flow between neighbouring views, both ways, with masks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field, field_validator
from pydantic_core import PydanticCustomError

from pipeline.artifacts.cameras import Camera, Cameras
from pipeline.artifacts.flow import Flow, FlowPair
from pipeline.artifacts.points import Points
from pipeline.artifacts.views import View, Views
from pipeline.errors import RequestError
from pipeline.stage import Parts, Stage, StageConfig, StageContext

#: Trusted shares below this are worth a word to the user,
_POOR_SHARE = 0.1
#: where the views are this near to each other (degrees) or nobody knows how near: of wider ones
#: nothing better is expected. It is what a user is asked to photograph at.
_NEAR = 20.0
#: A narrower window (sigma, pixels) holds hardly more than the pixel whose mean is taken out.
LEAST_WINDOW = 0.5


class FlowConfig(StageConfig):
    """Settings of the flow stage."""

    method: Literal["dis", "farneback"] = Field("dis", description="Optical flow algorithm.")
    contrast_window: float = Field(
        4.0,
        ge=0,
        le=100,
        description="Local brightness and contrast are evened out in a window of this sigma "
        "(pixels) first, because the flash moves with the camera; 0: not at all.",
    )
    prewarp: Literal["auto", "on", "off"] = Field(
        "auto",
        description="Predict flow from cameras and points and estimate only what is left; auto: "
        "wherever there are cameras and points.",
    )
    window: int = Field(
        1, ge=1, le=10, description="Pair each view with this many next ones in viewing order."
    )
    max_angle: float = Field(
        45.0, ge=0, le=180,
        description="Widest angle between the views of a pair, degrees (where cameras are known). "
        "Without pre-warp, flow is mostly wrong from about 12 degrees on.",
    )  # fmt: skip
    mask: Literal["consistency", "none"] = Field(
        "consistency",
        description="Trust flow where there and back agree and no other test speaks against it; "
        "none: everywhere (an ablation).",
    )
    consistency_relative: float = Field(
        0.0, ge=0, le=1,
        description="Forward-backward test: tolerated share of the squared motion (with "
        "pre-warp: of the motion that geometry did not predict). The usual 0.01 trusts more "
        "pixels, of which more are wrong.",
    )  # fmt: skip
    consistency_absolute: float = Field(
        0.25, ge=0, le=100, description="Forward-backward test: tolerated squared error, pixels^2."
    )
    min_texture: float = Field(
        2.0, ge=0, le=128,
        description="Trust flow only where the grey levels (0-255) of the 9x9 pixels around vary "
        "with at least this standard deviation; 0 switches the test off.",
    )  # fmt: skip
    highlight_level: float = Field(
        1.0, gt=0, le=1,
        description="Don't trust flow where the darkest colour channel is above this (highlights "
        "of the flash move with the camera); 1 switches the test off.",
    )  # fmt: skip

    @field_validator("contrast_window")
    @classmethod
    def _more_than_a_pixel(cls, value: float) -> float:
        if 0 < value < LEAST_WINDOW:
            why = f"in a window of less than {LEAST_WINDOW} nothing is left of a photograph"
            raise PydanticCustomError("window", "{why}", {"why": why})
        return value


class FlowStage(Stage):
    """Views (and cameras and points, where there are any) -> flow of neighbouring views."""

    name = "flow"
    version = 3
    summary = "optical flow between neighbouring views, both ways, with consistency masks"
    Config = FlowConfig
    requires = ("views",)
    optional = ("cameras", "points")
    provides = ("flow",)
    libraries = ("opencv-contrib-python-headless", "numpy", "numba")
    rehearsals = ("stages.flow.rehearsal:splatting",)
    methods: ClassVar[Mapping[str, str]] = {
        "dis": "Dense Inverse Search (Kroeger et al. 2016): fast, the default",
        "farneback": "polynomial expansion (Farnebäck 2003)",
    }

    def report(self) -> Parts:
        from stages.flow.report import PARTS

        return PARTS

    def run(self, context: StageContext) -> None:
        from pipeline.kernels.threads import opencv_threads

        with opencv_threads(1):
            _run(context)


def _run(context: StageContext) -> None:
    from pipeline.kernels.threads import in_threads
    from stages.flow.geometry import splat_depth
    from stages.flow.pair import Estimator, Side, Trust, flow_between

    config: FlowConfig = context.config
    views: Views = context.load("views")
    placed: Cameras | None = context.load("cameras") if context.has("cameras") else None
    points: Points | None = context.load("points") if context.has("points") else None
    geometry = placed is not None and points is not None and len(points) > 0
    if config.prewarp == "on" and not geometry:
        raise RequestError(
            "flow.prewarp=on needs cameras and points, and this run has no stage before flow that "
            "gives both. Add the stages init and align, or set flow.prewarp=auto."
        )
    prewarp = geometry and config.prewarp != "off"

    cameras = _cameras_of(views, placed)
    pairs, too_wide = _choose_pairs(views, cameras if placed else None, points, config)
    _warn_of_missing(context, len(views), len(cameras), len(pairs), too_wide)

    def side(view: View) -> Side:
        camera = cameras.get(view.name)
        depth = None
        if camera is not None and points is not None and geometry:
            depth = splat_depth(points.positions, points.scale, camera)
        return Side(view.image, view.valid(), camera, depth)

    shown = {view.name: view for pair in pairs for view in pair[:2]}
    sides = dict(zip(shown, in_threads(side, shown.values(), context.threads), strict=True))

    estimator = Estimator(config.method, config.contrast_window, prewarp)
    trust = Trust(
        config.mask, config.consistency_relative, config.consistency_absolute,
        config.min_texture, config.highlight_level,
    )  # fmt: skip
    results: list[FlowPair] = []
    deviations, shares, poor = [], [], []
    context.progress("flow", 0, len(pairs))
    found = in_threads(
        lambda pair: flow_between(sides[pair[0].name], sides[pair[1].name], estimator, trust),
        pairs, context.threads, lambda done: context.progress("flow", done, len(pairs)),
    )  # fmt: skip
    for (view_i, view_j, angle), (forward, backward) in zip(pairs, found, strict=True):
        share = 0.5 * float(forward.mask.mean() + backward.mask.mean())
        if share < _POOR_SHARE and not angle > _NEAR:
            poor.append(f"{_title(view_i)} and {_title(view_j)} ({share:.0%})")
        shares.append(share)
        deviations += [forward.deviation, backward.deviation]
        results.append(
            FlowPair(
                view_i.name, view_j.name,
                forward.flow, backward.flow, forward.mask, backward.mask,
            )
        )  # fmt: skip
    if poor:
        context.warn(
            "Flow can be trusted on few pixels, and hardly contributes to the fit, between "
            f"{', '.join(poor)}."
        )
    context.save(Flow(tuple(sorted(results, key=lambda pair: (pair.name_i, pair.name_j)))))

    figures: dict[str, float | int | str] = {
        "pairs": len(results), "pairs_too_wide": len(too_wide), "prewarp": str(prewarp).lower(),
    }  # fmt: skip
    if shares:
        figures["trusted_share"] = round(float(np.mean(shares)), 4)
    compared = np.concatenate(deviations) if deviations else np.zeros(0)
    if compared.size:
        figures["median_px_from_geometry"] = round(float(np.median(compared)), 3)
    context.summarize(**figures)


def _title(view: View) -> str:
    """How the user knows a photograph."""
    return view.source_name or view.name


def _cameras_of(views: Views, placed: Cameras | None) -> dict[str, Camera]:
    """The camera of each placed view, at the size of the view's image."""
    if placed is None:
        return {}
    known = placed.by_name()
    return {
        view.name: known[view.name].resized(view.width, view.height)
        for view in views.views
        if view.name in known
    }


def _choose_pairs(
    views: Views, cameras: dict[str, Camera] | None, points: Points | None, config: FlowConfig
) -> tuple[list[tuple[View, View, float]], list[tuple[str, str, float]]]:
    """Pair the neighbours in viewing order; also return who is too far apart, and how far.

    Angles are degrees. Without cameras (None) the viewing order is that of the views, and no angle
    is known (NaN).
    """
    from pipeline.geometry.order import viewing_order
    from stages.flow.order import neighbour_pairs, parallax_angle

    if cameras is None:
        order = list(range(len(views)))
        return [
            (views.views[a], views.views[b], np.nan)
            for a, b in neighbour_pairs(order, config.window)
        ], []
    placed = [view for view in views.views if view.name in cameras]
    centres = np.array([cameras[view.name].centre for view in placed]).reshape(-1, 3)
    positions = points.positions if points is not None else None
    pairs, too_wide = [], []
    for a, b in neighbour_pairs(viewing_order(centres), config.window):
        view_i, view_j = placed[a], placed[b]
        angle = parallax_angle(cameras[view_i.name], cameras[view_j.name], positions)
        if angle <= config.max_angle:
            pairs.append((view_i, view_j, angle))
        else:
            too_wide.append((_title(view_i), _title(view_j), angle))
    return pairs, too_wide


def _warn_of_missing(
    context: StageContext,
    views: int,
    placed: int,
    pairs: int,
    too_wide: list[tuple[str, str, float]],
) -> None:
    """Tell of gaps in a sweep. Of a few photographs far apart nobody expects flow."""
    if not pairs and not too_wide:
        context.warn(
            f"Optical flow needs two views whose cameras are known; of {views} views, {placed} "
            "have one. The fit goes on without its flow term, on colour alone."
        )
    elif pairs > len(too_wide) > 0:
        wide = ", ".join(
            f"{i} and {j} ({angle:.0f}°)"
            if np.isfinite(angle)
            else f"{i} and {j} (nothing in common)"
            for i, j, angle in too_wide
        )
        context.warn(
            f"Left out of the flow, as the views are too far apart "
            f"(flow.max_angle={context.config.max_angle:g}°): {wide}."
        )
