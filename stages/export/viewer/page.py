"""The viewer page: one HTML file with the scene, the shaders and the scripts inside."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.gaussians import Gaussians, Light
from pipeline.artifacts.space.scale import NO_SCALE
from pipeline.geometry.world import scene_depth
from pipeline.pages.pictures import jpeg_uri
from stages.export.pictures.orbits import Orbit
from stages.export.splats import PER_ROW, texels, visible
from stages.export.viewer.compact import MOST_SEEN, Pack, add_gaussians, add_mesh
from stages.export.viewer.lighter import with_degree
from stages.splatting.rendering import used_degree

HERE = Path(__file__).parent
#: Quality of the photographs in the page, as JPEG.
PHOTO_QUALITY = 80
#: What shows a scene and lets one turn it, on any page; and what the viewer adds.
SCENE_SCRIPTS = (
    "camera.js", "decode.js", "sort.js", "renderer.js", "mesh.js", "screen.js", "steering.js",
)  # fmt: skip
VIEWER_SCRIPTS = (
    "picking.js", "measuring.js", "link.js", "viewer.js", "marks.js", "tools.js", "panel.js",
    "controls.js", "start.js",
)  # fmt: skip
SHADERS = (
    "splat.vert.glsl", "splat.frag.glsl", "screen.vert.glsl", "screen.frag.glsl",
    "mesh.vert.glsl", "mesh.frag.glsl",
)  # fmt: skip
#: How far beyond the photographs the viewer lets one turn, and the highest elevation (radians).
BEYOND = np.radians(40.0)
STEEPEST = np.radians(80.0)
#: stages/splatting linearises the projection within the view and this share of its size around it
SLOPE_MARGIN = 0.15


@dataclass(frozen=True)
class Knowledge:
    """What the tools of the page need beside the scene.

    Attributes:
        scale: the record of the scale (`pipeline.artifacts.space.scale.Scale.as_dict`).
        frame: what the frame of the scene is (`stages.export.texts.describe_frame`).
        teeth: FDI and Universal number, jaw, doubt, centre [3] and towards [3], the direction from
            which it was photographed.
        measurements: see `stages.export.measuring.measures`.
        axes: [3, 3] rows: the patient's left, up, out of the mouth; None: not known.
        jaws, seen: [N] of all Gaussians: the jaw (0 neither, 1 upper, 2 lower), and how many
            photographs saw it; None: not known.
        mesh: vertices [V, 3], faces [F, 3] and the vertices' jaws [V], small; None: no mesh.
    """

    scale: Mapping[str, Any] = field(default_factory=NO_SCALE.as_dict)
    frame: Mapping[str, Any] = field(default_factory=dict)
    teeth: Sequence[Mapping[str, Any]] = ()
    measurements: Sequence[Mapping[str, Any]] = ()
    axes: npt.NDArray[np.float64] | None = None
    jaws: npt.NDArray[np.uint8] | None = None
    seen: npt.NDArray[np.uint8] | None = None
    mesh: tuple[npt.NDArray[np.float64], npt.NDArray[np.int32], npt.NDArray[np.uint8]] | None = None


def describe_camera(camera: Camera) -> dict[str, Any]:
    """A camera as the viewer reads it (see `Pose` in renderer.js)."""
    return {
        "rotation": camera.rotation.ravel().tolist(),
        "translation": camera.translation.tolist(),
        "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
        "width": camera.width, "height": camera.height,
    }  # fmt: skip


def describe_orbit(orbit: Orbit) -> dict[str, Any]:
    """Centre, axes and limits of the viewer's camera."""
    low, high = orbit.span()
    all_around = high - low + 2 * BEYOND > np.radians(330)
    nearest, farthest = float(orbit.distances.min()), float(orbit.distances.max())
    return {
        "centre": orbit.centre.tolist(),
        "up": orbit.up.tolist(),
        "front": orbit.front.tolist(),
        "radius": orbit.radius,
        "turn": [low, high],
        "limits": {
            "azimuth": None if all_around else [low - BEYOND, high + BEYOND],
            "elevation": [
                max(-STEEPEST, float(orbit.elevations.min()) - BEYOND),
                min(STEEPEST, float(orbit.elevations.max()) + BEYOND),
            ],
            "distance": [0.15 * nearest, 2.5 * farthest],
            "pan": 1.5 * orbit.radius,
        },
    }


def describe_light(light: Light | None, orbit: Orbit) -> dict[str, Any] | None:
    """The light as the shader takes it, and the distances that the photographs were taken from."""
    if light is None:
        return None
    (narrow, broad), (strong, weak) = light.widths, light.strengths
    return {
        "globals": [light.diffuse_share, light.falloff, narrow, strong, broad, weak,
                    light.distance, light.gamma],
        "centre": orbit.centre.tolist(),
        "distances": [float(orbit.distances.min()), float(orbit.distances.max())],
    }  # fmt: skip


def rasterizer_constants(gaussians: Gaussians, cameras: Sequence[Camera]) -> dict[str, float]:
    """The constants of our rasterizer, with its near plane for a typical camera of the scene."""
    from stages.splatting.kernels.compositing import ALPHA_MAX
    from stages.splatting.rasterizer import ALPHA_CUT, LOW_PASS
    from stages.splatting.rendering import NEAR_FRACTION

    return {
        "low_pass": float(LOW_PASS),
        "alpha_min": float(ALPHA_CUT),
        "alpha_max": float(ALPHA_MAX),
        "near": NEAR_FRACTION * (scene_depth(gaussians.means, cameras) or 1.0),
        "slope_margin": SLOPE_MARGIN,
    }


def build_page(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    orbit: Orbit,
    photos: Mapping[str, npt.NDArray[np.uint8]],
    rasterizer: Mapping[str, float],
    sh_degree: int = 3,
    knowledge: Knowledge | None = None,
) -> str:
    """Build the viewer page.

    Args:
        gaussians: the scene.
        cameras: of the input photographs, one button each; the middle one is shown first.
        orbit: frame of the cameras.
        photos: camera name -> RGB [H, W, 3] to compare with; may hold none, or only some.
        rasterizer: see `rasterizer_constants`, so that the page draws what the fit has seen.
        sh_degree: highest spherical-harmonics degree to carry; where that is less than the scene
            has, those are fitted to the colours that the cameras see.
        knowledge: what else is known of the scene, for the tools of the page.

    Returns:
        The text of a self-contained HTML file: no names, no paths, no network.
    """
    known = knowledge or Knowledge()
    carried = with_degree(gaussians, cameras, sh_degree)
    described, splats = pack_scene(carried, orbit, rasterizer, sh_degree, known)
    views = []
    for camera in cameras:
        view = describe_camera(camera)
        if camera.name in photos:
            view["photo"] = jpeg_uri(photos[camera.name], PHOTO_QUALITY)
        views.append(view)
    scene = {
        "id": hashlib.sha256(gaussians.means.tobytes()).hexdigest()[:12],  # of links: where it lies
        "format": described,
        "background": list(gaussians.background),
        "orbiting": describe_orbit(orbit),
        "views": views,
        "first": orbit.middle(),
        "scale": dict(known.scale),
        "frame": dict(known.frame),
        "teeth": list(known.teeth),
        "measurements": list(known.measurements),
        "axes": None if known.axes is None else known.axes.tolist(),
        "knows": {
            "jaws": known.jaws is not None and bool(known.jaws.any()),
            "seen": known.seen is not None,
        },
        "shaders": shaders(),
    }
    parts = {
        "styles": (HERE / "viewer.css").read_text(),
        "scene": script_json(scene),
        "splats": splats,
        "scripts": scripts(*SCENE_SCRIPTS, *VIEWER_SCRIPTS),
    }
    page = (HERE / "viewer.html").read_text()
    for key, text in parts.items():
        page = page.replace("{{" + key + "}}", text, 1)
    return page


def scripts(*names: str) -> str:
    """Scripts of this folder, one after the other."""
    return "\n".join((HERE / name).read_text() for name in names)


def shaders() -> dict[str, str]:
    """GLSL by file name, as `SplatRenderer` takes it."""
    return {name: (HERE / name).read_text() for name in SHADERS}


def script_json(value: Any) -> str:
    """JSON that nothing in it can end the script element of."""
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")


def pack_scene(
    gaussians: Gaussians, orbit: Orbit, rasterizer: Mapping[str, float], sh_degree: int = 3,
    known: Knowledge | None = None,
) -> tuple[dict[str, Any], str]:  # fmt: skip
    """What `unpacked` in decode.js reads: the format as JSON values, and the arrays as text.

    Args:
        gaussians, rasterizer, sh_degree, known: see `build_page`.
        orbit: of the cameras, in the frame of the Gaussians.
    """
    known = known or Knowledge()
    shown = visible(gaussians, rasterizer["alpha_min"])
    light = gaussians.light
    kept = Gaussians(
        gaussians.means[shown], gaussians.quats_wxyz[shown], gaussians.log_scales[shown],
        gaussians.logit_opacities[shown], gaussians.sh[shown], light[shown] if light else None,
    )  # fmt: skip
    degree = 0 if light else min(sh_degree, used_degree(kept))
    pack = Pack()
    none = np.zeros(len(shown), np.uint8)
    jaws = none if known.jaws is None else known.jaws
    seen = none if known.seen is None else np.minimum(known.seen, MOST_SEEN)
    flags = (jaws | seen << 2)[shown]
    add_gaussians(pack, kept, degree, flags, orbit.centre, orbit.radius)
    if known.mesh is not None:
        add_mesh(pack, *known.mesh)
    carried = 1 if light else degree  # the shader takes a light's normals for harmonics
    described = {
        "count": len(kept), "sh_degree": carried, "texels": texels(carried),
        "per_row": PER_ROW, "arrays": pack.described, "reach": orbit.radius,
        "centre": orbit.centre.tolist(), "knowsSeen": known.seen is not None,
        "rasterizer": dict(rasterizer), "light": describe_light(light, orbit),
    }  # fmt: skip
    return described, pack.text()
