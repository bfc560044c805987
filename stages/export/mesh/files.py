"""Mesh files: coloured PLY and binary STL."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement

from stages.export.mesh.surface import Mesh, face_normals, vertex_normals


def write_mesh_ply(path: Path, mesh: Mesh) -> None:
    """Write binary PLY: x y z nx ny nz red green blue, and triangles."""
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
    faces = np.empty(len(mesh.faces), [("vertex_indices", "<i4", (3,))])
    faces["vertex_indices"] = mesh.faces
    elements = [PlyElement.describe(rows, "vertex"), PlyElement.describe(faces, "face")]
    PlyData(elements, byte_order="<").write(str(path))


def write_stl(path: Path, mesh: Mesh) -> None:
    """Write binary STL (one unit of the file is one world unit; STL has no units)."""
    normals = face_normals(mesh)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    rows = np.zeros(
        len(mesh.faces), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("spare", "<u2")]
    )
    rows["normal"] = normals
    rows["corners"] = mesh.vertices[mesh.faces]
    header = b"dentalsplat".ljust(80, b"\0") + np.array(len(rows), "<u4").tobytes()
    path.write_bytes(header + rows.tobytes())
