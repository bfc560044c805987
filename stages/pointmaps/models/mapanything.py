"""MapAnything (Keetha et al., 2025): any number of images to metric pointmaps and cameras."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from pipeline.artifacts.views import View
from stages.pointmaps.interface import ModelCard, PreparedView, ViewPrediction
from stages.pointmaps.loading import checkpoint_file, import_module, offline, to_numpy
from stages.pointmaps.options import PointmapOptions
from stages.pointmaps.prepare import nearest_shape, prepare

#: Image sizes (width, height) that the published weights were trained for.
SHAPES = (
    (518, 518), (518, 392), (518, 336), (518, 294), (518, 252), (518, 168),
    (392, 518), (336, 518), (294, 518), (252, 518),
)  # fmt: skip
#: Mean and deviation of the channels, as its image encoder (DINOv2) wants them.
MEAN = np.array([0.485, 0.456, 0.406], np.float32)
DEVIATION = np.array([0.229, 0.224, 0.225], np.float32)


class MapAnything:
    """The user's MapAnything, images only."""

    card: ClassVar[ModelCard] = ModelCard(
        name="mapanything",
        title="MapAnything",
        package="mapanything",
        repository="https://github.com/facebookresearch/map-anything",
        install="pip install git+https://github.com/facebookresearch/map-anything.git",
        code_licence="Apache 2.0",
        weights_licence="facebook/map-anything: CC BY-NC 4.0; facebook/map-anything-apache: "
        "Apache 2.0",
        weights="huggingface-cli download facebook/map-anything-apache --local-dir FOLDER fetches "
        "them (init.pointmap.checkpoint is that folder); its image encoder also wants the code of "
        "DINOv2 in torch's hub cache: load the model once with the network on.",
        weights_gb=2.3,
        gb_per_image=0.35,
        pixels=518 * 392,
    )
    hub_name: ClassVar[str] = "facebook/map-anything-apache"

    def __init__(self, options: PointmapOptions, device: Any) -> None:
        network = import_module(
            self.card, "models", options.package, options.package_folder
        ).MapAnything
        path = checkpoint_file(self.card, options.checkpoint, folder_allowed=True)
        with offline(self.card):
            model = network.from_pretrained(str(path) if path else self.hub_name)
            self._model = model.to(device).eval()
        self._device = device

    @staticmethod
    def prepare(views: list[View], options: PointmapOptions) -> list[PreparedView]:
        """All images to the one trained size that is nearest to their mean aspect."""
        aspect = float(np.mean([view.width / view.height for view in views]))
        return [
            prepare(view, k, nearest_shape(view.width, view.height, aspect, SHAPES))
            for k, view in enumerate(views)
        ]

    def predict_views(self, views: Sequence[PreparedView]) -> list[ViewPrediction]:
        """Points of all images in the world of the first."""
        import torch

        inputs = []
        for view in views:
            normalised = ((view.image - MEAN) / DEVIATION).transpose(2, 0, 1)
            tensor = torch.from_numpy(np.ascontiguousarray(normalised, np.float32))[None]
            inputs.append({"img": tensor.to(self._device), "data_norm_type": ["dinov2"]})
        with offline(self.card), torch.no_grad():
            found = self._model.infer(
                inputs,
                memory_efficient_inference=False,
                use_amp=self._device.type == "cuda",
                amp_dtype="bf16",
                apply_mask=True,
                mask_edges=True,
                apply_confidence_mask=False,
            )
        return [_read(one) for one in found]


def _read(answer: Any) -> ViewPrediction:
    confidence = to_numpy(answer["conf"])[0]
    known = to_numpy(answer["mask"])[0].reshape(confidence.shape) > 0.5
    return ViewPrediction(
        to_numpy(answer["pts3d"])[0],
        to_numpy(answer["pts3d_cam"])[0],
        np.where(known, confidence, np.float32(1)),
        np.linalg.inv(to_numpy(answer["camera_poses"])[0].astype(np.float64)),
    )
