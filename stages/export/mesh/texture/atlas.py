"""A texture of pieces of the photographs, for a mesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from stages.export.mesh.surface import Mesh, vertex_normals
from stages.export.mesh.texture.charts import best_photograph, charts
from stages.export.mesh.texture.levelling import levelled
from stages.export.mesh.texture.sight import Sight
from stages.export.pictures.preview import draw

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Numbers = npt.NDArray[np.int32]
Pixels = npt.NDArray[np.uint8]
Bools = npt.NDArray[np.bool_]

#: Pixels of the photograph around each piece, for viewers that mix neighbouring pixels.
MARGIN = 4
#: Pixels square of a face that no photograph shows, with its corners in the middle of three.
PATCH = 4
#: Where they would take more than this share of the largest texture, and the photographs not have
#: room beside them, faces of a colour share one: of ever fewer colours, this far apart.
PATCHES, COLORS_APART = 0.25, (4, 8, 16, 32, 64, 128, 256)
#: Colours at vertices are means over so many pixels square.
SAMPLE = 5
#: Smaller by this factor until all pieces have room.
SHRINK = 0.9
JPEG_QUALITY = 90


@dataclass(frozen=True)
class TexturedMesh:
    """A mesh with places in a picture.

    Attributes:
        vertices, normals: [N, 3]; those on seams are there more than once.
        places: [N, 2] in the picture, 0..1 from its upper left corner.
        faces: [F, 3] int32, in the order of the mesh that it was made of.
        picture: JPEG.
        photographed: [F] whether a photograph shows the face.
    """

    vertices: Array
    normals: Array
    places: Array
    faces: Numbers
    picture: bytes
    photographed: Bools

    def moved(self, similarity: Array) -> TexturedMesh:
        """In the frame that `similarity` [4, 4] leads to."""
        if np.array_equal(similarity, np.eye(4)):
            return self
        linear = similarity[:3, :3]
        rotation = linear / np.cbrt(np.linalg.det(linear))
        vertices = self.vertices @ linear.T + similarity[:3, 3]
        return replace(self, vertices=vertices, normals=self.normals @ rotation.T)

    def part(self, kept: Bools) -> TexturedMesh:
        """The faces where `kept` [F] is True, with the same picture."""
        faces = self.faces[kept]
        used = np.unique(faces)
        number = np.zeros(len(self.vertices), np.int32)
        number[used] = np.arange(len(used), dtype=np.int32)
        return TexturedMesh(
            self.vertices[used], self.normals[used], self.places[used], number[faces],
            self.picture, self.photographed[kept],
        )  # fmt: skip


def textured(
    mesh: Mesh,
    seen: Sequence[Sight],
    pictures: Sequence[Pixels],
    largest: int,
) -> TexturedMesh:
    """Colour a mesh from photographs: each face from the one that shows it best.

    Where two photographs meet, their colours are brought together. Faces that none shows have the
    colours of the mesh's vertices.

    Args:
        mesh: to colour.
        seen: as each of K cameras sees it. pictures: what they took, RGB [H, W, 3].
        largest: width and height of the texture, pixels, at most.
    """
    label, pairs = best_photograph(mesh.faces, seen, pictures)
    colors = np.stack([_at(p, s.pixels) for p, s in zip(pictures, seen, strict=True)])
    added = levelled(mesh.faces, label, colors, mesh.colors * 255)
    even = [
        _corrected(picture, mesh.faces[label == k], seen[k].pixels, added[k])
        for k, picture in enumerate(pictures)
    ]
    chart = np.where(label >= 0, charts(label, pairs), -1)
    pieces = _pieces(mesh.faces, label, chart, seen, pictures)
    unseen = np.flatnonzero(label < 0)
    own = np.clip(mesh.colors * 255 + added[-1], 0, 255)
    return _laid_out(mesh, pieces, even, seen, unseen, own, largest)


def _at(picture: Pixels, pixels: Array) -> Array:
    """[V, 3] colours around places [V, 2] of a picture."""
    height, width = picture.shape[:2]
    column, row = np.clip(pixels, 0, (width - 1, height - 1)).astype(np.int64).T
    return cv2.blur(picture, (SAMPLE, SAMPLE))[row, column].astype(np.float64)


def _corrected(picture: Pixels, faces: Numbers, pixels: Array, added: Array) -> Pixels:
    """A photograph with what is added at the vertices, and nothing but what the faces show.

    Args:
        picture: [H, W, 3].
        faces: [F, 3] that are coloured from it.
        pixels: [V, 2] of the vertices. added: [V, 3].
    """
    height, width = picture.shape[:2]
    flat = np.ones(len(pixels))
    correction = np.zeros((height, width, 3), np.float32)
    drawn = np.zeros((height, width), np.float32)
    for channel in range(3):
        drawn[:] = 0
        plane = np.zeros((height, width), np.float32)
        draw(pixels, flat, added[:, channel], faces, drawn, plane)
        correction[..., channel] = plane
    inside = (drawn > 0).astype(np.uint8)
    if not inside.any():
        return picture
    if inside.all():
        beyond = correction
    else:
        # the nearest pixel that was drawn says what is added beyond
        _, nearest = cv2.distanceTransformWithLabels(
            1 - inside, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        values = np.zeros((int(nearest.max()) + 1, 3), np.float32)
        values[nearest[inside > 0]] = correction[inside > 0]
        beyond = values[nearest]
    even = np.clip(np.rint(picture + beyond), 0, 255).astype(np.uint8)
    around = cv2.dilate(inside, np.ones((2 * MARGIN + 1, 2 * MARGIN + 1), np.uint8)) > 0
    mean = even[inside > 0].mean(0).astype(np.uint8)
    return np.where(around[..., None], even, mean)


@dataclass(frozen=True)
class _Piece:
    """Faces that are coloured from one rectangle of one photograph.

    Attributes:
        faces: numbers of them.
        photograph: number of it.
        left, top, right, bottom: pixels.
    """

    faces: Ints
    photograph: int
    left: int
    top: int
    right: int
    bottom: int

    @property
    def area(self) -> int:
        return (self.right - self.left) * (self.bottom - self.top)


def _pieces(
    faces: Numbers, label: Ints, chart: Ints, seen: Sequence[Sight], pictures: Sequence[Pixels]
) -> list[_Piece]:
    """One rectangle for each chart, or for each photograph where that takes less room."""
    found = []
    order = np.argsort(chart, kind="stable")
    order = order[chart[order] >= 0]
    ends = np.flatnonzero(np.diff(chart[order], append=-2)) + 1
    groups = np.split(order, ends[:-1]) if len(order) else []
    for k, (sight, picture) in enumerate(zip(seen, pictures, strict=True)):
        mine = [group for group in groups if label[group[0]] == k]
        if not mine:
            continue
        single = [_piece(group, k, faces, sight, picture) for group in mine]
        whole = _piece(np.concatenate(mine), k, faces, sight, picture)
        found += [whole] if whole.area <= sum(piece.area for piece in single) else single
    return found


def _piece(group: Ints, k: int, faces: Numbers, sight: Sight, picture: Pixels) -> _Piece:
    height, width = picture.shape[:2]
    pixels = sight.pixels[faces[group]].reshape(-1, 2)
    left, top = np.maximum(np.floor(pixels.min(0)).astype(int) - MARGIN, 0)
    right, bottom = np.minimum(np.ceil(pixels.max(0)).astype(int) + MARGIN, (width, height))
    return _Piece(np.sort(group), k, int(left), int(top), int(right), int(bottom))


@dataclass(frozen=True)
class _Block:
    """Faces that no photograph shows, as one piece of the texture.

    Attributes:
        picture: rows of patches.
        places: [N, 3, 2] of the corners of the faces in it, pixels.
    """

    picture: Pixels
    places: Array

    @property
    def size(self) -> tuple[int, int]:
        height, width = self.picture.shape[:2]
        return width, height


def _arranged(
    pieces: Sequence[_Piece], blocks: Sequence[_Block], largest: int
) -> tuple[list[tuple[int, int]], _Block, list[tuple[int, int]], tuple[int, int]]:
    """Room for all pieces and a block: the first that does without shrinking the pieces more.

    Returns:
        Sizes of the pieces, the block, the upper left corners of these and of that, and width and
        height of all together.
    """
    scale = 1.0
    while True:
        sizes = [
            (max(1, round((p.right - p.left) * scale)), max(1, round((p.bottom - p.top) * scale)))
            for p in pieces
        ]
        for block in blocks:
            corners, width, height = packed([*sizes, block.size], largest)
            if max(width, height) <= largest:
                return sizes, block, corners, (width, height)
        if scale < 1e-2:
            return sizes, blocks[-1], corners, (width, height)
        scale *= SHRINK


def _laid_out(
    mesh: Mesh, pieces: Sequence[_Piece], even: Sequence[Pixels], seen: Sequence[Sight],
    unseen: Ints, own: Array, largest: int,
) -> TexturedMesh:  # fmt: skip
    """Put all pieces into one picture, and say where each face is in it."""
    blocks = _blocks(own[mesh.faces[unseen]], largest)
    sizes, block, corners, (width, height) = _arranged(pieces, blocks, largest)
    picture = np.full((height, width, 3), 128, np.uint8)
    places = np.zeros((len(mesh.faces), 3, 2))
    number = np.full(len(mesh.faces), len(pieces), np.int64)
    for index, (piece, size, corner) in enumerate(zip(pieces, sizes, corners, strict=False)):
        crop = even[piece.photograph][piece.top : piece.bottom, piece.left : piece.right]
        if size != (crop.shape[1], crop.shape[0]):
            smaller = cv2.resize(crop, size, interpolation=cv2.INTER_AREA)
            crop = np.asarray(smaller, np.uint8)
        x, y = corner
        picture[y : y + size[1], x : x + size[0]] = crop
        local = seen[piece.photograph].pixels[mesh.faces[piece.faces]] - (piece.left, piece.top)
        share = np.array(size) / (piece.right - piece.left, piece.bottom - piece.top)
        places[piece.faces] = local * share + corner
        number[piece.faces] = index
    x, y = corners[-1]
    picture[y : y + block.size[1], x : x + block.size[0]] = block.picture
    places[unseen] = block.places + np.array([x, y])
    quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
               cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]  # fmt: skip
    _, jpeg = cv2.imencode(".jpg", picture[..., ::-1], quality)
    # a vertex for each piece that it is in; those of faces without a photograph each by itself
    key = mesh.faces.astype(np.int64) * (len(pieces) + 1) + number[:, None]
    alone = len(mesh.vertices) * (len(pieces) + 1) + 3 * np.arange(len(unseen))[:, None]
    key[unseen] = alone + np.arange(3)
    _, first, faces = np.unique(key, return_index=True, return_inverse=True)
    origin = mesh.faces.ravel()[first]
    return TexturedMesh(
        mesh.vertices[origin], vertex_normals(mesh)[origin],
        places.reshape(-1, 2)[first] / (width, height), faces.reshape(-1, 3).astype(np.int32),
        jpeg.tobytes(), number < len(pieces),
    )  # fmt: skip


def _blocks(colors: Array, largest: int) -> list[_Block]:
    """Faces that no photograph shows, with one patch each; where those are many, with ever fewer.

    Args:
        colors: [N, 3, 3] of their corners, 0..255.
        largest: width and height of the texture, at most.
    """
    block = _patches(colors, largest)
    if block.size[0] * block.size[1] <= PATCHES * largest**2:
        return [block]
    return [block, *(_shared(colors, apart, largest) for apart in COLORS_APART)]


def _shared(colors: Array, apart: int, largest: int) -> _Block:
    """One patch of one colour for all faces whose colours are in the same cell, so wide, of RGB."""
    even = colors.mean(1)
    red, green, blue = (even // apart).astype(np.int64).T
    _, cell, count = np.unique(
        (red << 16) + (green << 8) + blue, return_inverse=True, return_counts=True
    )
    mean = np.stack([np.bincount(cell, channel) for channel in even.T], 1) / count[:, None]
    block = _patches(np.repeat(mean[:, None], 3, 1), largest)
    return replace(block, places=block.places[cell])


def _patches(colors: Array, largest: int) -> _Block:
    """A square of `PATCH` pixels for each of N faces, in rows.

    Args:
        colors: [N, 3, 3] of the corners, 0..255.
        largest: width of the rows, at most.
    """
    count = len(colors)
    across = max(1, min(largest // PATCH, int(np.ceil(np.sqrt(count)))))
    steps = (np.arange(PATCH) - 0.5) / (PATCH - 2)
    right, down = np.meshgrid(np.clip(steps, 0, 1), np.clip(steps, 0, 1))
    a, b, c = (colors[:, k, None, None] for k in range(3))
    shade = a + (b - a) * right[..., None] + (c - a) * down[..., None]
    rows = -(-count // across)
    squares = np.zeros((rows * across, PATCH, PATCH, 3), np.uint8)
    squares[:count] = np.clip(np.rint(shade), 0, 255)
    picture = squares.reshape(rows, across, PATCH, PATCH, 3).swapaxes(1, 2)
    corner = np.stack(np.divmod(np.arange(count), across)[::-1], 1) * PATCH
    offsets = np.array([[1.0, 1.0], [PATCH - 1.0, 1.0], [1.0, PATCH - 1.0]])
    return _Block(picture.reshape(rows * PATCH, across * PATCH, 3), corner[:, None] + offsets)


def packed(
    sizes: Sequence[tuple[int, int]], largest: int
) -> tuple[list[tuple[int, int]], int, int]:
    """Rectangles in rows, the highest first.

    Args:
        sizes: width and height of each.
        largest: width of all together, unless one is wider.

    Returns:
        The upper left corner of each, and width and height of all together: as square as it gets.
    """
    area = sum(w * h for w, h in sizes)
    widest = max(w for w, _ in sizes)
    limit = max(widest, min(largest, int(np.ceil(np.sqrt(1.2 * area)))))
    corners = [(0, 0)] * len(sizes)
    x, y, row, width = 0, 0, 0, 1
    for index in sorted(range(len(sizes)), key=lambda k: (-sizes[k][1], -sizes[k][0], k)):
        w, h = sizes[index]
        if x + w > limit:
            x, y, row = 0, y + row, 0
        corners[index] = (x, y)
        x, row = x + w, max(row, h)
        width = max(width, x)
    return corners, width, max(y + row, 1)
