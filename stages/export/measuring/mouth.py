"""The teeth of a scene, as its exports show them: crowns, landmarks, measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.space.scale import Scale
from pipeline.artifacts.teeth import Dentition, Teeth
from pipeline.artifacts.views import View, Views
from stages.dentition.working import outline_in_view
from stages.export.measuring.landmarks import (
    landmark_pixels,
    moved_dentition,
    read_landmarks,
)
from stages.export.measuring.measures import measure_mouth, mouth_axes
from stages.export.teeth import LEAST_ALPHA
from stages.splatting.rendering import RenderedView

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Mouth:
    """What is known of the teeth as a whole.

    Attributes:
        dentitions: of the placed photographs that show teeth, in pixels of the exported images.
        axes: [3, 3] rows: the patient's left, up, out of the mouth; None: not known.
        measurements: see `measure_mouth`.
    """

    dentitions: Mapping[str, Dentition]
    axes: Array | None
    measurements: Sequence[Mapping[str, Any]]


def read_mouth(
    teeth: Teeth,
    views: Views,
    cameras: Sequence[Camera],
    seen: Sequence[RenderedView],
    up: Array,
    scale: Scale,
) -> Mouth:
    """Measure a mouth.

    Args:
        teeth: the crowns, photograph by photograph.
        views: the photographs as the scene was made of them.
        cameras: of the placed ones, in the frame of the exports.
        seen: the scene as each of these cameras sees it.
        up: [3] upwards.
        scale: see `measure_mouth`.
    """
    by_name, read = views.by_name(), teeth.by_name()
    found: dict[str, Dentition] = {}
    shown: list[Camera] = []
    depths: list[npt.NDArray[np.floating]] = []
    for camera, rendered in zip(cameras, seen, strict=True):
        dentition = read.get(camera.name)
        if dentition is None or dentition.set_aside:
            continue
        view = by_name[camera.name]
        found[camera.name] = exported_dentition(dentition, view)
        shown.append(camera)
        known = np.isfinite(rendered.depth) & (rendered.alpha >= LEAST_ALPHA) & view.valid()
        depths.append(np.where(known, rendered.depth, 0))
    reading = read_landmarks(list(found.values()), shown, depths)
    return Mouth(found, mouth_axes(reading.places, up), measure_mouth(reading, up, scale))


def exported_dentition(dentition: Dentition, view: View) -> Dentition:
    """A dentition in pixels of the image that is exported (see `outline_in_view`)."""
    crowns = dentition.all_crowns
    size = (view.width, view.height)
    if dentition.size == size and not view.lens_taken_out:
        return dentition
    pixels = [landmark_pixels(crown) for crown in crowns]
    if pixels:
        moved = outline_in_view(np.concatenate(pixels), dentition.size, view)
        split = np.cumsum([len(points) for points in pixels])[:-1]
        dentition = moved_dentition(dentition, dict(enumerate(np.split(moved, split))))
    return replace(dentition, size=size)
