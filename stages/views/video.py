"""Take frames from a film: uniformly, turned upright, with their times."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt

from stages.views.decode import UnusableImage
from stages.views.orientation import orientation_from_rotation
from stages.views.sampling import uniform_indices


@dataclass(frozen=True)
class VideoFrame:
    """One frame on its stored pixel grid.

    Attributes:
        index: number of the frame in the film, from 0.
        rgb: [H, W, 3] uint8.
        orientation: EXIF orientation that turns it upright (from the display matrix).
        seconds: since the first frame.
    """

    index: int
    rgb: npt.NDArray[np.uint8]
    orientation: int
    seconds: float


def read_frames(
    path: Path,
    wanted: int,
    threads: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
    check_size: Callable[[int, int], None] = lambda width, height: None,
) -> list[VideoFrame]:
    """Read `wanted` frames, uniformly chosen from the first to the last.

    The packets are counted first, then the film is decoded once; again if the count was wrong
    (a damaged film, or one cut without re-encoding).

    Args:
        path: the film.
        wanted: number of frames; all if the film has fewer.
        threads: for decoding; does not change the frames.
        progress: called with (frames decoded, frames in all).
        check_size: as in `decode_photo`.

    Raises:
        UnusableImage: it can't be opened or has no frames.
    """
    try:
        count = _count_packets(path)
        if count == 0:
            raise UnusableImage("has no video frames in it")
        frames, found = _decode(path, uniform_indices(count, wanted), count, threads, progress,
                                check_size)  # fmt: skip
        if found != count and found > 0:
            frames, _ = _decode(path, uniform_indices(found, wanted), found, threads, progress,
                                check_size)  # fmt: skip
    except (av.error.FFmpegError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise UnusableImage(f"can't be read as a video ({reason})") from error
    if not frames:
        raise UnusableImage("has no video frames that can be decoded")
    return frames


def _count_packets(path: Path) -> int:
    with av.open(str(path)) as container:
        if not container.streams.video:
            raise UnusableImage("has no video in it, only other streams")
        packets = container.demux(container.streams.video[0])
        return sum(1 for packet in packets if packet.size and not packet.is_discard)


def _decode(
    path: Path, indices: list[int], count: int, threads: int,
    progress: Callable[[int, int], None], check_size: Callable[[int, int], None],
) -> tuple[list[VideoFrame], int]:  # fmt: skip
    """The frames at `indices`, and how many the film has."""
    chosen, frames, start, index = set(indices), [], 0.0, -1
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        stream.codec_context.thread_count = threads
        for index, frame in enumerate(container.decode(stream)):
            if index == 0:
                check_size(frame.width, frame.height)
                start = frame.time or 0.0
            if index in chosen:
                seconds = frame.time - start if frame.time is not None else index
                frames.append(
                    VideoFrame(
                        index=index,
                        rgb=np.ascontiguousarray(frame.to_ndarray(format="rgb24")),
                        orientation=orientation_from_rotation(frame.rotation),
                        seconds=round(float(seconds), 6),
                    )
                )
            if index % 10 == 0:
                progress(min(index + 1, count), count)
    return frames, index + 1
