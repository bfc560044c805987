"""What the exported files are, for people (`README.txt`) and programs (`scene.json`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

DESCRIPTIONS = {
    "viewer.html": "the scene to look at: open it in a browser; works from disk, sends nothing",
    "preview.png": "one picture: photograph, the 3D scene from the same place, a new viewpoint",
    "orbit.mp4": "a walk around the scene through the places of the photographs",
    "splats.ply": "3D Gaussians in the standard 3DGS layout, for SuperSplat and other viewers",
    "mesh.ply": "triangle mesh with colours",
    "mesh.stl": "the same mesh without colours",
    "points.ply": "thinned point cloud with colours",
    "colmap": "COLMAP model: images, and cameras and points in sparse/0",
    "transforms.json": "the cameras for nerfstudio (ns-train splatfacto --data .)",
    "teeth.json": "the teeth: FDI and Universal number, doubt, place in 3D, outlines in the images",
}

TEETH = """\

Teeth. teeth.json has {teeth} teeth. "doubt" is the probability that a number is wrong; check those
above .2. "centre" is the middle of what is seen of a crown, in the frame above. Outlines are pixels
of colmap/images. Photographs that were set aside are named there, with the reason.
"""

README = """\
dentalsplat export
==================

{files}

Frame. All files share one frame: {frame}.
Axes are right-handed. Up in the photographs is ({up[0]:.4f}, {up[1]:.4f}, {up[2]:.4f}).
Cameras in colmap/ are OpenCV cameras (x right, y down, z forward); those in transforms.json
have OpenGL axes (x right, y up, z backward) in the same world.
Lengths are in {units}.{caution}
{teeth}
{placed} of {total} photographs could be placed. They appear as 000, 001, ... in the order in which
they were given; no file names, places or times are carried along.
"""


def scene_description(
    files: Sequence[str],
    frame: str,
    units: str,
    up: Sequence[float],
    similarity: Sequence[Sequence[float]],
    counts: Mapping[str, int],
    skipped: Mapping[str, str],
    versions: Mapping[str, str],
) -> dict[str, Any]:
    """The content of `scene.json`.

    Args:
        files: top-level names in the export folder.
        frame: ``input`` (of what the user gave) or ``world`` (ours).
        units: ``mm`` or ``arbitrary``, of that frame.
        up: direction in that frame that is up in the photographs.
        similarity: [4, 4] matrix that led from our world into the frame.
        counts: what there is how many times.
        skipped: what could not be made -> why.
        versions: of dentalsplat and of the libraries that made the files.
    """
    return {
        "format": "dentalsplat export 1",
        "files": {name: DESCRIPTIONS[name] for name in DESCRIPTIONS if name in files},
        "frame": {
            "name": frame,
            "units": units,
            "handedness": "right",
            "camera_axes": "OpenCV: x right, y down, z forward (transforms.json: OpenGL)",
            "up": list(up),
            "frame_from_world": [list(row) for row in similarity],
        },
        "counts": dict(counts),
        "skipped": dict(skipped),
        "versions": dict(versions),
    }


def readme(scene: Mapping[str, Any]) -> str:
    """The text of `README.txt`, from `scene_description`."""
    frame = scene["frame"]
    width = max(map(len, scene["files"]), default=0) + 2
    lines = [f"{name:<{width}}{what}" for name, what in scene["files"].items()]
    metric = frame["units"] == "mm"
    return README.format(
        files="\n".join(lines),
        frame=(
            "the frame of the cameras or the scale that were given"
            if frame["name"] == "input"
            else "the reconstruction's own (its scale and orientation are arbitrary)"
        ),
        up=frame["up"],
        units="millimetres" if metric else "arbitrary units",
        caution="" if metric else " Nothing can be measured in them: no scale was known.",
        placed=scene["counts"]["placed_photographs"],
        total=scene["counts"]["photographs"],
        teeth=TEETH.format(**scene["counts"]) if "teeth" in scene["counts"] else "",
    )
