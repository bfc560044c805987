"""The soft tissue around the teeth: gums on both sides, palate, floor, tongue, cheeks."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from gums import Sheet, grid_sheet, smoothstep
from scipy.ndimage import gaussian_filter, gaussian_filter1d, maximum_filter
from scipy.spatial import cKDTree

from .arrange import Row, Tooth
from .options import MouthOptions
from .rays import cast, teeth_scene

Array = npt.NDArray[np.float64]
STEP = 0.3  # mm between the samples of a sheet, away from the gum's edge
FINE = 0.2  # and along it


def gum_edge(teeth: tuple[Tooth, ...], along: Array, options: MouthOptions) -> Array:
    """Height [S] of the gum's edge over the occlusal plane: scallops, papillae, healed gaps."""
    low, step = np.full_like(along, -np.inf), along[1] - along[0]
    for tooth in teeth:
        plan = tooth.plan
        away = np.abs(along - tooth.along) / (plan.width / 2)
        papilla = min(0.46 * tooth.exposed, 4.2) * (0.75 if plan.sort == "molar" else 1.0)
        papilla *= options.papilla
        neck = tooth.edge + tooth.exposed + options.recession * (0.5 + away)
        bow = neck - papilla * np.minimum(away, 1.35) ** 2.4
        low = np.maximum(low, np.where(away < 1.2, bow, -np.inf))
    # Where a tooth is missing the ridge lies at the level of the necks beside it.
    open_ = np.isinf(low)
    place = np.array([tooth.along for tooth in teeth])
    necks = np.array([tooth.edge + tooth.exposed for tooth in teeth])
    level = np.interp(along, place, necks)
    near = np.min(
        [np.abs(along - tooth.along) - tooth.plan.width / 2 for tooth in teeth], axis=0
    )  # [S] distance from the nearest crown
    bridge = np.interp(along, along[~open_], low[~open_])
    share = smoothstep(0.3, 3.5, near)
    low = np.where(open_, bridge * (1 - share) + (level - 1.0) * share, low)
    softer = gaussian_filter1d(low, 1.2 / step, mode="nearest")
    gap = smoothstep(0.0, 1.0, near)
    low = low * (1 - gap) + softer * gap
    return gaussian_filter1d(low, 0.3 / step, mode="nearest") - 0.3


def above_gum(row: Row, tooth: Tooth, options: MouthOptions) -> npt.NDArray[np.int32]:
    """The triangles [M, 3] of a tooth but for those deep under the gum: some would poke out."""
    along = np.arange(-row.arch.reach, row.arch.reach, STEP)
    points = row.arch.at(along)[0]
    flat = cKDTree(points[:, (0, 2)])
    margin = gum_edge(row.teeth, along, options)[flat.query(tooth.vertices[:, (0, 2)])[1]]
    depth = row.up * tooth.vertices[:, 1] - margin
    return tooth.triangles[(depth[tooth.triangles] < 1.1).any(1)]


def _reliefs(row: Row, along: Array, heights: Array) -> tuple[Array, Array]:
    """How far teeth reach outwards and inwards from the arch line at [S, R]: mm, nan where none."""
    scene = teeth_scene(row.teeth)
    points, _, normals = row.arch.at(along)
    found = []
    for start, sign in ((9.0, -1.0), (-16.0, 1.0)):
        origin = points[:, None] + start * normals[:, None]
        origin = origin + row.up * heights[..., None] * (0, 1, 0)
        towards = np.broadcast_to(sign * normals[:, None], origin.shape)
        hit = cast(scene, np.concatenate([origin, towards], -1))["t_hit"].astype(float)
        offset = start + sign * hit
        bad = ~np.isfinite(hit) | (hit > 14)
        found.append(np.where(bad, np.nan, offset))
    return found[0], found[1]


def grow_gum(row: Row, options: MouthOptions, rng: np.random.Generator) -> list[Sheet]:
    """The gum of one jaw: [outer and inner face as one sheet, palate or floor of the mouth]."""
    arch, teeth, up = row.arch, row.teeth, row.up
    child = options.dentition != "permanent"
    first, last = teeth[0], teeth[-1]
    ends = (first.along - first.plan.width / 2 - 5.0, last.along + last.plan.width / 2 + 5.0)
    along = np.arange(max(ends[0], -arch.reach), min(ends[1], arch.reach), FINE)
    depth = np.arange(-1.5, 27.0, STEP)[None]
    margin = gum_edge(teeth, along, options)
    behind = np.maximum(
        along - last.along - last.plan.width / 2, first.along - first.plan.width / 2 - along
    )
    margin = margin + smoothstep(1.5, 5.0, behind) * 6.0
    height = margin[:, None] + depth  # [S, R]
    outer, inner = _reliefs(row, along, height)
    relief = np.where(np.isnan(outer), -4.0, np.maximum(outer, -4.0))

    thick = np.interp(
        along, [tooth.along for tooth in teeth], [tooth.plan.thickness for tooth in teeth]
    )[:, None]
    near = np.min(
        [np.abs(along - tooth.along) - 0.45 * tooth.plan.width for tooth in teeth], axis=0
    )
    lacking = smoothstep(0.3, 3.0, near)[:, None]  # where there is no root
    bridged = gaussian_filter(np.maximum(relief, -1.6), (0.55 / FINE, 0.35 / STEP))
    bridged = np.maximum(bridged, relief - 0.05)
    bridged = gaussian_filter(bridged, (0.25 / FINE, 0.25 / STEP))
    ridges = np.zeros_like(height)
    for tooth in teeth:
        away = (along - tooth.along) / (0.36 * tooth.plan.width)
        strength = 1.3 if tooth.plan.sort == "canine" else 0.8
        ridges += strength * np.exp(-(away[:, None] ** 2)) * np.exp(-np.maximum(depth, 0) / 7)
    bone = -0.75 - 1.8 * lacking * np.exp(-np.maximum(depth, 0) / 6) + ridges
    bone = bone - 0.05 * np.maximum(depth, 0)
    outside = np.logaddexp(5 * (bridged + 0.28), 5 * bone) / 5
    far = smoothstep(2.5, 6.0, depth)
    outside = outside * (1 - far) + np.maximum(bone, bridged + 0.35) * far
    roots = maximum_filter(relief, (int(1.2 / FINE) | 1, int(1.2 / STEP) | 1))
    buried = smoothstep(0.8, 1.6, depth) * np.maximum(roots + 0.35 - outside, 0)
    outside = outside + gaussian_filter(buried, (0.8 / FINE, 0.8 / STEP))
    swell = 0.14 + 0.35 * options.inflamed * rng.random()
    rim = swell * np.exp(-(((depth - 0.9) / 0.7) ** 2))
    covers = smoothstep(-0.35, 0.4, depth)
    crest = -0.5 * thick  # the middle of the ridge
    under = np.where(lacking > 0.5, crest + 1.0, np.minimum(relief, bridged) - 1.0)
    under = np.maximum(gaussian_filter1d(under, 1.0 / FINE, axis=0), crest)
    round_ = smoothstep(-1.5, 1.5, depth) * lacking + covers * (1 - lacking)
    offset = under * (1 - round_) + (outside + rim) * round_

    # The fold, and beyond it the lip held away; the frenum in the middle.
    scale = 0.75 if child else 1.0
    lift = np.maximum(depth - 10.0 * scale, 0) / 6
    offset = offset + 4.0 * lift**2 / (0.35 + lift)
    offset = offset - 0.7 * smoothstep(1.5, 8.0, depth)
    cheek = 0.16 * np.maximum(behind, 0)[:, None] ** 1.4
    offset = offset + cheek * smoothstep(-6.0, 7.0, depth)
    strands = rng.normal(size=len(along))
    strands = gaussian_filter1d(strands, 2.6 / FINE)
    strands = 0.22 * strands / strands.std() * np.exp(-((along / 25) ** 4))
    frenum = 1.6 * np.exp(-((along / 1.2) ** 2)) + strands
    offset = offset + frenum[:, None] * smoothstep(3.0, 11.0 * scale, depth)
    for size, strength in ((2.2, 0.2), (0.8, 0.04)):
        waves = gaussian_filter(rng.normal(size=height.shape), (size / FINE, size / STEP))
        offset = offset + strength * waves / waves.std() * smoothstep(0.3, 6.0, depth)

    # The inner face, from its edge to the palate.
    deep = int(9.0 / STEP)
    within = np.where(np.isnan(inner), 2.0, np.minimum(inner, 2.0))[:, :deep]
    within = np.where(np.isnan(inner[:, :deep]), crest, within)
    bay = gaussian_filter(np.minimum(within, crest * 0.8), (0.7 / FINE, 0.35 / STEP))
    slope = (0.9 if up > 0 else 0.35) * np.maximum(depth[:, :deep] - 2.0, 0)
    inside = np.minimum(bay - 0.35 + 1.2 * lacking, -0.9 * thick + 2.0 * lacking + 0.6) - slope
    covers = smoothstep(-0.4, 0.4, depth[:, :deep]) * (1 - lacking) + lacking * smoothstep(
        -1.5, 2.0, depth[:, :deep]
    )
    inside = (crest - 0.2) * (1 - covers) + inside * covers

    points, _, normals = arch.at(along)

    def world(away: Array, level: Array) -> Array:
        flat = points[:, None] + away[..., None] * normals[:, None]
        return flat + up * level[..., None] * (0, 1, 0)

    near, mid = int(4.5 / STEP), int(9 / STEP)  # rows thin out away from the edge
    thin = np.r_[0:near, near:mid:2, mid : depth.shape[1] : 4]
    thin_in = np.r_[0:near, near : deep - 1 : 2, deep - 1][::-1]
    across = np.concatenate([inside[:, thin_in], offset[:, thin]], 1)
    levels = np.concatenate([height[:, thin_in], height[:, thin]], 1)
    depths = np.concatenate([depth[:, thin_in], depth[:, thin]], 1)
    local = np.stack(
        np.broadcast_arrays(along[:, None], levels, np.repeat(depths, len(along), 0)), -1
    )
    gum = grid_sheet(world(across, levels), local, up > 0)
    rim = world(inside, height[:, :deep])[:, -1]
    coarse = np.r_[0 : len(along) - 1 : 3, len(along) - 1]
    return [gum, _vault(up, along[coarse], rim[coarse], rng)]


def _vault(up: int, along: Array, rim: Array, rng: np.random.Generator) -> Sheet:
    """Palate or floor of the mouth: from the inner gum [S, 3] to the midline."""
    q = np.linspace(0, 1, 28)[None, :, None] ** 1.2
    back = rim[:, 2].min()
    middle = np.stack(
        [
            np.full(len(rim), rim[:, 0].mean()),
            0.5 * (rim[:, 1] + rim[::-1, 1]),
            back + rng.uniform(0.7, 0.85) * (0.5 * (rim[:, 2] + rim[::-1, 2]) - back),
        ],
        -1,
    )
    lift = (rng.uniform(5, 12) if up > 0 else -5.0) * (1 - (1 - q) ** 2.0)
    points = rim[:, None] * (1 - q) + middle[:, None] * q
    if up > 0:  # the folds behind the incisors
        folds = np.sin(points[..., 2] * 1.5 + 1.2 * np.sin(points[..., 0] * 0.45))
        front = smoothstep(back * 0.6, back * 0.25, points[..., 2])
        lift = lift - (0.3 * folds * front * np.sin(np.pi * q[..., 0]))[..., None]
    points = points + up * lift * np.array([0.0, 1.0, 0.0])
    local = np.stack(
        np.broadcast_arrays(along[:, None], up * points[..., 1], 3.0 + 12.0 * q[..., 0]), -1
    )
    return grid_sheet(points, local, up < 0)


def tongue(rows: tuple[Row, Row], rng: np.random.Generator) -> Sheet:
    """A tongue that lies within the lower teeth."""
    row = rows[1]
    line = row.arch.at(np.linspace(row.teeth[0].along, row.teeth[-1].along, 101))[0]
    u, v = np.meshgrid(np.linspace(-1, 1, 60), np.linspace(0, 1, 50), indexing="ij")
    front = float(line[50, 2]) - rng.uniform(8, 14)
    z = front - 70 * v
    room = np.minimum(
        np.interp(z, line[50:, 2][::-1], line[50:, 0][::-1] - line[50, 0]),
        np.interp(z, line[:51, 2], line[50, 0] - line[:51, 0]),
    )
    half = np.maximum(room - 9.0, 2.0) * np.sqrt(np.clip(1 - (1 - np.minimum(1, 4 * v)) ** 2, 0, 1))
    x = float(line[50, 0]) + half * u
    y = -rng.uniform(0, 5) - 9 * (1 - np.sqrt(np.clip(1 - 0.9 * u**2, 0, 1)))
    y = y - 13 * (1 - np.minimum(1, 3.5 * v)) ** 2 - 1.0 * np.exp(-((u / 0.12) ** 2))
    points = np.stack([x, y, z], -1)
    points = points + 0.25 * gaussian_filter(rng.normal(size=points.shape), (2, 2, 0))
    return grid_sheet(points, np.stack([x, z, np.full_like(x, 9.0)], -1))


def cheek(row: Row, side: int, open_degrees: float, rng: np.random.Generator) -> Sheet:
    """A cheek held away from the teeth.

    Args:
        row: of the upper jaw.
        side: +1 for the patient's left cheek, -1 for the right.
        open_degrees: heading of the cheek in plan where it leaves the last molar: 0 straight
            forwards, 90 sideways.
        rng: for its shape.
    """
    last = row.teeth[-1] if side > 0 else row.teeth[0]
    start, tangent, normal = row.arch.at(last.along + side * (last.plan.width / 2 + 3.0))
    start = start + normal * rng.uniform(0.0, 2.5) + side * tangent * rng.uniform(0, 3)
    s = np.linspace(-24, 90, 114)
    turnback = np.radians(open_degrees) * (1 - 0.35 * smoothstep(0, 60, s))
    heading = np.where(s < 0, 0.1, turnback)
    heading = gaussian_filter1d(heading, 3.0)
    x = side * np.cumsum(np.sin(heading)) * (s[1] - s[0])
    z = np.cumsum(np.cos(heading)) * (s[1] - s[0])
    zero = int(np.argmin(np.abs(s)))
    x, z = x - x[zero] + start[0], z - z[zero] + start[2]
    y = np.linspace(-48, 48, 80)[None]
    bulge = (1 - np.clip((y / 48) ** 2, 0, 1)) * rng.uniform(1, 5)
    wave = gaussian_filter(rng.normal(size=(114, 80)), 5) * 6.0
    move = -side * (wave - bulge + 3)
    points = np.stack(np.broadcast_arrays(x[:, None] + move, y, z[:, None]), -1)
    local = np.stack(np.broadcast_arrays(s[:, None] + 200 * side, y, 14.0), -1)
    return grid_sheet(points, local)
