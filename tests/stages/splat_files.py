"""Readers of the splat files that we write, from the formats' descriptions, not our code."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np
from plyfile import PlyData

from pipeline.artifacts.gaussians import Gaussians

C0 = 0.28209479177387814


def read_spz(path: Path) -> tuple[Gaussians, int]:
    """An `.spz` of version 2, and its degree."""
    data = gzip.decompress(path.read_bytes())
    magic, version, count, degree, bits, flags, zero = struct.unpack_from("<IIIBBBB", data)
    assert (magic, version, flags, zero) == (0x5053474E, 2, 0, 0)
    rest = (degree + 1) ** 2 - 1
    at = 16

    def block(width: int) -> np.ndarray:
        nonlocal at
        found = np.frombuffer(data, np.uint8, count * width, at).reshape(count, width)
        at += count * width
        return found

    raw = block(9).reshape(count, 3, 3).astype(np.int32)
    fixed = raw[..., 0] | raw[..., 1] << 8 | raw[..., 2] << 16
    fixed = np.where(fixed & 0x800000, fixed - (1 << 24), fixed)
    alpha = np.clip(block(1)[:, 0] / 255.0, 1e-6, 1 - 1e-6)
    colors = (block(3) / 255.0 - 0.5) / 0.15
    scales = block(3) / 16.0 - 10
    xyz = block(3) / 127.5 - 1
    w = np.sqrt(np.maximum(0, 1 - (xyz**2).sum(1)))
    sh = np.zeros((count, 16, 3), np.float32)
    sh[:, 0] = colors
    sh[:, 1 : 1 + rest] = (block(3 * rest).reshape(count, rest, 3) - 128.0) / 128.0
    assert at == len(data)
    quats = np.column_stack([w, xyz])
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    return Gaussians(
        (fixed / (1 << bits)).astype(np.float32), quats.astype(np.float32),
        scales.astype(np.float32), np.log(alpha / (1 - alpha)).astype(np.float32), sh,
    ), degree  # fmt: skip


def read_compressed_ply(path: Path) -> tuple[Gaussians, int]:
    """PlayCanvas's compressed `.ply`, and the degree of its harmonics."""
    ply = PlyData.read(str(path))
    chunks, vertices = ply["chunk"].data, ply["vertex"].data
    count = len(vertices)
    assert len(chunks) == -(-count // 256)
    chunk = chunks[np.arange(count) // 256]

    def share(word: np.ndarray, shift: int, bits: int) -> np.ndarray:
        return (word >> shift & ((1 << bits) - 1)) / ((1 << bits) - 1)

    def within(shares: list[np.ndarray], names: tuple[str, str, str]) -> np.ndarray:
        columns = [
            chunk[f"min_{name}"] * (1 - t) + chunk[f"max_{name}"] * t
            for name, t in zip(names, shares, strict=True)
        ]
        return np.stack(columns, 1)

    def three(word: np.ndarray) -> list[np.ndarray]:
        return [share(word, 21, 11), share(word, 11, 10), share(word, 0, 11)]

    color = vertices["packed_color"]
    alpha = np.clip(share(color, 0, 8), 1e-6, 1 - 1e-6)
    shares = [share(color, shift, 8) for shift in (24, 16, 8)]
    word = vertices["packed_rotation"]
    largest = word >> 30
    others = [(share(word, shift, 10) - 0.5) * np.sqrt(2) for shift in (20, 10, 0)]
    most = np.sqrt(np.maximum(0, 1 - sum(part**2 for part in others)))
    quats = np.zeros((count, 4))
    for place in range(4):
        rows = largest == place
        quats[rows, place] = most[rows]
        for column, part in zip([c for c in range(4) if c != place], others, strict=True):
            quats[rows, column] = part[rows]
    sh = np.zeros((count, 16, 3), np.float32)
    sh[:, 0] = (within(shares, ("r", "g", "b")) - 0.5) / C0
    number = 0
    if "sh" in ply:
        rows = ply["sh"].data
        number = len(rows.dtype.names)
        rest = np.stack([rows[f"f_rest_{k}"] for k in range(number)], 1).astype(np.float64)
        rest = np.clip((rest + 0.5) / 256, 0, 1) * 8 - 4
        sh[:, 1 : 1 + number // 3] = rest.reshape(count, 3, number // 3).transpose(0, 2, 1)
    return Gaussians(
        within(three(vertices["packed_position"]), ("x", "y", "z")).astype(np.float32),
        quats.astype(np.float32),
        within(
            three(vertices["packed_scale"]), ("scale_x", "scale_y", "scale_z")
        ).astype(np.float32),
        np.log(alpha / (1 - alpha)).astype(np.float32), sh,
    ), int(np.sqrt(number // 3 + 1)) - 1  # fmt: skip
