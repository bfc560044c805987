"""All files of a mesh: together and jaw by jaw, for viewers, slicers and printers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.fdi import Jaw
from pipeline.artifacts.space.frames import Frame
from pipeline.artifacts.space.scale import Scale
from stages.export.mesh.files import faces_of, mesh_name, moved, write_mesh_ply, write_stl
from stages.export.mesh.solid import closed, is_closed
from stages.export.mesh.surface import Mesh, repair
from stages.export.mesh.texture.atlas import TexturedMesh
from stages.export.mesh.texture.glb import write_glb
from stages.export.orientation import file_from_frame

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

#: Voxels in which closed models are made, mm.
MODEL_VOXEL = 0.3
#: Turns the lower jaw so that y leads away from the upper one.
_LOWER_UP = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Writer:
    """Where files go, and how.

    Attributes:
        folder: for the files.
        frame, scale: of the exports.
    """

    folder: Path
    frame: Frame
    scale: Scale

    def surface(self, stem: str, mesh: Mesh, colored: TexturedMesh | None) -> None:
        """A mesh with colours, for slicers, and with the photographs on it; named so where nothing
        can be measured on it."""
        comments = [f"dentalsplat: {self.scale.text}"]
        write_mesh_ply(self.folder / mesh_name(stem, "ply", self.scale), mesh, comments)
        self.plain(stem, mesh, "z up" if self.frame.stands else "")
        if colored is not None:
            name = mesh_name(stem, "glb", self.scale)
            extras = {"scale": self.scale.as_dict(), "frame": self.frame.name}
            write_glb(self.folder / name, colored.moved(self._turned(name)), extras)

    def plain(self, stem: str, mesh: Mesh, lies: str = "") -> None:
        """The shape alone, as .stl, whose header may say how it lies."""
        name = mesh_name(stem, "stl", self.scale)
        said = ", ".join(filter(None, (self.scale.short, lies)))
        write_stl(self.folder / name, moved(mesh, self._turned(name)), said)

    def _turned(self, name: str) -> Array:
        frame = self.frame
        return file_from_frame(name, frame.stands, self.scale.unit == "mm", frame.to_mouth)


def write_meshes(
    writer: Writer, mesh: Mesh, colored: TexturedMesh | None, jaws: Mapping[Jaw, Bools]
) -> None:
    """Write a mesh together, and each jaw.

    Args:
        mesh: in the frame of the exports.
        colored: the same with a texture, its faces in the same order.
        jaws: jaw -> its faces [F]; may be empty.
    """
    writer.surface("mesh", mesh, colored)
    for jaw, kept in jaws.items():
        part = None if colored is None else colored.part(kept)
        writer.surface(f"mesh_{jaw}", faces_of(mesh, kept), part)


def write_models(
    writer: Writer,
    mesh: Mesh,
    jaws: Mapping[Jaw, Bools],
    height: float,
    depth: float,
    most_faces: int,
) -> str:
    """Write a closed model of each jaw with a base.

    Args:
        mesh, jaws: see `write_meshes`.
        height, depth: mm, see `solid.closed`.
        most_faces: triangles of a model, at most.

    Returns:
        Why there is none; empty: there is one of each jaw.
    """
    if writer.scale.put_aside:
        return (
            "export.frame=world has the reconstruction's own units, and a base is so many "
            "millimetres high"
        )
    if writer.scale.unit != "mm":
        return "no scale is known, so nobody can say how high a base is"
    if not jaws:
        return (
            "hardly any crowns of one of the jaws are seen, so nothing tells which part of the "
            "mesh belongs to which"
        )
    mouth = writer.frame.to_mouth
    if mouth is None:
        return "too few teeth are known with their numbers to tell where the occlusal plane lies"
    lacking = []
    for jaw, kept in jaws.items():
        up = mouth if jaw == "upper" else _LOWER_UP @ mouth
        model = closed(moved(faces_of(mesh, kept), up), height, depth, MODEL_VOXEL)
        if model is not None:
            # fewer triangles where it is flat, unless that opens it
            simpler = repair(model, most_faces, 0)
            model = simpler if is_closed(simpler) else model
        if model is None or not is_closed(model):
            lacking.append(jaw)
            continue
        writer.plain(f"model_{jaw}", moved(model, np.asarray(np.linalg.inv(up))))
    if lacking:
        return f"the surface of the {' and '.join(lacking)} jaw could not be closed"
    return ""
