"""First cameras and points from pointmaps, before global alignment optimises anything."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.pointmaps import PointmapPair
from pipeline.artifacts.points import Points
from pipeline.artifacts.views import View
from pipeline.errors import ReconstructionError
from pipeline.geometry import cloud
from pipeline.geometry.depths import view_depths
from pipeline.geometry.normals import UNSURE, depth_normals
from pipeline.geometry.start import start_from_tree
from pipeline.geometry.world import move_camera, normalising_similarity


@dataclass(frozen=True)
class QuickStart:
    """What the pointmaps say before they are aligned.

    Attributes:
        cameras: of the placed views, in the order of the views.
        depths: of each [H, W] float32 z-depth, 0 where nothing is known.
        points: the depth maps, lifted.
        unplaced: names of the other views.
    """

    cameras: tuple[Camera, ...]
    depths: tuple[npt.NDArray[np.float32], ...]
    points: Points
    unplaced: tuple[str, ...]


def quick_start(
    pairs: Sequence[PointmapPair],
    views: Sequence[View],
    focals: Mapping[str, float] | None = None,
    max_points: int = 400_000,
    seed: int = 0,
) -> QuickStart:
    """Chain the pairs along their best spanning tree, in a normalised world.

    Args:
        pairs: pointmaps at the pixels of the views.
        views: the photographs.
        focals: known focal lengths, pixels, by name of the view.
        max_points: points drawn at most.
        seed: of that draw.

    Raises:
        ReconstructionError: the pointmaps connect no two views.
    """
    pairs = list(pairs)
    start = start_from_tree(pairs, focals)
    depths = view_depths(pairs, start)
    placed = [view for view in views if view.name in depths]
    if len(placed) < 2:
        raise ReconstructionError(
            "The pointmaps connect no two photographs: nowhere is there a confident point that two "
            "of them see. Take photographs that overlap more, 10 to 20 degrees apart, in focus."
        )
    found = [start.cameras[view.name] for view in placed]
    surface = np.concatenate(
        [
            camera.unproject(depths[camera.name].depth)[depths[camera.name].depth > 0]
            for camera in found
        ]
    )
    motion = normalising_similarity(found, surface)
    found = [move_camera(camera, motion) for camera in found]
    scale = np.float32(motion[0])
    clouds, maps = [], []
    for view, camera in zip(placed, found, strict=True):
        confidence = np.where(view.valid(), depths[view.name].confidence, np.float32(1))
        depth = np.where(confidence > 1, scale * depths[view.name].depth, np.float32(0))
        normals = depth_normals(depth, np.maximum(confidence - 1, UNSURE), camera)
        maps.append(depth)
        clouds.append(cloud.depth_points(view.image, depth, normals, confidence, camera))
    return QuickStart(
        tuple(found),
        tuple(maps),
        cloud.thinned(cloud.joined(clouds), max_points, seed),
        tuple(view.name for view in views if view.name not in depths),
    )
