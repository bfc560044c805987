"""The `evaluate` stage: how good the scene is, by photographs, true cameras and true surfaces."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.errors import RequestError
from pipeline.stage import Parts, Stage, StageContext
from pipeline.untrusted.names import printable
from pipeline.untrusted.paths import user_path
from pipeline.untrusted.pictures import SUFFIXES
from stages.evaluate.config import EvaluateConfig


class EvaluateStage(Stage):
    """Views, cameras and Gaussians -> metrics; more of them where the truth is known."""

    name = "evaluate"
    version = 11
    summary = "figures of input and held-out views, poses and geometry; side by side pictures"
    Config = EvaluateConfig
    requires = ("views", "cameras", "gaussians")
    optional = ("held_out", "points")
    provides = ("metrics",)
    rehearsals = ("stages.evaluate.rehearsal:support",)
    libraries = (
        "numpy", "numba", "opencv-contrib-python-headless", "scipy", "open3d", "pycolmap",
        "torchmetrics", "torch",
    )  # fmt: skip

    def sources(self, config: Any, request: Mapping[str, Any]) -> Mapping[str, Path]:
        from pipeline.geometry.models.known_cameras import model_files
        from stages.evaluate.images.perceptual import find_vgg_weights

        found: dict[str, Path] = {}
        if config.ground_truth is not None:
            files = model_files(Path(config.ground_truth), "evaluate.ground_truth")
            found |= {f"ground_truth/{path.name}": path for path in files.values()}
        if config.mesh is not None:
            found["mesh/mesh.ply"] = _mesh_file(config)
        if config.masks is not None:
            found |= {f"masks/{printable(path.name)}": path for path in _mask_files(config.masks)}
        weights = find_vgg_weights(config.lpips_weights)
        if weights is not None:
            found[f"lpips/vgg16{weights.suffix}"] = weights
        return found

    def report(self) -> Parts:
        from stages.evaluate.report import PARTS

        return PARTS

    def run(self, context: StageContext) -> None:
        from stages.evaluate.evaluation import evaluate
        from stages.splatting.rendering import Painter

        evaluate(context, Painter)


def _mesh_file(config: Any) -> Path:
    path = user_path(config.mesh, "evaluate.mesh")
    if not path.is_file():
        raise RequestError(f"evaluate.mesh: there is no file {path}. Give a .ply, .stl or .obj.")
    if config.ground_truth is None:
        raise RequestError(
            "evaluate.mesh is given, but not evaluate.ground_truth: without true cameras nobody "
            "knows where the reconstruction lies in the world of the mesh. Give both, or neither."
        )
    return path


def _mask_files(folder: str) -> list[Path]:
    path = user_path(folder, "evaluate.masks")
    if not path.is_dir():
        raise RequestError(
            f"evaluate.masks: there is no folder {path}. Give the folder of masks named as the "
            "photographs, 255 where the figures count."
        )
    found = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES)
    if not found:
        raise RequestError(f"evaluate.masks: there is no picture in {path}.")
    return found
