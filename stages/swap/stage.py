"""The `swap` stage: a model's cameras in place of those that earlier stages found.

It may stand after any stage that gives cameras: ``--stages views,init,align,swap,sap,flow,fit``
with ``--set swap.cameras=MODEL``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import Field

from pipeline.errors import RequestError
from pipeline.stage import Stage, StageConfig, StageContext, runtime
from pipeline.untrusted.paths import GivenPath

if TYPE_CHECKING:
    from pipeline.artifacts.cameras import Camera

SETTING = "swap.cameras"
#: Distortion of the photographs, in pixels, that is worth a word.
_BENT = 0.5
#: Two reconstructions of the same photographs are seldom further apart than this in the median:
#: degrees, and shares of the largest distance between two cameras.
_TURNED, _AWAY = 10.0, 0.3


class SwapConfig(StageConfig):
    """Settings of the stage `swap`."""

    cameras: GivenPath | None = runtime(
        None,
        description="cameras to use from here on: folder of a COLMAP model, or a transforms.json",
    )
    lenses: bool = Field(
        True, description="take the model's focal lengths and principal points too, not only poses"
    )


class SwapStage(Stage):
    """cameras of earlier stages -> those of a model, in the same world."""

    name: ClassVar[str] = "swap"
    version: ClassVar[int] = 4
    summary: ClassVar[str] = "put a COLMAP model's cameras in place of those of the earlier stages"
    Config: ClassVar[type[StageConfig]] = SwapConfig
    requires: ClassVar[tuple[str, ...]] = ("views", "cameras")
    provides: ClassVar[tuple[str, ...]] = ("cameras",)
    libraries: ClassVar[tuple[str, ...]] = ("pycolmap", "numpy")

    def sources(self, config: Any, request: Mapping[str, Any]) -> Mapping[str, Path]:
        from pipeline.geometry.models.known_cameras import model_files

        if config.cameras is None:
            raise RequestError(
                "The stage 'swap' puts given cameras in place of those found, but none are given. "
                "Pass --set swap.cameras=PATH with the folder of a COLMAP model or a "
                "transforms.json."
            )
        return model_files(Path(config.cameras), SETTING)

    def run(self, context: StageContext) -> None:
        """Bring the model's cameras into the world of the present ones, so that points stay valid.

        Raises:
            RequestError: fewer than two views have both.
        """
        from dataclasses import replace

        from pipeline.geometry.models.known_cameras import (
            bending,
            matching_cameras,
            pinhole_camera,
            read_cameras,
        )
        from pipeline.geometry.world import move_camera, similarity_between

        config: SwapConfig = context.config
        views, present = context.load("views"), context.load("cameras")
        known = matching_cameras(
            read_cameras(context.sources.values(), SETTING)[0], views.views, SETTING
        )
        given = {
            view.name: pinhole_camera(view, known[view.name], SETTING)
            for view in views.views
            if view.name in known
        }
        now = present.by_name()
        both = [name for name in given if name in now]
        if len(both) < 2:
            raise RequestError(
                f"swap.cameras: only {len(both)} of the photographs have a camera both in the "
                "model and from the earlier stages; it takes two to bring one to the other."
            )
        motion = similarity_between([given[name] for name in both], [now[name] for name in both])
        moved = {name: move_camera(camera, motion) for name, camera in given.items()}
        turned, away = _apart([moved[name] for name in both], [now[name] for name in both])
        if turned > _TURNED or away > _AWAY:
            context.warn(
                f"The model's cameras are {turned:.0f}° and {100 * away:.0f} % of their distances "
                "from those of the earlier stages (median), and are used all the same. Are they "
                "the cameras of these photographs, with the axes of their format (a "
                "transforms.json has camera-to-world matrices, y up and z back)?"
            )
        if not config.lenses:
            moved = {
                name: replace(now[name], cam_from_world=moved[name].cam_from_world) for name in both
            }
        bent = [
            bending(v, known[v.name], SETTING)
            for v in views.views
            if v.name in known and not v.lens_taken_out
        ]
        if max(bent, default=0.0) > _BENT:
            context.warn(
                f"The model's lenses distort the photographs by up to {max(bent):.1f} pixels, and "
                "this stage leaves the photographs as they are: what they show lies that far off. "
                "Give the model of undistorted photographs, or start from these cameras with "
                "init.cameras, which takes the distortion out."
            )
        dropped = [
            view.source_name or view.name
            for view in views.views
            if view.name in now and view.name not in moved
        ]
        if dropped:
            context.warn(f"The model has no camera of {', '.join(dropped)}; left out.")
        context.save(
            replace(
                present,
                cameras=tuple(moved[view.name] for view in views.views if view.name in moved),
                provisional=False,
            )
        )
        context.summarize(views_registered=len(moved), views_total=len(views))


def _apart(cameras: Sequence[Camera], others: Sequence[Camera]) -> tuple[float, float]:
    """How far aligned cameras are from others of the same views: degrees, and share of the largest
    distance between two of the others; medians."""
    import numpy as np

    from pipeline.geometry.pose_metrics import centres_of, position_errors, rotation_errors

    found, wanted = (np.stack([c.cam_from_world for c in some]) for some in (cameras, others))
    centres = centres_of(wanted)
    largest = float(np.linalg.norm(centres[:, None] - centres[None], axis=-1).max())
    away = position_errors(found, wanted) / max(largest, 1e-12)
    return float(np.median(rotation_errors(found, wanted))), float(np.median(away))
