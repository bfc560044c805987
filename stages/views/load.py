"""Decode and prepare all files of a case, and say all that is wrong with them in one go."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from pipeline.artifacts.views import View
from pipeline.errors import RequestError
from stages.views.decode import UnusableImage, decode_mask, decode_photo, large_images_allowed
from stages.views.video import read_frames
from stages.views.working import Mask, Prepared, check_size, prepare

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Loaded:
    """A prepared picture and where it comes from.

    Attributes:
        source_name: label of the file; for a frame of a video with ``#`` and its number.
        source_sha256: of the file.
        picture: what it looks like.
        timestamp: seconds from the first frame of the video, or None.
    """

    source_name: str
    source_sha256: str
    picture: Prepared
    timestamp: float | None = None


def load_photos(
    files: Mapping[str, Path], masks: Mapping[str, Path], long_side: int, min_side: int,
    threads: int = 1, progress: Progress = lambda done, total: None,
) -> list[Loaded]:  # fmt: skip
    """Load photographs.

    Args:
        files: label -> image file.
        masks: label of an image -> mask file.
        long_side, min_side: of the result, pixels.
        threads: how many to decode at a time; memory grows with it.
        progress: called with (done, total).

    Raises:
        RequestError: some can't be used; all of them are named.
    """

    def load(label: str) -> Loaded | str:
        try:
            data = _read(files[label])
            photo = decode_photo(data, partial(check_size, long_side=long_side, min_side=min_side))
            mask = _read_mask(masks[label]) if label in masks else None
            picture = prepare(
                photo.rgb, photo.valid, photo.orientation, photo.focal_px, long_side, mask
            )
        except UnusableImage as error:
            return f"{label} {error}"
        return Loaded(label, hashlib.sha256(data).hexdigest(), picture)

    loaded, problems = [], []
    with large_images_allowed(), ThreadPoolExecutor(max(1, min(threads, 4))) as pool:
        for number, result in enumerate(pool.map(load, files), 1):
            progress(number, len(files))
            if isinstance(result, Loaded):
                loaded.append(result)
            else:
                problems.append(result)
    if problems:
        _refuse(problems, len(files))
    return loaded


def load_video(
    label: str, path: Path, mask: Path | None, frames: int, long_side: int, min_side: int,
    threads: int = 1, progress: Progress = lambda done, total: None,
) -> list[Loaded]:  # fmt: skip
    """Load uniformly chosen frames of a video; a mask serves for all of them.

    Raises:
        RequestError: the video or the mask can't be used.
    """
    try:
        check = partial(check_size, long_side=long_side, min_side=min_side)
        found = read_frames(path, frames, threads, progress, check)
        given = _read_mask(mask) if mask else None
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        return [
            Loaded(
                f"{label}#{frame.index}", digest,
                prepare(frame.rgb, None, frame.orientation, None, long_side, given),
                frame.seconds,
            )
            for frame in found
        ]  # fmt: skip
    except UnusableImage as error:
        raise RequestError(
            f"The video {label} {error}. Check that it plays, save it again as MP4 (H.264), or "
            "export single frames and name their folder instead."
        ) from error


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


def prepared_views(loaded: Sequence[Loaded], prefix: str = "") -> tuple[View, ...]:
    """The views of an artifact, numbered in order: ``000``, ``001``, ... after the prefix."""
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


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise UnusableImage(f"can't be read ({error.strerror or error})") from error


def _read_mask(path: Path) -> Mask:
    try:
        return decode_mask(_read(path))
    except UnusableImage as error:
        raise UnusableImage(f"has a mask ({path.name}) that {error}") from error


def _refuse(problems: Sequence[str], total: int) -> None:
    if len(problems) == 1:
        raise RequestError(
            f"A photograph can't be used: {problems[0]}. Copy it again from the camera, or remove "
            "it, and run the same command."
        )
    shown = "; ".join(problems[:8]) + ("; ..." if len(problems) > 8 else "")
    raise RequestError(
        f"{len(problems)} of {total} photographs can't be used: {shown}. Copy them again from the "
        "camera, or remove them, and run the same command."
    )
