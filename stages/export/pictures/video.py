"""An H.264 video that browsers play, with the same bytes for the same frames."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt


def even(size: int) -> int:
    """The largest even number up to `size`, which 4:2:0 chroma needs."""
    return max(2, size - size % 2)


def write_video(
    path: Path, frames: Iterable[npt.NDArray[np.uint8]], size: tuple[int, int], fps: int, crf: int
) -> int:
    """Encode RGB frames [H, W, 3] as MP4 (libx264, yuv420p, BT.709, index at the front).

    One thread and bit-exact muxing: neither the thread count nor the time of day gets into the
    file.

    Args:
        path: of the `.mp4`.
        frames: all of (height, width) = `size` reversed, both even.
        size: (width, height).
        fps: frames a second.
        crf: constant rate factor, 0 (lossless) to 51.

    Returns:
        The number of frames written.
    """
    container_options = {"movflags": "+faststart", "fflags": "+bitexact"}
    written = 0
    with av.open(str(path), "w", format="mp4", options=container_options) as container:
        stream = container.add_stream("libx264", rate=fps)
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"
        stream.time_base = Fraction(1, fps)
        stream.thread_count = 1
        # x264's macroblock tree reads beyond the edge of its half-size pictures on CPUs with
        # AVX-512: the bytes would change from run to run.
        stream.options = {
            "crf": str(crf), "preset": "medium", "threads": "1", "flags": "+bitexact",
            "x264-params": "mbtree=0",
        }  # fmt: skip
        context = stream.codec_context
        context.color_primaries = context.color_trc = context.colorspace = 1  # BT.709
        context.color_range = 1  # 16..235
        for index, pixels in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")
            frame = frame.reformat(
                format="yuv420p", src_colorspace="ITU709", dst_colorspace="ITU709"
            )
            frame.pts = index
            frame.time_base = Fraction(1, fps)
            container.mux(stream.encode(frame))
            written += 1
        container.mux(stream.encode(None))
    return written
