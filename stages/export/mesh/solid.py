"""A closed model of a jaw with a flat base, for printing, from the surface that was seen.

Photographs show a jaw from outside. What is behind that surface is made up: so much material, as
high as the crowns' edges and rounded off from there, and a base that goes on from the gum, away
from the other jaw. The seen surface itself stays where it is.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from stages.export.mesh.field import BLOCK, Field, around_blocks
from stages.export.mesh.jaws import LEDGE
from stages.export.mesh.nets import zero_surface
from stages.export.mesh.plan import Plan, plan_behind
from stages.export.mesh.rims import even_rims, rim_edges
from stages.export.mesh.surface import Mesh, drop_small_parts, face_normals, vertex_normals

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int64]

#: Grid points of a model, at most; beyond, voxels get larger.
MOST_POINTS = 8_000_000
#: Parts of a jaw smaller than this share of its largest are not made solid.
SMALLEST_PART = 0.05
#: A closest point with this share of border vertices lies on the border of the surface.
ON_BORDER = 0.999
#: How often normals are evened out there.
EVENINGS = 20
#: What is nearest is asked for at every so many points; divides `BLOCK`.
COARSE = 2
#: Points so near to the surface, in voxels, have their true distance ...
EXACT = 2.0
#: ... and those nearer than this are passed by it.
PASSED = 0.75
#: What goes on from layer to layer is evened over so many voxels, and ends within about as many.
GOES_ON, ENDS = 1.5, 2.0
#: Below a border means so steeply below it (cosine).
BELOW = 0.5
#: Made-up parts thinner than twice this many voxels are left out.
THIN = 2
#: A vertex goes back onto the seen surface if it is no further from it, in voxels.
SNAP = 0.6
#: The blur, in voxels, that rounds what is made up; its slope there is about 1 / 2.5 a voxel.
BLUR, SLOPE = 1.5, 3.75
#: Next to its other side a point is at least this far from the surface, in voxels.
LEAST = 0.05


@dataclass(frozen=True)
class _Grid:
    """Points of a box: `low` + index * `voxel`, y away from the other jaw.

    The base ends halfway between two layers, at layer `base`; the grid goes on beyond it.
    """

    low: Array
    shape: tuple[int, int, int]
    voxel: float
    base: float

    @classmethod
    def around(cls, vertices: Array, height: float, depth: float, voxel: float) -> _Grid:
        """A grid for the model of a surface with vertices [V, 3]; see `closed`."""
        low, high = vertices.min(0), vertices.max(0)
        room = np.array([2 * depth, depth + height, 2 * depth])
        voxel = max(voxel, float(np.cbrt(np.prod(high - low + room) / MOST_POINTS)))
        margin = depth + 3 * voxel
        low = low - margin
        top = high[1] + height
        layer = int(np.ceil((top - low[1]) / voxel))
        low[1] = top - (layer - 0.5) * voxel
        shape = np.ceil((high + margin - low) / voxel).astype(int) + 1
        shape[1] = layer + 4
        x, y, z = (-(-shape // BLOCK) * BLOCK).tolist()
        return cls(low, (x, y, z), voxel, layer - 0.5)

    def points(self, places: npt.NDArray) -> Floats:
        """[N, 3] of places [N, 3], which may lie between the grid's."""
        return (self.low + self.voxel * places).astype(np.float32)


@dataclass(frozen=True)
class _Nearest:
    """Of N points what is nearest of the seen surface.

    Attributes:
        there: [N, 3] the nearest point.
        border: [N] whether it is on the border.
        normal: [N, 3] there, unit; on the border that of what is around.
        distance: [N].
        cosine: [N] of the way from there with the normal: positive outside.
        below: [N] whether the way from there leads away from the other jaw.
    """

    there: Array
    border: Bools
    normal: Array
    distance: Array
    cosine: Array
    below: Bools

    def __getitem__(self, chosen: Bools) -> _Nearest:
        return _Nearest(*(getattr(self, each.name)[chosen] for each in fields(self)))


class _Seen:
    """The seen surface, to be asked for its nearest point."""

    def __init__(self, mesh: Mesh) -> None:
        import open3d

        self.mesh = mesh
        self.normals = vertex_normals(mesh)
        self.even = _evened(mesh, self.normals)
        self.border = border_vertices(mesh).astype(np.float64)
        self.scene = open3d.t.geometry.RaycastingScene()
        core: Any = open3d.core  # its stubs lack the arguments' defaults
        self.scene.add_triangles(
            core.Tensor(np.ascontiguousarray(mesh.vertices, np.float32)),
            core.Tensor(np.ascontiguousarray(mesh.faces, np.uint32)),
        )
        self.tensor = core.Tensor

    def nearest(self, points: npt.NDArray[np.floating]) -> _Nearest:
        """What is nearest to points [N, 3]."""
        asked = np.ascontiguousarray(points, np.float32)
        found = self.scene.compute_closest_points(self.tensor(asked))
        faces = self.mesh.faces[found["primitive_ids"].numpy().astype(np.int64)]
        u, v = found["primitive_uvs"].numpy().astype(np.float64).T
        shares = np.stack([1 - u - v, u, v], 1)[..., None]
        there = (self.mesh.vertices[faces] * shares).sum(1)
        border = (self.border[faces][..., None] * shares).sum((1, 2)) > ON_BORDER
        normals = np.where(border[:, None, None], self.even[faces], self.normals[faces])
        normal = (normals * shares).sum(1)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        way = points - there
        distance = np.linalg.norm(way, axis=1)
        cosine = (way * normal).sum(1) / np.maximum(distance, 1e-12)
        return _Nearest(there, border, normal, distance, cosine, way[:, 1] > BELOW * distance)

    def beside(self, grid: _Grid) -> tuple[Ints, _Nearest]:
        """The places [N, 3] of a grid's points within `EXACT` voxels, and what is nearest."""
        cells = [size // BLOCK for size in grid.shape]
        middles = BLOCK * np.indices(cells).reshape(3, -1).T + (BLOCK - 1) / 2
        # No point of a cell is further from its middle than this.
        within = grid.voxel * (BLOCK - 1) / 2 * np.sqrt(3)
        away = self.scene.compute_distance(self.tensor(grid.points(middles))).numpy()
        close = (away < EXACT * grid.voxel + 1.01 * within).reshape(cells)
        for axis in range(3):
            close = np.repeat(close, BLOCK, axis=axis)
        places = np.argwhere(close)
        found = self.nearest(grid.points(places))
        near = found.distance < EXACT * grid.voxel
        return places[near], found[near]


def closed(mesh: Mesh, height: float, depth: float, voxel: float) -> Mesh | None:
    """A closed model with a flat base.

    Args:
        mesh: seen surface of a jaw; y leads away from the other jaw.
        height: of the base, beyond the surface.
        depth: of the material behind the surface.
        voxel: of the grid in which it is made, at least. All three in mm, as the mesh.

    Returns:
        The model: watertight, with normals outwards, where the surface was seen on that surface.
        Without colours (white). None, if nothing solid comes out.
    """
    grid = _Grid.around(mesh.vertices, height, depth, voxel)
    mesh = even_rims(drop_small_parts(_without_ledges(mesh), SMALLEST_PART))
    if not len(mesh):
        return None
    seen = _Seen(mesh)
    places, near = seen.beside(grid)
    passed = near.distance < PASSED * grid.voxel
    plan = plan_behind(places[passed], near.normal[passed], grid.shape, grid.voxel, depth)
    share = _material(grid, seen, plan, depth, places, near)
    solid = share > 0.5
    at = tuple(places.T)
    skin = np.zeros_like(solid)
    skin[at] = solid[at] & ~near.border & (near.cosine <= 0)
    ball = ndimage.iterate_structure(ndimage.generate_binary_structure(3, 1), THIN)
    solid = ndimage.binary_opening(solid, ball) | skin
    solid[:, 0] = False
    for axis in (0, 2):  # nothing touches the walls of the box
        np.moveaxis(solid, axis, 0)[[0, -1]] = False
    solid = ndimage.binary_fill_holes(well_composed(_one_piece(solid)))
    if not solid.any():
        return None
    share = np.where(solid == (share > 0.5), share, solid).astype(np.float32)
    values = SLOPE * ndimage.gaussian_filter(0.5 - share, BLUR)
    exact = ~near.border
    at = tuple(places[exact].T)
    values[at] = (np.sign(near.cosine) * near.distance)[exact] / grid.voxel
    values = np.where(solid, np.minimum(values, -LEAST), np.maximum(values, LEAST))
    beyond = (np.arange(grid.shape[1]) - grid.base).astype(np.float32)
    values = np.maximum(values, beyond[None, :, None])
    vertices, faces = zero_surface(_field(values, grid.voxel), 1)
    vertices = vertices + grid.low
    found = seen.nearest(vertices)
    top = grid.low[1] + grid.base * grid.voxel
    on_surface = ~found.border & (found.distance < SNAP * grid.voxel)
    on_surface &= vertices[:, 1] < top - grid.voxel
    vertices = np.where(on_surface[:, None], found.there, vertices)
    return Mesh(vertices, faces, np.ones((len(vertices), 3)))


def _without_ledges(mesh: Mesh) -> Mesh:
    """The mesh without the faces that look away from the other jaw, from its rims on: in front of
    these there would be no base."""
    normals = face_normals(mesh)
    away = normals[:, 1] > LEDGE * np.linalg.norm(normals, axis=1)
    touched = border_vertices(mesh)
    while True:
        ledge = away & touched[mesh.faces].any(1)
        more = mesh.faces[ledge]
        if touched[more].all():
            return replace(mesh, faces=mesh.faces[~ledge])
        touched[more] = True


def _material(
    grid: _Grid, seen: _Seen, plan: Plan, depth: float, places: Ints, near: _Nearest
) -> Floats:
    """[X, Y, Z] how much of each point is material, 0..1, up to the base and beyond.

    Behind the surface there is what the plan says, in front of it nothing. Beyond its border, away
    from the other jaw, goes on what was there the layer before, evened out more and more.

    Args:
        places, near: see `_Seen.beside`.
    """
    columns = plan.share > 0
    width, length = (size // COARSE for size in columns.shape)
    cells = np.asarray(columns.reshape(width, COARSE, length, COARSE).any((1, 3)))
    asked = np.repeat(cells[:, None, :], grid.shape[1] // COARSE, axis=1)
    found = seen.nearest(grid.points(COARSE * np.argwhere(asked) + (COARSE - 1) / 2))

    def goes_on(one: _Nearest) -> Bools:
        return (one.distance > depth) | (one.border & (one.below | (one.cosine > 0)))

    def spread(values: Bools) -> Bools:
        whole = np.zeros(asked.shape, bool)
        whole[asked] = values
        for axis in range(3):
            whole = np.repeat(whole, COARSE, axis=axis)
        return whole

    going_on, free = spread(goes_on(found)), spread(~found.border & (found.cosine > 0))
    at = tuple(places.T)
    going_on[at], free[at] = goes_on(near), ~near.border & (near.cosine > 0)
    slope = np.hypot(ENDS, np.sqrt(2 * np.pi) * GOES_ON) / ENDS
    share = np.zeros(grid.shape, np.float32)
    before = share[:, 0]
    for layer in range(grid.shape[1]):
        behind = np.minimum(plan.share, np.clip((layer - plan.top) / ENDS + 0.5, 0, 1))
        even = ndimage.gaussian_filter(before, GOES_ON)
        gone_on = np.clip(slope * (even - 0.5) + 0.5, 0, 1)
        behind[free[:, layer]] = 0
        before = share[:, layer] = np.where(going_on[:, layer], gone_on, behind)
    return share


def border_vertices(mesh: Mesh) -> Bools:
    """[V] whether a vertex is on an edge that only one face has."""
    found = np.zeros(len(mesh.vertices), bool)
    found[rim_edges(mesh.faces)] = True
    return found


def _evened(mesh: Mesh, normals: Array) -> Array:
    """[V, 3] normals as means over what is around."""
    from scipy.sparse import coo_matrix

    count = len(mesh.vertices)
    start = mesh.faces[:, [0, 1, 2, 1, 2, 0]].ravel()
    end = mesh.faces[:, [1, 2, 0, 0, 1, 2]].ravel()
    ties = coo_matrix((np.ones(len(start)), (start, end)), (count, count)).tocsr()
    shares = 1 / (1 + np.asarray(ties.sum(1)))
    for _ in range(EVENINGS):
        normals = (normals + ties @ normals) * shares
    return normals


def is_closed(mesh: Mesh) -> bool:
    """Has every edge two faces, one in each direction, and is the volume positive?"""
    start, end = mesh.faces[:, [0, 1, 2]].ravel(), mesh.faces[:, [1, 2, 0]].ravel()
    there = np.sort(start.astype(np.int64) * len(mesh.vertices) + end)
    back = np.sort(end.astype(np.int64) * len(mesh.vertices) + start)
    if not len(mesh) or (np.diff(there) == 0).any() or not np.array_equal(there, back):
        return False
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return bool((a * np.cross(b, c)).sum() > 0)


def _one_piece(solid: Bools) -> Bools:
    """The largest connected piece, without hollows inside."""
    pieces, count = ndimage.label(solid)
    if count == 0:
        return solid
    sizes = np.bincount(pieces.ravel())
    sizes[0] = 0
    return np.asarray(ndimage.binary_fill_holes(pieces == sizes.argmax()))


def well_composed(solid: Bools) -> Bools:
    """Voxels added until none touch along an edge or at a corner alone.

    The surface of what comes out passes each edge and each vertex once (Latecki, Eckhardt and
    Rosenfeld 1995, "Well-composed sets").

    Args:
        solid: [X, Y, Z], nothing at the walls.
    """
    solid = solid.copy()
    while True:
        added = np.zeros_like(solid)
        for one, other in ((0, 1), (0, 2), (1, 2)):
            squares = [_shifted(solid, {one: i, other: j}) for i in (0, 1) for j in (0, 1)]
            a, b, c, d = squares
            crossed = ((a & d) & ~(b | c)) | ((b & c) & ~(a | d))
            for i in (0, 1):
                for j in (0, 1):
                    _shifted(added, {one: i, other: j})[crossed] = True
        corners = {
            (i, j, k): _shifted(solid, {0: i, 1: j, 2: k})
            for i in (0, 1) for j in (0, 1) for k in (0, 1)
        }  # fmt: skip
        total = sum(part.astype(np.int8) for part in corners.values())
        for (i, j, k), part in corners.items():
            opposite = corners[1 - i, 1 - j, 1 - k]
            alone = (part & opposite & (total == 2)) | (~part & ~opposite & (total == 6))
            for p, q, r in corners:
                _shifted(added, {0: p, 1: q, 2: r})[alone] = True
        if not (added & ~solid).any():
            return solid
        solid |= added


def _shifted(values: Bools, steps: dict[int, int]) -> Bools:
    """A view without the last (step 0) or the first (step 1) layer along each axis named."""
    parts = [slice(None)] * 3
    for axis, step in steps.items():
        parts[axis] = slice(step, values.shape[axis] - 1 + step)
    return values[tuple(parts)]


def _field(values: Floats, voxel: float) -> Field:
    """A dense grid as a field: the blocks where its sign changes, and those around them."""
    inside = values < 0
    mixed = ndimage.binary_dilation(inside, np.ones((3, 3, 3))) & ~ndimage.binary_erosion(
        inside, np.ones((3, 3, 3))
    )
    shape = tuple(size // BLOCK for size in values.shape)

    def by_block(array: npt.NDArray) -> npt.NDArray:
        cut = array.reshape(shape[0], BLOCK, shape[1], BLOCK, shape[2], BLOCK)
        return cut.transpose(0, 2, 4, 1, 3, 5)

    used = ndimage.binary_dilation(by_block(mixed).any((3, 4, 5)), np.ones((3, 3, 3)))
    blocks = np.argwhere(used).astype(np.int64)
    chosen = np.ascontiguousarray(by_block(values)[used], np.float32)
    return Field(voxel, blocks, around_blocks(blocks), chosen, np.ones_like(chosen))
