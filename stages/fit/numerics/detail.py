"""Gaussians in parts, and what is fine in an image."""

from __future__ import annotations

import cv2
import numpy as np

from stages.fit.arrays import Array, Bools, Floats, Indices
from stages.fit.numerics.density import rotations

#: halves of a Gaussian lie this many of its standard deviations from its middle, and are narrower
#: by this factor: a little less wide together than it was, since what is split is to show more
APART, SHRINK = 0.5, 0.6
#: what a blur of this standard deviation, in pixels, leaves of an image is not fine: Gaussians that
#: are split are about as wide as this (1.3 does the same on a real triad and on rendered teeth)
COARSE = 2.0


def wide_axes(packed: Floats, pixel: Floats, least: float) -> Bools:
    """[N, 3] axes, the two longest at most, that are more than `least` pixels [N] wide."""
    wide = np.exp(packed[:, 7:10]) > least * pixel[:, None]
    wide[np.arange(len(packed)), packed[:, 7:10].argmin(1)] = False
    return wide


def within(axes: Bools, score: Array, room: int) -> Bools:
    """Of axes [N, 3] to be split, those of the largest scores, so that `room` more are enough."""
    more = 2 ** axes.sum(1) - 1
    order = np.argsort(-score, kind="stable")
    allowed = np.zeros(len(axes), bool)
    allowed[order] = np.cumsum(more[order]) <= room
    return np.asarray(axes & allowed[:, None])


def divide(packed: Floats, axes: Bools) -> tuple[Floats, Indices, Bools]:
    """Split Gaussians in two along each of some of their axes.

    Args:
        packed: [N, D].
        axes: [N, 3].

    Returns:
        The new matrix, for each of its rows the old row that it came from, and whether it is new;
        in the order of the old rows, so that what lay side by side still does.
    """
    source = np.arange(len(packed), dtype=np.int64)
    offsets = np.zeros((len(packed), 3), np.float32)
    for axis in range(3):
        twice = axes[source, axis]
        offsets[twice, axis] = -APART
        other = offsets[twice].copy()
        other[:, axis] = APART
        offsets = np.concatenate([offsets, other])
        source = np.concatenate([source, source[twice]])
    result = packed[source]
    moved = offsets * np.exp(result[:, 7:10])
    result[:, :3] += np.einsum("nij,nj->ni", rotations(result[:, 3:7]), moved)
    result[:, 7:10] += np.log(np.float32(SHRINK)) * axes[source]
    order = np.argsort(source, kind="stable")
    source = source[order]
    return result[order], source, np.asarray(axes[source].any(1))


def fine(image: Floats, mask: Floats) -> Floats:
    """[3, H, W] an image without what is even around each pixel, inside a mask [H, W]."""
    around = np.maximum(cv2.GaussianBlur(mask, (0, 0), COARSE), np.float32(1e-3))
    planes = [
        plane - np.asarray(cv2.GaussianBlur(plane * mask, (0, 0), COARSE), np.float32) / around
        for plane in image
    ]
    return np.stack(planes)
