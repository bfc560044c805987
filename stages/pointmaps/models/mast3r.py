"""MASt3R (Leroy et al., ECCV 2024): DUSt3R with metric pointmaps; its descriptors are not used."""

from __future__ import annotations

from typing import ClassVar

from stages.pointmaps.interface import ModelCard
from stages.pointmaps.models.dust3r import Dust3r


class Mast3r(Dust3r):
    """The user's MASt3R, which is called as DUSt3R is."""

    card: ClassVar[ModelCard] = ModelCard(
        name="mast3r",
        title="MASt3R",
        package="mast3r",
        repository="https://github.com/naver/mast3r",
        install="git clone --recursive https://github.com/naver/mast3r && pip install -r "
        "mast3r/requirements.txt -r mast3r/dust3r/requirements.txt, then name the checkout as "
        "init.pointmap.package_folder (or on PYTHONPATH)",
        code_licence="CC BY-NC-SA 4.0 (not for commercial use)",
        weights_licence="CC BY-NC-SA 4.0 and the terms of the training data (CHECKPOINTS_NOTICE)",
        weights="MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric.pth is linked in the README of "
        "the repository.",
        weights_gb=2.8,
        gb_per_image=0.7,
        pixels=512 * 384,
    )
    model_class: ClassVar[str] = "AsymmetricMASt3R"
    hub_name: ClassVar[str] = "naver/MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric"
