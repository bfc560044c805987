"""Photographs that are one picture, one of them turned over.

Clinics photograph sides in a mirror, turn the picture over and keep both; to the eye, and to a
reader of teeth, the one is then a photograph of the other side.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]

#: long side of the small copies that are compared, pixels, and spots taken of each
SIDE, SPOTS = 256, 600
#: how much nearer a spot's counterpart is than the next spot like it
RATIO = 0.8
#: pixels of a small copy by which spots may lie beside the similarity
BESIDE = 2.0
#: Two photographs are one picture if so many spots agree in one similarity, and such a share of
#: those that look alike. Of twelve patients' photographs no two have more than 12 and .50; one from
#: the front and itself turned over, faces being nearly symmetrical, 36 and .51. Copies cut by a
#: tenth, of half the size and compressed: 38 and .83 at least. Of those cut by three tenths,
#: smaller and much compressed, 32 of 36 are found.
LEAST_SPOTS, LEAST_SHARE = 16, 0.6


class _Spots(NamedTuple):
    places: Floats  # [N, 2]
    looks: Floats  # [N, 128]


def turned_copies(images: Mapping[int, Floats]) -> list[tuple[int, int]]:
    """Pairs of photographs of which each is the other turned over (its mirror image).

    Args:
        images: [H, W, 3] float32 sRGB in 0..1 of each, by its number.
    """
    small = {number: _small(image) for number, image in images.items()}
    spots = {number: _spots(grey) for number, grey in small.items()}
    turned = {number: _spots(np.ascontiguousarray(grey[:, ::-1])) for number, grey in small.items()}
    return [(a, b) for a, b in combinations(images, 2) if _one_picture(spots[a], turned[b])]


def _small(image: Floats) -> npt.NDArray[np.uint8]:
    scale = min(1.0, SIDE / max(image.shape[:2]))
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return np.rint(255 * cv2.resize(grey, size, interpolation=cv2.INTER_AREA)).astype(np.uint8)


def _spots(grey: npt.NDArray[np.uint8]) -> _Spots:
    found, looks = cv2.SIFT.create(SPOTS).detectAndCompute(grey, None)
    places = np.array([spot.pt for spot in found], np.float32).reshape(-1, 2)
    return _Spots(places, np.asarray([] if looks is None else looks, np.float32).reshape(-1, 128))


def _one_picture(first: _Spots, second: _Spots) -> bool:
    if min(len(first.places), len(second.places)) < LEAST_SPOTS:
        return False
    nearest = cv2.BFMatcher().knnMatch(first.looks, second.looks, k=2)
    alike = [near for near, next_ in nearest if near.distance < RATIO * next_.distance]
    if len(alike) < LEAST_SPOTS:
        return False
    _, agreeing = cv2.estimateAffinePartial2D(
        first.places[[match.queryIdx for match in alike]],
        second.places[[match.trainIdx for match in alike]],
        method=cv2.RANSAC, ransacReprojThreshold=BESIDE,
    )  # fmt: skip
    agreed = 0 if agreeing is None else int(agreeing.sum())
    return agreed >= max(LEAST_SPOTS, LEAST_SHARE * len(alike))
