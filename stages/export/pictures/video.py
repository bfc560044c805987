"""An H.264 video that browsers play, with the same bytes for the same frames."""

from __future__ import annotations

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path
from typing import Self

import av
import numpy as np
import numpy.typing as npt

#: Frames that wait for the encoder, at most.
WAITING = 2


def even(size: int) -> int:
    """The largest even number up to `size`, which 4:2:0 chroma needs."""
    return max(2, size - size % 2)


class Video:
    """An MP4 that frames are added to (libx264, yuv420p, BT.709, index at the front).

    One thread for the encoder and bit-exact muxing: neither the thread count nor the time of day
    gets into the file. Use as a context manager; an error inside leaves an unfinished file.

    Args:
        path: of the `.mp4`.
        size: (width, height), both even.
        fps: frames a second.
        crf: constant rate factor, 1 to 51 (0, lossless, is of a profile that few play).
        beside: encode in a thread, while the caller makes the next frame.
    """

    def __init__(
        self, path: Path, size: tuple[int, int], fps: int, crf: int, beside: bool = False
    ) -> None:
        options = {"movflags": "+faststart", "fflags": "+bitexact"}
        self._container = av.open(str(path), "w", format="mp4", options=options)
        self._stream = stream = self._container.add_stream("libx264", rate=fps)
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"
        stream.time_base = self._time_base = Fraction(1, fps)
        stream.thread_count = 1
        # 'superfast' takes a fifth of the time of 'medium' for a fifth more bytes, at equal SSIM.
        # x264's macroblock tree, which it leaves out, reads beyond the edge of its half-size
        # pictures on CPUs with AVX-512: the bytes would change from run to run.
        stream.options = {
            "crf": str(crf), "preset": "superfast", "threads": "1", "flags": "+bitexact",
            "x264-params": "mbtree=0",
        }  # fmt: skip
        context = stream.codec_context
        context.color_primaries = context.color_trc = context.colorspace = 1  # BT.709
        context.color_range = 1  # 16..235
        self._pool = ThreadPoolExecutor(1) if beside else None
        self._waiting: deque[Future[None]] = deque()
        self._added = 0
        self._failed = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            if kind is None:
                self._wait(0)
                self._container.mux(self._stream.encode(None))
        finally:
            if self._pool is not None:
                self._pool.shutdown(cancel_futures=True)
            self._container.close()

    def add(self, pixels: npt.NDArray[np.uint8]) -> None:
        """Add a frame, [3 H / 2, W] uint8: planar 4:2:0 in BT.709, 16..235 (see `frames.yuv420`).

        It may be encoded after this returns: it must not be written to.
        """
        number, self._added = self._added, self._added + 1
        if self._pool is None:
            self._encode(pixels, number)
        else:
            self._waiting.append(self._pool.submit(self._encode, pixels, number))
            self._wait(WAITING)

    def _wait(self, most: int) -> None:
        """Until no more than so many frames wait; raises what the encoder raised."""
        while len(self._waiting) > most:
            self._waiting.popleft().result()

    def _encode(self, pixels: npt.NDArray[np.uint8], number: int) -> None:
        if self._failed:  # the library crashes where the header could not be written
            return
        frame = av.VideoFrame.from_ndarray(pixels, format="yuv420p")
        frame.pts = number
        frame.time_base = self._time_base
        try:
            self._container.mux(self._stream.encode(frame))
        except BaseException:
            self._failed = True
            raise
