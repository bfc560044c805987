"""Which photographs of a scene are input and which are held out: the protocols."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.errors import RequestError
from pipeline.untrusted.paths import matching
from pipeline.untrusted.pictures import SUFFIXES

#: The paper's video protocol (section 4.1).
VIDEO_FRAMES = 24
TEST_FRAMES = 12


@dataclass(frozen=True)
class Split:
    """The photographs of one cell.

    Attributes:
        photographs: the input, in order.
        held_out: what the method never sees, and is scored on; empty where the input is scored.
    """

    photographs: tuple[Path, ...]
    held_out: tuple[Path, ...]


def pictures_of(images: Sequence[Path]) -> list[Path]:
    """The photographs that a scene names, in the order of the numbers in their names.

    Args:
        images: folders, files or glob patterns.

    Raises:
        RequestError: there are none, or two of the same name.
    """
    from stages.views.sampling import natural_key

    found: list[Path] = []
    for place in images:
        if place.is_dir():
            found += [path for path in place.iterdir() if path.suffix.lower() in SUFFIXES]
        elif place.is_file():
            found.append(place)
        else:
            found += matching(place)
    where = ", ".join(map(str, images))
    found = [path for path in found if path.is_file() and path.name[:1] != "."]
    found.sort(key=lambda path: natural_key(path.name))
    if not found:
        raise RequestError(
            f"{where}: no photographs ({', '.join(SUFFIXES)}). A scene of a benchmark is "
            "a folder of them; a video must be taken apart into frames first."
        )
    stems = [path.stem for path in found]
    twice = next((path for path in found if stems.count(path.stem) > 1), None)
    if twice is not None:
        raise RequestError(
            f"{where}: two photographs are called {twice.stem}; cameras and masks belong to "
            "photographs by name, so each needs a name of its own."
        )
    return found


def split_views(files: list[Path], protocol: str, views: int | None, test_every: int = 2) -> Split:
    """Divide photographs into input and held-out ones.

    Args:
        files: all photographs of the scene, in viewing order.
        protocol: ``video24``: 24 frames, uniformly sampled if there are more; held out are
            floor(linspace(1, 22, 12)), the other 12 are the pool; the input is
            floor(linspace(0, 11, views)) of the pool (the paper, section 4.1).
            ``test_every``: held out is each `test_every`-th, beginning with the second and without
            the last; the rest is the pool. ``all``: all are input and nothing is held out.
        views: number of input views; None for the whole pool.

    Raises:
        RequestError: there are too few photographs.
    """
    where = files[0].parent
    if protocol == "all":
        return Split(tuple(files), ())
    if protocol == "video24":
        if len(files) < VIDEO_FRAMES:
            raise RequestError(
                f"{where}: the protocol video24 needs {VIDEO_FRAMES} frames, and there are "
                f"{len(files)}. Use the protocol test_every."
            )
        files = [files[k] for k in np.linspace(0, len(files) - 1, VIDEO_FRAMES).astype(int)]
        held = set(np.linspace(1, VIDEO_FRAMES - 2, TEST_FRAMES).astype(int).tolist())
    else:
        held = set(range(1, len(files) - 1, test_every))
    pool = [path for index, path in enumerate(files) if index not in held]
    count = len(pool) if views is None else views
    if count > len(pool) or count < 2:
        raise RequestError(
            f"{where}: {views} input views were asked for, and the protocol {protocol} leaves "
            f"{len(pool)} of {len(files)} photographs to choose from."
        )
    chosen = np.linspace(0, len(pool) - 1, count).astype(int).tolist()
    return Split(tuple(pool[k] for k in chosen), tuple(files[k] for k in sorted(held)))
