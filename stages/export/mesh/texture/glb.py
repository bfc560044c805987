"""Binary glTF 2.0: a mesh with a texture in one file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from stages.export.mesh.texture.atlas import TexturedMesh

#: glTF's numbers for kinds of values and of buffers.
_FLOAT, _UINT = 5126, 5125
_VERTICES, _FACES = 34962, 34963
#: Linear, the second between smaller versions of the texture as well; do not repeat it.
_LINEAR, _MIPMAPS, _EDGE = 9729, 9987, 33071
_MAGIC, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942


def write_glb(path: Path, mesh: TexturedMesh, extras: Mapping[str, Any]) -> None:
    """Write a mesh as .glb. It is not lit by viewers that can leave that out
    (KHR_materials_unlit): photographs have their light.

    Args:
        mesh: in the frame of the file: metres where there is a unit, y up, looked at along -z.
        extras: for `asset.extras`.
    """
    arrays: list[tuple[npt.NDArray[Any], dict[str, Any], int]] = []
    positions = np.asarray(mesh.vertices, "<f4")
    bounds = {"min": positions.min(0).tolist(), "max": positions.max(0).tolist()}
    arrays.append((positions, {"type": "VEC3", "componentType": _FLOAT, **bounds}, _VERTICES))
    vectors = {"type": "VEC3", "componentType": _FLOAT}
    arrays.append((np.asarray(mesh.normals, "<f4"), vectors, _VERTICES))
    places = {"type": "VEC2", "componentType": _FLOAT}
    arrays.append((np.asarray(mesh.places, "<f4"), places, _VERTICES))
    corners = {"type": "SCALAR", "componentType": _UINT}
    arrays.append((np.asarray(mesh.faces, "<u4").ravel(), corners, _FACES))
    content, views, accessors = b"", [], []
    for index, (array, kind, target) in enumerate(arrays):
        data = array.tobytes()
        views.append(
            {"buffer": 0, "byteOffset": len(content), "byteLength": len(data), "target": target}
        )
        accessors.append({"bufferView": index, "count": len(array), **kind})
        content += data
    views.append({"buffer": 0, "byteOffset": len(content), "byteLength": len(mesh.picture)})
    content = _padded(content + mesh.picture, b"\0")
    primitive = {
        "attributes": {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2}, "indices": 3, "material": 0,
    }  # fmt: skip
    material = {
        "name": "photographs",
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": 0}, "metallicFactor": 0.0, "roughnessFactor": 1.0,
        },
        "extensions": {"KHR_materials_unlit": {}},
    }  # fmt: skip
    description = {
        "asset": {"version": "2.0", "generator": "dentalsplat", "extras": dict(extras)},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": path.stem}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [material],
        "textures": [{"source": 0, "sampler": 0}],
        "images": [{"bufferView": len(views) - 1, "mimeType": "image/jpeg"}],
        "samplers": [{"magFilter": _LINEAR, "minFilter": _MIPMAPS, "wrapS": _EDGE, "wrapT": _EDGE}],
        "bufferViews": views,
        "accessors": accessors,
        "buffers": [{"byteLength": len(content)}],
    }
    text = _padded(json.dumps(description, separators=(",", ":"), allow_nan=False).encode(), b" ")
    size = 12 + 8 * 2 + len(text) + len(content)
    head = np.array([_MAGIC, 2, size], "<u4").tobytes()
    parts = [
        np.array([len(data), kind], "<u4").tobytes() + data
        for kind, data in ((_JSON, text), (_BINARY, content))
    ]
    path.write_bytes(head + b"".join(parts))


def _padded(data: bytes, filler: bytes) -> bytes:
    """To a multiple of four bytes, as glTF wants its chunks."""
    return data + filler * (-len(data) % 4)
