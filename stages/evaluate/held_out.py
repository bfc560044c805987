"""Cameras of photographs that the reconstruction never saw: registered from the ground truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.views import View
from pipeline.errors import RequestError
from pipeline.geometry.similarity import camera_similarity, moved_camera

Array = npt.NDArray[np.float64]

#: How the registered cameras come about, for whoever reads the figures.
ALIGNMENT = (
    "similarity that brings the reconstructed cameras of the input views onto the true ones, least "
    "squares over centres and orientations"
)
#: Lenses that differ less than this in any parameter, relative, are the same.
_SAME_LENS = 1e-3


@dataclass(frozen=True)
class Registration:
    """How a reconstruction lies in the world of the ground truth.

    Attributes:
        names: views that have both a reconstructed and a true camera.
        scale, rotation, shift: similarity, true = s R reconstructed + t.
        focal_ratio: reconstructed focal length over the true one, median of the views.
        centre_shift: [2] reconstructed minus true principal point in true focal lengths, median.
    """

    names: tuple[str, ...]
    scale: float
    rotation: Array
    shift: Array
    focal_ratio: float
    centre_shift: Array

    def to_truth(self, points: npt.NDArray[np.floating]) -> Array:
        """Points [..., 3] of the reconstruction in the world of the ground truth."""
        return np.asarray(points, np.float64) @ (self.scale * self.rotation.T) + self.shift

    def pose_in_truth(self, cam_from_world: Array) -> Array:
        """[4, 4] cam_from_world of a reconstructed camera in the world of the ground truth."""
        return moved_camera(cam_from_world, self.scale, self.rotation, self.shift)

    def registered(self, truth: Camera) -> Camera:
        """The reconstruction's camera of a photograph whose true camera is known.

        Pose by the similarity; the focal length is the true one times `focal_ratio`, since that is
        the lens which the reconstruction believes in.
        """
        inverse = self.rotation.T
        pose = moved_camera(
            truth.cam_from_world, 1 / self.scale, inverse, -inverse @ self.shift / self.scale
        )
        return replace(
            truth, cam_from_world=pose,
            fx=truth.fx * self.focal_ratio, fy=truth.fy * self.focal_ratio,
            cx=truth.cx + self.centre_shift[0] * truth.fx,
            cy=truth.cy + self.centre_shift[1] * truth.fy,
        )  # fmt: skip


def register(
    cameras: Mapping[str, Camera], truth: Mapping[str, Camera], depth: float
) -> Registration:
    """Lay the reconstruction into the world of the ground truth, by the cameras of both.

    Args:
        cameras: reconstructed ones by name; truth: true ones by name, for the same image sizes.
        depth: of the scene from the reconstructed cameras, in its units (see
            `camera_similarity`).

    Raises:
        RequestError: fewer than two cameras, at two places, are in both.
    """
    names = [name for name in cameras if name in truth]
    try:
        scale, rotation, shift = camera_similarity(
            np.array([cameras[name].cam_from_world for name in names]).reshape(-1, 4, 4),
            np.array([truth[name].cam_from_world for name in names]).reshape(-1, 4, 4),
            depth,
        )
    except ValueError as error:
        raise RequestError(
            f"evaluate.ground_truth: {len(names)} of the {len(cameras)} reconstructed cameras have "
            f"a true one, and {error}; the two worlds can't be aligned."
        ) from None
    pairs = [(cameras[name], truth[name]) for name in names]
    ratios = [0.5 * (ours.fx / true.fx + ours.fy / true.fy) for ours, true in pairs]
    shifts = [
        ((ours.cx - true.cx) / true.fx, (ours.cy - true.cy) / true.fy) for ours, true in pairs
    ]
    return Registration(
        tuple(names), scale, rotation, shift, float(np.median(ratios)), np.median(shifts, axis=0)
    )


def common_lens(views: Sequence[View]) -> str | None:
    """The lens that was taken out of all views alike: "" for none, None where they differ.

    See `View.lens_taken_out`; parameters may differ by a thousandth.
    """
    texts = sorted({view.lens_taken_out for view in views})
    if len(texts) == 1:
        return texts[0]
    words = [text.split() for text in texts]
    if "" in texts or len({(word[0], len(word)) for word in words}) > 1:
        return None
    numbers = np.array([[float(value) for value in word[1:]] for word in words])
    size = np.maximum(np.abs(numbers).max(0), 1e-9)
    return texts[0] if (np.ptp(numbers, axis=0) <= _SAME_LENS * size).all() else None


def without_lens(view: View, lens: str) -> View:
    """A photograph with the distortion of a lens (`View.lens_taken_out`) taken out of it."""
    from pipeline.geometry.models.known_cameras import as_pinhole, lens_of

    return as_pinhole(view, lens_of(view, lens), "evaluate.ground_truth")[0]
