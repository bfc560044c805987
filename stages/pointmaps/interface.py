"""What a pointmap model is given and what it gives back, for pairwise and multi-view models."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float32]


@dataclass(frozen=True)
class PreparedView:
    """One photograph as a model wants it.

    Attributes:
        name: of the view.
        index: number of the view among those given.
        image: [h, w, 3] float32 sRGB in 0..1; what else it needs, the adapter does.
        model_from_view: [3, 3] float64 affine map from pixels of the view to pixels of `image`.
        view_size: (width, height) of the view.
    """

    name: str
    index: int
    image: Array
    model_from_view: npt.NDArray[np.float64]
    view_size: tuple[int, int]


@dataclass(frozen=True)
class PairPrediction:
    """A model's answer for two views, in the pixels of the prepared images.

    Attributes:
        points_i: [h_i, w_i, 3] float32 in the camera frame of i.
        points_j_in_i: [h_j, w_j, 3] float32 in the camera frame of i.
        confidence_i, confidence_j: [h, w] float32, raw, >= 1; 1: nothing known.
    """

    points_i: Array
    points_j_in_i: Array
    confidence_i: Array
    confidence_j: Array


@dataclass(frozen=True)
class ViewPrediction:
    """A multi-view model's answer for one view, in the pixels of the prepared image.

    Attributes:
        points: [h, w, 3] float32 in the model's world.
        local_points: [h, w, 3] float32 in the view's camera frame.
        confidence: [h, w] float32, raw, >= 1; 1: nothing known.
        cam_from_world: [4, 4] float64 rigid.
    """

    points: Array
    local_points: Array
    confidence: Array
    cam_from_world: npt.NDArray[np.float64]


@dataclass(frozen=True)
class ModelCard:
    """What a user has to know of a model before it runs.

    Attributes:
        name: value of `PointmapOptions.method`.
        title: as its authors write it.
        package: top-level Python package.
        repository: where it comes from.
        install: how to install it, one line.
        code_licence, weights_licence: in a few words.
        weights: how to come by the weights.
        weights_gb: size of the parameters in float32.
        gb_per_image: further memory per image of `pixels` that is in the model at once.
        pixels: of the image that `gb_per_image` speaks of.
    """

    name: str
    title: str
    package: str
    repository: str
    install: str
    code_licence: str
    weights_licence: str
    weights: str
    weights_gb: float
    gb_per_image: float
    pixels: int
