"""Gaussians of PlayCanvas's compressed `.ply`, which our exports have, and SuperSplat writes.

Source: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/ply/ and the reader
of the PlayCanvas engine (MIT): chunks of 256 Gaussians, each within its own bounds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.gaussians import (
    COMPRESSED_BOUNDS,
    COMPRESSED_CHUNK,
    COMPRESSED_HARMONIC_SPAN,
    COMPRESSED_WORDS,
    MOST_GAUSSIANS,
    REST_COUNTS,
    SH_COEFFICIENTS,
)
from pipeline.errors import RequestError
from pipeline.untrusted.files import UnusableFile
from pipeline.untrusted.scenes.ply import CLOUD, Element, read_ply
from stages.splatting.rendering import CONSTANT_HARMONIC

Array = npt.NDArray[np.float32]
Doubles = npt.NDArray[np.float64]

#: The property by which one knows such a file.
MARK = COMPRESSED_WORDS[0]
_PLACES, _SIZES, _COLOURS = COMPRESSED_BOUNDS


def read_compressed_ply(path: Path) -> dict[str, Array]:
    """Read a compressed `.ply` into the fields of `Gaussians`; opaque ones have an infinite logit.

    Raises:
        RequestError: it is damaged, lacks what such a file has, or has more than any scene.
    """
    try:
        return _gaussians(read_ply(path, CLOUD))
    except UnusableFile as error:
        raise RequestError(f"{path} {error}. Write it again.") from error


def _gaussians(found: Mapping[str, Element]) -> dict[str, Array]:
    none = Element(0, {}, {})
    chunks, vertices, sh = (found.get(name, none) for name in ("chunk", "vertex", "sh"))
    count = vertices.count
    if not 0 < count <= MOST_GAUSSIANS:
        raise UnusableFile(f"has {count:,} Gaussians; 1 to {MOST_GAUSSIANS:,} are read")
    bounded = (*_PLACES, *_SIZES, *(_COLOURS if "min_r" in chunks.columns else ()))
    bounds = [f"{side}_{name}" for name in bounded for side in ("min", "max")]
    words = {n: column for n, column in vertices.columns.items() if column.dtype.kind == "u"}
    lacking = [n for n in bounds if n not in chunks.columns] + [
        n for n in COMPRESSED_WORDS if n not in words
    ]
    if lacking:
        raise UnusableFile(f"is no whole compressed .ply: it lacks {', '.join(lacking)}")
    if chunks.count != -(-count // COMPRESSED_CHUNK):
        raise UnusableFile(f"is damaged: it has {chunks.count} chunks for {count} Gaussians")
    rest = [f"f_rest_{k}" for k in range(len(sh.columns))]
    if sh.count not in (0, count) or len(rest) not in REST_COUNTS or {*rest} != {*sh.columns}:
        raise UnusableFile("is damaged: its harmonics are not those of its Gaussians")
    position, rotation, scale, color = (words[name].astype(np.uint32) for name in COMPRESSED_WORDS)
    chunk = np.arange(count) // COMPRESSED_CHUNK

    def within(shares: Doubles, names: Sequence[str]) -> Doubles:
        low, high = (
            np.stack([chunks.columns[f"{side}_{name}"] for name in names], 1).astype(np.float64)
            for side in ("min", "max")
        )
        return low[chunk] * (1 - shares) + high[chunk] * shares

    shown = _unpacked(color, (8, 8, 8, 8))
    with np.errstate(all="ignore"):  # what is not finite is told of by who takes it
        colors = within(shown[:, :3], _COLOURS) if _COLOURS[0] in bounded else shown[:, :3]
        harmonics = np.zeros((count, SH_COEFFICIENTS, 3), np.float32)
        harmonics[:, 0] = (colors - 0.5) / CONSTANT_HARMONIC
        if sh.count and rest:
            level = np.stack([sh.columns[name] for name in rest], 1).astype(np.float64)
            share = np.where(level == 0, 0, np.where(level == 255, 1, (level + 0.5) / 256))
            further = ((share - 0.5) * COMPRESSED_HARMONIC_SPAN).reshape(count, 3, -1)
            harmonics[:, 1 : 1 + further.shape[2]] = further.transpose(0, 2, 1)
        fields = {
            "means": within(_unpacked(position, (11, 10, 11)), _PLACES),
            "quats_wxyz": _rotations(rotation),
            "log_scales": within(_unpacked(scale, (11, 10, 11)), _SIZES),
            "logit_opacities": np.log(shown[:, 3]) - np.log1p(-shown[:, 3]),
            "sh": harmonics,
        }
        return {name: values.astype(np.float32) for name, values in fields.items()}


def _unpacked(words: npt.NDArray[np.uint32], bits: Sequence[int]) -> Doubles:
    """Words [N] of numbers, the first in the highest bits, as shares 0..1 [N, C]."""
    left, shares = sum(bits), []
    for width in bits:
        left -= width
        most = (1 << width) - 1
        shares.append((words >> np.uint32(left) & np.uint32(most)) / most)
    return np.stack(shares, 1)


def _rotations(words: npt.NDArray[np.uint32]) -> Doubles:
    """Words [N] of the largest component's place and the three others -> [N, 4] wxyz."""
    others = (_unpacked(words, (10, 10, 10)) - 0.5) * np.sqrt(2)
    most = np.sqrt(np.maximum(0, 1 - np.square(others).sum(1)))
    largest = (words >> np.uint32(30)).astype(np.int64)
    places = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]  # [N, 3]
    quats, rows = np.zeros((len(words), 4)), np.arange(len(words))
    quats[rows, largest] = most
    quats[rows[:, None], places] = others
    return quats
