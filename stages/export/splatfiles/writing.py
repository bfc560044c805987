"""The splat files of an export, each as its readers expect it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.artifacts.gaussians import Gaussians, write_gaussians_ply
from pipeline.artifacts.space.frames import BACKGROUND, TURNED
from stages.export.orientation import file_from_frame
from stages.export.scene import Scene
from stages.export.splatfiles.compressed import compressed_ply_bytes
from stages.export.splatfiles.order import morton_order, taken
from stages.export.splatfiles.plain import with_constant_color
from stages.export.splatfiles.sog import sog_bytes
from stages.export.splatfiles.spz import spz_bytes
from stages.export.splats import visible
from stages.splatting.frame import move_gaussians
from stages.splatting.rasterizer import ALPHA_CUT
from stages.splatting.rendering import used_degree

FULL, CONSTANT = "splats.ply", "splats_constant_colour.ply"
COMPRESSED, SOG, SPZ = "splats.compressed.ply", "splats.sog", "splats.spz"


def write_splats(
    folder: Path, scene: Scene, stands: bool, comments: list[str], all_files: bool = True
) -> None:
    """Write the full `.ply`, the one of constant colour, the compressed one, `.sog` and `.spz`.

    The smaller four leave out what is too transparent to be drawn. No file has bands of harmonics
    that are zero everywhere.

    Args:
        stands: the frame of the exports has y up and z towards the viewer, so that files stand as
            their readers expect it (`stages.export.orientation`); else all are in that frame.
        comments: lines for the headers of the `.ply` files.
        all_files: write the smaller four too.
    """
    frame = scene.gaussians
    if stands:
        comments = [*comments, TURNED]
    if any(frame.background):
        comments = [*comments, f"{BACKGROUND} {' '.join(map(repr, map(float, frame.background)))}"]
    turned = _turned(frame, FULL, stands)
    degree = used_degree(frame)
    write_gaussians_ply(folder / FULL, turned, degree, comments)
    if not all_files:
        return
    shown = np.flatnonzero(visible(frame, float(ALPHA_CUT)))
    shown = shown[morton_order(frame.means[shown])]
    # A constant is the same in any frame, and the .ply and .sog stand alike.
    colored = replace(turned, sh=with_constant_color(frame, scene.cameras).sh)
    write_gaussians_ply(folder / CONSTANT, taken(colored, shown), 0, comments)
    packed = compressed_ply_bytes(taken(turned, shown), degree, comments)
    (folder / COMPRESSED).write_bytes(packed)
    (folder / SOG).write_bytes(sog_bytes(taken(turned, shown), degree))
    spz = _turned(frame, SPZ, stands)
    (folder / SPZ).write_bytes(spz_bytes(taken(spz, shown), degree))


def _turned(gaussians: Gaussians, name: str, stands: bool) -> Gaussians:
    return move_gaussians(gaussians, file_from_frame(name, stands))
