"""Motions in the terms of orthodontics: mesial, buccal, extrusion; tip, torque, rotation."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.fdi import is_left, is_upper, other_side, permanent_of

Array = npt.NDArray[np.float64]

#: The parts of a movement: shift of the crown's middle in mm, then turn about it in degrees. A
#: positive one goes to the mesial side, outwards, out of the gum; the edge goes to the mesial side,
#: the edge goes outwards, the mesial side goes outwards.
PARTS = ("mesial", "buccal", "extrusion", "tip", "torque", "rotation")
#: What the same is called in the other direction.
OPPOSITE = ("distal", "lingual", "intrusion", "tip", "torque", "rotation")


def mouth_axes(centres: Mapping[int, Array]) -> Array:
    """[3, 3] rows: the patient's left, up, and forwards, by where the teeth stand.

    The plane of each jaw's teeth gives what is up, the two sides what is left.

    Args:
        centres: FDI number -> [3] centre of the crown.

    Raises:
        ValueError: the teeth lie on a line, or all on one side.
    """
    numbers = sorted(centres)
    points = np.array([centres[n] for n in numbers])
    upper = np.array([is_upper(n) for n in numbers])
    left = np.array([is_left(n) for n in numbers])
    if left.all() or not left.any() or len(numbers) < 4:
        raise ValueError("teeth of both sides are needed to tell left from right")
    flat = points.copy()
    for jaw in (upper, ~upper):
        if jaw.any():
            flat[jaw] -= points[jaw].mean(0)
    _, size, axes = np.linalg.svd(flat, full_matrices=False)
    if size[1] < 0.05 * size[0]:
        raise ValueError("the teeth lie on a line")
    up = axes[2]
    # Pairs of teeth on both sides say best what is left.
    sideways = np.zeros(3)
    for k, n in enumerate(numbers):
        other = other_side(n)
        if left[k] and other in centres:
            apart = points[k] - centres[other]
            sideways += apart
    if not sideways.any():
        sideways = points[left].mean(0) - points[~left].mean(0)
    sideways -= up * (sideways @ up)
    sideways /= np.linalg.norm(sideways)
    forwards = np.cross(sideways, up)
    place = np.array([permanent_of(n) % 10 for n in numbers], np.float64)
    if upper.any() and not upper.all():
        turned = up @ (points[upper].mean(0) - points[~upper].mean(0)) < 0
    else:  # front teeth lie ahead of the others
        turned = float(np.cov(points @ forwards, place)[0, 1]) > 0
    if turned:
        up, forwards = -up, -forwards
    return np.stack([sideways, up, forwards])


def tooth_axes(centres: Mapping[int, Array]) -> dict[int, Array]:
    """FDI number -> [3, 3] rows mesial, buccal, extrusion, each at the tooth's place on its arch.

    The arch of a jaw is a smooth curve (a polynomial of degree 4, or 2 where teeth are few) through
    the centres, in the plane of the teeth.

    Raises:
        ValueError: as `mouth_axes`.
    """
    mouth = mouth_axes(centres)
    result = {}
    for jaw in (True, False):
        numbers = [n for n in sorted(centres) if is_upper(n) == jaw]
        if not numbers:
            continue
        local = np.array([centres[n] for n in numbers]) @ mouth.T
        x, z = local[:, 0], local[:, 2]
        degree = 4 if len(numbers) >= 8 else 2 if len(numbers) >= 3 else 0
        curve = np.polynomial.Polynomial.fit(x, z, degree)
        slope = curve.deriv()(x) if degree else np.zeros_like(x)
        for n, s in zip(numbers, slope, strict=True):
            tangent = np.array([1.0, 0.0, s]) / np.hypot(1, s)  # towards the left
            buccal = np.array([-s, 0.0, 1.0]) / np.hypot(1, s)
            mesial = -tangent if is_left(n) else tangent
            out_of_gum = np.array([0.0, -1.0 if jaw else 1.0, 0.0])
            result[n] = np.stack([mesial, buccal, out_of_gum]) @ mouth
    return result


def to_parts(axes: Array) -> Array:
    """[6, 6] that leads from a displacement (shift mm, rotation vector rad) to `PARTS`.

    Args:
        axes: [3, 3] of the tooth (see `tooth_axes`).
    """
    hand = np.sign(np.linalg.det(axes))  # a rotation's sign depends on the side of the mouth
    mesial, buccal, extrusion = axes
    matrix = np.zeros((6, 6))
    matrix[:3, :3] = axes
    matrix[3:, 3:] = np.degrees(hand * np.stack([buccal, -mesial, extrusion]))
    return matrix


def words(parts: Array, error: Array) -> str:
    """What a tooth did, in words: the parts that are beyond their error, largest first.

    Args:
        parts: [6] as `PARTS`. error: [6] half of the 95 % interval of each.
    """
    said = []
    sure = [k for k in range(6) if abs(parts[k]) > error[k]]
    for k in sorted(sure, key=lambda k: (k > 2, -abs(parts[k]))):
        if k < 3:
            name = PARTS[k] if parts[k] > 0 else OPPOSITE[k]
            said.append(f"{abs(parts[k]):.2f} mm {name}")
        else:
            said.append(f"{PARTS[k]} {parts[k]:+.1f}°")
    return ", ".join(said) or "no movement beyond the uncertainty"
