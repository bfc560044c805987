"""What every way of finding the cameras leads to, and bringing it into a normalised world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera, Cameras
from pipeline.artifacts.space.scale import NO_SCALE, Scale
from pipeline.artifacts.views import View
from pipeline.geometry.graph import Pair
from pipeline.geometry.world import move_camera, normalising_similarity
from stages.init.sfm.matching.pictures import Links

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Placement:
    """The views that could be placed, their cameras, and sparse points that they observe.

    Attributes:
        views: the placed views, their images as pinhole cameras see them (undistorted).
        cameras: one for each of them.
        points: [P, 3] world.
        seen: for each of them [K] int64 indices of the points that it observes.
        weights: pairs of them by position -> how well their matches link them.
        input_from_world: [4, 4] similarity to the frame of known input; identity: nothing known.
        scale: of that frame: its unit, where it comes from, how sure it is.
        given: the user gave the cameras, and that frame is theirs.
        figures: for the summary.
        links: the matches that the cameras came from, to be drawn; None without.
    """

    views: tuple[View, ...]
    cameras: tuple[Camera, ...]
    points: Array
    seen: tuple[npt.NDArray[np.int64], ...]
    weights: dict[Pair, float]
    input_from_world: Array = field(default_factory=lambda: np.eye(4))
    scale: Scale = NO_SCALE
    given: bool = False
    figures: dict[str, float | int | str] = field(default_factory=dict)
    links: Links | None = None

    def placed(self) -> Cameras:
        """The cameras as they are handed on."""
        return Cameras(self.cameras, self.input_from_world, self.scale, self.given)

    def normalised(self, downs: Sequence[Array] | None = None) -> Placement:
        """The same in a world that is centred, scaled and upright (`normalising_similarity`).

        `input_from_world` still leads to the same frame.

        Args:
            downs: directions [3] of the world that lead down, where they are known.
        """
        motion = normalising_similarity(self.cameras, self.points, downs)
        scale, rotation, shift = motion
        old_from_new = np.eye(4)
        old_from_new[:3, :3] = rotation.T / scale
        old_from_new[:3, 3] = -rotation.T @ shift / scale
        return replace(
            self,
            cameras=tuple(move_camera(camera, motion) for camera in self.cameras),
            points=scale * self.points @ rotation.T + shift,
            input_from_world=self.input_from_world @ old_from_new,
        )
