"""The frame of a mouth: how its teeth say that it lies.

x leads to the patient's left, y up, z to the front. The occlusal plane (y = 0) is the plane that
comes nearest to the biting edges and cusps of the upper teeth, of the lower ones where too few of
those are seen; x is the direction from teeth of the right side to their counterparts on the left,
of both jaws; the origin is the middle between the edges of the foremost pair (11 and 21, where both
are seen), moved into the plane.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.dental.fdi import (
    JAWS,
    is_primary,
    is_upper,
    other_side,
    permanent_of,
    primary_of,
    teeth_of,
)
from pipeline.artifacts.dental.sizes import TEXTBOOK_DEVIATION, textbook_width
from pipeline.artifacts.teeth import Teeth
from pipeline.artifacts.views import View
from stages.init.scale import depth_near

Array = npt.NDArray[np.float64]
#: ("tip" or "zenith", FDI number of the permanent tooth in that place) -> [3] place in the world.
Places = Mapping[tuple[str, int], Array]

#: Crowns whose number is more doubtful than this say nothing.
MOST_DOUBT = 0.5
#: The depth of a crown's edge is taken this share of the way from its tip to its zenith: at the tip
#: itself it may already be that of what lies behind.
INSIDE = 0.2
#: So many teeth make a plane, and so many pairs the way to the left.
LEAST_TEETH, LEAST_PAIRS = 5, 2
#: An arch must reach this far back, as a share of its width (both as standard deviations), or
#: nothing is known of how the plane leans; and lie this flat, as a share of its depth.
LEAST_DEPTH, LEAST_FLATNESS = 0.15, 0.5
#: So many neighbours side by side tell a scale.
LEAST_NEIGHBOURS = 5
#: Rounds in which teeth that stand out of the plane lose weight.
ROUNDS = 8


def tooth_places(
    teeth: Teeth, views: Sequence[View], cameras: Sequence[Camera],
    depths: Sequence[npt.NDArray[np.float32]],
) -> dict[tuple[str, int], Array]:  # fmt: skip
    """Edges and necks of the numbered teeth in the world, each the median over the photographs.

    Lens distortion that was taken out after the teeth were read is not followed: it moves crowns
    by less than their size.

    Args:
        views: the placed photographs.
        cameras, depths: of each, with z-depth [H, W], 0 where unknown.
    """
    read = {dentition.name: dentition for dentition in teeth.chosen}
    found: dict[tuple[str, int], list[Array]] = {}
    for view, camera, depth in zip(views, cameras, depths, strict=True):
        dentition = read.get(view.name)
        if dentition is None:
            continue
        factor = np.array([view.width, view.height]) / np.array(dentition.size)
        for crown in dentition.all_crowns:
            if not crown.number or crown.doubt > MOST_DOUBT:
                continue
            for kind, near, far in (
                ("tip", crown.tip, crown.zenith), ("zenith", crown.zenith, crown.tip)
            ):  # fmt: skip
                inside = ((1 - INSIDE) * near + INSIDE * far) * factor
                if not ((inside >= 0).all() and (inside < (view.width, view.height)).all()):
                    continue
                z = depth_near(depth, inside)
                if z is not None:
                    ray = (near * factor - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
                    local = z * np.append(ray, 1.0) - camera.translation
                    key = (kind, permanent_of(crown.number))
                    found.setdefault(key, []).append(camera.rotation.T @ local)
    return {key: np.median(places, axis=0) for key, places in sorted(found.items())}


def mouth_frame(places: Places) -> Array | None:
    """[4, 4] rotation and shift from the world to the frame of the mouth; None: it can't be told.

    Args:
        places: edges ("tip") and necks ("zenith") of the teeth.
    """
    tips = {tooth: place for (kind, tooth), place in places.items() if kind == "tip"}
    pairs = [
        (t, other_side(t)) for t in sorted(tips) if t // 10 in (1, 4) and other_side(t) in tips
    ]
    rises = [
        (place - tips[tooth]) * (1 if is_upper(tooth) else -1)
        for (kind, tooth), place in sorted(places.items()) if kind == "zenith" and tooth in tips
    ]  # fmt: skip
    if len(pairs) < LEAST_PAIRS or not rises:
        return None
    rows = [[tooth for tooth in teeth_of(jaw) if tooth in tips] for jaw in JAWS]
    row = next((row for row in rows if len(row) >= LEAST_TEETH), None)
    if row is None:
        return None
    plane = _plane(np.array([tips[tooth] for tooth in row]))
    if plane is None:
        return None
    middle, normal = plane
    up = normal * (np.sign(normal @ np.mean(rises, axis=0)) or 1.0)
    left = np.sum([tips[b] - tips[a] for a, b in pairs], axis=0)
    left = left - (left @ up) * up
    left /= max(float(np.linalg.norm(left)), 1e-30)
    front = np.cross(left, up)
    # Teeth far from the midline stand further back; if not, sides or jaws are mixed up.
    reach = np.array([tooth % 10 for tooth in row], np.float64)
    ahead = np.array([tips[tooth] for tooth in row]) @ front
    if np.cov(reach, ahead)[0, 1] >= 0:
        return None
    jaw_pairs = [pair for pair in pairs if pair[0] in row] or pairs
    foremost = min(jaw_pairs, key=lambda pair: pair[0] % 10)
    origin = (tips[foremost[0]] + tips[foremost[1]]) / 2
    origin = origin - ((origin - middle) @ up) * up
    frame = np.eye(4)
    frame[:3, :3] = np.stack([left, up, front])
    frame[:3, 3] = -frame[:3, :3] @ origin
    return frame


def primary_places(teeth: Teeth) -> frozenset[int]:
    """FDI numbers of the permanent teeth in whose place most photographs show a primary one."""
    seen: dict[int, list[bool]] = {}
    for read in teeth.chosen:
        for crown in read.all_crowns:
            if crown.number and crown.doubt <= MOST_DOUBT:
                seen.setdefault(permanent_of(crown.number), []).append(is_primary(crown.number))
    return frozenset(tooth for tooth, primary in seen.items() if 2 * sum(primary) > len(primary))


def textbook_scale(
    places: Places, primary: frozenset[int] = frozenset()
) -> tuple[float, float] | None:
    """Millimetres per unit by the distances of neighbours' edges, if these are a textbook's.

    Args:
        places: edges ("tip") of the teeth.
        primary: of `primary_places`.

    Returns:
        The factor and its relative standard deviation; None: too few neighbours are seen.

    Source:
        Widths of crowns: `pipeline.artifacts.dental.sizes`.
    """
    ratios = []
    for jaw in JAWS:
        for a, b in pairwise(teeth_of(jaw)):
            if ("tip", a) not in places or ("tip", b) not in places:
                continue
            apart = float(np.linalg.norm(places["tip", b] - places["tip", a]))
            standing = (primary_of(tooth) if tooth in primary else tooth for tooth in (a, b))
            textbook = sum(map(textbook_width, standing)) / 2
            ratios.append(textbook / max(apart, 1e-30))
    if len(ratios) < LEAST_NEIGHBOURS:
        return None
    factor = float(np.median(ratios))
    spread = 1.4826 * float(np.median(np.abs(np.array(ratios) / factor - 1)))
    return factor, float(np.hypot(TEXTBOOK_DEVIATION, 1.2533 * spread / np.sqrt(len(ratios))))


def _plane(points: Array) -> tuple[Array, Array] | None:
    """A point and the normal of the plane nearest to points [N, 3]; None where they tell none."""
    weight = np.ones(len(points))
    middle, axes, spread = points[0], np.eye(3), np.zeros(3)
    for _ in range(ROUNDS):
        share = weight / weight.sum()
        middle = share @ points
        centred = points - middle
        _, singular, axes = np.linalg.svd(np.sqrt(share)[:, None] * centred, full_matrices=False)
        spread = singular
        off = np.abs(centred @ axes[2])
        usual = max(float(np.median(off)), 1e-9 * float(spread[0]), 1e-30)
        weight = 1 / np.maximum(off, usual)
    if spread[1] < LEAST_DEPTH * spread[0] or spread[2] > LEAST_FLATNESS * spread[1]:
        return None
    return middle, axes[2]
