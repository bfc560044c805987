"""Two visits in one frame: by the teeth of the same number, whatever some of them have done since;
then crowns laid onto crowns by their shape alone (ICP, point to plane)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from pipeline.geometry.similarity import robust_similarity, similarity
from pipeline.studies.register import solving
from pipeline.studies.register.visit import Visit

Array = npt.NDArray[np.float64]

#: Sets of teeth that are tried, and teeth of each.
TRIES, SAMPLE = 400, 4
#: A tooth agrees with a frame if its centre is met within this, mm.
NEAR = 1.2
#: Two visits of a patient differ at most so much in scale (each may be off by 10 % and more).
MOST_SCALE = 1.4
#: Points of a crown that are laid on, and those they are laid onto.
POINTS, TARGET = 500, 6000
#: Neighbours that a normal comes from.
NEIGHBOURS = 24
#: Share of the points that count, the nearest ones: outlines differ from visit to visit.
KEPT = 0.8
ROUNDS = 25
#: So many of a crown's points say something of their own: errors of depth go over whole faces.
INDEPENDENT = 15
#: A point of a good surface is off by this, mm.
DEVIATION = 0.1
#: A crown's motion by shape is held to no motion by this many mm: faces slide along each other.
LOOSE = 1.0


@dataclass(frozen=True)
class Laid:
    """A crown laid onto the other visit's.

    Attributes:
        displacement: [6] shift of its centre (mm) and rotation vector (rad).
        information: [6, 6] how sure that is; small where faces slide along each other.
        residual: root mean square distance of the points that count, mm.
    """

    displacement: Array
    information: Array
    residual: float


@dataclass(frozen=True)
class Target:
    """Points [N, 3] of a crown with normals [N, 3], and a tree of the points."""

    points: Array
    normals: Array
    tree: cKDTree


def target_of(points: Array) -> Target:
    """Get a crown ready to lay others onto."""
    points = points[np.linspace(0, len(points) - 1, min(len(points), TARGET)).astype(int)]
    tree = cKDTree(points)
    near = tree.query(points, min(NEIGHBOURS, len(points)))[1]
    off = points[near] - points[near].mean(1, keepdims=True)
    _, axes = np.linalg.eigh(np.swapaxes(off, 1, 2) @ off)
    # Points in the middle of their neighbours: noise along the normal is averaged.
    smooth = points + axes[..., 0] * ((points[near].mean(1) - points) * axes[..., 0]).sum(
        1, keepdims=True
    )
    return Target(smooth, axes[..., 0], cKDTree(smooth))


def lay(source: Array, target: Target, start: Array, centre: Array) -> Laid:
    """Lay a crown onto another.

    Args:
        source: [N, 3] its points, mm.
        target: in the same frame.
        start: [4, 4] motion to begin with.
        centre: [3] that its displacement is given at.
    """
    source = source[np.linspace(0, len(source) - 1, min(len(source), POINTS)).astype(int)]
    motion = start
    lever = solving.LEVER**2
    loose = np.diag([1.0] * 3 + [lever] * 3) / LOOSE**2
    share = INDEPENDENT / (KEPT * len(source)) / DEVIATION**2
    matrix, residual = np.eye(6), 0.0
    for _ in range(ROUNDS):
        moved = source @ motion[:3, :3].T + motion[:3, 3]
        distance, nearest = target.tree.query(moved)
        used = distance <= np.quantile(distance, KEPT)
        points, nearest = moved[used], nearest[used]
        normals = target.normals[nearest]
        off = ((target.points[nearest] - points) * normals).sum(1)
        size = max(1.5 * float(np.median(np.abs(off))), 0.02)
        weight = np.minimum(1, size / np.maximum(np.abs(off), 1e-9))
        about = points - (motion[:3, :3] @ centre + motion[:3, 3])
        jacobian = np.concatenate([normals, np.cross(about, normals)], 1)
        pulled = weight[:, None] * jacobian
        matrix = share * pulled.T @ jacobian
        drift = solving.displacement(motion, centre)
        vector = share * pulled.T @ off - loose @ drift
        change = np.linalg.solve(matrix + loose, vector)
        motion = solving.moved_tooth(motion, change, centre)
        residual = float(np.sqrt(np.mean(off**2)))
        if solving.travel(change) < 1e-4:
            break
    return Laid(solving.displacement(motion, centre), matrix, residual)


def first_frame(
    source: Mapping[int, Array], target: Mapping[int, Array], seed: int = 0
) -> tuple[Array, list[int]]:
    """The similarity that brings most teeth of one visit onto the same teeth of the other.

    RANSAC over sets of four teeth, then least squares of the distances over those that agree.

    Args:
        source, target: FDI number -> [3] centre of the crown, mm.
        seed: of the sets.

    Returns:
        [4, 4] target_from_source, and the numbers of the teeth that agree with it.

    Raises:
        ValueError: fewer than four teeth in common, or none that agree.
    """
    numbers = sorted(set(source) & set(target))
    if len(numbers) < SAMPLE:
        raise ValueError(f"{len(numbers)} teeth in common")
    a = np.array([source[n] for n in numbers])
    b = np.array([target[n] for n in numbers])
    rng = np.random.default_rng(seed)
    best, found = -np.inf, None
    for _ in range(TRIES):
        sample = rng.choice(len(numbers), SAMPLE, replace=False)
        weight = np.zeros(len(numbers))
        weight[sample] = 1
        scale, rotation, shift = similarity(a, b, weight)
        if not 1 / MOST_SCALE < scale < MOST_SCALE:
            continue
        off = np.linalg.norm(b - scale * a @ rotation.T - shift, axis=1)
        score = float(np.maximum(1 - (off / NEAR) ** 2, 0).sum())
        if score > best:
            best, found = score, off < NEAR
    if found is None or found.sum() < 3:
        raise ValueError("no frame agrees with three teeth")
    weight = found.astype(float)
    scale, rotation, shift = robust_similarity(a, b, weight)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = scale * rotation, shift
    return matrix, [n for n, agrees in zip(numbers, found, strict=True) if agrees]


def refined_frame(
    first: Visit, second: Visit, frame: Array, agreeing: Sequence[int], rounds: int = 15
) -> Array:
    """[4, 4] first_from_second by the surfaces of teeth that agree, from one by their centres."""
    numbers = [n for n in agreeing if n in first.teeth and n in second.teeth]
    if len(numbers) < 3:
        return frame
    targets = {n: target_of(first.teeth[n]) for n in numbers}
    source = {
        n: second.teeth[n][
            np.linspace(0, len(second.teeth[n]) - 1, min(len(second.teeth[n]), POINTS)).astype(int)
        ]
        for n in numbers
    }
    for _ in range(rounds):
        a, b, weights = [], [], []
        for n in numbers:
            moved = source[n] @ frame[:3, :3].T + frame[:3, 3]
            distance, nearest = targets[n].tree.query(moved)
            near = distance <= np.quantile(distance, KEPT)
            normal = targets[n].normals[nearest[near]]
            along = ((targets[n].points[nearest[near]] - moved[near]) * normal).sum(1)
            a.append(source[n][near])
            b.append(moved[near] + along[:, None] * normal)
            size = np.full(len(along), float(np.median(np.abs(along))))
            weights.append(1 / np.maximum(size, 0.05) ** 2 / len(along))
        scale, rotation, shift = similarity(
            np.concatenate(a), np.concatenate(b), np.concatenate(weights)
        )
        frame = np.eye(4)
        frame[:3, :3], frame[:3, 3] = scale * rotation, shift
    return frame


def laid_crowns(
    first: Visit, second: Visit, first_from_second: Array, agreeing: Sequence[int]
) -> dict[int, Laid]:
    """FDI number -> the first visit's crown laid onto the second's, in the first visit's frame."""
    found = {}
    for number in sorted(set(first.teeth) & set(second.teeth)):
        there = second.teeth[number] @ first_from_second[:3, :3].T + first_from_second[:3, 3]
        centre = first.centres[number]
        start = np.eye(4)
        apart = np.median(there, axis=0) - centre
        if number not in agreeing and np.linalg.norm(apart) < 4:
            start[:3, 3] = apart
        found[number] = lay(first.teeth[number], target_of(there), start, centre)
    return found


def inverted(frame: Array) -> Array:
    """[4, 4] the way back."""
    return np.asarray(np.linalg.inv(frame), np.float64)
