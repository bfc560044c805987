"""VGGT (Wang et al., CVPR 2025): any number of images to depth maps and cameras."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from typing import Any, ClassVar

import numpy as np

from pipeline.artifacts.views import View
from stages.pointmaps.interface import ModelCard, PreparedView, ViewPrediction
from stages.pointmaps.loading import checkpoint_file, import_module, offline, to_numpy
from stages.pointmaps.options import PointmapOptions
from stages.pointmaps.prepare import fixed_width, padded_alike, prepare


class Vggt:
    """The user's VGGT. Its depth maps and cameras are more accurate than its pointmap head."""

    card: ClassVar[ModelCard] = ModelCard(
        name="vggt",
        title="VGGT",
        package="vggt",
        repository="https://github.com/facebookresearch/vggt",
        install="pip install git+https://github.com/facebookresearch/vggt.git",
        code_licence="VGGT licence (LICENSE.txt of the repository)",
        weights_licence="VGGT-1B: CC BY-NC 4.0; VGGT-1B-Commercial: VGGT licence, commercial use "
        "allowed, on application",
        weights="model.pt or model.safetensors is at https://huggingface.co/facebook/VGGT-1B.",
        weights_gb=5.0,
        gb_per_image=0.45,
        pixels=518 * 392,
    )
    hub_name: ClassVar[str] = "facebook/VGGT-1B"

    def __init__(self, options: PointmapOptions, device: Any) -> None:
        import torch

        named = (options.package, options.package_folder)
        network = import_module(self.card, "models.vggt", *named).VGGT
        self._decode = import_module(
            self.card, "utils.pose_enc", *named
        ).pose_encoding_to_extri_intri
        path = checkpoint_file(self.card, options.checkpoint, folder_allowed=True)
        with offline(self.card):
            if path is not None and path.is_file():
                model = network()
                if path.suffix == ".safetensors":
                    from safetensors.torch import load_file

                    weights = load_file(path)
                else:
                    weights = torch.load(path, map_location="cpu", weights_only=True)
                # The commercial weights come without heads that are not needed here.
                model.load_state_dict(weights, strict=False)
            else:
                model = network.from_pretrained(str(path) if path else self.hub_name)
            self._model = model.to(device).eval()
        self._device = device

    @staticmethod
    def prepare(views: list[View], options: PointmapOptions) -> list[PreparedView]:
        """Width 518, height a multiple of 14, all of one size by white borders."""
        return padded_alike(
            [prepare(view, k, fixed_width(view.width, view.height)) for k, view in enumerate(views)]
        )

    def predict_views(self, views: Sequence[PreparedView]) -> list[ViewPrediction]:
        """Points of all images in one world, lifted from the depth maps."""
        import torch

        images = torch.from_numpy(np.stack([view.image.transpose(2, 0, 1) for view in views]))
        half = nullcontext()
        if self._device.type == "cuda":
            modern = torch.cuda.get_device_capability(self._device)[0] >= 8
            half = torch.autocast(  # type: ignore[assignment]
                "cuda", dtype=torch.bfloat16 if modern else torch.float16
            )
        with offline(self.card), torch.no_grad(), half:
            found = self._model(images.to(self._device))
            extrinsic, intrinsic = self._decode(found["pose_enc"].float(), images.shape[-2:])
        depths = to_numpy(found["depth"])[0, ..., 0]
        confidences = to_numpy(found["depth_conf"])[0]
        return [
            lifted(depth, confidence, pose, matrix)
            for depth, confidence, pose, matrix in zip(
                depths, confidences, to_numpy(extrinsic)[0], to_numpy(intrinsic)[0], strict=True
            )
        ]


def lifted(depth: Any, confidence: Any, extrinsic: Any, intrinsic: Any) -> ViewPrediction:
    """Lift a depth map [h, w] with extrinsics [3, 4] and intrinsics [3, 3] into the world."""
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5
    local = np.stack(
        [
            (u - intrinsic[0, 2]) / intrinsic[0, 0] * depth,
            (v - intrinsic[1, 2]) / intrinsic[1, 1] * depth,
            depth,
        ],
        -1,
    )
    pose = np.eye(4)
    pose[:3] = extrinsic
    points = (local - pose[:3, 3]) @ pose[:3, :3]
    return ViewPrediction(points.astype(np.float32), local.astype(np.float32), confidence, pose)
