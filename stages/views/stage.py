"""The stage `views`: photographs or a video in, prepared views out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path, PurePath
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from pipeline.errors import RequestError
from pipeline.stage import Parts, Stage, StageConfig, StageContext, runtime
from pipeline.untrusted.names import printable
from pipeline.untrusted.paths import POSSIBLE
from stages.views.find import MASK_PREFIX, find_images, find_masks, held_labels, is_video
from stages.views.sampling import is_sequence, uniform_indices

FRAMES_OF_A_VIDEO = 24  # as the paper samples (section 4.1)


class ViewsConfig(StageConfig):
    """How photographs are prepared."""

    long_side: Literal["auto"] | Annotated[int, Field(ge=64, le=4096)] = Field(
        "auto",
        description="working size: pixels of the long side; smaller photographs stay as they are "
        "(auto: 1024, 724 or 512, as their sharpness and their number allow)",
    )
    frames: int | None = Field(
        None, ge=2, le=1000,
        description="use this many, spread over all; default: all photographs, 24 of a video",
    )  # fmt: skip
    sampling: Literal["difference", "time"] = Field(
        "difference",
        description="frames of a video are spread evenly by how much they differ, or in time",
    )
    min_side: int = Field(
        64, ge=16, le=4096,
        description="refuse photographs whose short side is less than this at working size",
    )  # fmt: skip
    masks: Annotated[Path, POSSIBLE] | None = runtime(
        None,
        description="folder of masks named as the photographs, bright where these may be used "
        "(their contents count, not their place)",
    )
    held_out: tuple[str, ...] = Field(
        (),
        description="photographs to test with: file names or stems among those given (of a video: "
        "film.mp4#12, any frame); no stage but evaluate sees them",
    )
    deduplicate: bool = Field(True, description="leave out photographs that are there twice")
    cut_sheets: bool = Field(
        True,
        description="cut a picture that holds several photographs side by side into these, and a "
        "border off",
    )


class ViewsStage(Stage):
    """Decode, turn upright, resize, and note how each view relates to its file."""

    name: ClassVar[str] = "views"
    version: ClassVar[int] = 13
    summary: ClassVar[str] = "read photographs or a video and bring them to one working size"
    Config: ClassVar[type[StageConfig]] = ViewsConfig
    provides: ClassVar[tuple[str, ...]] = ("views",)
    may_provide: ClassVar[tuple[str, ...]] = ("held_out",)
    libraries: ClassVar[tuple[str, ...]] = (
        "av", "opencv-contrib-python-headless", "pillow", "pillow-heif", "pydicom",
    )  # fmt: skip
    uses_sources: ClassVar[bool] = True
    thrift: ClassVar[str] = (
        "Use fewer photographs (--frames) or a smaller working size (--set views.long_side=384)."
    )

    def sources(self, config: ViewsConfig, request: Mapping[str, Any]) -> Mapping[str, Path]:
        files = find_images(request["images"], request.get("tell", lambda message: None))
        masks = find_masks(config.masks, files) if config.masks is not None else {}
        # frames of a film and photographs of a sheet are known when these are read
        of_files = [name for name in config.held_out if name.rpartition("#")[0] not in files]
        held = () if is_video(PurePath(next(iter(files)))) else held_labels(files, of_files)
        inputs = [label for label in files if label not in held]
        kept = {inputs[i] for i in uniform_indices(len(inputs), config.frames)} | set(held)
        chosen = [label for label in files if label in kept]
        given = [masks[label] for label in chosen if label in masks]
        named = {f"{MASK_PREFIX}{printable(mask.name)}": mask for mask in given}
        return {label: files[label] for label in chosen} | named

    def report(self) -> Parts:
        from stages.views.report import PARTS

        return PARTS

    def run(self, context: StageContext) -> None:
        from pipeline.artifacts.views import HeldOut, Views
        from stages.views.load import (
            Loaded,
            drop_duplicates,
            first_taken,
            load_photos,
            load_video,
            prepared_views,
            shows_nothing,
        )
        from stages.views.reading.video import Wanted
        from stages.views.sharpness import best_size, largest_size

        config: ViewsConfig = context.config
        files = {k: v for k, v in context.sources.items() if not k.startswith(MASK_PREFIX)}
        masks = _masks_by_label(context.sources, files)

        def progress(done: int, total: int) -> None:
            context.progress("reading", done, total)

        first = next(iter(files))
        from_video = is_video(PurePath(first))
        wanted = (config.frames or FRAMES_OF_A_VIDEO) if from_video else len(files)
        frames = Wanted(wanted, config.sampling == "difference", _frame_numbers(first, config))
        said: dict[str, None] = {}  # each once, however often the files are read

        def load(long_side: int) -> list[Loaded]:
            size = {"long_side": long_side, "min_side": config.min_side}
            if from_video:
                return load_video(
                    first, files[first], masks.get(first), frames, cut_border=config.cut_sheets,
                    threads=context.threads, progress=progress, warn=said.setdefault, **size,
                )  # fmt: skip
            return load_photos(
                files, masks, cut_sheets=config.cut_sheets,
                threads=context.threads, progress=progress, warn=said.setdefault, **size,
            )  # fmt: skip

        if config.long_side == "auto":
            size = largest_size(wanted)
            everything = load(size)
            if len(everything) < wanted and largest_size(len(everything)) > size:  # a short film
                everything = load(largest_size(len(everything)))
            best = best_size([item.picture for item in everything])
            if any(max(item.picture.rgb.shape) > best for item in everything):
                everything = load(best)
        else:
            everything = load(config.long_side)
        for message in said:
            context.warn(message)
        _tell_of_sheets(files, [item.source_name for item in everything], context.warn)
        held_names = held_labels([item.source_name for item in everything], config.held_out)
        loaded = [item for item in everything if item.source_name not in held_names]
        # the views come first: what is held out never decides which of them stays
        distinct, held = loaded, [item for item in everything if item.source_name in held_names]
        if config.deduplicate:
            unlike = drop_duplicates([*loaded, *held], context.warn)
            distinct = [item for item in unlike if item.source_name not in held_names]
            held = [item for item in unlike if item.source_name in held_names]
        if len(distinct) < 2:
            what = "one frame only" if from_video else "the same picture"
            named = first if from_video else " and ".join(item.source_name for item in loaded[:3])
            if len(loaded) < 2 and held_names:
                what, named = "too much is held out", "views.held_out"
            elif len(files) == 1 and not from_video:
                what, named = "one photograph only", first
            raise RequestError(
                f"{named}: {what}, and a 3D scene needs at least two different photographs, better "
                "three or more, taken from different sides. Add some and run again."
            )
        if config.frames is not None and len(everything if from_video else loaded) < config.frames:
            context.warn(
                f"{config.frames} views were asked for, but there are only {len(distinct)}: all of "
                "them are used."
            )
        for item in (*distinct, *held):
            if shows_nothing(item.picture):
                context.warn(f"{item.source_name} shows almost nothing (a blank or black picture).")
        views = prepared_views(distinct)
        names = [item.source_name for item in distinct]
        ordered = from_video or (set(names) <= set(files) and is_sequence(names))
        context.save(Views(views, ordered=ordered))
        if held:
            kept_back = prepared_views(held, "h", first_taken(distinct))
            context.save(HeldOut(kept_back, ordered=ordered))
            context.summarize(held_out=len(held))
        context.summarize(
            views=len(views),
            width=max(view.width for view in views),
            height=max(view.height for view in views),
        )


def _frame_numbers(film: str, config: ViewsConfig) -> frozenset[int]:
    """Numbers of the frames of a film that are held out."""
    named = (name.rpartition("#") for name in config.held_out)
    numbers = [number for label, _, number in named if label == film and number.isdecimal()]
    return frozenset(map(int, numbers))


def _tell_of_sheets(
    files: Iterable[str], names: Sequence[str], warn: Callable[[str], None]
) -> None:
    """Say which pictures were cut into several photographs."""
    for label in files:
        count = sum(name.startswith(f"{label}#") for name in names)
        if count > 1 and not is_video(PurePath(label)):
            warn(
                f"{label} holds {count} photographs side by side and was cut into {label}#1 to "
                f"#{count}. If it is one photograph, set views.cut_sheets=false."
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
