"""Where the teeth stand: two arches that fit their teeth, and each crown a little out of line."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from anatomy import ArchLine, turn

from .crowns import CrownPlan, crown_mesh, plan_crown
from .options import MouthOptions

Array = npt.NDArray[np.float64]

EDGES = {  # how far the tips reach beyond the occlusal plane with an overbite of 2.9 mm
    +1: (1.9, 1.4, 1.9, 1.5, 1.4, 1.3, 1.2, 1.0),
    -1: (1.0, 1.0, 1.3, 1.2, 1.1, 1.0, 0.9, 0.8),
}
TORQUE = {+1: (9, 8, 2, 0, -2, -4, -6, -6), -1: (4, 3, -1, -3, -5, -6, -7, -8)}
FRONT = (1.0, 1.0, 0.85, 0.45, 0.2, 0.05, 0.0, 0.0)  # share of what the front does


class Arch(ArchLine):  # type: ignore[misc]
    """The line that the labial faces follow, by arc length from the midline.

    Args:
        half_width, depth, power: the line is z = -setback - depth |x / half_width| ** power.
        setback: how far it lies behind z = 0 in front, mm.
        centre: x of its middle, mm.
    """

    def __init__(
        self, half_width: float, depth: float, power: float, setback: float, centre: float = 0.0
    ) -> None:
        x = np.linspace(-1.35, 1.35, 3001) * half_width
        z = -setback - depth * np.abs(x / half_width) ** power
        length = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(z)))])
        self._along, self._x, self._z = length - length[len(x) // 2], x + centre, z
        self._heading = np.unwrap(np.arctan2(np.gradient(z), np.gradient(x)))
        self.reach = float(self._along[-1])


def fit_arch(length: float, half_width: float, power: float, setback: float, centre: float) -> Arch:
    """The arch whose arc from the midline to `half_width` has a given length, mm."""
    low, high = 5.0, 80.0
    x = np.linspace(0, 1, 400)
    for _ in range(30):
        depth = (low + high) / 2
        step = np.hypot(np.diff(x * half_width), np.diff(depth * x**power))
        low, high = (depth, high) if step.sum() < length else (low, depth)
    return Arch(half_width, (low + high) / 2, power, setback, centre)


@dataclass(frozen=True)
class Tooth:
    """A tooth where it stands.

    Attributes:
        plan: its number and sizes.
        side: +1 on the patient's left, -1 on the right.
        along: position of its middle on the arch line, mm from the midline (left positive).
        edge: distance of its tip from the occlusal plane towards its root, mm (usually negative).
        exposed: height of the part of the crown that has come through, mm.
        vertices: [N, 3] in the world, mm.
        local: [N, 3] in the tooth, mm (see `crown_mesh`).
        triangles: [M, 3].
        centre: [3] middle of the crown in the world, mm.
        labial: [3] point of the outer face at half height, and
        outward: [3] its direction.
    """

    plan: CrownPlan
    side: int
    along: float
    edge: float
    exposed: float
    vertices: Array
    local: Array
    triangles: npt.NDArray[np.int32]
    centre: Array
    labial: Array
    outward: Array


def quadrant_numbers(quadrant: int, dentition: str, rng: np.random.Generator) -> list[int]:
    """FDI numbers of a quadrant (1..4) from the midline back, whether or not they are missing."""
    if dentition == "permanent":
        return [10 * quadrant + n for n in range(1, 9)]
    milk = [10 * (quadrant + 4) + n for n in range(1, 6)]
    if dentition == "primary":
        return milk
    numbers = [10 * quadrant + 1, 10 * quadrant + 2, *milk[2:], 10 * quadrant + 6]
    if rng.random() < 0.25:
        numbers[1] = milk[1]
    if rng.random() < 0.25:  # the first premolar or the canine has come
        late = int(rng.choice([3, 4]))
        numbers[late - 1] = 10 * quadrant + late
    return numbers


@dataclass(frozen=True)
class Row:
    """One jaw's arch and teeth, from the patient's right to the left."""

    up: int
    arch: Arch
    teeth: tuple[Tooth, ...]


def _plans(
    up: int, options: MouthOptions, rng: np.random.Generator
) -> dict[int, list[tuple[CrownPlan, float]]]:
    """Per side (-1, +1), the crowns from the midline back with the share of their height shown."""
    plans: dict[int, list[tuple[CrownPlan, float]]] = {}
    common: dict[int, float] = {}
    for side in (-1, 1):
        quadrant = {(1, -1): 1, (1, 1): 2, (-1, 1): 3, (-1, -1): 4}[up, side]
        plans[side] = []
        for fdi in quadrant_numbers(quadrant, options.dentition, rng):
            plan = plan_crown(fdi)
            spread = options.size_spread
            alike = common.setdefault(fdi % 10, float(rng.normal()))
            factor = options.size * np.exp(spread * (0.8 * alike + 0.4 * rng.normal()))
            if fdi in (12, 22) and rng.random() < 0.05:
                factor *= 0.75  # peg-shaped
            tall = options.size * options.crown_height * np.exp(0.05 * rng.normal() + 0.03 * alike)
            shown = 1.0
            if options.dentition == "mixed" and not plan.primary and rng.random() < 0.4:
                shown = float(rng.uniform(0.35, 0.95))
            plan = replace(
                plan, width=plan.width * float(factor), height=plan.height * float(tall),
                thickness=plan.thickness * options.size,
            )  # fmt: skip
            plans[side].append((plan, shown))
    return plans


def arrange(options: MouthOptions, rng: np.random.Generator) -> tuple[Row, Row]:
    """The upper and the lower row of teeth."""
    rows = []
    primary = options.dentition == "primary"
    half = {"permanent": 30.0, "primary": 22.6, "mixed": 27.0}[options.dentition]
    half *= options.size * options.arch_width
    torque_of_mouth = rng.normal(size=2) * 4.0
    for up in (1, -1):
        plans = _plans(up, options, rng)
        places: dict[int, list[float]] = {}
        lengths = []
        crowd = max(options.crowding, 0.0) * (1.0 if up < 0 else 0.7)
        loose = max(-options.crowding, 0.0)
        for side in (-1, 1):
            reach = 0.04 + (options.diastema / 2 if up > 0 else 0.0)
            places[side] = []
            for number, (plan, _) in enumerate(plans[side]):
                room = plan.width * (1 - crowd * (1.0 if number < 4 else 0.25))
                if plan.fdi in options.missing and number < 6:
                    room *= rng.uniform(0.25, 1.0) if rng.random() < 0.4 else 1.0
                places[side].append(reach + room / 2)
                gap = max(0.0, 0.05 + 0.06 * rng.normal())
                gap += loose * plan.width * 2 * rng.random() * (1.0 if number < 4 else 0.3)
                if primary and number in ((1, 2) if up > 0 else (2, 3)):
                    gap += 0.8 * rng.random()  # primate spaces
                reach += room + gap
                if number < (5 if primary else 7):
                    length = reach
            lengths.append(length)
        narrow = 0.0 if up > 0 else 1.9
        setback = 0.0 if up > 0 else options.overjet
        centre = 0.0 if up > 0 else options.midline
        length = float(np.mean(lengths))
        if options.dentition == "mixed":
            length *= 56.0 / 47.0
            half_width = half * 1.08 - narrow
        else:
            half_width = half - narrow
        half_width = min(half_width, 0.8 * length)
        arch = fit_arch(length, half_width, options.arch_power, setback, centre)
        bite = (options.overbite - 2.9) / 2
        teeth = []
        for side in (-1, 1):
            for number, (plan, shown) in enumerate(plans[side]):
                if plan.fdi in options.missing:
                    continue
                lean = TORQUE[up][plan.number - 1] * (0.4 if plan.primary else 1.0)
                lean += torque_of_mouth[(1 - up) // 2] * FRONT[number]
                out = -options.cross[(1 + side) // 2] * (1 - FRONT[number]) * (up > 0)
                edge = -(EDGES[up][number] * (0.75 if primary else 1.0) + bite * FRONT[number])
                edge += 0.25 * rng.normal() + (1 - shown) * plan.height
                teeth.append(
                    _place(
                        plan, up, side, arch, side * places[side][number], edge, lean,
                        out, shown, options, rng,
                    )
                )  # fmt: skip
        rows.append(Row(up, arch, tuple(sorted(teeth, key=lambda tooth: tooth.along))))
    return rows[0], rows[1]


def _place(
    plan: CrownPlan, up: int, side: int, arch: Arch, along: float, edge: float, lean: float,
    out: float, shown: float, options: MouthOptions, rng: np.random.Generator,
) -> Tooth:  # fmt: skip
    """Build one crown and put it on its arch."""
    local, triangles = crown_mesh(
        plan, options.wear * rng.uniform(0.5, 1.0), max(options.recession, 0) * 1.5 + 1.6, rng
    )
    back = plan.number >= 6
    calm = 0.35 if back or plan.primary else 1.0
    twist = options.twist * calm * rng.normal() * (1.3 if up < 0 and plan.number < 4 else 1.0)
    tip = options.tilt * calm * rng.normal() + (3.0 if plan.number < 4 else 1.0)
    torque = lean + options.tilt * 0.7 * calm * rng.normal()
    # Local x points to the distal side; in the world's frame of the tooth x is to the left.
    shape = local * (side, 1.0, 1.0)
    frame = turn(1, twist) @ turn(2, -side * tip) @ turn(0, -torque)
    pivot = np.array([0.0, plan.height * 0.5, -plan.thickness * 0.25])
    point, tangent, normal = arch.at(along)
    shift = np.clip(options.shift * calm * rng.normal(size=2), -2.5, 2.5)
    if plan.number == 3 and options.crowding > 0.06 and rng.random() < 0.4:
        shift += (abs(shift[0]) + 1.0, 0.0)  # a canine that found no room stands outside
    origin = point + normal * (shift[0] + out) + (0, up * (edge + 0.15 * shift[1]), 0)
    axes = np.stack([tangent, (0.0, float(up), 0.0), normal])

    def world(points: Array) -> Array:
        return origin + ((points - pivot) @ frame.T + pivot) @ axes

    level = np.array([0.0, plan.height * 0.5, 0.0])
    flipped = triangles[:, ::-1].copy() if side * up < 0 else triangles
    crown = local[:, 1] < plan.height
    vertices = world(shape)
    return Tooth(
        plan, side, along, edge + 0.15 * float(shift[1]), plan.height * shown, vertices, local,
        flipped, vertices[crown].mean(0), world(level[None])[0],
        np.array([0.0, 0.0, 1.0]) @ frame.T @ axes,
    )  # fmt: skip
