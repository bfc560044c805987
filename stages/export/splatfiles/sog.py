"""PlayCanvas's `.sog`, version 2: a zip of lossless WebP pictures, one pixel a Gaussian.

Source: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog. `meta.json`
names the pictures: `means_l` and `means_u`, the low and the high bytes of positions (as
sign * log(1 + |x|), 16 bits between bounds); `quats`, the three smallest components and, in alpha,
252 + the place of the largest; `scales` and `sh0`, indices into a codebook each (`sh0` has the
opacity in alpha); and `shN_labels`, 16 bits each, into a palette of harmonics `shN_centroids` (64
entries a row, a pixel a coefficient), whose colours are indices into a third codebook.

The description calls y up; the readers turn the file as they turn a 3DGS `.ply`, and so does this.
"""

from __future__ import annotations

import io
import json
import zipfile
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.gaussians import Gaussians
from stages.export.splats import coefficients, opacity_bytes, smallest_three

Floats = npt.NDArray[np.floating]
Bytes = npt.NDArray[np.uint8]

#: Entries of a codebook, of a row of the palette, and of the palette at most (labels have 16 bits).
CODES, PER_ROW, MOST_BITS = 256, 64, 16
#: Bins of the histogram that a codebook is fitted to, and rounds of Lloyd's algorithm.
BINS, ROUNDS = 8192, 12
#: The date that every file in the zip has: the first that a zip can tell.
NO_DATE = (1980, 1, 1, 0, 0, 0)


def sog_bytes(gaussians: Gaussians, degree: int) -> bytes:
    """The Gaussians as a `.sog` file.

    Args:
        gaussians: N finite ones, best in an order in which neighbours lie beside each other.
        degree: of the harmonics to keep, 0..3.
    """
    count = len(gaussians)
    width = max(1, int(np.ceil(np.sqrt(count))))
    pictures: dict[str, Bytes] = {}

    def picture(name: str, columns: Bytes) -> str:
        """[N, C] bytes as a picture of `width`; its name."""
        channels = columns.shape[1]
        pixels = np.zeros((width * max(1, -(-count // width)), channels), np.uint8)
        pixels[:count] = columns
        pictures[f"{name}.webp"] = pixels.reshape(-1, width, channels)
        return f"{name}.webp"

    means = gaussians.means.astype(np.float64)
    means = np.sign(means) * np.log1p(np.abs(means))
    low, high = (means.min(0), means.max(0)) if count else (np.zeros(3), np.zeros(3))
    span = np.where(high > low, high - low, 1.0)
    levels = np.rint((means - low) / span * 65535).astype(np.uint16)
    sizes, size_codes = _coded(gaussians.log_scales)
    colors, color_codes = _coded(gaussians.sh[:, 0])
    opaque = opacity_bytes(gaussians)[:, None]
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "dentalsplat"},
        "count": count,
        "means": {
            "mins": low.tolist(), "maxs": high.tolist(),
            "files": [
                picture("means_l", (levels & 255).astype(np.uint8)),
                picture("means_u", (levels >> 8).astype(np.uint8)),
            ],
        },
        "scales": {"codebook": size_codes, "files": [picture("scales", sizes)]},
        "quats": {"files": [picture("quats", _rotations(gaussians.quats_wxyz))]},
        "sh0": {
            "codebook": color_codes,
            "files": [picture("sh0", np.concatenate([colors, opaque], 1))],
        },
    }  # fmt: skip
    if degree and count:
        beyond = coefficients(degree)
        entries, labels = _palette(gaussians.sh[:, 1 : 1 + beyond].reshape(count, -1))
        coded, codes = _coded(entries)
        rows = np.zeros((-(-len(coded) // PER_ROW) * PER_ROW, beyond, 3), np.uint8)
        rows[: len(coded)] = coded.reshape(len(coded), beyond, 3)
        pictures["shN_centroids.webp"] = rows.reshape(-1, PER_ROW * beyond, 3)
        places = np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], 1).astype(np.uint8)
        meta["shN"] = {
            "count": len(entries), "bands": degree, "codebook": codes,
            "files": ["shN_centroids.webp", picture("shN_labels", places)],
        }  # fmt: skip
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(zipfile.ZipInfo("meta.json", NO_DATE), json.dumps(meta))
        for name, pixels in pictures.items():
            archive.writestr(zipfile.ZipInfo(name, NO_DATE), _webp(pixels))
    return packed.getvalue()


def _webp(pixels: Bytes) -> bytes:
    """A picture [H, W, 3 | 4] without loss, colours of transparent pixels too."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "WEBP", lossless=True, quality=20, method=1, exact=True)
    return stream.getvalue()


def _coded(values: Floats) -> tuple[Bytes, list[float]]:
    """Values [...] as indices into a codebook, and the codebook: Lloyd's, on their histogram.

    Each round lets a code be the mean of the values nearest to it. The first codes are spread with
    the cube root of the density, which is best where codes are many (Panter and Dite 1951).
    """
    numbers = np.asarray(values, np.float64)
    if not numbers.size or numbers.min() == numbers.max():
        value = float(numbers.flat[0]) if numbers.size else 0.0
        return np.zeros(numbers.shape, np.uint8), [value] * CODES
    weight, edges = np.histogram(numbers, BINS)
    middles = (edges[1:] + edges[:-1]) / 2
    spread = np.cumsum(np.cbrt(weight))
    codes = np.interp((np.arange(CODES) + 0.5) / CODES, spread / spread[-1], middles)
    for _ in range(ROUNDS):
        nearest = np.searchsorted((codes[1:] + codes[:-1]) / 2, middles)
        total = np.bincount(nearest, weight, CODES)
        mean = np.bincount(nearest, weight * middles, CODES) / np.maximum(total, 1)
        codes = np.sort(np.where(total > 0, mean, codes))
    codes = codes.astype(np.float32)
    index = np.searchsorted((codes[1:] + codes[:-1]) / 2, numbers)
    return index.astype(np.uint8), codes.tolist()


def _rotations(quats_wxyz: Floats) -> Bytes:
    """[N, 4] quaternions as bytes: the three smallest components, 252 + place of the largest."""
    largest, others = smallest_three(quats_wxyz)
    shares = others * np.sqrt(0.5) + 0.5
    found = np.concatenate([np.rint(shares * 255), 252 + largest[:, None]], 1)
    return np.clip(found, 0, 255).astype(np.uint8)


def _palette(harmonics: Floats) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]:
    """Harmonics [N, C] as a palette [P, C] and [N] places in it.

    Where the palette has room for all, each Gaussian has its own: half as many entries would make
    the file of the sample scene a fifth smaller and .15 dB worse. Else groups are halved at the
    median of the coefficient that varies most in them, until the palette is full, and each entry is
    the mean of a group: no random numbers, and N log P work.
    """
    values = np.ascontiguousarray(harmonics, np.float32)
    order = np.arange(len(values))
    if len(values) <= 1 << MOST_BITS:
        return values, order
    starts = np.array([0])
    for _ in range(MOST_BITS):
        ends = np.append(starts[1:], len(values))
        sizes = ends - starts
        group = np.repeat(np.arange(len(starts)), sizes)
        inside = values[order]
        mean = np.add.reduceat(inside, starts) / sizes[:, None]
        varies = np.add.reduceat(inside**2, starts) / sizes[:, None] - mean**2
        axis = varies.argmax(1)
        order = order[np.lexsort((inside[np.arange(len(order)), axis[group]], group))]
        starts = np.sort(np.concatenate([starts, (starts + ends) // 2]))
    sizes = np.append(starts[1:], len(values)) - starts
    labels = np.empty(len(values), np.int64)
    labels[order] = np.repeat(np.arange(len(starts)), sizes)
    return (np.add.reduceat(values[order], starts) / sizes[:, None]).astype(np.float32), labels
