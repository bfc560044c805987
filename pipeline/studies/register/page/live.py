"""Both visits' scenes for one canvas: what the viewer of an export draws, in one common frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.studies.register.comparing import Comparison
from pipeline.studies.register.geometry import inverted
from pipeline.studies.register.visit import Visit, in_frame, scale_of

Array = npt.NDArray[np.float64]

HERE = Path(__file__).parent
#: Harmonics that the page carries, so that two scenes are no more to send than one with all.
DEGREE = 1


@dataclass(frozen=True)
class Live:
    """What the page holds for the live scenes.

    Attributes:
        described: JSON for scenes.js: both scenes' formats and frames, the camera's limits, the
            places of photographs.
        splats: of each scene, as `unpacked` in decode.js takes them.
        scripts: JavaScript.
        places: names of the photographs at whose places one can stand.
    """

    described: str
    splats: tuple[str, str]
    scripts: str
    places: tuple[str, ...]


def live_scenes(found: Comparison, places: list[tuple[str, Camera]]) -> Live | None:
    """Both scenes as the same camera sees them; None if a visit comes without its scene.

    The common frame is the first visit's, in millimetres. Gaussians stay in the worlds of their
    runs: the camera is carried there, so that harmonics and light stay as they were fitted.

    Args:
        found: the comparison.
        places: photographs to stand at, in the frame of the first visit; the middle one is first.
    """
    from stages.export.viewer.page import (
        SCENE_SCRIPTS,
        describe_camera,
        describe_orbit,
        script_json,
        scripts,
        shaders,
    )

    made = [
        _packed(found.first, found.first.frame),
        _packed(found.second, found.first_from_second @ found.second.frame),
    ]
    packed = [entry for entry in made if entry is not None]
    if len(packed) < 2 or found.first.gaussians is None:
        return None
    described = {
        "scenes": [entry for entry, _ in packed],
        "background": list(found.first.gaussians.background),
        "orbiting": describe_orbit(_orbit(found.first, np.eye(4))),
        "places": [describe_camera(camera) for _, camera in places],
        "first": len(places) // 2,
        "shaders": shaders(),
    }
    own = (HERE / "scenes.js").read_text()
    return Live(
        script_json(described), (packed[0][1], packed[1][1]),
        f"{scripts(*SCENE_SCRIPTS)}\n{own}", tuple(name for name, _ in places),
    )  # fmt: skip


def _packed(visit: Visit, common_from_world: Array) -> tuple[dict[str, Any], str] | None:
    """A visit's Gaussians in the world of their run, and the way there from the common frame."""
    from stages.export.viewer.lighter import with_degree
    from stages.export.viewer.page import pack_scene, rasterizer_constants

    if visit.gaussians is None:
        return None
    back = inverted(visit.frame)
    cameras = [in_frame(look.camera, back) for look in visit.looks]
    constants = rasterizer_constants(visit.gaussians, cameras)
    light = with_degree(visit.gaussians, cameras, DEGREE)
    described, splats = pack_scene(light, _orbit(visit, back), constants, DEGREE)
    world_from_common = inverted(common_from_world)
    scale = scale_of(world_from_common)
    similarity = {
        "rotation": (world_from_common[:3, :3] / scale).ravel().tolist(),
        "translation": world_from_common[:3, 3].tolist(),
        "scale": scale,
    }
    return {"format": described, "from_common": similarity}, splats


def _orbit(visit: Visit, frame: Array):  # type: ignore[no-untyped-def]
    """How a visit's cameras stand around its teeth, in the frame that a similarity leads to."""
    from stages.export.pictures.orbits import find_orbit

    scale = scale_of(frame)
    depths = [
        scale * float(np.median(look.depth[known])) if known.any() else None
        for look in visit.looks
        for known in [(look.labels > 0) & (look.depth > 0)]
    ]
    return find_orbit([in_frame(look.camera, frame) for look in visit.looks], depths)
