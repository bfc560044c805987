"""The geometry of our synthetic mouth: teeth along two arches, and the gums they grow from.

Lengths are millimetres. World frame: x towards the patient's left, y up, z out of the mouth. The
sizes are textbook averages (rounded), so that the scene is nobody's mouth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter, gaussian_filter1d

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ToothKind:
    """Shape of one sort of crown.

    The profiles run from the incisal edge (0) over the neck (1) into the root (1.5).

    Attributes:
        width: share of the full width.
        labial, lingual: offset of the two faces from the arch line in mm, positive outwards.
        roundness: exponent of the superellipse that the cross-sections are.
        cusps: how many tips along the arch.
        cusp_height: from the tips to the corners, mm.
        cusp_power: 1 gives a pointed tip, 3 a straight edge.
    """

    width: tuple[float, ...]
    labial: tuple[float, ...]
    lingual: tuple[float, ...]
    roundness: float
    cusps: int
    cusp_height: float
    cusp_power: float


STATIONS = (0.0, 0.06, 0.15, 0.35, 0.6, 0.85, 1.0, 1.15, 1.5)
KINDS = {
    "incisor": ToothKind(
        width=(0.86, 0.95, 0.99, 1.0, 0.95, 0.85, 0.78, 0.72, 0.55),
        labial=(-0.55, -0.18, 0.08, 0.42, 0.72, 0.8, 0.62, 0.1, -2.0),
        lingual=(-1.1, -1.5, -1.8, -2.3, -3.4, -5.4, -6.2, -6.3, -5.6),
        roundness=2.7, cusps=1, cusp_height=0.45, cusp_power=3.2,
    ),
    "canine": ToothKind(
        width=(0.42, 0.66, 0.86, 1.0, 0.96, 0.86, 0.79, 0.73, 0.58),
        labial=(-0.9, -0.3, 0.15, 0.7, 1.1, 1.1, 0.85, 0.2, -1.8),
        lingual=(-1.7, -2.4, -3.0, -4.0, -5.4, -6.9, -7.4, -7.4, -6.6),
        roundness=2.25, cusps=1, cusp_height=1.7, cusp_power=1.5,
    ),
    "premolar": ToothKind(
        width=(0.55, 0.78, 0.92, 1.0, 0.95, 0.85, 0.79, 0.74, 0.6),
        labial=(-2.2, -1.2, -0.6, 0.1, 0.5, 0.55, 0.35, -0.2, -2.0),
        lingual=(-5.5, -6.6, -7.4, -8.2, -8.6, -8.3, -7.9, -7.5, -6.6),
        roundness=2.3, cusps=1, cusp_height=1.5, cusp_power=1.6,
    ),
    "molar": ToothKind(
        width=(0.72, 0.88, 0.95, 1.0, 0.98, 0.91, 0.86, 0.82, 0.72),
        labial=(-2.2, -1.1, -0.5, 0.15, 0.5, 0.5, 0.3, -0.2, -2.0),
        lingual=(-7.0, -8.3, -9.2, -10.0, -10.4, -10.2, -9.8, -9.4, -8.4),
        roundness=2.9, cusps=2, cusp_height=1.3, cusp_power=1.7,
    ),
}  # fmt: skip
SEQUENCE = ("incisor", "incisor", "canine", "premolar", "premolar", "molar", "molar")


@dataclass(frozen=True)
class Jaw:
    """One arch: its sizes and where it lies.

    Attributes:
        up: +1 if the roots point up (upper jaw), -1 if down.
        widths, heights: of the crowns from the midline back.
        edges: how far each tip reaches beyond the occlusal plane (overbite), towards the other jaw.
        half_width, depth: of the arch line, at the last molar.
        setback: how far the arch line lies behind z = 0 in front (overjet).
        torque: inclination of the crowns from the midline back, degrees, outwards at the edge.
    """

    up: int
    widths: tuple[float, ...]
    heights: tuple[float, ...]
    edges: tuple[float, ...]
    half_width: float
    depth: float
    setback: float
    torque: tuple[float, ...]


UPPER = Jaw(
    +1, (8.5, 6.8, 7.6, 7.0, 6.8, 10.0, 9.4), (9.9, 8.7, 9.8, 8.3, 7.7, 7.3, 6.9),
    (1.9, 1.4, 2.0, 1.6, 1.4, 1.3, 1.2), 30.0, 45.0, 0.0, (9, 8, 2, 0, -2, -4, -6),
)  # fmt: skip
LOWER = Jaw(
    -1, (5.3, 5.9, 6.8, 7.0, 7.1, 10.9, 10.3), (8.2, 8.5, 9.8, 8.5, 7.9, 7.4, 7.0),
    (1.0, 1.0, 1.3, 1.2, 1.1, 1.0, 0.9), 28.2, 43.5, 3.1, (4, 3, -1, -3, -5, -6, -7),
)  # fmt: skip


@dataclass(frozen=True)
class Tooth:
    """A tooth where it stands.

    Attributes:
        kind: key of `KINDS`.
        index: 0..13 in the upper jaw, 14..27 in the lower.
        along: position of its middle on the arch line, mm from the midline (left positive).
        width, height: of the crown.
        edge: y of its tip.
        vertices: [N, 3] in the world.
        local: [N, 3] in the tooth: along the arch, from the tip towards the root, outwards.
        triangles: [M, 3].
    """

    kind: str
    index: int
    along: float
    width: float
    height: float
    edge: float
    vertices: Array
    local: Array
    triangles: npt.NDArray[np.int32]


class ArchLine:
    """The line that the labial faces follow, by arc length from the midline."""

    def __init__(self, jaw: Jaw) -> None:
        x = np.linspace(-jaw.half_width * 1.09, jaw.half_width * 1.09, 4001)
        z = -jaw.setback - jaw.depth * np.abs(x / jaw.half_width) ** 2.35
        length = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(z)))])
        self._along, self._x, self._z = length - length[len(x) // 2], x, z
        self._heading = np.unwrap(np.arctan2(np.gradient(z), np.gradient(x)))
        self.reach = float(self._along[-1])

    def at(self, along: npt.ArrayLike) -> tuple[Array, Array, Array]:
        """Points [..., 3] (y = 0), tangents and outward normals at arc lengths [...]."""
        along = np.asarray(along, float)
        zero = np.zeros_like(along)
        heading = np.interp(along, self._along, self._heading)
        points = np.stack(
            [np.interp(along, self._along, self._x), zero, np.interp(along, self._along, self._z)],
            -1,
        )
        tangents = np.stack([np.cos(heading), zero, np.sin(heading)], -1)
        normals = np.stack([-np.sin(heading), zero, np.cos(heading)], -1)
        return points, tangents, normals


def crown_mesh(
    kind: ToothKind, width: float, height: float, random: np.random.Generator, detail: int
) -> tuple[Array, npt.NDArray[np.int32]]:
    """Loft a crown with its root: [N, 3] local vertices and [M, 3] triangles.

    Local frame: x along the arch, y from the tip (0) towards the root, z outwards.
    """
    rows, columns = detail, 2 * detail
    t = 1.3 * np.linspace(0, 1, rows) ** 1.5  # the root ends in the gum
    angle = np.linspace(0, 2 * np.pi, columns, endpoint=False)

    def profile(values: tuple[float, ...]) -> Array:
        smooth = np.interp(np.linspace(0, 1.5, 301), STATIONS, values)
        return np.interp(t, np.linspace(0, 1.5, 301), gaussian_filter1d(smooth, 6, mode="nearest"))

    half = profile(kind.width) * width / 2 * (1 + 0.02 * random.normal(size=1))
    labial, lingual = profile(kind.labial), profile(kind.lingual)
    power = 2 / kind.roundness
    across = np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** power
    outward = np.sign(np.sin(angle)) * np.abs(np.sin(angle)) ** power
    x = half[:, None] * across[None]
    z = (labial + lingual)[:, None] / 2 + (labial - lingual)[:, None] / 2 * outward[None]
    y = np.repeat(t[:, None] * height, columns, 1)

    u = np.clip(2 * x / width, -1, 1)
    if kind.cusps == 2:  # two tips, a groove between them that runs down the outer face
        fall = np.abs(np.abs(2 * (np.abs(u) - 0.47))) ** kind.cusp_power
        groove = np.exp(-((u / 0.13) ** 2)) * np.clip(1 - t / 0.75, 0, 1)[:, None]
        z = z - 0.42 * groove * (outward[None] > 0)
    else:
        skew = 0.1 * random.normal()
        fall = np.abs(u - skew * (1 - np.abs(u))) ** kind.cusp_power
    fade = np.exp(-((t / 0.3) ** 2))[:, None]
    y = y + kind.cusp_height * np.clip(fall, 0, 1.3) * fade
    # Developmental lobes of the front teeth, and some unevenness everywhere.
    lobes = np.cos(3 * np.pi * u) * np.exp(-(((t - 0.3) / 0.35) ** 2))[:, None]
    z = z + (0.09 if kind.cusps == 1 else 0.03) * lobes * (outward[None] > 0)
    bump = gaussian_filter(random.normal(size=x.shape), (detail / 9, detail / 9), mode="wrap")
    z = z + 0.07 * bump / bump.std() * np.clip(t * 6, 0, 1)[:, None]
    y[0] += 0.1

    local = np.stack([x, y, z], -1).reshape(-1, 3)
    fossa = 0.5 + (0.9 if kind.roundness > 2.8 or kind.cusps == 2 else 0.0)
    caps = [local[:columns].mean(0) + np.array([0, fossa, 0]), local[-columns:].mean(0)]
    local = np.concatenate([local, caps])
    i, j = np.mgrid[: rows - 1, :columns]
    a, b = i * columns + j, i * columns + (j + 1) % columns
    c, d = a + columns, b + columns
    sides = np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)]).reshape(-1, 3)
    ring = np.arange(columns)
    following = (ring + 1) % columns
    tip = np.stack([np.full(columns, rows * columns), ring, following], -1)
    last = (rows - 1) * columns
    end = np.stack([np.full(columns, rows * columns + 1), last + following, last + ring], -1)
    return local, np.concatenate([sides, tip, end]).astype(np.int32)


def turn(axis: int, degrees: float) -> Array:
    """[3, 3] rotation about a coordinate axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    matrix = np.eye(3)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = c, -s, s, c
    return matrix


def grow_teeth(jaw: Jaw, random: np.random.Generator, detail: int) -> list[Tooth]:
    """The 14 teeth of a jaw from the patient's right to the left, each a little out of line."""
    line = ArchLine(jaw)
    teeth = []
    for side in (-1, 1):
        reach = 0.04
        for number, kind in enumerate(SEQUENCE):
            width = jaw.widths[number] * (1 + 0.02 * random.normal())
            height = jaw.heights[number] * (1 + 0.03 * random.normal())
            along = side * (reach + width / 2)
            reach += width + max(0.0, 0.08 + 0.07 * random.normal())
            local, triangles = crown_mesh(KINDS[kind], width, height, random, detail)
            twist, tip, torque = random.normal(size=3) * (4.5, 2.0, 2.0)
            if jaw.up < 0 and number < 3:
                twist *= 1.8  # lower front teeth are usually crowded
            frame = turn(1, twist) @ turn(2, tip - side * jaw.up * (3.0 if number < 3 else 1.0))
            frame = frame @ turn(0, -(jaw.torque[number] + torque))
            pivot = np.array([0.0, height * 0.5, -1.5])
            placed = (local - pivot) @ frame.T + pivot
            point, tangent, normal = line.at(along)
            edge = -jaw.up * (jaw.edges[number] + 0.2 * random.normal())
            origin = point + normal * 0.3 * random.normal() + (0, edge, 0)
            axes = np.stack([tangent, (0.0, float(jaw.up), 0.0), normal])
            if jaw.up < 0:  # mirrored frame: keep the triangles facing outwards
                triangles = triangles[:, ::-1].copy()
            index = (7 + number if side > 0 else 6 - number) + (0 if jaw.up > 0 else 14)
            teeth.append(
                Tooth(
                    kind, index, along, width, height, edge,
                    origin + placed @ axes, local, triangles,
                )
            )  # fmt: skip
    return sorted(teeth, key=lambda tooth: tooth.along)


def gum_margin(teeth: list[Tooth], along: Array, up: int) -> Array:
    """Distance of the gum's edge from the occlusal plane, along the arch: scallops and papillae."""
    margin = np.full_like(along, -np.inf)
    for tooth in teeth:
        away = np.abs(along - tooth.along) / (tooth.width / 2)
        papilla = min(0.5 * tooth.height, 4.2) * (0.75 if "molar" in tooth.kind else 1.0)
        scallop = up * tooth.edge + tooth.height - papilla * np.minimum(away, 1.6) ** 2.3
        margin = np.maximum(margin, np.where(away < 1.25, scallop, -np.inf))
    ends = np.isinf(margin)
    margin[ends] = np.interp(along[ends], along[~ends], margin[~ends])
    return gaussian_filter1d(margin, 0.22 / (along[1] - along[0]), mode="nearest")
