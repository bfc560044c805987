"""Mesh files: coloured PLY and binary STL."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.gaussians import ply_comment
from pipeline.artifacts.space.scale import Scale
from stages.export.mesh.surface import Mesh, face_normals, vertex_normals

#: What the name of a mesh ends with if nothing can be measured on it.
WITHOUT_SCALE = "_without_scale"
#: Bytes of the header of a binary STL.
STL_HEADER = 80


def mesh_name(stem: str, suffix: str, scale: Scale) -> str:
    """The name of a mesh file: ``mesh.stl``, or ``mesh_without_scale.stl``."""
    return f"{stem}{'' if scale.unit == 'mm' else WITHOUT_SCALE}.{suffix}"


def faces_of(mesh: Mesh, kept: npt.NDArray[np.bool_]) -> Mesh:
    """Some faces of a mesh, [F] True: kept, and their vertices."""
    used = np.unique(mesh.faces[kept])
    number = np.zeros(len(mesh.vertices), np.int32)
    number[used] = np.arange(len(used), dtype=np.int32)
    return Mesh(mesh.vertices[used], number[mesh.faces[kept]], mesh.colors[used])


def moved(mesh: Mesh, similarity: npt.NDArray[np.float64]) -> Mesh:
    """The mesh in the frame that `similarity` [4, 4] leads to."""
    if np.array_equal(similarity, np.eye(4)):
        return mesh
    vertices = mesh.vertices @ similarity[:3, :3].T + similarity[:3, 3]
    return replace(mesh, vertices=vertices.astype(mesh.vertices.dtype))


def write_mesh_ply(path: Path, mesh: Mesh, comments: Iterable[str] = ()) -> None:
    """Write binary PLY: x y z nx ny nz red green blue, and triangles.

    Args:
        comments: lines for the header.
    """
    names = ["x", "y", "z", "nx", "ny", "nz"]
    fields = [(n, "<f4") for n in names] + [(n, "u1") for n in ("red", "green", "blue")]
    rows = np.empty(len(mesh.vertices), fields)
    normals = vertex_normals(mesh)
    for index, (position, normal) in enumerate(zip(names[:3], names[3:], strict=True)):
        rows[position] = mesh.vertices[:, index]
        rows[normal] = normals[:, index]
    eight_bit = np.clip(np.rint(mesh.colors * 255), 0, 255).astype(np.uint8)
    for index, channel in enumerate(("red", "green", "blue")):
        rows[channel] = eight_bit[:, index]
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("corners", "<i4", (3,))])
    faces["count"], faces["corners"] = 3, mesh.faces
    # plyfile writes lists one by one
    columns = [f"property float {name}" for name in names]
    columns += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header = [
        "ply", "format binary_little_endian 1.0", *map(ply_comment, comments),
        f"element vertex {len(rows)}", *columns,
        f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", "",
    ]  # fmt: skip
    path.write_bytes("\n".join(header).encode("ascii") + rows.tobytes() + faces.tobytes())


def write_stl(path: Path, mesh: Mesh, said: str = "") -> None:
    """Write binary STL (one unit of the file is one world unit; STL has no units).

    Triangles of no area, with two corners in one place, are left out: readers drop them and say so.

    Args:
        said: for the header, which has room for some 65 letters: the scale, above all.
    """
    corners = mesh.vertices[mesh.faces].astype(np.float32)
    solid = (corners != np.roll(corners, 1, 1)).any(2).all(1)
    normals = face_normals(mesh)[solid]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    rows = np.zeros(
        len(normals), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("spare", "<u2")]
    )
    rows["normal"] = normals
    rows["corners"] = corners[solid]
    text = f"dentalsplat {said}".strip().encode("ascii", "replace")[:STL_HEADER]
    header = text.ljust(STL_HEADER, b"\0") + np.array(len(rows), "<u4").tobytes()
    path.write_bytes(header + rows.tobytes())
