"""What decodes a film, in a process of its own (`pipeline.untrusted.child`)."""

from __future__ import annotations

import importlib
import os
import pkgutil
from collections.abc import Generator, Iterator
from typing import Any, BinaryIO

import av
import numpy as np

from pipeline.untrusted.child import Arrays, Reply, Values
from pipeline.untrusted.files import UnusableFile
from pipeline.untrusted.films import MAX_PIXELS, opened_film
from stages.views.orientation import orientation_from_rotation
from stages.views.sampling import uniform_indices

for _module in pkgutil.walk_packages(av.__path__, "av."):  # it imports most of them when used
    if not _module.name.endswith((".__main__", ".datasets")):
        importlib.import_module(_module.name)


def work(values: Values, arrays: Arrays) -> Iterator[Reply]:
    """Frames of the film behind an open descriptor.

    The packets are counted first, then the film is decoded once; again if the count was wrong
    (a damaged film, or one cut without re-encoding): then ``again`` comes, and the frames before it
    don't count.
    """
    with os.fdopen(int(values["file"]), "rb") as file:
        try:
            count = yield from _count_packets(file)
            if count == 0:
                raise UnusableFile("has no video frames in it")
            wanted, threads = int(values["wanted"]), int(values["threads"])
            found = yield from _decode(file, uniform_indices(count, wanted), count, threads)
            if found not in (0, count):
                yield {"again": True}, []
                yield from _decode(file, uniform_indices(found, wanted), found, threads)
        except MemoryError:
            raise
        except (av.error.FFmpegError, OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise UnusableFile(f"can't be read as a video ({reason})") from error


def _count_packets(file: BinaryIO) -> Generator[Reply, None, int]:
    """How many frames the film seems to have; says now and then that it is at work."""
    count = 0
    with opened_film(file) as container:
        stream = _video(container)
        check_size(stream.codec_context.width, stream.codec_context.height)
        for number, packet in enumerate(container.demux(stream)):
            count += bool(packet.size and not packet.is_discard)
            if number % 500 == 0:
                yield {"counted": count}, []
    return count


def _video(container: Any) -> Any:
    if not container.streams.video:
        raise UnusableFile("has no video in it, only other streams")
    stream = container.streams.video[0]
    if stream.codec_context is None:
        raise UnusableFile(
            "can't be read as a video: its pictures are coded in a way that is not known here"
        )
    return stream


def check_size(width: int, height: int) -> None:
    """Refuse frames that are larger than films have."""
    if width * height > MAX_PIXELS:
        raise UnusableFile(
            f"has frames of {width} x {height} pixels, more than the "
            f"{MAX_PIXELS // 1_000_000} megapixels that can be read of a film"
        )


def _decode(
    file: BinaryIO, indices: list[int], count: int, threads: int
) -> Generator[Reply, None, int]:
    """The frames at `indices`; returns how many the film has."""
    chosen, start, index = set(indices), 0.0, -1
    with opened_film(file) as container:
        stream = _video(container)
        stream.thread_type = "AUTO"
        stream.codec_context.thread_count = threads
        for index, frame in enumerate(container.decode(stream)):
            check_size(frame.width, frame.height)
            if index == 0:
                yield {"size": [frame.width, frame.height]}, []
                start = frame.time or 0.0
            if index in chosen:
                seconds = frame.time - start if frame.time is not None else index
                yield (
                    {
                        "index": index,
                        "orientation": orientation_from_rotation(frame.rotation),
                        "seconds": round(float(seconds), 6),
                    },
                    [np.ascontiguousarray(frame.to_ndarray(format="rgb24"))],
                )
            if index % 10 == 0:
                yield {"done": min(index + 1, count), "of": count}, []
    return index + 1
