"""MUSt3R (Cabon et al., CVPR 2025): any number of images to pointmaps in one world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from stages.pointmaps.interface import ModelCard, PreparedView, ViewPrediction
from stages.pointmaps.loading import import_module, offline, required_checkpoint, to_numpy
from stages.pointmaps.models.dust3r import Dust3r, as_signed_tensor
from stages.pointmaps.options import PointmapOptions

#: Views that MUSt3R starts from together; the others follow one by one.
_FIRST_VIEWS = 2


class Must3r:
    """The user's MUSt3R, all views in its memory."""

    card: ClassVar[ModelCard] = ModelCard(
        name="must3r",
        title="MUSt3R",
        package="must3r",
        repository="https://github.com/naver/must3r",
        install="pip install must3r@git+https://github.com/naver/must3r.git",
        code_licence="MUSt3R Non-Commercial License",
        weights_licence="MUSt3R Non-Commercial License and the terms of the training data (NOTICE)",
        weights="MUSt3R_512.pth is linked in the README of the repository.",
        weights_gb=1.8,
        gb_per_image=0.25,
        pixels=512 * 384,
    )

    def __init__(self, options: PointmapOptions, device: Any) -> None:
        named = (options.package, options.package_folder)
        model_module = import_module(self.card, "model", *named)
        self._engine = import_module(self.card, "engine.inference", *named)
        path = required_checkpoint(self.card, options.checkpoint)
        with offline(self.card):
            self._encoder, self._decoder = model_module.load_model(
                str(path), device=device, img_size=options.long_side, verbose=False
            )
            self._activation = model_module.get_pointmaps_activation(self._decoder, verbose=False)
        self._device = device

    prepare = staticmethod(Dust3r.prepare)

    def predict_views(self, views: Sequence[PreparedView]) -> list[ViewPrediction]:
        """Points of all images in the world of the first."""
        import torch

        def answer(raw: Any) -> Any:
            return self._engine.postprocess(
                raw, pointmaps_activation=self._activation, compute_cam=True
            )

        first = min(_FIRST_VIEWS, len(views))
        with offline(self.card):
            _, found = self._engine.inference_multi_ar(
                self._encoder,
                self._decoder,
                [as_signed_tensor(view.image).to(self._device) for view in views],
                [torch.tensor(k) for k in range(len(views))],
                [torch.tensor(view.image.shape[:2]).to(self._device) for view in views],
                [first] + [1] * (len(views) - first),
                max_bs=1,
                verbose=False,
                device=self._device,
                preserve_gpu_mem=True,
                post_process_function=answer,
            )
            return [
                ViewPrediction(
                    to_numpy(one["pts3d"]),
                    to_numpy(one["pts3d_local"]),
                    to_numpy(one["conf"]),
                    np.linalg.inv(to_numpy(one["c2w"]).astype(np.float64)),
                )
                for one in found
            ]
