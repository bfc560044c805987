"""The stage `views`: photographs or a video in, prepared views out."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePath
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from pipeline.errors import RequestError
from pipeline.stage import Stage, StageConfig, StageContext, runtime
from stages.views.find import MASK_PREFIX, find_images, find_masks, is_video
from stages.views.sampling import is_sequence, uniform_indices

FRAMES_OF_A_VIDEO = 24  # as the paper samples (section 4.1)


class ViewsConfig(StageConfig):
    """How photographs are prepared."""

    long_side: int = Field(
        512, ge=64, le=4096,
        description="working size: pixels of the long side; smaller photographs stay as they are",
    )  # fmt: skip
    frames: int | None = Field(
        None, ge=2, le=1000,
        description="use this many, uniformly sampled; default: all photographs, 24 of a video",
    )  # fmt: skip
    min_side: int = Field(
        64, ge=16, le=4096,
        description="refuse photographs whose short side is less than this at working size",
    )  # fmt: skip
    masks: Path | None = runtime(
        None,
        description="folder of masks named as the photographs, bright where these may be used "
        "(their contents count, not their place)",
    )
    deduplicate: bool = Field(True, description="leave out photographs that are there twice")


class ViewsStage(Stage):
    """Decode, turn upright, resize, and note how each view relates to its file."""

    name: ClassVar[str] = "views"
    version: ClassVar[int] = 1
    summary: ClassVar[str] = "read photographs or a video and bring them to one working size"
    Config: ClassVar[type[StageConfig]] = ViewsConfig
    provides: ClassVar[tuple[str, ...]] = ("views",)
    libraries: ClassVar[tuple[str, ...]] = (
        "av", "opencv-contrib-python-headless", "pillow", "pillow-heif",
    )  # fmt: skip
    uses_sources: ClassVar[bool] = True

    def sources(self, config: ViewsConfig, request: Mapping[str, Any]) -> Mapping[str, Path]:
        files = find_images(request["images"])
        masks = find_masks(config.masks, files) if config.masks is not None else {}
        labels = list(files)
        chosen = [labels[i] for i in uniform_indices(len(labels), config.frames)]
        named = {
            f"{MASK_PREFIX}{masks[label].name}": masks[label] for label in chosen if label in masks
        }
        return {label: files[label] for label in chosen} | named

    def run(self, context: StageContext) -> None:
        from pipeline.artifacts.views import View, Views
        from stages.views.load import drop_duplicates, load_photos, load_video, shows_nothing

        config: ViewsConfig = context.config
        files = {k: v for k, v in context.sources.items() if not k.startswith(MASK_PREFIX)}
        masks = _masks_by_label(context.sources, files)
        size = {"long_side": config.long_side, "min_side": config.min_side}

        def progress(done: int, total: int) -> None:
            context.progress("reading", done, total)

        first = next(iter(files))
        from_video = is_video(PurePath(first))
        if from_video:
            loaded = load_video(
                first, files[first], masks.get(first), config.frames or FRAMES_OF_A_VIDEO,
                threads=context.threads, progress=progress, **size,
            )  # fmt: skip
        else:
            loaded = load_photos(files, masks, threads=context.threads, progress=progress, **size)
        distinct = drop_duplicates(loaded, context.warn) if config.deduplicate else loaded
        if len(distinct) < 2:
            what = "one frame only" if from_video else "the same picture"
            named = first if from_video else " and ".join(item.source_name for item in loaded[:3])
            raise RequestError(
                f"{named}: {what}, and a 3D scene needs at least two different photographs, better "
                "three or more, taken from different sides. Add some and run again."
            )
        if config.frames is not None and len(loaded) < config.frames:
            context.warn(
                f"{config.frames} views were asked for, but there are only {len(loaded)}: all of "
                "them are used."
            )
        for item in distinct:
            if shows_nothing(item.picture):
                context.warn(f"{item.source_name} shows almost nothing (a blank or black picture).")
        views = tuple(
            View(
                name=f"{number:03d}",
                image=item.picture.rgb.astype(np.float32) / np.float32(255),
                mask=item.picture.mask,
                working_from_source=item.picture.working_from_source,
                source_size=item.picture.source_size,
                source_name=item.source_name,
                source_sha256=item.source_sha256,
                focal_px=item.picture.focal_px,
                timestamp=item.timestamp,
            )
            for number, item in enumerate(distinct)
        )
        ordered = from_video or is_sequence([item.source_name for item in distinct])
        context.save(Views(views, ordered=ordered))
        context.summarize(
            views=len(views),
            width=max(view.width for view in views),
            height=max(view.height for view in views),
        )


def _masks_by_label(sources: Mapping[str, Path], files: Mapping[str, Path]) -> dict[str, Path]:
    """Label of an image -> its mask, by the rule of `find_masks`."""
    masks = {}
    for label, path in sources.items():
        if label.startswith(MASK_PREFIX):
            stem = PurePath(label).stem
            fitting = [name for name in files if PurePath(name).name == stem]
            fitting = fitting or [name for name in files if PurePath(name).stem == stem]
            masks[fitting[0]] = path
    return masks
