"""Settings of the pointmap path. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

#: The learned models that there is an adapter for, in the order in which `auto` prefers them:
#: multi-view models need one pass where pairwise ones need one per pair.
MODELS = ("mapanything", "vggt", "must3r", "mast3r", "dust3r")
#: All values of `method`: the models, and pointmaps made elsewhere.
METHODS = (*MODELS, "files")


@dataclass(frozen=True)
class PointmapOptions:
    """Settings of `predict.predict_pointmaps`.

    Attributes:
        method: one of `METHODS`.
        checkpoint: the model's weights: a file, or for vggt and mapanything also a folder as
            Hugging Face lays it out. None: what the package finds in its own local cache; nothing
            is ever downloaded.
        package: name of the Python package, if not the usual one (a fork).
        package_folder: a checkout to import the package from, if it is not installed.
        files: folder of `.npz` pointmaps, for method "files".
        file_names: what the names in `files` mean: "source" (file names of the photographs),
            "neutral" (names of the views: 000, 001, ...) or "auto".
        device: "auto" (CUDA if there), "cpu", "cuda", "cuda:1", ...
        long_side: long side of the images that dust3r, mast3r and must3r see, pixels; what their
            weights were trained for (512 or 224).
        graph: which pairs: "complete", "window" (each view with the next ones), "star" (all with
            one) or "auto".
        complete_up_to: auto takes all pairs up to this many views.
        window: next views that each view is paired with.
        reference: number of the view that a star is around; None: the middle one.
        symmetric: ask pairwise models for each pair in both orders; they answer differently.
        max_memory_gb: refuse to start where more than this would be needed; None: what is free.
        edge_jump: neighbouring pixels of a map whose points are further apart than this share of
            their distance are not on one surface, and nothing is interpolated between them.
    """

    method: str = "files"
    checkpoint: Path | None = None
    package: str | None = None
    package_folder: Path | None = None
    files: Path | None = None
    file_names: str = "auto"
    device: str = "auto"
    long_side: int = 512
    graph: str = "auto"
    complete_up_to: int = 8
    window: int = 3
    reference: int | None = None
    symmetric: bool = True
    max_memory_gb: float | None = None
    edge_jump: float = 0.03
