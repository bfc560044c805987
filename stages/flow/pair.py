"""Flow between two views in both directions, with its masks: the pieces put together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.views import to_uint8
from stages.flow import estimate, geometry

Array = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

#: Blur (sigma, pixels) of the flow that cameras and points predict.
_PREDICTED_BLUR = 2.0
#: Relative difference of depth that is still the same surface, and hides nothing.
_SAME_SURFACE = 0.02


@dataclass(frozen=True)
class Side:
    """One of the two views.

    Attributes:
        image: [H, W, 3] float32 sRGB in 0..1.
        valid: [H, W] bool, where the photograph may be used.
        camera: its camera, or None.
        depth: [H, W] float32 depth (z) from geometry, 0 where unknown; or None.
    """

    image: Array
    valid: Mask
    camera: Camera | None = None
    depth: Array | None = None

    def gray(self) -> npt.NDArray[np.uint8]:
        return np.asarray(cv2.cvtColor(to_uint8(self.image), cv2.COLOR_RGB2GRAY))


@dataclass(frozen=True)
class Estimator:
    """How flow is estimated: see the fields of the same names in the stage's config."""

    method: estimate.Method = "dis"
    normalization: float = 4.0
    prewarp: bool = True


@dataclass(frozen=True)
class Trust:
    """When flow is trusted: see the fields of the same names in the stage's config."""

    mask: Literal["consistency", "none"] = "consistency"
    consistency_relative: float = 0.0
    consistency_absolute: float = 0.25
    min_texture: float = 2.0
    highlight_level: float = 1.0


@dataclass(frozen=True)
class OneWay:
    """Flow from one view to the other.

    Attributes:
        flow: [H, W, 2] float32 pixels.
        mask: [H, W] bool, where it can be trusted.
        deviation: distance in pixels of the trusted flow from the flow that geometry predicts,
            [M] for the M trusted pixels where geometry is known; empty without geometry.
    """

    flow: Array
    mask: Mask
    deviation: Array


def flow_between(i: Side, j: Side, estimator: Estimator, trust: Trust) -> tuple[OneWay, OneWay]:
    """Estimate flow from i to j and from j to i, and where each can be trusted.

    A pixel is trusted if the flow there and back agrees (`estimate.consistency_mask`), it starts
    and ends on valid pixels, and no test that applies speaks against it: with pre-warp, the
    surface is known there and not hidden in the other view; texture; highlights. With the mask
    ``"none"`` the valid pixels are all that is asked for.

    Args:
        i, j: the views; `camera` and `depth` of both are needed for the pre-warp.
        estimator: how to estimate.
        trust: when to trust.

    Returns:
        Forward (i to j) and backward (j to i).
    """
    predictions = [_predict(a, b) for a, b in ((i, j), (j, i))]
    flows, residuals = [], []
    for (a, b), prediction in zip(((i, j), (j, i)), predictions, strict=True):
        if prediction is not None and estimator.prewarp:
            start = geometry.extend(prediction.flow, prediction.known, _PREDICTED_BLUR)
        else:
            start = estimate.centred_start(_size(a), _size(b))
        flow, residual = estimate.estimate_flow(
            estimate.local_contrast(a.gray(), estimator.normalization),
            estimate.local_contrast(b.gray(), estimator.normalization),
            start,
            estimator.method,
        )
        flows.append(flow)
        residuals.append(residual)

    results = []
    for index, (a, b) in enumerate(((i, j), (j, i))):
        flow, other = flows[index], 1 - index
        mask = _usable(a, trust) & estimate.lands_on(flow, _usable(b, trust))
        if trust.mask == "consistency":
            mask &= estimate.consistency_mask(
                flow, flows[other], residuals[index], residuals[other],
                trust.consistency_relative, trust.consistency_absolute,
            )  # fmt: skip
        prediction = predictions[index]
        if prediction is not None and estimator.prewarp and trust.mask == "consistency":
            assert b.depth is not None
            mask &= prediction.known & ~geometry.occluded(
                prediction.flow, prediction.depth_in_other, b.depth, _SAME_SURFACE
            )
        deviation = np.zeros(0, np.float32)
        if prediction is not None:
            compared = mask & prediction.known
            deviation = np.linalg.norm(flow - prediction.flow, axis=-1)[compared]
        results.append(OneWay(flow, mask, deviation))
    return results[0], results[1]


@dataclass(frozen=True)
class _Prediction:
    flow: Array
    depth_in_other: Array
    known: Mask


def _predict(a: Side, b: Side) -> _Prediction | None:
    if a.camera is None or b.camera is None or a.depth is None or b.depth is None:
        return None
    flow, depth_in_b = geometry.predicted_flow(a.depth, a.camera, b.camera)
    return _Prediction(flow, depth_in_b, depth_in_b > 0)


def _size(side: Side) -> tuple[int, int]:
    return side.image.shape[1], side.image.shape[0]


def _usable(side: Side, trust: Trust) -> Mask:
    usable = side.valid
    if trust.mask == "none":
        return usable
    if trust.min_texture > 0:
        usable = usable & estimate.textured(side.gray(), trust.min_texture)
    if trust.highlight_level < 1:
        usable = usable & ~estimate.highlights(side.image, trust.highlight_level)
    return usable
