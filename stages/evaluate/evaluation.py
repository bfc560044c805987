"""The evaluation as a whole: artifacts in, `metrics.json` and pictures out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera, Cameras
from pipeline.artifacts.gaussians import Gaussians
from pipeline.artifacts.metrics import Metrics
from pipeline.artifacts.views import HeldOut, View, Views
from pipeline.errors import RequestError
from pipeline.geometry.pose_metrics import pose_figures
from pipeline.geometry.world import scene_depth
from pipeline.kernels.threads import in_threads
from pipeline.stage import StageContext
from stages.evaluate.config import EvaluateConfig
from stages.evaluate.held_out import (
    ALIGNMENT,
    Registration,
    common_lens,
    register,
    without_lens,
)
from stages.evaluate.images import pictures
from stages.evaluate.images.perceptual import Lpips
from stages.evaluate.images.score import Figures, summary_of
from stages.evaluate.refinement import refine_camera
from stages.evaluate.scene import Examiner, Rendered
from stages.evaluate.support import LEGEND, beyond
from stages.evaluate.truth import Truth, read_truth, scoring_mask
from stages.splatting.support import SeenSurface

#: The input views trained the scene, so that their figures say nothing about unseen views. They
#: are of final renders at 8 bits; the PSNR that the fit reports on its way is a running mean over
#: single views before rounding, through the fit's own loss, and only tells how far it has come.
PROTOCOL = "input views (training views), 8-bit images, registered cameras"
#: Held-out photographs of which by so much more counts than of the input ones are worth a word.
UNLIKE = 0.1
#: The two ways of placing held-out photographs, which no table may mix.
TEST_PROTOCOLS = {
    "registered": "held-out photographs, 8-bit images; cameras registered only: the true ones, "
    "moved by the similarity of the input views' cameras; true focal length times the median ratio "
    "of reconstructed to true over the input views",
    "refined": "held-out photographs, 8-bit images; cameras registered as above, then refined "
    "photometrically with the scene as it is (mean absolute error where something is rendered, "
    "best pose kept)",
}


def labelled(sources: Mapping[str, Path], folder: str) -> dict[str, Path]:
    """The sources whose label begins with a folder, without it."""
    return {
        str(PurePath(label).relative_to(folder)): path
        for label, path in sources.items()
        if PurePath(label).parts[0] == folder
    }


def evaluate(context: StageContext, painter: Callable[..., Callable[[Camera], Rendered]]) -> None:
    """Score every placed view, and held-out photographs, poses and geometry where truth is given.

    Args:
        context: of the stage.
        painter: (gaussians, background, threads) -> what draws the scene as a camera sees it.

    Raises:
        RequestError: no camera belongs to any of the views; the truth can't be used.
    """
    config: EvaluateConfig = context.config
    views: Views = context.load("views")
    gaussians: Gaussians = context.load("gaussians")
    held: tuple[View, ...] = ()
    if context.has("held_out"):
        kept_back: HeldOut = context.load("held_out")
        held = kept_back.views
    cameras = _placed_cameras(views, context.load("cameras"))
    background = config.background or gaussians.background
    draw = painter(gaussians, background=background, threads=context.threads)
    masks = labelled(context.sources, "masks")
    files = labelled(context.sources, "ground_truth")
    truth = read_truth(files.values(), views.views, held) if files else None
    held = _straightened(context, views, cameras, held) if truth is not None else held
    regions = {view.name: scoring_mask(masks, view) for view in (*views.views, *held)}
    _check_masks(context, masks, [*views.views, *held], regions)
    weights = next(iter(labelled(context.sources, "lpips").values()), None)
    examiner = Examiner(
        draw, config, context.output("metrics"),
        {name: region for name, region in regions.items() if region is not None},
        Lpips.from_file(weights) if weights is not None else None,
    )  # fmt: skip
    figures, surfaces = _input_views(context, examiner, views, cameras)
    figures["background"] = list(background)
    depth = scene_depth(gaussians.means, cameras.values()) or 1.0
    if truth is not None:
        placed = {name: cameras[name] for name in cameras if name in truth.cameras}
        try:
            registration = register(placed, truth.cameras, depth)
        except RequestError as error:
            context.warn(f"{error} Held-out photographs, poses and geometry are not scored.")
        else:
            figures["poses"] = _poses(placed, truth, registration, views)
            geometry = _geometry(context, examiner, truth, registration, surfaces)
            if geometry is not None:
                figures["geometry"] = geometry
            if held:
                figures["held_out"] = _held_out(
                    context, examiner, held, truth, registration, depth, surfaces
                )
                _warn_of_masks(context, figures)
    elif held:
        context.warn(
            f"Photographs held out are not scored ({len(held)}): their cameras are not known. Give "
            "--set evaluate.ground_truth=PATH with a transforms.json or COLMAP model."
        )
    if config.novel_angle > 0:
        middle = np.median(gaussians.means.astype(np.float64), axis=0)
        outside = beyond(list(cameras.values()), middle, config.novel_angle)
        told = in_threads(lambda c: examiner.novel(c, surfaces), outside, context.threads)
        novel = {camera.name: those for camera, those in zip(outside, told, strict=True)}
        if novel:
            figures["novel"] = {"degrees_beyond": config.novel_angle, "views": novel}
            figures["support_legend"] = LEGEND
    context.save(Metrics({**figures, "gaussians": len(gaussians)}))
    _summarize(context, figures, len(views))


def _placed_cameras(views: Views, placed: Cameras) -> dict[str, Camera]:
    """The cameras of the views at their image size, in the order of the views."""
    cameras = placed.by_name()
    found = {
        view.name: cameras[view.name].resized(view.width, view.height)
        for view in views.views
        if view.name in cameras
    }
    if not found:
        names = ", ".join(view.name for view in views.views)
        raise RequestError(
            "None of the cameras belongs to one of the views, so there is nothing to compare: the "
            f"views are {names}, the cameras {', '.join(sorted(cameras)) or 'none'}. "
            "Cameras from outside must carry the names of the views."
        )
    return found


def _check_masks(
    context: StageContext, masks: Mapping[str, Path], views: list[View],
    regions: Mapping[str, npt.NDArray[np.bool_] | None],
) -> None:  # fmt: skip
    """Say which masks for scoring mark nothing; their figures would be missing without a word."""
    given = {view.source_name or view.name: regions[view.name] for view in views}
    if masks and all(region is None for region in given.values()):
        raise RequestError(
            f"evaluate.masks: none of the masks there is named as a photograph: they have names "
            f"like {min(masks)}, the photographs like {min(given)}. A mask bears the name of its "
            "photograph, such as 003.png for 003.jpg."
        )
    empty = [name for name, region in given.items() if region is not None and not region.any()]
    if empty:
        context.warn(
            f"evaluate.masks: no pixel of the masks of {', '.join(empty)} is 255, so that nothing "
            "is scored inside them."
        )


def _straightened(
    context: StageContext, views: Views, cameras: Mapping[str, Camera], held: tuple[View, ...]
) -> tuple[View, ...]:
    """The held-out photographs as the lens of the reconstruction shows them."""
    lens = common_lens([view for view in views.views if view.name in cameras])
    if lens is None and held:
        context.warn(
            "The views were undistorted each with a lens of its own, so that it is not known how "
            "to undistort the held-out photographs: they are not scored."
        )
        return ()
    return tuple(without_lens(view, lens) for view in held) if lens else held


def _input_views(
    context: StageContext, examiner: Examiner, views: Views, cameras: Mapping[str, Camera]
) -> tuple[dict[str, Any], list[SeenSurface]]:
    """Figures of the views that made the scene, and what they show of it."""
    config: EvaluateConfig = context.config
    placed = [view for view in views.views if view.name in cameras]
    pictured = {placed[k].name for k in pictures.spread(len(placed), config.max_comparisons)}
    without_pixels = [view.name for view in placed if not view.valid().any()]
    shown = [view for view in placed if view.name not in without_pixels]
    if not shown:
        raise RequestError(
            "The masks leave no pixel of any placed view, so there is nothing to compare. Check "
            "that white means 'use this pixel' in your masks."
        )
    found = in_threads(
        lambda view: examiner.examine(
            view, cameras[view.name], pictured=view.name in pictured
        ),
        shown, context.threads, lambda done: context.progress("render", done, len(shown)),
    )  # fmt: skip
    figures = {view.name: scored for view, (scored, _) in zip(shown, found, strict=True)}
    surfaces = [surface for _, surface in found]
    if without_pixels:
        context.warn(f"Not scored, because their masks are empty: {', '.join(without_pixels)}.")
    summary = summary_of(figures)
    return {
        "protocol": PROTOCOL,
        "views": figures,
        **summary,
        "coverage": summary["mean"]["coverage"],
        "views_unplaced": [view.name for view in views.views if view.name not in cameras],
        "views_without_pixels": without_pixels,
    }, surfaces


def _held_out(
    context: StageContext, examiner: Examiner, held: tuple[View, ...], truth: Truth,
    registration: Registration, depth: float, surfaces: list[SeenSurface],
) -> dict[str, Any]:  # fmt: skip
    """Figures of photographs that the reconstruction never saw, by protocol.

    Also `pictures`, the protocol that the pictures are of, and `sources`, the photographs' names.
    """
    config: EvaluateConfig = context.config
    scored = [view for view in held if view.name in truth.cameras and view.valid().any()]
    if len(scored) < len(held):
        left = [v.source_name or v.name for v in held if v.name not in {s.name for s in scored}]
        context.warn(f"Held-out photographs without a true camera or pixels: {', '.join(left)}.")
    asked = tuple(TEST_PROTOCOLS) if config.test_poses == "both" else (config.test_poses,)
    pictured = set(pictures.spread(len(scored), config.max_comparisons))

    def examine(index: int) -> list[Figures]:
        view, found = scored[index], []
        camera = registration.registered(truth.cameras[view.name])
        for protocol in asked:
            if protocol == "refined":
                camera = refine_camera(
                    examiner.render, view.image, view.valid(), camera, depth
                ).camera
            last = protocol == asked[-1]
            found.append(
                examiner.examine(
                    view, camera, "heldout_", index in pictured and last, last, surfaces
                )[0]
            )
        return found

    examined = in_threads(
        examine, range(len(scored)), context.threads,
        lambda done: context.progress("held-out views", done, len(scored)),
    )  # fmt: skip
    figures = {
        protocol: {view.name: found[number] for view, found in zip(scored, examined, strict=True)}
        for number, protocol in enumerate(asked)
    }
    blocks: dict[str, Any] = {
        protocol: {"protocol": TEST_PROTOCOLS[protocol], "views": those, **summary_of(those)}
        for protocol, those in figures.items()
        if those
    }
    sources = {view.name: view.source_name for view in scored}
    return {**blocks, "pictures": asked[-1], "sources": sources}


def _warn_of_masks(context: StageContext, figures: dict[str, Any]) -> None:
    """Say where held-out photographs count in parts that the scene was never made from."""
    held = figures["held_out"]
    scored = next((held[name] for name in TEST_PROTOCOLS if name in held), None)
    if scored is None:
        return
    used, counted = (
        float(np.mean([view["pixels"] for view in block["views"].values()]))
        for block in (figures, scored)
    )
    if counted - used > UNLIKE:
        context.warn(
            f"The scene is made from {used:.0%} of the input photographs' pixels (the rest is "
            f"masked), but of held-out ones {counted:.0%} count: what it was never to show counts "
            "as wrong. Figures of a part of them are had by evaluate.masks; whole photographs of "
            "teeth are used with init.dental.mask_rest=false."
        )


def _poses(
    placed: Mapping[str, Camera], truth: Truth, registration: Registration, views: Views
) -> dict[str, Any]:
    """Figures of the input views' cameras."""
    names = registration.names
    ratios = [
        0.5 * (placed[name].fx / truth.cameras[name].fx + placed[name].fy / truth.cameras[name].fy)
        for name in names
    ]
    block = pose_figures(
        np.array([registration.pose_in_truth(placed[name].cam_from_world) for name in names]),
        np.array([truth.cameras[name].cam_from_world for name in names]),
        np.array(ratios),
        sum(view.name in truth.cameras for view in views.views),
        "mm" if truth.units == "mm" else "units of the ground truth",
    )
    return {**block, "alignment": ALIGNMENT}


def _geometry(
    context: StageContext, examiner: Examiner, truth: Truth, registration: Registration,
    surfaces: list[SeenSurface],
) -> dict[str, Any] | None:  # fmt: skip
    """Figures against the mesh, where there is one."""
    files = labelled(context.sources, "mesh")
    if not files:
        return None
    from pipeline.geometry.mesh import Mesh
    from stages.evaluate.geometry import geometry_figures

    config: EvaluateConfig = context.config
    context.progress("geometry", 0, 1)
    cloud = context.load("points").positions if context.has("points") else None
    block = geometry_figures(
        Mesh.read(next(iter(files.values())), "evaluate.mesh"), surfaces, truth.cameras,
        registration, examiner.regions, cloud, config.align, config.geometry_distances,
        truth.units,
    )  # fmt: skip
    context.progress("geometry", 1, 1)
    if block is None:
        context.warn(
            "No input view has the mesh in it (evaluate.mesh): the geometry is not scored. Is the "
            "mesh in the world of evaluate.ground_truth?"
        )
    return block


def _summarize(context: StageContext, figures: dict[str, Any], views: int) -> None:
    mean = figures["mean"]
    context.summarize(
        psnr=round(mean["psnr"], 2),
        ssim=round(mean["ssim"], 4),
        coverage=round(mean["coverage"], 4),
        views=f"{len(figures['views'])}/{views}",
    )
    for protocol in TEST_PROTOCOLS:
        block = figures.get("held_out", {}).get(protocol)
        if block:
            context.summarize(
                **{
                    f"held_out_{protocol}_psnr": round(block["mean"]["psnr"], 2),
                    f"held_out_{protocol}_ssim": round(block["mean"]["ssim"], 4),
                }
            )
    if "poses" in figures:
        context.summarize(rotation_error_deg=round(figures["poses"]["rotation_deg"]["median"], 3))
    if "geometry" in figures:
        context.summarize(
            chamfer=round(figures["geometry"]["chamfer"], 4), unit=figures["geometry"]["unit"]
        )
