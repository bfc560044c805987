"""What the exported files are, for people (`README.txt`) and programs (`scene.json`)."""

from __future__ import annotations

import textwrap
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.artifacts.space.frames import Frame
from pipeline.artifacts.space.scale import Scale
from stages.export.mesh.files import WITHOUT_SCALE
from stages.export.orientation import file_from_frame


def _meshes() -> dict[str, str]:
    """What the files of the mesh are, whole and in parts, with and without a scale."""
    found = {}
    for end, said in (("", ""), (WITHOUT_SCALE, "; nothing can be measured on it")):
        for part, whose in (
            ("", ""),
            ("_upper", " of the upper jaw"),
            ("_lower", " of the lower jaw"),
        ):
            stem = f"mesh{part}{end}"
            found[f"{stem}.ply"] = f"triangle mesh{whose} with colours{said}"
            found[f"{stem}.glb"] = "the same with the photographs on it, for 3D viewers"
            found[f"{stem}.stl"] = "the same without colours, for slicers and CAD"
    return found


DESCRIPTIONS = {
    "viewer.html": "the scene to look at: open it in a browser; works from disk, sends nothing",
    "preview.png": "one picture: photograph, the 3D scene from the same place, a new viewpoint",
    "orbit.mp4": "a walk around the scene through the places of the photographs",
    "splats.ply": "3D Gaussians in the standard 3DGS layout, for SuperSplat and other viewers",
    "splats_constant_colour.ply": "the same for viewers that show one colour a Gaussian: the mean "
    "of what the photographs' cameras see",
    "splats.compressed.ply": "the same, small, for SuperSplat and PlayCanvas",
    "splats.sog": "the same, smaller still, for SuperSplat and PlayCanvas",
    "splats.spz": "the same, small, for viewers that read Niantic's .spz",
    **_meshes(),
    "model_upper.stl": "upper jaw, closed and with a base, for printing",
    "model_lower.stl": "lower jaw, closed and with a base, for printing",
    "points.ply": "thinned point cloud with colours",
    "colmap": "COLMAP model: images (and masks), cameras and points in sparse/0",
    "transforms.json": "the cameras for nerfstudio (ns-train splatfacto --data .)",
    "teeth.json": "the teeth: FDI and Universal number, doubt, place in 3D, outlines in the images",
    "teeth.csv": "the same as a table, a row for each tooth",
}

#: Paragraphs of `README.txt`. What is not in the folder is not spoken of.
CAMERAS = (
    "Cameras in colmap/ are OpenCV cameras (x right, y down, z forward); those in transforms.json "
    "have OpenGL axes (x right, y up, z backward) in the same world."
)
METRES = (
    "Lengths in .glb files are in metres, as their readers expect it; in all others in millimetres."
)
TEETH = (
    'Teeth: {teeth} in teeth.json, with a row for each in teeth.csv. "doubt" is the probability '
    'that a number is wrong; check those above .2. "centre" is the middle of what is seen of a '
    "crown, in the frame above. Outlines are pixels of the photographs as export.colmap writes "
    "them (colmap/images). Photographs that were set aside are named there, with the reason."
)
MODELS = (
    "Models. model_upper.stl and model_lower.stl are closed, with a flat base, ready to print: "
    "both lie on their bases (scene.json has the matrices), so they do not bite together as "
    "mesh_upper.stl and mesh_lower.stl do. Their outside is the mesh. The back and the base are "
    "made up, not measured: the photographs do not show them."
)
PHOTOGRAPHS = (
    "{placed_photographs} of {photographs} photographs could be placed. They appear as 000, 001, "
    "... in the order in which they were given; no file names, places or times are carried along."
)


#: Name of a frame -> its axes, its origin, and all that for people.
FRAMES: dict[str, tuple[str, str, str]] = {
    "mouth": (
        "x to the patient's left, y up, z to the front, towards the viewer",
        "between the edges of the upper central incisors, in the occlusal plane (y = 0)",
        "All files share the frame of the mouth: x leads to the patient's left, y up, z to the "
        "front, towards the viewer. The origin lies between the edges of the upper central "
        "incisors (or of the foremost pair of teeth that is seen), in the occlusal plane, which "
        "is y = 0: the plane nearest to the edges and cusps of the upper teeth.",
    ),
    "upright": (
        "x right, y up, z towards the viewer, as the photographs show it",
        "the middle of what the photographs show",
        "All files stand as the photographs show the scene: x leads to the right, y up, z towards "
        "the viewer. The origin is in the middle of what the photographs show.",
    ),
    "input": (
        "those of the cameras that were given",
        "that of the cameras that were given",
        "All files are in the frame of the cameras that were given.",
    ),
    "world": (
        "the reconstruction's own: x right, y down, z away from the viewer",
        "the middle of what the photographs show",
        "All files are in the reconstruction's own frame, and in its own units.",
    ),
}


def describe_frame(frame: Frame) -> dict[str, Any]:
    """The frame of the exports, as `scene.json` and the viewer page hold it."""
    axes, origin, _ = FRAMES[frame.name]
    return {
        "name": frame.name,
        "axes": axes,
        "origin": origin,
        "handedness": "right",
        "frame_from_world": frame.from_world.tolist(),
    }


def scene_description(
    files: Sequence[str],
    frame: Frame,
    scale: Scale,
    up: Sequence[float],
    counts: Mapping[str, int],
    skipped: Mapping[str, str],
    versions: Mapping[str, str],
) -> dict[str, Any]:
    """The content of `scene.json`.

    Args:
        files: top-level names in the export folder.
        frame: of the exports.
        scale: of that frame.
        up: direction in that frame that is up: the patient's, or that of the photographs.
        counts: what there is how many times.
        skipped: what could not be made -> why.
        versions: of dentalsplat and of the libraries that made the files.
    """
    return {
        "format": "dentalsplat export 2",
        "files": {name: DESCRIPTIONS[name] for name in DESCRIPTIONS if name in files},
        "scale": scale.as_dict(),
        "frame": {
            **describe_frame(frame),
            "units": scale.units,
            "camera_axes": "OpenCV: x right, y down, z forward (transforms.json: OpenGL)",
            "up": list(up),
            "file_from_frame": {
                name: turn.tolist()
                for name in sorted(files)
                for turn in [
                    file_from_frame(name, frame.stands, scale.unit == "mm", frame.to_mouth)
                ]
                if not np.array_equal(turn, np.eye(4))
            },
        },
        "counts": dict(counts),
        "skipped": dict(skipped),
        "versions": dict(versions),
    }


def readme(scene: Mapping[str, Any]) -> str:
    """The text of `README.txt`, from `scene_description`."""
    files, frame, counts = scene["files"], scene["frame"], scene["counts"]
    width = max(map(len, files), default=0) + 2
    up = "({:.4f}, {:.4f}, {:.4f})".format(*(round(x, 4) + 0.0 for x in frame["up"]))
    place = [
        f"Frame. {FRAMES[frame['name']][2]} Axes are right-handed. Up in the photographs is {up}.",
        CAMERAS if "transforms.json" in files else "",
        _turned(frame["file_from_frame"]),
        METRES if any(name.endswith(".glb") for name in frame["file_from_frame"]) else "",
    ]
    paragraphs = [
        f"Scale. {scene['scale']['text']}",
        " ".join(filter(None, place)),
        TEETH.format(**counts) if "teeth" in counts else "",
        MODELS if any(name.startswith("model_") for name in files) else "",
        *(f"Not made ({what}): {why}." for what, why in scene["skipped"].items()),
        PHOTOGRAPHS.format(**counts),
    ]
    return (
        "\n\n".join(
            [
                "dentalsplat export\n==================",
                "\n".join(f"{name:<{width}}{what}" for name, what in files.items()),
                *(textwrap.fill(text, 100) for text in paragraphs if text),
            ]
        )
        + "\n"
    )


def _turned(names: Collection[str]) -> str:
    """Which files are turned against the frame, beside closed models; "" where none is."""
    said = []
    if any(name.startswith("splats") for name in names):
        also = " and splats.sog" if "splats.sog" in names else ""
        said.append(f"splats*.ply{also} by 180 degrees about z, for SuperSplat")
    if any(name.startswith("mesh") and name.endswith(".stl") for name in names):
        said.append("mesh*.stl by 90 degrees about x, so that z is up")
    if not said:
        return ""
    return (
        "Some files are turned against that frame, as their readers expect it: "
        f"{', and '.join(said)}. scene.json has the matrices."
    )
