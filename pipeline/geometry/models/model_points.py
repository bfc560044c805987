"""The sparse points of a COLMAP model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.points import Points
from pipeline.errors import RequestError
from pipeline.geometry.cloud import neighbour_distances
from pipeline.untrusted.files import UnusableFile
from pipeline.untrusted.scenes.colmap import read_cloud, read_model

Integers = npt.NDArray[np.int64]


@dataclass(frozen=True)
class ModelPoints:
    """Points as the model has them, in its world, sorted by their identifiers there.

    Attributes:
        positions: [P, 3] float64.
        colors: [P, 3] float32 sRGB in 0..1; black where the model was made without colours.
        observed: image name -> [K] sorted indices of the points that it observes.
    """

    positions: npt.NDArray[np.float64]
    colors: npt.NDArray[np.float32]
    observed: dict[str, Integers]

    def __len__(self) -> int:
        return len(self.positions)

    def track_lengths(self) -> Integers:
        """[P] in how many images each point was found."""
        count = np.zeros(len(self), np.int64)
        for indices in self.observed.values():
            count[indices] += 1
        return count


def read_model_points(folder: Path) -> ModelPoints:
    """Read the points of a COLMAP model (text or binary, of any version).

    Args:
        folder: of the model's files.

    Raises:
        RequestError: a file of them is missing or damaged.
    """
    try:
        model, cloud = read_model(folder), read_cloud(folder)
    except UnusableFile as error:
        raise RequestError(f"The model {folder} {error}. Is it whole?") from error
    strangers = np.setdiff1d(cloud.images, np.array(list(model.images), np.uint32))
    if len(strangers):
        raise RequestError(
            f"The model {folder} holds points that image {strangers[0]} observes, which is not in "
            "its images. Is it whole?"
        )
    order = np.argsort(cloud.numbers)
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    by_image = np.argsort(cloud.images, kind="stable")
    points = np.repeat(rank, cloud.lengths)[by_image]
    ends = np.searchsorted(cloud.images[by_image], list(model.images), side="right")
    begins = np.searchsorted(cloud.images[by_image], list(model.images), side="left")
    observed = {
        image.name: np.unique(points[begin:end])
        for image, begin, end in zip(model.images.values(), begins, ends, strict=True)
    }
    return ModelPoints(
        positions=cloud.positions[order],
        colors=cloud.colors[order].astype(np.float32) / np.float32(255),
        observed=dict(sorted(observed.items())),
    )


def as_points(
    positions: npt.NDArray[np.float64],
    colors: npt.NDArray[np.float32],
    observed: Mapping[str, Integers],
    cameras: Mapping[str, Camera],
) -> Points:
    """Sparse points as a cloud to start a fit from.

    The normal points to the cameras that observed the point (their mean direction), the confidence
    is the number of images that it was found in, and the scale the mean distance to its three
    nearest neighbours, as in 3D Gaussian Splatting.

    Args:
        positions: [P, 3] in the world of `cameras`.
        colors: [P, 3] sRGB in 0..1.
        observed: name -> [K] indices of points that it observes.
        cameras: name -> camera; observations by others only count for the confidence.
    """
    normals = np.zeros((len(positions), 3))
    count = np.zeros(len(positions))
    for name, indices in sorted(observed.items()):
        count[indices] += 1
        if name in cameras:
            towards = cameras[name].centre - positions[indices]
            length = np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
            normals[indices] += towards / length
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return Points(
        positions=positions.astype(np.float32),
        colors=np.asarray(colors, np.float32),
        normals=normals.astype(np.float32),
        confidence=np.maximum(count, 1).astype(np.float32),
        scale=neighbour_distances(positions),
    )
