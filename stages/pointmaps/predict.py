"""The entry of the pointmap path: photographs in, pairwise pointmaps out."""

from __future__ import annotations

import contextlib
import hashlib
import importlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.artifacts.pointmaps import PointmapPair
from pipeline.artifacts.views import View
from pipeline.errors import RequestError, nearest
from pipeline.installed import library_version
from stages.pointmaps.files import match_names, pointmap_files, read_pairs
from stages.pointmaps.graph import choose_graph, scene_pairs
from stages.pointmaps.interface import ModelCard, PreparedView, ViewPrediction
from stages.pointmaps.loading import choose_device, is_installed
from stages.pointmaps.memory import answer_gb, check_memory, needed_gb
from stages.pointmaps.options import METHODS, MODELS, PointmapOptions
from stages.pointmaps.prepare import clean_map, resample_map

Progress = Callable[[str, int, int], None]

#: Module and class of each adapter; imported when it is asked for.
_ADAPTERS = {
    "dust3r": ("stages.pointmaps.models.dust3r", "Dust3r"),
    "mast3r": ("stages.pointmaps.models.mast3r", "Mast3r"),
    "must3r": ("stages.pointmaps.models.must3r", "Must3r"),
    "vggt": ("stages.pointmaps.models.vggt", "Vggt"),
    "mapanything": ("stages.pointmaps.models.mapanything", "MapAnything"),
}


def adapter(method: str) -> Any:
    """The adapter class of a model.

    Raises:
        RequestError: there is none of that name.
    """
    if method not in _ADAPTERS:
        raise RequestError(
            f"There is no pointmap model '{method}'; choose one of {', '.join(METHODS)}."
            + nearest(method, METHODS)
        )
    module, name = _ADAPTERS[method]
    return getattr(importlib.import_module(module), name)


def cards() -> list[ModelCard]:
    """What there is to know of every model that has an adapter (for `pipeline doctor`)."""
    return [adapter(name).card for name in MODELS]


def available() -> list[str]:
    """The models whose package is installed here, best first. Imports none of them."""
    return [card.name for card in cards() if is_installed(card.package)]


def source_files(options: PointmapOptions) -> dict[str, Path]:
    """The user's files that the pointmaps depend on, by a label without folders.

    They belong to the key of what is computed from them. Nothing is checked here.
    """
    chosen = options.files if options.method == "files" else options.checkpoint
    if chosen is None:
        return {}
    if chosen.is_dir():
        pattern = "*.npz" if options.method == "files" else "*"
        return {path.name: path for path in sorted(chosen.glob(pattern)) if path.is_file()}
    return {"checkpoint": chosen} if chosen.is_file() else {}


def model_code(options: PointmapOptions) -> str:
    """Which code answers: model, versions of its package and of torch, checkout; "" for files.

    It belongs to the key of what is computed with it.
    """
    if options.method == "files":
        return ""
    package = options.package or adapter(options.method).card.package
    versions = ", ".join(f"{name} {library_version(name)}" for name in (package, "torch"))
    if options.package_folder is None:
        return f"{options.method} ({versions})"
    digest = hashlib.sha256()
    for path in sorted((options.package_folder / package).rglob("*.py")):
        digest.update(path.read_bytes())
    return f"{options.method} ({versions}, checkout {digest.hexdigest()[:12]})"


def predict_pointmaps(
    views: Sequence[View],
    ordered: bool,
    options: PointmapOptions,
    progress: Progress = lambda step, done, total: None,
    threads: int = 1,
) -> list[PointmapPair]:
    """Ask a model, or read files: pairs at the pixels of the views.

    Outside a view's mask, where a model did not look and where its answer is no number, the
    confidence is 1. A model's answer on the CPU may depend on the number of threads.

    Args:
        views: the photographs, at least two.
        ordered: whether they are in the order in which they were taken.
        options: see `PointmapOptions`.
        progress: called with (step, done, total).
        threads: for models on the CPU.

    Raises:
        RequestError: too few views, a model or weights that are missing, files that don't fit, or
            too little memory; the message says what to do.
    """
    if len(views) < 2:
        raise RequestError("Pointmaps need at least two photographs.")
    if options.method == "files":
        files = match_names(pointmap_files(options.files), views, options.file_names)
        return list(read_pairs(files, views, options.edge_jump, progress))
    kind = adapter(options.method)
    multi_view = hasattr(kind, "predict_views")
    graph = choose_graph(options.graph, len(views), ordered, multi_view, options.complete_up_to)
    pairs = scene_pairs(
        graph, len(views), options.window, options.reference, options.symmetric and not multi_view
    )
    prepared = kind.prepare(list(views), options)
    device = choose_device(options.device)
    check_memory(
        kind.card,
        device,
        needed_gb(kind.card, [int(np.prod(v.image.shape[:2])) for v in prepared], multi_view),
        answer_gb(pairs, [view.width * view.height for view in views]),
        options.max_memory_gb,
        multi_view,
    )
    progress("load model", 0, 1)
    with _threads(threads):
        model = kind(options, device)
        progress("load model", 1, 1)
        if multi_view:
            progress("pointmaps", 0, 1)
            answers = _checked(kind.card, prepared, model.predict_views(prepared))
            progress("pointmaps", 1, 1)
            return list(_pairs_of_views(pairs, views, prepared, answers, options))
        found = []
        for done, (i, j) in enumerate(pairs):
            progress("pointmaps", done, len(pairs))
            answer = model.predict_pair(prepared[i], prepared[j])
            first = _at_view(views[i], prepared[i], answer.points_i, answer.confidence_i, options)
            second = _at_view(
                views[j], prepared[j], answer.points_j_in_i, answer.confidence_j, options
            )
            found.append(
                PointmapPair(views[i].name, views[j].name, first[0], second[0], first[1], second[1])
            )
        progress("pointmaps", len(pairs), len(pairs))
        return found


@contextlib.contextmanager
def _threads(count: int) -> Iterator[None]:
    """torch on so many threads for a while."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(max(1, count))
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _at_view(
    view: View, prepared: PreparedView, points: Any, confidence: Any, options: PointmapOptions
) -> tuple[Any, Any]:
    """A model's map at the pixels of the view, without bad values and outside the mask unknown."""
    shape = prepared.image.shape[:2]
    if points.shape != (*shape, 3) or confidence.shape != shape:
        raise RequestError(
            f"The model answered with maps of the shape {points.shape} for an image of "
            f"{shape[1]}x{shape[0]} pixels: its package is of a version that this adapter does not "
            "know."
        )
    points, confidence = clean_map(points, confidence)
    points, confidence = resample_map(
        points, confidence, prepared.model_from_view, prepared.view_size, options.edge_jump
    )
    return points, np.where(view.valid(), confidence, np.float32(1))


def _checked(
    card: ModelCard, prepared: Sequence[PreparedView], answers: Sequence[ViewPrediction]
) -> Sequence[ViewPrediction]:
    if len(answers) != len(prepared):
        raise RequestError(
            f"{card.title} answered for {len(answers)} of {len(prepared)} photographs: its package "
            "is of a version that this adapter does not know."
        )
    return answers


def _pairs_of_views(
    pairs: Sequence[tuple[int, int]],
    views: Sequence[View],
    prepared: Sequence[PreparedView],
    answers: Sequence[ViewPrediction],
    options: PointmapOptions,
) -> Iterator[PointmapPair]:
    """Pairs from one world: view j's points are carried into the camera frame of i."""
    local = [
        _at_view(view, ready, answer.local_points, answer.confidence, options)
        for view, ready, answer in zip(views, prepared, answers, strict=True)
    ]
    world: Mapping[int, tuple[Any, Any]] = {
        j: _at_view(views[j], prepared[j], answers[j].points, answers[j].confidence, options)
        for j in sorted({j for _, j in pairs})
    }
    for i, j in pairs:
        pose = answers[i].cam_from_world
        carried = world[j][0].astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
        yield PointmapPair(
            views[i].name, views[j].name, local[i][0], carried.astype(np.float32), local[i][1],
            world[j][1],
        )  # fmt: skip
