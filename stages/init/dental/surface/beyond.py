"""What lies beyond the gum that the reader knows: kept where photographs agree on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.confidence import MEASURED
from stages.init.dental.solution import ArchFit, PlacedView
from stages.init.dental.surface.chart.looks import SurfaceView
from stages.init.dental.surface.dense import ArchSurface

Mask = npt.NDArray[np.bool_]


def without_guesses_beyond(
    surface: ArchSurface, fit: ArchFit, jaws: Sequence[Mask | None]
) -> ArchSurface:
    """Leave out what is neither on the jaws as the reader shows them nor measured.

    Mucosa beyond the fold goes on from the gum, and a surface of it is worth having where
    photographs match on it. Where they don't it may be a lip or a retractor.

    Args:
        surface: made as if all that photographs show were tooth or gum.
        fit: cameras.
        jaws: of each photograph [H, W], in its pixels: where it shows tooth or gum.
    """
    kept = surface.confidence >= MEASURED
    views: list[SurfaceView | None] = []
    for found, jaw, placed in zip(surface.views, jaws, fit.views, strict=True):
        if found is not None and jaw is not None and placed is not None:
            kept |= _lies_on(jaw, surface.positions, placed)
            found = _where(jaw | (found.confidence >= MEASURED), found)
        views.append(found)
    place = np.cumsum(kept) - 1
    faces = surface.faces[kept[surface.faces].all(axis=1)]
    return replace(
        surface,
        views=tuple(views),
        positions=surface.positions[kept],
        colors=surface.colors[kept],
        normals=surface.normals[kept],
        confidence=surface.confidence[kept],
        tooth=surface.tooth[kept],
        faces=place[faces].astype(np.int32),
    )


def _where(kept: Mask, found: SurfaceView) -> SurfaceView:
    return SurfaceView(
        depth=np.where(kept, found.depth, np.float32(0)),
        normal=np.where(kept[..., None], found.normal, np.float32(0)),
        confidence=np.where(kept, found.confidence, np.float32(1)),
    )


def _lies_on(mask: Mask, points: npt.NDArray[np.float32], placed: PlacedView) -> Mask:
    """[N] bool: where a photograph [H, W] would show points [N, 3], its mask is True."""
    height, width = mask.shape
    camera = placed.camera("", width, height)
    pixels, depths = camera.project(points)
    lies = camera.shows(pixels, depths)
    column, row = pixels[lies].astype(int).T
    lies[lies] = mask[row, column]
    return lies
