"""Decode and prepare all files of a case, and say all that is wrong with them in one go."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np

from pipeline.artifacts.views import View
from pipeline.errors import RequestError
from pipeline.untrusted.files import FILM, PHOTOGRAPH, UnusableFile, opened, read
from stages.views.reading.apart import Decoder
from stages.views.reading.video import VideoFrame, Wanted, map_frames
from stages.views.sheets import photographs_in
from stages.views.working import (
    Box,
    Mask,
    Prepared,
    TooSmall,
    UnusableMask,
    check_size,
    prepare,
)

Progress = Callable[[int, int], None]

MASK_ADVICE = "Mend the mask, or take it out of views.masks, and run the same command."


@dataclass(frozen=True)
class Loaded:
    """A prepared picture and where it comes from.

    Attributes:
        source_name: label of the file; for a frame of a video with ``#`` and its number, for one of
            several photographs in a picture with ``#1``, ``#2``, ...
        source_sha256: of the file.
        picture: what it looks like.
        timestamp: seconds from the first frame of the video, or None.
        taken_at: by the camera's clock, seconds; or None.
        pages: pictures in the file, of which the first is taken.
    """

    source_name: str
    source_sha256: str
    picture: Prepared
    timestamp: float | None = None
    taken_at: float | None = None
    pages: int = 1


def load_photos(
    files: Mapping[str, Path], masks: Mapping[str, Path], long_side: int, min_side: int,
    cut_sheets: bool = True, threads: int = 1, progress: Progress = lambda done, total: None,
    warn: Callable[[str], None] = lambda message: None,
) -> list[Loaded]:  # fmt: skip
    """Load photographs.

    Args:
        files: label -> image file.
        masks: label of an image -> mask file.
        long_side, min_side: of the result, pixels.
        cut_sheets: cut pictures into the photographs they hold (`photographs_in`).
        threads: how many to decode at a time; memory grows with it.
        progress: called with (done, total).
        warn: called with what is not taken of a file that is used.

    Raises:
        RequestError: some can't be used; all of them are named.
    """

    def load(label: str) -> list[Loaded] | UnusableFile:
        try:
            data = read(files[label], PHOTOGRAPH)
            # a row of photographs is long and low: these are checked one by one
            check = partial(check_size, min_side=min_side)
            fits = partial(check, long_side=long_side)
            photo = decoder.photo(data, partial(check, long_side=None) if cut_sheets else fits)
            mask = _read_mask(masks[label], decoder) if label in masks else None
            whole = Box(0, 0, *photo.rgb.shape[:2])
            boxes = [whole]
            if cut_sheets:
                boxes = photographs_in(photo.rgb)
            if len(boxes) > 1:  # a banner across a sheet is left out
                boxes = [box for box in boxes if _fitting(box, fits)] or [whole]
            if len(boxes) == 1:
                fits(boxes[0].right - boxes[0].left, boxes[0].bottom - boxes[0].top)
            focal = photo.focal_px if len(boxes) == 1 else None
            pictures = [
                prepare(photo.rgb, photo.valid, photo.orientation, focal, long_side, mask, box)
                for box in boxes
            ]
        except TooSmall as error:
            return TooSmall(f"{label} {error}", error.advice)
        except UnusableFile as error:
            return type(error)(f"{label} {error}")
        digest = hashlib.sha256(data).hexdigest()
        if len(pictures) == 1:
            return [Loaded(label, digest, pictures[0], None, photo.taken_at, photo.pages)]
        return [
            Loaded(f"{label}#{k}", digest, picture, pages=photo.pages)
            for k, picture in enumerate(pictures, 1)
        ]

    loaded: list[Loaded] = []
    problems: list[UnusableFile] = []
    with Decoder() as decoder, ThreadPoolExecutor(max(1, min(threads, 4))) as pool:
        try:
            results = zip(files, pool.map(load, files), strict=True)
            for number, (label, result) in enumerate(results, 1):
                progress(number, len(files))
                if isinstance(result, UnusableFile):
                    problems.append(result)
                    continue
                loaded += result
                if result[0].pages > 1:
                    warn(
                        f"{label} holds {result[0].pages} pictures, of which the first is used. "
                        "Save the others as files of their own, if they are wanted."
                    )
        except BaseException:  # an interrupt does not wait for what is being decoded
            decoder.stop()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    if problems:
        _refuse(problems, len(files))
    return loaded


def load_video(
    label: str, path: Path, mask: Path | None, wanted: Wanted, long_side: int, min_side: int,
    cut_border: bool = True, threads: int = 1, progress: Progress = lambda done, total: None,
    warn: Callable[[str], None] = lambda message: None,
) -> list[Loaded]:  # fmt: skip
    """Load evenly chosen frames of a video; a mask serves for all of them.

    Args:
        cut_border: cut off what most frames have around them, such as the bars beside a film that
            was taken upright.
        warn: called with what is wrong with the film, if it can be used all the same.

    Raises:
        RequestError: the video or the mask can't be used.
    """

    def prepared(frame: VideoFrame) -> tuple[int, float, Prepared, list[Box]]:
        within = photographs_in(frame.rgb) if cut_border and box is None else []
        picture = prepare(frame.rgb, None, frame.orientation, None, long_side, given, box)
        return frame.index, frame.seconds, picture, within

    def frames_of(file: BinaryIO, of: Wanted) -> list[tuple[int, float, Prepared, list[Box]]]:
        return map_frames(
            file, prepared, of, threads, progress, check, lambda what: warn(f"{label} {what}")
        )

    box: Box | None = None
    try:
        check = partial(check_size, long_side=long_side, min_side=min_side)
        given = None
        if mask is not None:
            with Decoder() as decoder:
                given = _read_mask(mask, decoder)
        with opened(path, FILM) as file:
            found = frames_of(file, wanted)
            if cut_border:
                box = _common_border([entry[2] for entry in found], [entry[3] for entry in found])
            if box is not None:
                file.seek(0)
                known = tuple(entry[0] for entry in found)
                found = frames_of(file, replace(wanted, indices=known))
            file.seek(0)
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        return [
            Loaded(f"{label}#{index}", digest, picture, seconds)
            for index, seconds, picture, _ in found
        ]
    except UnusableMask as error:
        raise RequestError(f"The video {label} {error}. {MASK_ADVICE}") from error
    except TooSmall as error:
        raise RequestError(f"The video {label} {error}. {error.advice}") from error
    except UnusableFile as error:
        raise RequestError(
            f"The video {label} {error}. Check that it plays, save it again as MP4 (H.264), or "
            "export single frames and name their folder instead."
        ) from error


def _fitting(box: Box, check: Callable[[int, int], None]) -> bool:
    try:
        check(box.right - box.left, box.bottom - box.top)
    except UnusableFile:
        return False
    return True


def _common_border(pictures: Sequence[Prepared], parts: Sequence[Sequence[Box]]) -> Box | None:
    """What most frames of a film are within; None where that is all of them.

    Args:
        pictures: the frames.
        parts: of each, the photographs in it.
    """
    (width, height), *others = {picture.source_size for picture in pictures}
    if others:
        return None
    whole = Box(0, 0, height, width)
    boxes = [found[0] if len(found) == 1 else whole for found in parts]
    common = Box(*np.median(boxes, axis=0).astype(int).tolist())
    return None if common == whole else common


def drop_duplicates(
    loaded: Sequence[Loaded], warn: Callable[[str], None] = lambda message: None
) -> list[Loaded]:
    """Keep the first of pictures whose pixels are equal at working size; warn of the others."""
    first: dict[bytes, Loaded] = {}
    for item in loaded:
        rgb = item.picture.rgb
        key = hashlib.sha256(repr(rgb.shape).encode() + rgb.tobytes()).digest()
        if key in first:
            warn(
                f"{item.source_name} is the same picture as {first[key].source_name} and was left "
                "out."
            )
        else:
            first[key] = item
    return list(first.values())


def first_taken(loaded: Iterable[Loaded]) -> float | None:
    """When the first of the pictures was taken, by the camera's clock; None where none tells."""
    return min((item.taken_at for item in loaded if item.taken_at is not None), default=None)


def prepared_views(
    loaded: Sequence[Loaded], prefix: str = "", start: float | None = None
) -> tuple[View, ...]:
    """The views of an artifact, numbered in order: ``000``, ``001``, ... after the prefix.

    Args:
        loaded: what they show.
        start: when the time begins that they are given, by the camera's clock; None: with the
            first of them.
    """
    start = first_taken(loaded) if start is None else start

    def after(taken_at: float | None) -> float | None:
        return None if taken_at is None or start is None else taken_at - start

    return tuple(
        View(
            name=f"{prefix}{number:03d}",
            image=item.picture.rgb.astype(np.float32) / np.float32(255),
            mask=item.picture.mask,
            working_from_source=item.picture.working_from_source,
            source_size=item.picture.source_size,
            source_name=item.source_name,
            source_sha256=item.source_sha256,
            focal_px=item.picture.focal_px,
            timestamp=item.timestamp,
            taken_after=after(item.taken_at),
        )
        for number, item in enumerate(loaded)
    )


def shows_nothing(picture: Prepared) -> bool:
    """Is it (nearly) one colour: a lens cap, a flash that failed, a blank?"""
    gray = picture.rgb.mean(-1)
    if picture.mask is not None:
        gray = gray[picture.mask]
    low, high = np.percentile(gray, [1, 99])
    return bool(high - low < 12)


def _read_mask(path: Path, decoder: Decoder) -> Mask:
    try:
        return decoder.mask(read(path, PHOTOGRAPH))
    except UnusableFile as error:
        raise UnusableMask(f"has a mask ({path.name}) that {error}") from error


def _refuse(problems: Sequence[UnusableFile], total: int) -> None:
    shown = "; ".join(map(str, problems[:8])) + ("; ..." if len(problems) > 8 else "")
    what, them = "A photograph", "it"
    if len(problems) > 1:
        what, them = f"{len(problems)} of {total} photographs", "them"
    advice = f"Copy {them} again from the camera, or remove {them}, and run the same command."
    if all(isinstance(problem, UnusableMask) for problem in problems):
        advice = MASK_ADVICE
    if small := [problem for problem in problems if isinstance(problem, TooSmall)]:
        advice = f"{small[0].advice} {advice}"
    raise RequestError(f"{what} can't be used: {shown}. {advice}")
