"""DUSt3R (Wang et al., CVPR 2024): two images to two pointmaps."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from pipeline.artifacts.views import View
from stages.pointmaps.interface import ModelCard, PairPrediction, PreparedView
from stages.pointmaps.loading import checkpoint_file, import_module, offline, to_numpy
from stages.pointmaps.options import PointmapOptions
from stages.pointmaps.prepare import multiple_of_patch, prepare


class Dust3r:
    """The user's DUSt3R, asked for one pair at a time."""

    card: ClassVar[ModelCard] = ModelCard(
        name="dust3r",
        title="DUSt3R",
        package="dust3r",
        repository="https://github.com/naver/dust3r",
        install="git clone --recursive https://github.com/naver/dust3r && pip install -r "
        "dust3r/requirements.txt, then name the checkout as init.pointmap.package_folder (or on "
        "PYTHONPATH)",
        code_licence="CC BY-NC-SA 4.0 (not for commercial use)",
        weights_licence="CC BY-NC-SA 4.0 and the terms of the training data",
        weights="DUSt3R_ViTLarge_BaseDecoder_512_dpt.pth is linked in the README of the "
        "repository.",
        weights_gb=2.3,
        gb_per_image=0.6,
        pixels=512 * 384,
    )  # fmt: skip
    model_class: ClassVar[str] = "AsymmetricCroCo3DStereo"
    hub_name: ClassVar[str] = "naver/DUSt3R_ViTLarge_BaseDecoder_512_dpt"

    def __init__(self, options: PointmapOptions, device: Any) -> None:
        model_module = import_module(self.card, "model", options.package, options.package_folder)
        # MASt3R brings DUSt3R along and puts it on the path when it is imported.
        own = options.package if self.card.name == "dust3r" else None
        self._inference = import_module(Dust3r.card, "inference", own, None).inference
        path = checkpoint_file(self.card, options.checkpoint, folder_allowed=True)
        with offline(self.card):
            model = getattr(model_module, self.model_class).from_pretrained(
                str(path) if path else self.hub_name
            )
            self._model = model.to(device).eval()
        self._device = device

    @staticmethod
    def prepare(views: list[View], options: PointmapOptions) -> list[PreparedView]:
        """Long side to `long_side`, sides cut to multiples of 16."""
        return [
            prepare(view, k, multiple_of_patch(view.width, view.height, options.long_side))
            for k, view in enumerate(views)
        ]

    def predict_pair(self, first: PreparedView, second: PreparedView) -> PairPrediction:
        """Pointmaps of both images in the frame of the first."""
        with offline(self.card):
            answer = self._inference(
                [(_as_input(first), _as_input(second))],
                self._model,
                self._device,
                batch_size=1,
                verbose=False,
            )
            one, two = answer["pred1"], answer["pred2"]
            return PairPrediction(
                to_numpy(one["pts3d"][0]),
                to_numpy(two["pts3d_in_other_view"][0]),
                to_numpy(one["conf"][0]),
                to_numpy(two["conf"][0]),
            )


def as_signed_tensor(image: Any) -> Any:
    """[3, h, w] float32 in -1..1, as the DUSt3R family wants its images [h, w, 3] in 0..1."""
    import torch

    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)) * 2 - 1)


def _as_input(view: PreparedView) -> dict[str, Any]:
    height, width = view.image.shape[:2]
    return {
        "img": as_signed_tensor(view.image)[None],
        "true_shape": np.array([[height, width]], np.int32),
        "idx": view.index,
        "instance": str(view.index),
    }
