"""Take frames from a film: spread evenly, turned upright, with their times."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, BinaryIO, TypeVar

import numpy as np
import numpy.typing as npt

from pipeline.untrusted.child import Child, seconds_for
from pipeline.untrusted.files import UnusableFile
from pipeline.untrusted.films import MOST_MEMORY
from stages.views.spread import distances, is_even, spread_indices

#: Each thread of the decoder holds frames of its own.
MOST_THREADS = 16
#: Key frames for each frame that is wanted from which no others are looked at.
ENOUGH_KEYS = 4

Used = TypeVar("Used")


@dataclass(frozen=True)
class VideoFrame:
    """One frame as it is stored, but for pixels that are not square: these are made so.

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


@dataclass(frozen=True)
class Wanted:
    """Which frames of a film to take.

    Attributes:
        count: how many, all if the film has fewer; the first and the last, or nearly, among them.
        by_difference: spread evenly by how much they differ (`spread_indices`), or in time.
        also: numbers of frames that are taken as well, where the film has them.
        indices: numbers of the frames, rising, where these are known.
    """

    count: int
    by_difference: bool = False
    also: frozenset[int] = frozenset()
    indices: tuple[int, ...] = ()


def map_frames(
    file: BinaryIO,
    use: Callable[[VideoFrame], Used],
    wanted: Wanted,
    threads: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
    check_size: Callable[[int, int], None] = lambda width, height: None,
    warn: Callable[[str], None] = lambda message: None,
) -> list[Used]:
    """What `use` makes of frames, evenly chosen from the first to the last, one at a time.

    The film is decoded in a process of its own.

    Args:
        file: the film, opened; nothing else is read.
        use: makes of a frame what is kept of it.
        wanted: which frames.
        threads: for decoding; does not change the frames.
        progress: called with (frames decoded, frames in all).
        check_size: as in `decode_photo`.
        warn: called with what is wrong with it, as the end of a sentence.

    Raises:
        UnusableFile: it can't be opened or has no frames.
    """
    descriptor = file.fileno()
    request: dict[str, Any] = {
        "file": descriptor, "wanted": wanted.count, "also": sorted(wanted.also),
        "indices": list(wanted.indices), "threads": min(threads, MOST_THREADS),
    }  # fmt: skip
    limit = seconds_for(os.fstat(descriptor).st_size)
    made: list[Used] = []
    with Child("stages.views.reading.video_child:work", MOST_MEMORY, [descriptor]) as child:
        if wanted.by_difference and not wanted.indices:
            request["indices"] = _chosen(child, request, limit, wanted.count, progress)
        for reply, arrays in child.ask(request, [], limit):
            if "size" in reply:
                check_size(*reply["size"])
            elif "counted" in reply:
                continue
            elif "there" in reply:
                warn(f"breaks off: of its {reply['of']} frames {reply['there']} are there.")
            elif "share" in reply:
                share = 100 * reply["share"]
                warn(f"breaks off: its end is missing, {share:.0f} % of its bytes are there.")
            elif "left_out" in reply:
                warn("is damaged: frames that can't be decoded are left out.")
            elif "again" in reply:
                made.clear()
            elif "done" in reply:
                progress(reply["done"], reply["of"])
            else:
                place, turn, time = reply["index"], reply["orientation"], reply["seconds"]
                made.append(use(VideoFrame(place, arrays[0], turn, time)))
    if not made:
        raise UnusableFile("has no video frames that can be decoded")
    return made


def _chosen(
    child: Child, request: Mapping[str, Any], limit: float, count: int,
    progress: Callable[[int, int], None],
) -> list[int]:  # fmt: skip
    """Numbers of so many frames; none where they are to be even in time."""
    for at in ("keys", "all"):
        places: list[int] = []
        pictures: list[npt.NDArray[np.uint8]] = []
        of, damaged = 0, False
        for reply, arrays in child.ask({**request, "glance": at}, [], limit):
            damaged |= "damaged" in reply
            if "index" in reply:
                places.append(reply["index"])
                pictures.append(arrays[0])
                of = reply["of"]
                progress(places[-1] + 1, of)
        if damaged:
            return []
        if len(places) < 2:
            continue
        apart = distances(pictures)
        if at == "keys" and is_even(apart):
            return []
        if at == "all" or len(places) >= ENOUGH_KEYS * count:
            return spread_indices(places, apart, of, count)
    return []
