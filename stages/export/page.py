"""The viewer page: one HTML file with the scene, the shaders and the scripts inside."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.gaussians import Gaussians, Light
from stages.export.pictures.orbits import Orbit
from stages.export.splats import PER_ROW, pack, texels, used_degree, visible, with_material

HERE = Path(__file__).parent
SCRIPTS = ("camera.js", "sort.js", "renderer.js", "viewer.js", "controls.js")
SHADERS = ("splat.vert.glsl", "splat.frag.glsl", "screen.vert.glsl", "screen.frag.glsl")
#: How far beyond the photographs the viewer lets one turn, and the highest elevation (radians).
BEYOND = np.radians(40.0)
STEEPEST = np.radians(80.0)
#: stages/splatting linearises the projection within the view and this share of its size around it
SLOPE_MARGIN = 0.15


def encode_jpeg(image: npt.NDArray[np.uint8], quality: int) -> str:
    """`data:` address of an RGB image [H, W, 3] as JPEG without metadata."""
    ok, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not ok:
        raise ValueError(f"cannot encode an image of shape {image.shape} as JPEG")
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode("ascii")


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

    depths = []
    for camera in cameras:
        z = gaussians.means @ camera.rotation[2] + camera.translation[2]
        depths.extend([float(np.median(z[z > 0]))] if (z > 0).any() else [])
    return {
        "low_pass": float(LOW_PASS),
        "alpha_min": float(ALPHA_CUT),
        "alpha_max": float(ALPHA_MAX),
        "near": NEAR_FRACTION * (float(np.median(depths)) if depths else 1.0),
        "slope_margin": SLOPE_MARGIN,
    }


def build_page(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    orbit: Orbit,
    photos: Mapping[str, npt.NDArray[np.uint8]],
    rasterizer: Mapping[str, float],
    sh_degree: int = 3,
    jpeg_quality: int = 85,
) -> str:
    """Build the viewer page.

    Args:
        gaussians: the scene.
        cameras: of the input photographs, one button each; the middle one is shown first.
        orbit: frame of the cameras.
        photos: camera name -> RGB [H, W, 3] to compare with; may hold none, or only some.
        rasterizer: see `rasterizer_constants`, so that the page draws what the fit has seen.
        sh_degree: highest spherical-harmonics degree to carry.
        jpeg_quality: of the photographs.

    Returns:
        The text of a self-contained HTML file: no names, no paths, no network.
    """
    shown = visible(gaussians, rasterizer["alpha_min"])
    light = gaussians.light
    kept = Gaussians(
        gaussians.means[shown], gaussians.quats_wxyz[shown], gaussians.log_scales[shown],
        gaussians.logit_opacities[shown], gaussians.sh[shown], light[shown] if light else None,
    )  # fmt: skip
    degree = min(sh_degree, used_degree(kept))
    if light:
        kept, degree = with_material(kept), 1
    views = []
    for camera in cameras:
        view = describe_camera(camera)
        if camera.name in photos:
            view["photo"] = encode_jpeg(photos[camera.name], jpeg_quality)
        views.append(view)
    scene = {
        "format": {
            "count": len(kept), "sh_degree": degree, "texels": texels(degree), "per_row": PER_ROW,
            "rasterizer": dict(rasterizer), "light": describe_light(light, orbit),
        },
        "background": list(gaussians.background),
        "orbiting": describe_orbit(orbit),
        "views": views,
        "first": orbit.middle(),
        "shaders": {name: (HERE / name).read_text() for name in SHADERS},
    }  # fmt: skip
    parts = {
        # Nothing in a JSON string can then close the script element.
        "scene": json.dumps(scene, separators=(",", ":")).replace("<", "\\u003c"),
        "splats": base64.b64encode(pack(kept, degree).tobytes()).decode("ascii"),
        "scripts": "\n".join((HERE / name).read_text() for name in SCRIPTS),
    }
    page = (HERE / "viewer.html").read_text()
    for key, text in parts.items():
        page = page.replace("{{" + key + "}}", text, 1)
    return page
