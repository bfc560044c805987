"""Everything that the exports are made of, in the frame of the exports."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera, Cameras
from pipeline.artifacts.gaussians import Gaussians
from pipeline.artifacts.points import Points
from pipeline.artifacts.space.frames import Frame
from pipeline.artifacts.views import Views, to_uint8
from stages.export.pictures.orbits import Orbit, central_depth, find_orbit, there_and_back, widened
from stages.export.pictures.video import even
from stages.export.splats import opacities
from stages.splatting.frame import move_cameras, move_gaussians, move_points
from stages.splatting.rendering import CONSTANT_HARMONIC, Painter, RenderedView

Progress = Callable[..., None]
Pixels = npt.NDArray[np.uint8]

#: So many Gaussians tell how far a scene reaches.
_TO_FRAME = 5000
#: Rise and fall of the video on its way, degrees.
SWAY = 2.0


@dataclass(frozen=True)
class Scene:
    """A reconstruction in the frame of the exports.

    Attributes:
        cameras: of the placed photographs.
        photos, masks: by camera name, at working size: RGB [H, W, 3]; bool [H, W], True: usable.
        masked: whether any photograph came with a mask.
        gaussians: the fitted scene.
        painter: draws it.
        points: the cloud it started from, or the centres of the Gaussians.
        seen: the Gaussians as each camera sees them.
        orbit: how the cameras stand around the scene.
        frame_from_world: [4, 4] similarity that led here.
    """

    cameras: tuple[Camera, ...]
    photos: dict[str, Pixels]
    masks: dict[str, npt.NDArray[np.bool_]]
    masked: bool
    gaussians: Gaussians
    painter: Painter
    points: Points
    seen: tuple[RenderedView, ...]
    orbit: Orbit
    frame_from_world: npt.NDArray[np.float64]

    def voxel(self, resolution: int) -> float:
        """Edge of a voxel, if so many go across what a photograph shows."""
        return 2 * self.orbit.radius / resolution

    def picture(self, camera: Camera) -> Pixels:
        """[H, W, 3] uint8 as a camera sees the Gaussians, black behind."""
        return to_uint8(self.painter(camera).image)

    def path(self, seconds: float, fps: int) -> tuple[list[Camera], list[int]]:
        """Places of the video, at the (even) size of the middle photograph, and each frame's."""
        middle = self.cameras[self.orbit.middle()]
        size = (even(middle.width), even(middle.height))
        count = max(1, round(seconds * fps))
        places, frames = there_and_back(self.orbit, self.cameras, size, count, np.radians(SWAY))
        return self._holding(places), frames

    def novel_camera(self, like: Camera) -> Camera:
        """A viewpoint between photographs, above or below: as far from all as one gets.

        Args:
            like: whose lens and size it has.
        """
        tried, _ = there_and_back(self.orbit, self.cameras, (2, 2), 60, np.radians(6.0))
        eyes = np.stack([camera.centre for camera in self.cameras])
        gaps = [np.linalg.norm(eyes - camera.centre, axis=1).min() for camera in tried]
        farthest = tried[int(np.argmax(gaps))]
        return self._holding([replace(like, cam_from_world=farthest.cam_from_world)])[0]

    def _holding(self, cameras: list[Camera]) -> list[Camera]:
        """The cameras, with what is cut out by masks in the picture as a whole; other scenes go on
        beyond it."""
        if not self.masked:
            return cameras
        some = thinned(centres(self.gaussians), _TO_FRAME, seed=0)
        return widened(cameras, some.positions.astype(np.float64))


def assemble(
    views: Views,
    cameras: Cameras,
    gaussians: Gaussians,
    points: Points | None,
    frame: Frame,
    threads: int,
    progress: Progress,
) -> Scene:
    """Bring the artifacts into a frame, and render them."""
    by_name = views.by_name()
    similarity = frame.from_world
    placed = move_cameras((c for c in cameras.cameras if c.name in by_name), similarity)
    moved = move_gaussians(gaussians, similarity)
    cloud = move_points(points, similarity) if points is not None else centres(moved)
    shown = [by_name[camera.name] for camera in placed]
    painter, seen = Painter(moved, threads=threads), []
    for index, camera in enumerate(placed):
        progress("views of the photographs", index, len(placed))
        seen.append(painter(camera))
    return Scene(
        cameras=placed,
        photos={view.name: to_uint8(view.image) for view in shown},
        masks={view.name: view.valid() for view in shown},
        masked=any(view.mask is not None for view in shown),
        gaussians=moved,
        painter=painter,
        points=cloud,
        seen=tuple(seen),
        orbit=find_orbit(
            placed,
            [central_depth(view.depth, view.alpha) for view in seen],
            np.array([0.0, 1.0, 0.0]) if frame.name == "mouth" else None,
        ),
        frame_from_world=similarity,
    )


def centres(gaussians: Gaussians, least_opacity: float = 0.3) -> Points:
    """The centres of the more opaque Gaussians as a cloud (without normals)."""
    kept = opacities(gaussians) >= least_opacity
    count = int(kept.sum())
    return Points(
        positions=gaussians.means[kept],
        colors=np.clip(0.5 + CONSTANT_HARMONIC * gaussians.sh[kept, 0], 0, 1).astype(np.float32),
        normals=np.zeros((count, 3), np.float32),
        confidence=np.full(count, 2, np.float32),
        scale=np.exp(gaussians.log_scales[kept].mean(1)),
    )


def thinned(points: Points, most: int, seed: int) -> Points:
    """At most `most` finite points, chosen at random but always the same, in their order."""
    index = np.flatnonzero(np.isfinite(points.positions).all(1))
    if len(index) > most:
        index = np.sort(np.random.default_rng(seed).choice(index, most, replace=False))
    return points[index]
