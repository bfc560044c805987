"""Mesh files: coloured PLY and binary STL."""

from __future__ import annotations

from pathlib import Path

import numpy as np

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
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("corners", "<i4", (3,))])
    faces["count"], faces["corners"] = 3, mesh.faces
    # plyfile writes lists one by one
    columns = [f"property float {name}" for name in names]
    columns += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header = [
        "ply", "format binary_little_endian 1.0",
        f"element vertex {len(rows)}", *columns,
        f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", "",
    ]  # fmt: skip
    path.write_bytes("\n".join(header).encode("ascii") + rows.tobytes() + faces.tobytes())


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
