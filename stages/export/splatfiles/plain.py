"""One colour a Gaussian, for viewers that read no spherical harmonics.

The constant of the harmonics is no colour that anybody has seen: where all photographs look from
one side, the other terms hold much of it. Viewers that read the constant alone then show a scene
too dark or in strange colours. Here each Gaussian gets the mean of its colours in the photographs'
cameras, each with the weight of what it contributes to that picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.gaussians import Gaussians
from stages.splatting.rendering import CONSTANT_HARMONIC, contributions, seen_colors

#: More cameras than this are thinned evenly: the mean changes little, and each costs time.
MOST_CAMERAS = 6
#: Gaussians that contribute less than this (pixels) to all pictures together were hardly seen.
LEAST_SEEN = 1e-3


def with_constant_color(gaussians: Gaussians, cameras: Sequence[Camera]) -> Gaussians:
    """The Gaussians with the mean colour that the cameras see, and no further harmonics.

    Those that no camera sees get the plain mean over the cameras.

    Args:
        gaussians: with harmonics, or with a light beside the lens.
        cameras: at least one; at most `MOST_CAMERAS` are asked.
    """
    count = min(MOST_CAMERAS, len(cameras))
    asked = [cameras[k] for k in np.linspace(0, len(cameras) - 1, count).round().astype(int)]
    total = np.zeros((len(gaussians), 3))
    weight = np.zeros(len(gaussians))
    plain = np.zeros((len(gaussians), 3))
    for camera in asked:
        colors = seen_colors(gaussians, camera).astype(np.float64)
        share = contributions(gaussians, camera).astype(np.float64)
        total += share[:, None] * colors
        weight += share
        plain += colors / count
    known = weight > LEAST_SEEN
    mean = np.where(known[:, None], total / np.where(known, weight, 1)[:, None], plain)
    sh: npt.NDArray[np.float32] = np.zeros_like(gaussians.sh)
    sh[:, 0] = (np.clip(mean, 0, 1) - 0.5) / CONSTANT_HARMONIC
    return replace(gaussians, sh=sh, light=None)
