"""Files of a comparison: register.json, movements.csv, a coloured mesh."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.fdi import universal_number
from pipeline.files import write_atomic
from pipeline.studies.register.comparing import Comparison, Moved
from pipeline.studies.register.movement import PARTS, words
from pipeline.studies.register.visit import Look, warning_of

Array = npt.NDArray[np.float64]
FORMAT = "dentalsplat register 1"
NOTES = {
    "frame": "the first visit's, millimetres, the axes those of its run (y leads up where teeth "
    "placed the photographs, mostly down else), its lengths times first_scaled_by (other than 1 "
    "where the second run's millimetre is the surer one); "
    "first_from_second leads there from the second's, 'at' and 'motion' are in it",
    "relative_scale": "size of the second run's millimetre in the first's, as the runs have them",
    "scale_deviation_percent": "null: how far the millimetres may be off is not known",
    "parts": "mesial (distal), buccal (lingual), extrusion (intrusion) of the point 'at' in mm; "
    "tip (edge to the mesial side), torque (edge outwards), rotation (mesial side outwards), "
    "degrees",
    "half_interval": "half of the 95 % interval of each part, but for the scale, which is common "
    "to all lengths (scale_deviation_percent)",
    "basis": "what the intervals stand on: few photographs; marks of the enamel; or, where these "
    "are too faint, optical flow, whose turns are far less sure",
    "reference": "teeth that stood still, against which everything is measured: a movement that "
    "all teeth share can't be seen, nor what all of a jaw do where 'warning' says that each jaw is "
    "compared by itself",
}
#: Colours by distance: none, and this far and more (mm).
FARTHEST = 1.5


def warning(found: Comparison) -> str:
    """What has to be known of the visits before any figure is read; mostly nothing."""
    said = []
    if len(found.jaws) > 1:
        said.append(
            "The jaws do not stand to each other as they did at the first visit (the lower one is "
            f"{found.jaws_apart:.1f} mm from there), so each is compared by itself: teeth are "
            "measured against teeth of their own jaw, and the second scene stands in the frame of "
            "the first by the upper one."
        )
    elif found.jaws:
        said.append(
            "The jaws do not stand to each other as they did at the first visit, and only the "
            f"{found.jaws[0]} one can be compared: the crowns of the other are too few, or do not "
            "agree well enough, and are not measured."
        )
    return " ".join([*said, *filter(None, [warning_of(found.first, found.second)])])


def described(found: Comparison) -> dict[str, Any]:
    """The content of register.json."""
    percent = found.scale_percent
    return {
        "format": FORMAT,
        "first": found.first.name,
        "second": found.second.name,
        "notes": NOTES,
        "warning": warning(found),
        "units": "mm",
        "scale_source": found.scale_source,
        "scale_deviation_percent": None if percent is None else round(percent, 2),
        "relative_scale": round(found.relative_scale, 5),
        "first_scaled_by": round(found.first_scaled_by, 5),
        "first_from_second": np.round(found.first_from_second, 6).tolist(),
        "reference": found.still,
        "same_patient": {
            "likeness": round(found.likeness, 3),
            "share_in_place": round(found.share, 3),
            "crown_residual_mm": round(found.residual, 3),
        },
        "not_measured": list(found.missing),
        "teeth": [_tooth(tooth) for tooth in found.teeth],
    }


def _tooth(tooth: Moved) -> dict[str, Any]:
    return {
        "fdi": tooth.tooth,
        "universal": universal_number(tooth.tooth),
        "moved": tooth.certain,
        "reference": tooth.still,
        "distance_mm": round(tooth.distance[0], 3),
        "angle_degrees": round(tooth.angle[0], 2),
        "parts": {name: round(float(v), 3) for name, v in zip(PARTS, tooth.parts, strict=True)},
        "half_interval": {
            name: round(float(v), 3) for name, v in zip(PARTS, tooth.half, strict=True)
        },
        "at": np.round(tooth.at, 3).tolist(),
        "motion": np.round(tooth.motion, 6).tolist(),
        "basis": tooth.basis,
        "photographs": tooth.photographs,
        "spots": tooth.spots,
        "words": words(tooth.parts, tooth.half if tooth.certain else np.full(6, np.inf)),
    }


def table(found: Comparison) -> str:
    """The content of movements.csv: one line a tooth."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    units = ["mm"] * 3 + ["degrees"] * 3
    head = ["fdi", "universal", "moved", "reference", "distance_mm", "angle_degrees"]
    for name, unit in zip(PARTS, units, strict=True):
        head += [f"{name}_{unit}", f"{name}_half_interval"]
    writer.writerow([*head, "photographs", "spots"])
    for tooth in found.teeth:
        row: list[Any] = [
            tooth.tooth, universal_number(tooth.tooth), "yes" if tooth.certain else "no",
            "yes" if tooth.still else "no", f"{tooth.distance[0]:.3f}", f"{tooth.angle[0]:.2f}",
        ]  # fmt: skip
        for value, half in zip(tooth.parts, tooth.half, strict=True):
            row += [f"{value:z.3f}", f"{half:.3f}"]
        writer.writerow([*row, tooth.photographs, tooth.spots])
    return out.getvalue()


def color_of(tooth: Moved) -> Array:
    """[3] sRGB 0..1: grey for what did not certainly move, else yellow to dark red by distance."""
    if not tooth.certain:
        return np.array([0.72, 0.74, 0.76])
    share = min(tooth.distance[0] / FARTHEST, 1.0)
    stops = np.array([[1.0, 0.9, 0.45], [0.96, 0.5, 0.15], [0.7, 0.05, 0.1]])
    return np.array([np.interp(share, (0, 0.5, 1), stops[:, k]) for k in range(3)])


def crown_mesh(looks: tuple[Look, ...], number: int) -> tuple[Array, npt.NDArray[np.int32]]:
    """Vertices [N, 3] and triangles [M, 3] of a crown as the photograph that shows most sees it."""
    look = max(looks, key=lambda k: int(((k.labels == number) & (k.depth > 0)).sum()))
    inside = (look.labels == number) & (look.depth > 0)
    index = np.full(inside.shape, -1, np.int32)
    index[inside] = np.arange(inside.sum(), dtype=np.int32)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = np.concatenate(
        [np.stack([a, c, b], -1).reshape(-1, 3), np.stack([b, c, d], -1).reshape(-1, 3)]
    )
    faces = faces[(faces >= 0).all(1)]
    depth = look.depth[inside]
    corners = depth[faces]
    return look.points[inside], faces[np.ptp(corners, axis=1) < 0.8]


def write_files(found: Comparison, out: Path) -> list[Path]:
    """Write register.json, movements.csv and movements.ply into a folder."""
    from stages.export.mesh.files import write_mesh_ply
    from stages.export.mesh.surface import Mesh

    write_atomic(out / "register.json", json.dumps(described(found), indent=1) + "\n")
    write_atomic(out / "movements.csv", table(found))
    vertices, faces, colors = [], [], []
    start = 0
    for tooth in found.teeth:
        points, triangles = crown_mesh(found.first.looks, tooth.tooth)
        if not len(triangles):
            continue
        vertices.append(points)
        faces.append(triangles + start)
        colors.append(np.tile(color_of(tooth), (len(points), 1)))
        start += len(points)
    write_mesh_ply(
        out / "movements.ply",
        Mesh(np.concatenate(vertices), np.concatenate(faces), np.concatenate(colors)),
    )
    return [out / name for name in ("register.json", "movements.csv", "movements.ply")]
