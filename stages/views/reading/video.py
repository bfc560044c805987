"""Take frames from a film: uniformly, turned upright, with their times."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import BinaryIO, TypeVar

import numpy as np
import numpy.typing as npt

from pipeline.untrusted.child import Child, seconds_for
from pipeline.untrusted.files import UnusableFile
from pipeline.untrusted.films import MOST_MEMORY

#: Each thread of the decoder holds frames of its own.
MOST_THREADS = 16

Used = TypeVar("Used")


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


def map_frames(
    file: BinaryIO,
    use: Callable[[VideoFrame], Used],
    wanted: int,
    threads: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
    check_size: Callable[[int, int], None] = lambda width, height: None,
) -> list[Used]:
    """What `use` makes of frames, uniformly chosen from the first to the last, one at a time.

    The film is decoded in a process of its own.

    Args:
        file: the film, opened; nothing else is read.
        use: makes of a frame what is kept of it.
        wanted: number of frames; all if the film has fewer.
        threads: for decoding; does not change the frames.
        progress: called with (frames decoded, frames in all).
        check_size: as in `decode_photo`.

    Raises:
        UnusableFile: it can't be opened or has no frames.
    """
    descriptor = file.fileno()
    request = {"file": descriptor, "wanted": wanted, "threads": min(threads, MOST_THREADS)}
    limit = seconds_for(os.fstat(descriptor).st_size)
    made: list[Used] = []
    with Child("stages.views.reading.video_child:work", MOST_MEMORY, [descriptor]) as child:
        for reply, arrays in child.ask(request, [], limit):
            if "size" in reply:
                check_size(*reply["size"])
            elif "counted" in reply:
                continue
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
