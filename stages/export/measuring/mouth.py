"""The teeth of a scene, as its exports show them: crowns, landmarks, measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.space.scale import Scale
from pipeline.artifacts.teeth import Crown, Dentition, Teeth
from pipeline.artifacts.views import View, Views
from stages.dentition.working import outline_in_view
from stages.export.measuring.landmarks import read_landmarks
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
    """A dentition in pixels of the image that is exported (see `outline_in_view`), without papillae
    and embrasures."""
    size = (view.width, view.height)
    if dentition.size == size and not view.lens_taken_out:
        return dentition

    def moved(crown: Crown) -> Crown:
        points = np.concatenate([[crown.zenith, crown.tip], crown.outline.reshape(-1, 2)])
        (zenith, tip), outline = np.split(outline_in_view(points, dentition.size, view), [2])
        wider = 1.0
        if len(outline):
            before, after = (np.hypot(*np.ptp(o, axis=0)) for o in (crown.outline, outline))
            wider = float(after) / max(float(before), 1e-9)
        return replace(
            crown, zenith=zenith, tip=tip, outline=outline,
            width=wider * crown.width, height=wider * crown.height,
            papilla_left=None, papilla_right=None, embrasure_left=None, embrasure_right=None,
        )  # fmt: skip

    upper, lower = (tuple(map(moved, row)) for row in (dentition.upper, dentition.lower))
    return replace(dentition, size=size, upper=upper, lower=lower)
