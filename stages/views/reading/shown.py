"""A decoded frame of a film as players show it: square, one moment, sRGB, which way is up."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import av
import numpy as np
import numpy.typing as npt
from av.sidedata.sidedata import Type

from stages.views.orientation import orientation_from_matrix, orientation_from_rotation
from stages.views.reading.hdr import HLG, PQ, srgb_from_hdr

Bytes = npt.NDArray[np.uint8]

#: Pixels of a film are this much wider than high, or higher than wide, at most: 4/3 on tapes and
#: cards of camcorders, 2.9 where half the columns were left out. More is damage.
WIDEST_PIXEL = 4.0
#: FFmpeg's number of colours that a film does not tell.
UNTOLD = 2
#: Films of more columns or rows are HD, whose colours are those of BT.709 where they are not told.
SD_COLUMNS, SD_ROWS = 1279, 576


def shown_size(stream: Any, frame: Any) -> tuple[int, int]:
    """(width, height) at which players show a frame: with square pixels, none of them lost."""
    aspect = float(stream.sample_aspect_ratio or 1)
    if not 1 / WIDEST_PIXEL <= aspect <= WIDEST_PIXEL:
        aspect = 1.0
    return round(frame.width * max(aspect, 1)), round(frame.height / min(aspect, 1))


def turn_of(frame: Any) -> int:
    """EXIF orientation that does what the display matrix of a frame does."""
    try:
        matrix = frame.side_data.get(Type.DISPLAYMATRIX)
    except ValueError:  # PyAV does not know all that can stand beside a frame
        return orientation_from_rotation(frame.rotation)
    if matrix is None:
        return 1
    (a, b), (c, d) = np.frombuffer(bytes(matrix), np.int32).reshape(3, 3)[:2, :2].tolist()
    return orientation_from_matrix(((a, c), (b, d)))


def shown(frame: Any, size: tuple[int, int]) -> Bytes:
    """[H, W, 3] uint8 of a frame, at this (width, height)."""
    is_hd = frame.width > SD_COLUMNS or frame.height > SD_ROWS
    colours = "ITU709" if frame.colorspace == UNTOLD and is_hd else None
    if frame.interlaced_frame and is_combed(frame.reformat(format="gray").to_ndarray()):
        half = _first_of_two(frame).reformat(format="rgb24", src_colorspace=colours).to_ndarray()
        frame = av.VideoFrame.from_ndarray(_with_rows_between(half, frame.height), "rgb24")
    if frame.color_trc in (PQ, HLG):
        return srgb_from_hdr(
            frame.reformat(*size, "rgb48le", "BT2020").to_ndarray(), frame.color_trc
        )
    picture = frame.reformat(*size, "rgb24", src_colorspace=colours).to_ndarray()
    return np.ascontiguousarray(picture)


def is_combed(grey: Bytes) -> bool:
    """Do rows of [H, W] look less like the next ones, taken later, than like those after these?

    Not where all is at rest, nor in films that are called interlaced but are not.
    """
    rows = grey.astype(np.int16)
    to_the_next = np.abs(2 * rows[1:-1] - rows[:-2] - rows[2:]).mean()
    to_the_same = np.abs(2 * rows[2:-2] - rows[:-4] - rows[4:]).mean()
    return bool(to_the_next > to_the_same)


def _first_of_two(frame: Any) -> Any:
    """Every second row of a frame, from its first on, colours too."""
    graph = av.filter.Graph()
    source = graph.add_buffer(
        width=frame.width, height=frame.height, format=frame.format, time_base=Fraction(1, 25)
    )
    graph.link_nodes(source, graph.add("field", "type=top"), graph.add("buffersink")).configure()
    graph.push(frame)
    return graph.pull()


def _with_rows_between(rgb: Bytes, height: int) -> Bytes:
    """The rows [H / 2, W, 3], and between them their means."""
    whole = rgb.repeat(2, axis=0)[:height]
    between = whole[1:-1:2]
    between[:] = (between.astype(np.uint16) + rgb[1 : 1 + len(between)] + 1) // 2
    return whole
