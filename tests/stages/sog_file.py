"""A reader of `.sog` files, from the format's description, not our code."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path

import numpy as np
from PIL import Image

from pipeline.artifacts.gaussians import Gaussians


def read_sog(path: Path) -> tuple[Gaussians, int]:
    """A bundled `.sog` of version 2, and the degree of its harmonics."""
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(files["meta.json"])
    assert meta["version"] == 2
    count = meta["count"]

    def image(name: str) -> np.ndarray:
        opened = Image.open(io.BytesIO(files[name]))
        assert opened.format == "WEBP"
        return np.asarray(opened.convert("RGBA")).astype(np.int64)

    def pixels(kind: str, number: int = 0) -> np.ndarray:
        return image(meta[kind]["files"][number]).reshape(-1, 4)[:count]

    share = (pixels("means")[:, :3] + 256 * pixels("means", 1)[:, :3]) / 65535
    low, high = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
    means = low + share * (high - low)
    means = np.sign(means) * np.expm1(np.abs(means))
    raw = pixels("quats")
    others = (raw[:, :3] / 255 * 2 - 1) / np.sqrt(2)
    quats = np.zeros((count, 4))
    for place in range(4):
        rows = raw[:, 3] == 252 + place
        quats[rows, place] = np.sqrt(np.maximum(0, 1 - (others[rows] ** 2).sum(1)))
        quats[np.ix_(rows, [c for c in range(4) if c != place])] = others[rows]
    assert not count or np.abs(quats).max(1).min() > 0, "each has a largest component"
    scales = np.array(meta["scales"]["codebook"])[pixels("scales")[:, :3]]
    first = pixels("sh0")
    sh = np.zeros((count, 16, 3), np.float32)
    sh[:, 0] = np.array(meta["sh0"]["codebook"])[first[:, :3]]
    alpha = first[:, 3] / 255
    degree = 0
    if "shN" in meta:
        degree = meta["shN"]["bands"]
        rest = (degree + 1) ** 2 - 1
        palette = image(meta["shN"]["files"][0])
        assert palette.shape[1] == 64 * rest
        palette = palette[..., :3].reshape(-1, rest, 3)
        assert len(palette) >= meta["shN"]["count"]
        labels = pixels("shN", 1)
        sh[:, 1 : 1 + rest] = np.array(meta["shN"]["codebook"])[
            palette[labels[:, 0] + 256 * labels[:, 1]]
        ]
    return Gaussians(
        means.astype(np.float32), quats.astype(np.float32), scales.astype(np.float32),
        np.log(alpha / (1 - alpha)).astype(np.float32), sh,
    ), degree  # fmt: skip
