"""Crowns: their sizes by FDI number (textbook averages, rounded), and their meshes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from anatomy import KINDS, STATIONS, ToothKind
from scipy.ndimage import gaussian_filter, gaussian_filter1d

Array = npt.NDArray[np.float64]

# Per jaw from the midline back: width along the arch, height, and thickness of the crown, mm.
PERMANENT = {
    +1: (
        (8.6, 6.8, 7.7, 7.1, 6.8, 10.2, 9.6, 8.8),
        (10.4, 8.9, 10.0, 8.5, 7.9, 7.4, 7.0, 6.4),
        (7.0, 6.0, 8.0, 9.0, 9.0, 11.0, 11.0, 10.0),
    ),
    -1: (
        (5.3, 5.8, 6.9, 7.0, 7.1, 11.0, 10.4, 10.0),
        (8.8, 9.0, 10.3, 8.6, 8.0, 7.4, 7.0, 6.8),
        (5.9, 6.3, 7.6, 7.7, 8.2, 10.4, 10.1, 9.6),
    ),
}
PRIMARY = {
    +1: (
        (6.5, 5.2, 6.8, 7.2, 8.8),
        (6.0, 5.6, 6.5, 5.2, 5.7),
        (5.0, 4.4, 6.6, 8.5, 9.8),
    ),
    -1: (
        (4.2, 4.6, 5.8, 7.8, 9.8),
        (5.2, 5.3, 6.1, 5.8, 5.6),
        (4.0, 4.2, 5.0, 7.2, 8.8),
    ),
}
SORTS = ("incisor", "incisor", "canine", "premolar", "premolar", "molar", "molar", "molar")
PRIMARY_SORTS = ("incisor", "incisor", "canine", "molar", "molar")
BULGE = {"incisor": 7.0, "canine": 8.5, "premolar": 9.2, "molar": 10.9}  # thickness in `KINDS`


@dataclass(frozen=True)
class CrownPlan:
    """One crown before it is placed.

    Attributes:
        fdi: its number.
        up: +1 in the upper jaw, -1 in the lower.
        number: 1 (midline) .. 8.
        primary: whether it is a milk tooth.
        sort: incisor, canine, premolar or molar.
        width, height, thickness: mm.
    """

    fdi: int
    up: int
    number: int
    primary: bool
    sort: str
    width: float
    height: float
    thickness: float


def plan_crown(fdi: int) -> CrownPlan:
    """The textbook crown of an FDI number (11-48, 51-85).

    Raises:
        ValueError: if there is no such tooth.
    """
    quadrant, number = divmod(fdi, 10)
    primary = quadrant >= 5
    up = +1 if quadrant in (1, 2, 5, 6) else -1
    sizes = (PRIMARY if primary else PERMANENT)[up]
    if not 1 <= quadrant <= 8 or not 1 <= number <= len(sizes[0]):
        raise ValueError(f"no such tooth: {fdi}")
    sort = (PRIMARY_SORTS if primary else SORTS)[number - 1]
    return CrownPlan(fdi, up, number, primary, sort, *(float(row[number - 1]) for row in sizes))


def _shape(plan: CrownPlan, rng: np.random.Generator) -> ToothKind:
    """The profiles of one crown: those of its sort, made its own."""
    kind = KINDS[plan.sort]
    if plan.sort == "incisor" and plan.up < 0:  # narrow, widest at the edge
        kind = replace(
            kind, width=(0.93, 0.99, 1.0, 0.97, 0.87, 0.75, 0.68, 0.62, 0.5), cusp_height=0.3
        )
    elif plan.sort == "incisor" and plan.number == 2:  # rounder than the central one
        kind = replace(
            kind, width=(0.74, 0.88, 0.96, 1.0, 0.94, 0.83, 0.75, 0.69, 0.52), cusp_height=0.8,
            cusp_power=2.4, roundness=2.4,
        )  # fmt: skip
    elif plan.sort == "incisor":
        kind = replace(kind, cusp_height=0.35, cusp_power=4.0)
    elif plan.sort == "premolar" and plan.up < 0:
        kind = replace(kind, cusp_height=1.2, cusp_power=1.8)
    if plan.sort in ("premolar", "molar"):  # a wide biting surface
        kind = replace(
            kind, labial=(-1.7, -0.8, -0.35, *kind.labial[3:]),
            lingual=tuple(np.array(kind.lingual) + np.array((-1.1, -0.7, -0.3, 0, 0, 0, 0, 0, 0))),
        )  # fmt: skip
    if plan.primary:  # bulbous, with a narrow neck
        swell = np.array((0.9, 0.97, 1.0, 1.0, 0.98, 0.93, 0.82, 0.74, 0.6))
        labial = np.add(kind.labial, (0, 0, 0.05, 0.1, 0.3, 0.55, 0.2, -0.1, 0))
        kind = replace(
            kind, width=tuple(swell * (0.95 if plan.sort == "incisor" else 1.0)),
            labial=tuple(labial), roundness=2.3, cusp_height=0.7 * kind.cusp_height,
        )  # fmt: skip
    bend = 1 + 0.03 * gaussian_filter1d(rng.normal(size=len(STATIONS)), 1.0)
    scale = plan.thickness / BULGE[plan.sort]
    lingual = np.array(kind.lingual) * scale
    return replace(
        kind, width=tuple(np.array(kind.width) * bend), lingual=tuple(lingual),
        roundness=kind.roundness * float(np.exp(0.06 * rng.normal())),
    )  # fmt: skip


def crown_mesh(
    plan: CrownPlan,
    wear: float,
    root: float,
    rng: np.random.Generator,
    rows: int = 24,
    columns: int = 44,
) -> tuple[Array, npt.NDArray[np.int32]]:
    """Loft a crown with the upper part of its root.

    Args:
        plan: what to build.
        wear: 0..1.
        root: length of the root that is built, mm.
        rng: for what makes each crown its own.
        rows, columns: how fine.

    Returns:
        [N, 3] local vertices, mm (x towards the distal side, y from the tip (0) to the root, z
        outwards), and [M, 3] triangles.
    """
    kind = _shape(plan, rng)
    width, height = plan.width, plan.height
    front = plan.sort in ("incisor", "canine")
    t = (1 + root / height) * np.linspace(0, 1, rows) ** 1.5
    fine = np.linspace(0, 1.5, 301)

    def profile(values: tuple[float, ...]) -> Array:
        smooth = gaussian_filter1d(np.interp(fine, STATIONS, values), 6, mode="nearest")
        return np.interp(t, fine, smooth)

    half, labial, lingual = (profile(v) for v in (kind.width, kind.labial, kind.lingual))
    half = half * width / 2
    # Rows of the sides, and before them rings that close the biting surface.
    inner = np.linspace(0, 1, 2 if front else 9)[:-1]
    ring = np.concatenate([inner, np.ones(rows)])[:, None]  # [R, 1] share of the section
    level = np.concatenate([np.zeros(len(inner)), t])[:, None]
    half, labial, lingual = (
        np.concatenate([np.full(len(inner), v[0]), v])[:, None] for v in (half, labial, lingual)
    )
    angle = np.linspace(0, 2 * np.pi, columns, endpoint=False)
    power = 2 / kind.roundness
    across = (np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** power)[None]
    outward = (np.sign(np.sin(angle)) * np.abs(np.sin(angle)) ** power)[None]
    x = half * across * ring
    z = (labial + lingual) / 2 + (labial - lingual) / 2 * outward * ring
    v = outward * ring

    u = np.clip(2 * x / width, -1, 1)
    cusps = kind.cusp_height * (1 - 0.75 * wear) * np.exp(0.2 * rng.normal())
    skew = 0.16 + 0.1 * rng.normal() if plan.sort != "incisor" else 0.0  # tips lie mesially
    if plan.sort == "incisor":  # the distal corner is rounder
        fall = np.abs(u) ** kind.cusp_power * (1 + 0.5 * u)
    elif kind.cusps == 2:
        fall = np.abs(2 * (np.abs(u + 0.04) - 0.47)) ** kind.cusp_power
    else:
        fall = np.abs(u + skew * (1 - np.abs(u))) ** kind.cusp_power
    y = level * height + cusps * np.clip(fall, 0, 1.5) * np.exp(-((level / 0.3) ** 2))
    if not front:  # inner cusps, the groove between the rows of cusps, ridges at both ends
        inside = 0.5 - 0.5 * np.tanh(4 * v)
        drop = (1.6 if plan.number == 4 and plan.up < 0 else 0.5) * (1 - 0.6 * wear)
        fade = np.exp(-((level / 0.25) ** 2))
        y = y + drop * inside * fade
        depth = (1.6 if plan.sort == "molar" else 1.4) * (1 - 0.7 * wear)
        bowl = 1 - ring**3
        y = y + depth * np.exp(-((v / 0.4) ** 2)) * bowl
        cross = np.exp(-((u / 0.13) ** 2)) + 0.5 * np.exp(-(((np.abs(u) - 0.45) / 0.1) ** 2))
        y = y + 0.5 * cross * bowl * (plan.sort == "molar")
    if kind.cusps == 2:  # grooves that run down the faces
        where = (0.0,) if plan.up > 0 or plan.number != 6 else (-0.28, 0.35)
        for place in where:
            groove = np.exp(-(((u - place) / 0.13) ** 2)) * np.clip(1 - level / 0.75, 0, 1)
            z = z - 0.4 * groove * np.sign(v) * np.abs(v)
    # Developmental lobes of front teeth (worn off with age), and some unevenness everywhere.
    lobes = np.cos(3 * np.pi * u) * np.exp(-(((level - 0.3) / 0.35) ** 2))
    z = z + (0.09 if front else 0.03) * lobes * (v > 0.2) * ring
    if plan.sort == "incisor":
        y = y - 0.18 * (1 - wear) * rng.random() * np.cos(3 * np.pi * u) * np.exp(
            -((level / 0.06) ** 2)
        )
    bump = gaussian_filter(rng.normal(size=x.shape), (2.5, 3.5), mode=("nearest", "wrap"))
    z = z + 0.07 * bump / bump.std() * np.clip(level * 6, 0, 1)

    local = np.stack(np.broadcast_arrays(x, y, z), -1).reshape(-1, 3)
    total = len(level)
    i, j = np.mgrid[: total - 1, :columns]
    a, b = i * columns + j, i * columns + (j + 1) % columns
    c, d = a + columns, b + columns
    faces = np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)]).reshape(-1, 3)
    return local, faces.astype(np.int32)
