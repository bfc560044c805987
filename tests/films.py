"""Frames of a film as tests want them: all that were chosen, at full size."""

from __future__ import annotations

from pathlib import Path

from pipeline.untrusted.files import FILM, opened
from stages.views.reading.video import VideoFrame, Wanted, map_frames


def read_frames(
    path: Path, wanted: int, threads: int = 1, *, by_difference: bool = False
) -> list[VideoFrame]:
    """What `map_frames` meets."""
    with opened(path, FILM) as file:
        return map_frames(file, lambda frame: frame, Wanted(wanted, by_difference), threads)
