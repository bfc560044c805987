"""The `splats` stage: Gaussians that another program fitted, in the place of those of `fit`.

Beside a finished run: ``pipeline run -w WORKSPACE --stages splats,evaluate`` with
``--set splats.file=PEER.ply`` scores them with the cameras that the run exported.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import Field

from pipeline.artifacts.space.frames import WANTED, Wanted
from pipeline.errors import RequestError
from pipeline.stage import Stage, StageConfig, StageContext, runtime
from pipeline.untrusted.paths import GivenPath, user_path

Channel = Annotated[float, Field(ge=0, le=1)]

SETTING = "splats.file"
#: Of Gaussians with fewer of their centres in the photographs, it is said that they may lie wrong.
LITTLE_IN_VIEW = 0.2
#: What may be wrong with Gaussians that no photograph shows.
_FRAME_ADVICE = (
    "Train on the cameras that this workspace exports, with the option that keeps their frame "
    "(OpenSplat: --keep-crs; gsplat: --no-normalize-world-space), or set splats.frame; for a file "
    "that was made from our own splats.ply, set splats.turned=true."
)


class SplatsConfig(StageConfig):
    """Settings of the stage `splats`."""

    file: GivenPath | None = runtime(
        None,
        description="Gaussians of another program: a .ply as 3DGS, gsplat, nerfstudio, OpenSplat "
        "and Brush write it, or PlayCanvas's compressed one. Its contents count, not its place.",
    )
    frame: Wanted = Field(
        "auto", description=f"frame that the file is in, as export.frame: {WANTED}"
    )
    turned: bool | None = Field(
        None,
        description="the file is turned by 180 degrees about z against that frame, as our own "
        "splats.ply is where the exports stand upright; null: as a comment in its header says",
    )
    background: tuple[Channel, Channel, Channel] | None = Field(
        None,
        description="colour that the other program had behind the scene, RGB in 0..1; null: as a "
        "comment in the file's header says, else black",
    )


class SplatsStage(Stage):
    """A `.ply` of Gaussians -> Gaussians in our world."""

    name: ClassVar[str] = "splats"
    version: ClassVar[int] = 4
    summary: ClassVar[str] = "take Gaussians that another program fitted (3DGS .ply)"
    Config: ClassVar[type[StageConfig]] = SplatsConfig
    requires: ClassVar[tuple[str, ...]] = ("cameras",)
    provides: ClassVar[tuple[str, ...]] = ("gaussians",)
    libraries: ClassVar[tuple[str, ...]] = ("numpy", "scipy")

    def sources(self, config: Any, request: Mapping[str, Any]) -> Mapping[str, Path]:
        if config.file is None:
            raise RequestError(
                "The stage 'splats' takes Gaussians that another program fitted, but none are "
                f"given. Pass --set {SETTING}=PATH with a 3DGS .ply."
            )
        path = user_path(config.file, SETTING)
        if not path.is_file():
            raise RequestError(f"{SETTING}: there is no file {path}. Give a 3DGS .ply.")
        return {"splats.ply": path}

    def run(self, context: StageContext) -> None:
        """Read the file, refuse what can't be rendered, and move it into our world.

        Raises:
            RequestError: no such file, no splats, none in it, or some that can't be rendered.
        """
        from pipeline.artifacts.space.frames import VIEWERS_PLY, frame_of
        from stages.splats.placing import (
            into_world,
            read_splats,
            says_turned,
            share_in_view,
            unusable,
        )

        config: SplatsConfig = context.config
        cameras = context.load("cameras")
        (path,) = context.sources.values()
        try:
            given = read_splats(path)
        except RequestError as error:
            raise RequestError(f"{SETTING}: {error}") from error
        if config.background is not None:
            given = replace(given, background=config.background)
        if not len(given):
            raise RequestError(f"{SETTING}: {path} holds no Gaussians. Give one that does.")
        wrong = int(unusable(given).sum())
        if wrong:
            raise RequestError(
                f"{SETTING}: {wrong:,} of the {len(given):,} Gaussians in {path} can't be "
                "rendered: they have numbers that are not finite, a rotation of length 0, or a "
                "size beyond measure (scales are natural logarithms). Remove them, or export again."
            )
        similarity = frame_of(cameras, config.frame).from_world
        if says_turned(path) if config.turned is None else config.turned:
            similarity = VIEWERS_PLY @ similarity
        placed = into_world(given, similarity)
        in_view = share_in_view(placed, cameras.cameras)
        if in_view == 0:
            raise RequestError(
                f"{SETTING}: none of the photographs shows any Gaussian of {path}: it is in "
                f"another frame than the exports. {_FRAME_ADVICE}"
            )
        if in_view < LITTLE_IN_VIEW:
            context.warn(
                f"Only {in_view:.0%} of the Gaussians in {path.name} lie where a photograph looks; "
                f"it may be in another frame than the exports. {_FRAME_ADVICE}"
            )
        context.save(placed)
        context.summarize(gaussians=len(placed), in_view=round(in_view, 3))
