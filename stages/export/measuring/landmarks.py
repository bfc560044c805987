"""Landmarks of crowns in 3D, with covariances: from where each photograph shows them, and depth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.dental.fdi import JAWS, is_left, is_upper, other_jaw
from pipeline.artifacts.teeth import Crown, Dentition, filled

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
#: rim: middle of where the crown ends towards the other jaw; tip: the same if that is its biting
#: edge, not covered by the other jaw; edge: the crown's face beside it; centre: middle of the
#: crown's face; mesial: where it meets the other side's central incisor; zenith: where the gum's
#: edge lies highest on the crown (lowest, in the lower jaw).
Name = Literal["tip", "rim", "edge", "centre", "mesial", "zenith"]

#: A landmark is read off a photograph to so many pixels, and this share of the crown's height.
PIXELS, SHARE = 1.0, 0.025
#: Along the ray the same landmark is as sure as the parallax between the photographs that show it
#: makes it; with a single photograph depth is a guess, as good as this sine of a parallax.
LEAST_PARALLAX = 0.05
#: A crown seen at an angle shows a part of its edge only: its middle may be off by this share of
#: the width that is missing.
FORESHORTENED = 0.3
#: Rays that come to the midline from a side by no more than this sine come from in front.
IN_FRONT = 0.42
#: Outlines are nearest to each other where their distance exceeds the least one by no more than
#: this share of a crown's width.
NEAREST = 0.06
#: Rays that come to a back tooth from the other side by more than this sine meet its inner face.
INNER = 0.3
#: The face next to the biting edge is this share of the crown's height inside its outline: the
#: outline itself may be the far side of the edge, seen from above.
INSIDE = 0.08
#: Crowns of two jaws nearer to each other than this share of their height touch in the photograph.
TOUCHING = 0.06
#: Depths that differ by less than this share do not tell which crown is before the other.
SAME_DEPTH = 0.005
#: Depth is taken within this share of the crown's height around a landmark, inside the crown.
REACH = 0.15
#: Where the other jaw covers the edge, depth this near to its crowns (share of the crown's height)
#: may be theirs: it is taken from further inside, from a larger part of the crown. On 20 mouths,
#: from whole runs, the overjet is off by .6 mm with .15 to .3 and .45 to .6, by 1.9 without.
BESIDE, REACH_BEHIND = 0.2, 0.5
_LEAST_PIXELS, _PLANE_PIXELS = 3, 10


@dataclass(frozen=True)
class Landmark:
    """A place with its doubt.

    Attributes:
        point: [3] frame of the exports.
        covariance: [3, 3] of its error, without that of the scale.
        doubt: 0..1, that it is of another tooth than its number says.
    """

    point: Array
    covariance: Array
    doubt: float


@dataclass(frozen=True)
class Sighting:
    """One landmark in one photograph."""

    point: Array
    ray: Array
    across: float
    width: float
    depth: float
    doubt: float


@dataclass(frozen=True)
class Reading:
    """What the photographs show.

    Attributes:
        landmarks: (name, FDI number) -> place.
        covered: teeth whose biting edge the other jaw covers in every photograph that shows them.
    """

    landmarks: Mapping[tuple[Name, int], Landmark]
    covered: frozenset[int]

    @property
    def places(self) -> dict[tuple[Name, int], Array]:
        """(name, FDI number) -> [3]."""
        return {key: mark.point for key, mark in self.landmarks.items()}

    def get(self, name: Name, number: int) -> Landmark | None:
        return self.landmarks.get((name, number))


def read_landmarks(
    dentitions: Sequence[Dentition],
    cameras: Sequence[Camera],
    depths: Sequence[npt.NDArray[np.floating]],
) -> Reading:
    """Lift the landmarks of numbered crowns to 3D and join those of all photographs.

    Args:
        dentitions: one of each placed photograph, in pixels of the image the camera describes.
        cameras: in the frame of the exports.
        depths: [H, W] z of the scene as each camera sees it; 0 where unknown.

    Returns:
        The landmarks that at least one photograph shows with depth.
    """
    sightings: dict[tuple[Name, int], list[Sighting]] = {}
    edges_seen: dict[int, list[bool]] = {}
    for dentition, camera, depth in zip(dentitions, cameras, depths, strict=True):
        crowns = _numbered(dentition, depth)
        meeting = _meeting_places({crown.number: crown for crown, _ in crowns})
        from_jaw = {jaw: _distance_from(dentition.crowns(jaw), dentition.size) for jaw in JAWS}
        for crown, covered in crowns:
            edges_seen.setdefault(crown.number, []).append(not covered)
            inside = filled((crown,), dentition.size)
            usual = (inside, REACH)
            at_rim = usual
            if covered:
                apart = from_jaw[other_jaw(crown.jaw)]
                at_rim = (inside & (apart >= BESIDE * _height(crown)), REACH_BEHIND)
            for name, pixel in (_places(crown, covered) | meeting.get(crown.number, {})).items():
                region = at_rim if name in ("rim", "edge") else usual
                sighting = _lift(crown, pixel, *region, camera, depth)
                if sighting is not None:
                    sightings.setdefault((name, crown.number), []).append(sighting)
    joined = {}
    left = _leftward(sightings)
    for key, seen in sightings.items():
        outside = [sighting for sighting in seen if _shows(key, sighting, left)]
        if outside:
            joined[key] = _joined(outside)
    never = frozenset(number for number, seen in edges_seen.items() if not any(seen))
    return Reading(joined, never)


def _numbered(dentition: Dentition, depth: npt.NDArray[np.floating]) -> list[tuple[Crown, bool]]:
    """The largest crown of each number, and whether the other jaw covers its biting edge."""
    largest: dict[int, Crown] = {}
    for crown in dentition.all_crowns:
        if crown.number and len(crown.outline) >= 3:
            other = largest.get(crown.number)
            if other is None or _area(crown) > _area(other):
                largest[crown.number] = crown
    return [(crown, _covered(crown, dentition, depth)) for crown in largest.values()]


def _height(crown: Crown) -> float:
    """Pixels from the gum to the biting edge."""
    return float(np.linalg.norm(crown.zenith - crown.tip))


def _area(crown: Crown) -> float:
    return float(cv2.contourArea(crown.outline.astype(np.float32)))


def _covered(crown: Crown, dentition: Dentition, depth: npt.NDArray[np.floating]) -> bool:
    """Does a crown end where one of the other jaw begins, that may be nearer to the camera?

    At its tip or along most of its edge: in the notch between two crowns a corner may be free.
    """
    if _covered_at(crown.tip, crown, dentition, depth):
        return True
    places = _along_edge(crown)
    return sum(_covered_at(place, crown, dentition, depth) for place in places) > len(places) / 2


def _along_edge(crown: Crown) -> list[Array]:
    """Pixels [2] where a crown's outline ends towards the other jaw: amid it, and to both sides."""
    down = (crown.tip - crown.zenith) / max(_height(crown), 1e-9)
    outline = np.asarray(crown.outline, np.float64).reshape(-1, 2)
    from_centre = outline - crown.centre
    along, across = from_centre @ down, from_centre @ np.array([-down[1], down[0]])
    middle, half = (across.max() + across.min()) / 2, np.ptp(across) / 2
    near = [np.abs(across - middle - side * half) < 0.25 * half for side in (-0.5, 0.0, 0.5)]
    return [outline[n][np.argmax(along[n])] for n in near if n.any()] or [crown.tip]


def _covered_at(
    place: Array, crown: Crown, dentition: Dentition, depth: npt.NDArray[np.floating]
) -> bool:
    """Does a crown of the other jaw begin at a pixel [2], that may be nearer to the camera?"""
    height = _height(crown)
    others = dentition.crowns(other_jaw(crown.jaw))
    for other in others:
        if len(other.outline) < 3:
            continue
        gap = -cv2.pointPolygonTest(
            other.outline.astype(np.float32), tuple(map(float, place)), True
        )
        if gap > TOUCHING * max(height, _height(other)):
            continue
        mine = _depth_near(place, height * REACH, filled((crown,), dentition.size), depth)
        theirs = _depth_near(place, height * 0.3, filled((other,), dentition.size), depth)
        if mine is None or theirs is None or theirs <= mine * (1 + SAME_DEPTH):
            return True
    return False


def _places(crown: Crown, covered: bool) -> dict[Name, Array]:
    """The pixels [2] of a crown's landmarks."""
    inside = crown.tip + INSIDE * (crown.zenith - crown.tip)
    found: dict[Name, Array] = {"rim": crown.tip, "edge": inside, "centre": crown.centre}
    if not covered:
        found["tip"] = crown.tip
    if not crown.doubtful:  # else the picture's border may have cut it
        found["zenith"] = crown.zenith
    return found


def _meeting_places(crowns: Mapping[int, Crown]) -> dict[int, dict[Name, Array]]:
    """Central incisor -> pixel [2] where it meets that of the other side, or is nearest to it."""
    found: dict[int, dict[Name, Array]] = {}
    for jaw in JAWS:
        sides: tuple[list[Crown], list[Crown]] = ([], [])
        for number, crown in crowns.items():
            if number % 10 == 1 and is_upper(number) == (jaw == "upper"):
                sides[is_left(number)].append(crown)
        if all(sides):
            right, left = (side[0] for side in sides)
            found[right.number] = found[left.number] = {"mesial": _between(right, left)}
    return found


def _between(one: Crown, other: Crown) -> Array:
    """[2] the middle of the stretch along which two outlines are nearest to each other."""
    a, b = (np.asarray(crown.outline, np.float64).reshape(-1, 2) for crown in (one, other))
    apart = np.linalg.norm(a[:, None] - b[None], axis=-1)
    near = apart <= apart.min() + NEAREST * min(one.width, other.width)
    return np.asarray((a[near.any(1)].mean(0) + b[near.any(0)].mean(0)) / 2)


def _depth_near(
    pixel: Array, reach: float, inside: Bools, depth: npt.NDArray[np.floating]
) -> float | None:
    """Depth at a pixel by the plane through what is known around it inside a crown, or None.

    A landmark lies at the crown's border, where depth itself belongs to whatever is behind.
    """
    reach = max(reach, 3.0)
    rows, columns = _window(pixel, reach, depth.shape)
    v, u = np.mgrid[rows, columns] + 0.5
    near = (np.hypot(u - pixel[0], v - pixel[1]) <= reach) & inside[rows, columns]
    z = np.asarray(depth[rows, columns], np.float64)
    near &= np.isfinite(z) & (z > 0)
    if near.sum() < _LEAST_PIXELS:
        return None
    z, u, v = z[near], u[near] - pixel[0], v[near] - pixel[1]
    middle = np.median(z)
    near_it = np.abs(z - middle) <= 3 * np.median(np.abs(z - middle)) + 1e-9 * middle
    z, u, v = z[near_it], u[near_it], v[near_it]
    if len(z) < _PLANE_PIXELS:
        return float(np.median(z))
    plane = np.linalg.lstsq(np.column_stack([u, v, np.ones(len(z))]), z, rcond=None)[0]
    return float(np.clip(plane[2], z.min(), z.max()))


def _window(pixel: Array, reach: float, shape: tuple[int, ...]) -> tuple[slice, slice]:
    low = np.maximum(np.floor(pixel - reach).astype(int), 0)
    high = np.minimum(np.ceil(pixel + reach).astype(int) + 1, (shape[1], shape[0]))
    return slice(low[1], max(high[1], low[1])), slice(low[0], max(high[0], low[0]))


def _distance_from(crowns: tuple[Crown, ...], size: tuple[int, int]) -> npt.NDArray[np.float32]:
    """[H, W] pixels to the nearest of some crowns."""
    free = (~filled(crowns, size)).astype(np.uint8)
    return np.asarray(cv2.distanceTransform(free, cv2.DIST_L2, 5), np.float32)


def _lift(
    crown: Crown, pixel: Array, inside: Bools, reach: float, camera: Camera,
    depth: npt.NDArray[np.floating],
) -> Sighting | None:  # fmt: skip
    """A landmark in one photograph; None: nothing is known of the depth there.

    Args:
        inside, reach: the pixels that depth is taken from, and how far from the landmark, as a
            share of the crown's height.
    """
    height = _height(crown)
    z = _depth_near(pixel, reach * height, inside, depth)
    if z is None:
        return None
    local = np.array([(pixel[0] - camera.cx) / camera.fx, (pixel[1] - camera.cy) / camera.fy, 1])
    point = (local * z - camera.translation) @ camera.rotation
    per_pixel = z / camera.fx
    return Sighting(
        point=point,
        ray=(local / np.linalg.norm(local)) @ camera.rotation,
        across=float(np.hypot(PIXELS, SHARE * height)) * per_pixel,
        width=(0.6 if crown.cut_left or crown.cut_right else 1.0) * crown.width * per_pixel,
        depth=per_pixel * PIXELS,
        doubt=crown.doubt,
    )


def _leftward(sightings: Mapping[tuple[Name, int], Sequence[Sighting]]) -> Array:
    """[3] the patient's left: from the middle of one side's crowns to that of the other's."""
    sides: tuple[list[Array], list[Array]] = ([], [])
    for (name, number), seen in sightings.items():
        if name == "centre":
            sides[is_left(number)].append(np.median([s.point for s in seen], axis=0))
    if not sides[0] or not sides[1]:
        return np.zeros(3)
    left = np.mean(sides[1], axis=0) - np.mean(sides[0], axis=0)
    return np.asarray(left / max(float(np.linalg.norm(left)), 1e-12))


def _shows(mark: tuple[Name, int], sighting: Sighting, left: Array) -> bool:
    """Where two crowns meet is another place from each side: only what sees them from in front.

    And of a back tooth its outer face: through an open bite a photograph shows the inner one.
    """
    name, number = mark
    from_left = float(-sighting.ray @ left)
    if name == "mesial":
        return abs(from_left) < IN_FRONT
    return number % 10 < 4 or from_left * (1 if is_left(number) else -1) > -INNER


def _joined(seen: Sequence[Sighting]) -> Landmark:
    """The place that several photographs agree on: each is sure across its ray, less along it.

    Where they agree less than they should, the covariance grows by as much (reduced chi squared).
    """
    rays = np.array([sighting.ray for sighting in seen])
    cosines = np.clip(rays @ rays.T, -1, 1)
    parallax = float(np.sqrt(1 - np.min(cosines) ** 2))
    widest = max(sighting.width for sighting in seen)
    information, towards = np.zeros((3, 3)), np.zeros(3)
    terms = []
    for sighting in seen:
        missing = FORESHORTENED * (widest - sighting.width)
        along = sighting.depth / max(parallax, LEAST_PARALLAX)
        outer = np.outer(sighting.ray, sighting.ray)
        across = sighting.across**2 + missing**2
        covariance = across * (np.eye(3) - outer) + (along**2 + missing**2) * outer
        inverse = np.linalg.inv(covariance)
        terms.append(inverse)
        information += inverse
        towards += inverse @ sighting.point
    joint: Array = np.asarray(np.linalg.inv(information), np.float64)
    point = joint @ towards
    if len(seen) > 1:
        off = [sighting.point - point for sighting in seen]
        chi = sum(float(o @ inverse @ o) for o, inverse in zip(off, terms, strict=True))
        joint = joint * max(1.0, chi / (3 * len(seen) - 3))
    return Landmark(point, joint, min(sighting.doubt for sighting in seen))
