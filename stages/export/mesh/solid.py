"""A closed model of a jaw with a flat base, for printing, from the surface that was seen.

Photographs show a jaw from outside. What is behind that surface is made up: so much material, and a
base that grows out of it, away from the other jaw. The seen surface itself stays where it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from stages.export.mesh.field import BLOCK, Field, around_blocks
from stages.export.mesh.nets import zero_surface
from stages.export.mesh.rims import rim_edges
from stages.export.mesh.surface import Mesh, vertex_normals

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Floats = npt.NDArray[np.float32]

#: Grid points of a model, at most; beyond, voxels get larger.
MOST_POINTS = 8_000_000
#: A closest point with this share of border vertices lies on the border of the surface ...
ON_BORDER = 0.999
#: ... behind which there is material within a cone around the normal, of this cosine.
BEHIND = 0.9
#: How often normals are evened out for that.
EVENINGS = 20
#: What is in front of the seen surface is empty so far, as a share of the depth behind it.
FREE = 0.5
#: Made-up parts thinner than twice this many voxels are left out.
THIN = 2
#: The nearest surface is sought for cells of so many points a side first; divides `BLOCK`.
COARSE = 4
#: Points so near to the surface, in voxels, have their true distance.
EXACT = 2.0
#: A vertex goes back onto the seen surface if it is no further from it, in voxels.
SNAP = 0.6
#: The blur, in voxels, that rounds what is made up; its slope there is about 1 / 2.5 a voxel.
BLUR, SLOPE = 1.0, 2.5
#: Next to its other side a point is at least this far from the surface, in voxels.
LEAST = 0.05


@dataclass(frozen=True)
class _Grid:
    """Points of a box: `low` + index * `voxel`, y away from the other jaw."""

    low: Array
    shape: tuple[int, int, int]
    voxel: float

    def points(self, places: npt.NDArray) -> Floats:
        """[N, 3] of places [N, 3], which may lie between the grid's."""
        return (self.low + self.voxel * places).astype(np.float32)


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

    def nearest(self, points: npt.NDArray[np.floating]) -> tuple[Array, Bools, Array, Array]:
        """Of points [N, 3]: the nearest [N, 3], whether it is on the border, distance and cosine.

        The cosine is that of the way from there with the normal there: positive outside. On the
        border it is the normal of what is around.
        """
        asked = np.ascontiguousarray(points, np.float32)
        found = self.scene.compute_closest_points(self.tensor(asked))
        faces = self.mesh.faces[found["primitive_ids"].numpy().astype(np.int64)]
        u, v = found["primitive_uvs"].numpy().astype(np.float64).T
        shares = np.stack([1 - u - v, u, v], 1)[..., None]
        there = (self.mesh.vertices[faces] * shares).sum(1)
        border = (self.border[faces][..., None] * shares).sum((1, 2)) > ON_BORDER
        normals = np.where(border[:, None, None], self.even[faces], self.normals[faces])
        normal = (normals * shares).sum(1)
        way = points - there
        distance = np.linalg.norm(way, axis=1)
        cosine = (way * normal).sum(1) / np.maximum(
            distance * np.linalg.norm(normal, axis=1), 1e-12
        )
        return there, border, distance, cosine

    def around(self, grid: _Grid, reach: float) -> tuple[Bools, Array, Array]:
        """Of a grid's points whether the nearest is on the border, distance and cosine, [X, Y, Z].

        Points further away than `reach`, which are most, are not looked at: they have a distance
        of infinity.
        """
        cells = [size // COARSE for size in grid.shape]
        middles = COARSE * np.indices(cells).reshape(3, -1).T + (COARSE - 1) / 2
        # No point of a cell is further from its middle than this.
        within = grid.voxel * (COARSE - 1) / 2 * np.sqrt(3)
        away = self.scene.compute_distance(self.tensor(grid.points(middles))).numpy()
        close = (away < reach + 1.01 * within).reshape(cells)
        for axis in range(3):
            close = np.repeat(close, COARSE, axis=axis)
        border = np.zeros(grid.shape, bool)
        distance, cosine = np.full(grid.shape, np.inf), np.zeros(grid.shape)
        _, border[close], distance[close], cosine[close] = self.nearest(
            grid.points(np.argwhere(close))
        )
        return border, distance, cosine


def closed(mesh: Mesh, height: float, depth: float, voxel: float) -> Mesh | None:
    """A closed model with a flat base.

    Args:
        mesh: seen surface of a jaw; y leads away from the other jaw.
        height: of the base, beyond the surface.
        depth: of the material behind the surface.
        voxel: of the grid in which it is made, at least. All three in units of the mesh.

    Returns:
        The model: watertight, with normals outwards, where the surface was seen on that surface.
        Without colours (white). None, if nothing solid comes out.
    """
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    room = np.array([2 * depth, depth + height, 2 * depth])
    voxel = max(voxel, float(np.cbrt(np.prod(high - low + room) / MOST_POINTS)))
    # the base ends halfway between two layers of the grid, which goes on beyond it
    margin = np.array([depth, depth, depth]) + 3 * voxel
    low = low - margin
    top = high[1] + height
    layer = int(np.ceil((top - low[1]) / voxel))  # the first beyond the base
    low[1] = top - (layer - 0.5) * voxel
    shape = np.ceil((high + margin - low) / voxel).astype(int) + 1
    shape[1] = layer + 4
    shape = -(-shape // BLOCK) * BLOCK
    grid = _Grid(low, (int(shape[0]), int(shape[1]), int(shape[2])), voxel)
    seen = _Seen(mesh)
    border, distance, cosine = seen.around(grid, max(depth, EXACT * voxel))
    free = (cosine > 0) & ~border & (distance < FREE * depth)
    shell = (distance < depth) & np.where(border, cosine < -BEHIND, cosine <= 0)
    # nothing is nearer to the other jaw than what was seen, nor goes on in front of that
    shell &= np.arange(grid.shape[1])[:, None] >= _tops(grid, mesh.vertices, depth)[:, None]
    last = _last(shell)
    solid = last > _last(free)
    base = int((high[1] - low[1]) / voxel) + 1
    solid[:, base:] = last[:, base:] >= 0  # the base is whole
    ball = ndimage.iterate_structure(ndimage.generate_binary_structure(3, 1), THIN)
    skin = solid & ~border & (cosine <= 0) & (distance < THIN * voxel)
    solid = ndimage.binary_opening(solid, ball) | skin
    solid[:, layer:] = False
    for axis in range(3):  # nothing touches the walls of the box
        np.moveaxis(solid, axis, 0)[[0, -1]] = False
    solid = ndimage.binary_fill_holes(well_composed(_one_piece(solid)))
    if not solid.any():
        return None
    rounded = SLOPE * ndimage.gaussian_filter(0.5 - solid.astype(np.float32), BLUR)
    exact = ~border & (distance < EXACT * voxel)
    values = rounded
    values[exact] = np.sign(cosine[exact]) * distance[exact] / voxel
    values = np.where(solid, np.minimum(values, -LEAST), np.maximum(values, LEAST))
    plane = (np.arange(grid.shape[1]) - (layer - 0.5)).astype(np.float32)
    values = np.maximum(values, plane[None, :, None])
    vertices, faces = zero_surface(_field(values, voxel), 1)
    vertices = vertices + low
    there, on_border, away, _ = seen.nearest(vertices)
    on_surface = ~on_border & (away < SNAP * voxel) & (vertices[:, 1] < top - voxel)
    vertices = np.where(on_surface[:, None], there, vertices)
    return Mesh(vertices, faces, np.ones((len(vertices), 3)))


def _last(marks: Bools) -> npt.NDArray[np.int16]:
    """[X, Y, Z] the last layer along y, up to each point, in which its column has a mark; or -1."""
    layers = np.arange(marks.shape[1], dtype=np.int16)[:, None]
    return np.maximum.accumulate(np.where(marks, layers, np.int16(-1)), axis=1)


def _tops(grid: _Grid, vertices: Array, reach: float) -> npt.NDArray[np.int64]:
    """[X, Z] the first layer in which a vertex lies within `reach` to the sides."""
    places = ((vertices - grid.low) / grid.voxel).astype(np.int64)
    tops = np.full((grid.shape[0], grid.shape[2]), grid.shape[1])
    np.minimum.at(tops, (places[:, 0], places[:, 2]), places[:, 1])
    steps = np.arange(-int(reach / grid.voxel), int(reach / grid.voxel) + 1)
    disc = steps[:, None] ** 2 + steps**2 <= (reach / grid.voxel) ** 2
    return ndimage.minimum_filter(tops, footprint=disc, mode="nearest")


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
