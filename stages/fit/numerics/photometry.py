"""What a photograph would show of surface that another one shows: exposure, light and lens.

Each photograph has an exposure of its own, and the light mostly comes from beside its lens: what
is near and faces it is brighter, and so is the middle of the picture. Where photographs show the
same Gaussians they tell how much: the logarithms of the light that two of them show of one differ
by their exposures, and by the same multiples of the differences of a few features. With these,
what one photograph shows says what any other one would.

Exposures alone would not do. A photograph from the side is brighter at its canines than the frontal
one, and darker at its incisors: differences that just go on beyond a border are worse than none
(twelve patients, a part of a photograph predicted from the others, by
`benchmarks/unseen_photograph.py --cut`: going on smoothly costs 2.9 dB, this gains 1.1).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from stages.fit.arrays import Array, Floats

if TYPE_CHECKING:
    from stages.splatting.rasterizer import Viewpoint

#: Light is (c + DARK) / (WHITE - c) of a colour c: a camera's curve. By it, distance counts as it
#: does in nature, and what is nearly white hardly gets whiter. 1.2 and 1.7 do as well.
DARK, WHITE = 0.05, 1.4
#: Exponents of light by the features, where nothing is known: cosine, distance (inverse square),
#: the exponential of the squared distance from the middle of the picture (over the width). Twelve
#: patients, by regression over all but one: .21, -2.1, -2.2. The coordinates themselves, for a
#: light beside the lens, add .06 dB to a part that is cut away.
EXPONENTS = (0.2, -2.0, -2.0)
#: What holds exponents there, against the mean square of what is to be explained. Colours of points
#: in a part that is cut away: 0.0003 to 0.003 the same 19.7 dB; exponents held as firmly at 0 (no
#: light at the lens) 19.4 to 17.9; as they are 15.2.
FIRMNESS = 1e-3
#: And exposures at 0.
EXPOSURE_FIRMNESS = 1e-4
#: Cosines below are as good as this one: normals are not that sure. Pairs of looks count from
#: SLANTED on.
GRAZING, SLANTED = 0.1, 0.2
#: Nothing is further from the middle than this share of the width.
FAR_OFF = 0.7
#: Residuals beyond count by their size, not by its square (Huber 1964); highlights are such.
OUTLIER = 0.1
ROUNDS = 8
#: Gaussians count if both photographs show so many pixels of them, more than MOST count no more.
LEAST, MOST = 0.05, 3.0
#: So many tell the exposures of two photographs, fewer than FEW do not.
SAMPLED, FEW = 20000, 50


def light_of(colours: Floats | Array) -> Array:
    """Logarithm of the light that came to colours in 0..1 (others count as these)."""
    colours = np.clip(colours, 0, 1).astype(np.float64)
    return np.asarray(np.log((colours + DARK) / (WHITE - colours)))


def colours_of(light: Array) -> Array:
    """The inverse of `light_of`; between -DARK and WHITE."""
    shown = np.exp(np.clip(light, -20, 20))
    return np.asarray((WHITE * shown - DARK) / (1 + shown))


def features(positions: Array, normals: Array, viewpoint: Viewpoint) -> Array:
    """[N, 3] what the light that a view shows of a surface depends on, in the order of EXPONENTS.

    Args:
        positions: [N, 3].
        normals: [N, 3], outwards, unit; 0 where they are not known: facing the view.
    """
    rays = viewpoint.centre - positions
    distance = np.linalg.norm(rays, axis=1)
    cosine = (normals * rays).sum(1) / distance
    cosine[~normals.any(1)] = 1.0
    local = positions @ viewpoint.pose[:, :3].T + viewpoint.pose[:, 3]
    depth = np.maximum(local[:, 2:], 1e-9)  # what lies behind is far aside
    aside = viewpoint.intrinsics[:2] * local[:, :2] / depth + viewpoint.intrinsics[2:]
    aside = (aside - np.array([viewpoint.width, viewpoint.height]) / 2) / viewpoint.width
    aside = np.clip(aside, -FAR_OFF, FAR_OFF)
    return np.column_stack(
        [np.log(np.maximum(cosine, GRAZING)), np.log(distance), (aside**2).sum(1)]
    )


@dataclass(frozen=True)
class Photometry:
    """Attributes:
    exposures: [V, 3] logarithms, of each photograph and channel.
    exponents: [3, 3].
    """

    exposures: Array
    exponents: Array

    def light(self, of: Array) -> Array:
        """[V, N, 3] logarithms of the light, but for what surface it falls on, of features
        [V, N, 3]."""
        return np.asarray(self.exposures[:, None] + of @ self.exponents)


def measured(light: Array, of: Array, pixels: Array) -> Photometry:
    """How photographs differ, from what several of them show: robust ridge regression.

    Args:
        light: [V, N, 3] that each view shows of Gaussians, logarithms.
        of: [V, N, 3] their features.
        pixels: [V, N] that each of them colours there.
    """
    views, prior = len(light), np.array(EXPONENTS)[:, None]
    known, rows, weights = [], [], []
    for a, b in combinations(range(views), 2):
        both = np.minimum(pixels[a], pixels[b])
        slanted = np.minimum(of[a, :, 0], of[b, :, 0]) < np.log(SLANTED)
        seen = np.flatnonzero((both > LEAST) & ~slanted)
        if len(seen) < FEW:
            continue
        seen = seen[:: -(-len(seen) // SAMPLED)]
        by_exposure = np.zeros((len(seen), views))
        by_exposure[:, [a, b]] = -1, 1
        differences = of[b, seen] - of[a, seen]
        known.append(light[b, seen] - light[a, seen] - differences @ prior)
        rows.append(np.hstack([by_exposure, differences]))
        weights.append(np.minimum(both[seen], MOST))
    found = np.zeros((views + len(prior), 3))
    if known:
        goal, system, weight = np.concatenate(known), np.concatenate(rows), np.concatenate(weights)
        weight = now = weight / weight.sum()
        held = np.diag([EXPOSURE_FIRMNESS] * views + [FIRMNESS] * len(prior))
        for _ in range(ROUNDS):
            weighted = system * now[:, None]
            found = np.linalg.solve(weighted.T @ system + held, weighted.T @ goal)
            off = np.abs(goal - system @ found).mean(1)
            now = weight * np.minimum(1, OUTLIER / np.maximum(off, 1e-9))
    return Photometry(found[:views], found[views:] + prior)


def expected(light: Array, of: Array, pixels: Array) -> Array:
    """[V, N, 3] colours that each view would show of each Gaussian by what the others show.

    Arguments as `measured` has them.
    """
    fallen = measured(light, of, pixels).light(of)
    total = np.maximum(pixels.sum(0), 1e-9)[:, None]
    surface = (pixels[..., None] * (light - fallen)).sum(0) / total
    return colours_of(surface + fallen)
