"""Everything that the exports are made of, in the frame of the exports."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera, Cameras
from pipeline.artifacts.gaussians import Gaussians
from pipeline.artifacts.points import Points
from pipeline.artifacts.views import Views, to_uint8
from stages.export.frame import move_cameras, move_gaussians, move_points
from stages.export.pictures.orbits import Orbit, between, central_depth, find_orbit, there_and_back
from stages.export.pictures.video import even
from stages.export.splats import opacities
from stages.export.surface import (
    DEEPEST_OCTREE,
    Mesh,
    drop_small_parts,
    fuse_depths,
    keep_near,
    poisson,
    repair,
    smoothed,
    spacing,
    trusted_depth,
)
from stages.splatting.rendering import RenderedView, render

Progress = Callable[..., None]
Pixels = npt.NDArray[np.uint8]

#: constant of the spherical harmonics: colour = .5 + SH_CONSTANT * f_dc
SH_CONSTANT = 0.28209479177387814
#: A mesh with fewer triangles than this is no mesh of anything.
FEWEST_FACES = 100
#: The mesh needs a trusted point within this many of their spacings, or this many voxels.
SUPPORT_REACH = 4.0
SUPPORT_VOXELS = 6.0
#: Connected parts of the mesh smaller than this share of the largest are dropped.
SMALLEST_PART = 0.02
#: Holes of up to this many edges are closed.
LARGEST_HOLE = 40


@dataclass(frozen=True)
class Scene:
    """A reconstruction in the frame of the exports.

    Attributes:
        cameras: of the placed photographs.
        photos, masks: by camera name, at working size: RGB [H, W, 3]; bool [H, W], True: usable.
        masked: whether any photograph came with a mask.
        gaussians: the fitted scene.
        points: the cloud it started from, or the centres of the Gaussians.
        seen: the Gaussians as each camera sees them.
        orbit: how the cameras stand around the scene.
        frame_from_world: [4, 4] similarity that led here.
        threads: how many to render with.
    """

    cameras: tuple[Camera, ...]
    photos: dict[str, Pixels]
    masks: dict[str, npt.NDArray[np.bool_]]
    masked: bool
    gaussians: Gaussians
    points: Points
    seen: tuple[RenderedView, ...]
    orbit: Orbit
    frame_from_world: npt.NDArray[np.float64]
    threads: int

    def render(self, camera: Camera) -> RenderedView:
        return render(self.gaussians, camera, threads=self.threads)

    def picture(self, camera: Camera) -> Pixels:
        """[H, W, 3] uint8 as a camera sees the Gaussians, black behind."""
        return to_uint8(self.render(camera).image)

    def path(self, seconds: float, fps: int, sway_degrees: float) -> list[Camera]:
        """Cameras of the video, at the (even) size of the middle photograph."""
        middle = self.cameras[self.orbit.middle()]
        size = (even(middle.width), even(middle.height))
        count = max(1, round(seconds * fps))
        return there_and_back(self.orbit, self.cameras, size, count, np.radians(sway_degrees))

    def novel_camera(self) -> Camera:
        """A viewpoint between photographs, and above them: as far from all as one gets."""
        tried = there_and_back(self.orbit, self.cameras, (2, 2), 60, np.radians(6.0))
        eyes = np.stack([camera.centre for camera in self.cameras])
        gaps = [np.linalg.norm(eyes - camera.centre, axis=1).min() for camera in tried]
        return tried[int(np.argmax(gaps))]


def assemble(
    views: Views,
    cameras: Cameras,
    gaussians: Gaussians,
    points: Points | None,
    similarity: npt.NDArray[np.float64],
    threads: int,
    progress: Progress,
) -> Scene:
    """Bring the artifacts into the frame that `similarity` [4, 4] leads to, and render them."""
    by_name = views.by_name()
    placed = move_cameras((c for c in cameras.cameras if c.name in by_name), similarity)
    moved = move_gaussians(gaussians, similarity)
    cloud = move_points(points, similarity) if points is not None else centres(moved)
    shown = [by_name[camera.name] for camera in placed]
    seen = []
    for index, camera in enumerate(placed):
        progress("views of the photographs", index, len(placed))
        seen.append(render(moved, camera, threads=threads))
    return Scene(
        cameras=placed,
        photos={view.name: to_uint8(view.image) for view in shown},
        masks={view.name: view.valid() for view in shown},
        masked=any(view.mask is not None for view in shown),
        gaussians=moved,
        points=cloud,
        seen=tuple(seen),
        orbit=find_orbit(placed, [central_depth(view.depth, view.alpha) for view in seen]),
        frame_from_world=similarity,
        threads=threads,
    )


def centres(gaussians: Gaussians, least_opacity: float = 0.3) -> Points:
    """The centres of the more opaque Gaussians as a cloud (without normals)."""
    kept = opacities(gaussians) >= least_opacity
    count = int(kept.sum())
    return Points(
        positions=gaussians.means[kept],
        colors=np.clip(0.5 + SH_CONSTANT * gaussians.sh[kept, 0], 0, 1).astype(np.float32),
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


def build_mesh(
    scene: Scene,
    method: str,
    resolution: int,
    smoothing: float,
    between_views: int,
    reach_behind: float,
    confidence: float,
    most_faces: int,
    progress: Progress,
) -> Mesh | None:
    """Reconstruct the surface, clean and simplify it.

    Args:
        scene: what to mesh.
        method: ``tsdf`` or ``poisson``.
        resolution: voxels across what a photograph shows.
        smoothing: voxels that the Poisson refit of the fused surface evens out; 0: no refit.
        between_views: further viewpoints to fuse.
        reach_behind: how far behind the scene's centre, in half widths of a photograph.
        confidence: points above it support the mesh.
        most_faces: triangles, at most.
        progress: called with (step, done, total).

    Returns:
        The mesh, or None if there is too little to make one of.
    """
    orbit = scene.orbit
    voxel = 2 * orbit.radius / resolution
    steps = len(scene.seen) + between_views + 3
    trusted = scene.points[scene.points.confidence > confidence]
    if len(trusted) < FEWEST_FACES:
        return None
    reach = max(SUPPORT_VOXELS * voxel, SUPPORT_REACH * spacing(trusted.positions))
    if method == "poisson":
        oriented = trusted[np.linalg.norm(trusted.normals, axis=1) > 0.5]
        if len(oriented) < FEWEST_FACES:
            return None
        depth = int(np.clip(np.ceil(np.log2(resolution)), 5, DEEPEST_OCTREE))
        surface, _ = poisson(oriented.positions, oriented.normals, oriented.colors, depth)
    else:

        def frames():  # type: ignore[no-untyped-def]
            extra = between(orbit, scene.cameras, between_views) if between_views else []
            for index, camera in enumerate([*scene.cameras, *extra]):
                progress("mesh", index, steps)
                seen = scene.seen[index] if index < len(scene.seen) else scene.render(camera)
                eye_to_centre = float(np.linalg.norm(camera.centre - orbit.centre))
                farthest = eye_to_centre + reach_behind * orbit.radius
                depth = trusted_depth(seen.depth, seen.alpha, farthest)
                if camera.name in scene.masks:
                    depth = np.where(scene.masks[camera.name], depth, np.float32(0))
                yield camera, to_uint8(seen.image), depth

        surface = fuse_depths(frames(), voxel, 5 * voxel)
    progress("mesh", steps - 3, steps)
    surface = drop_small_parts(keep_near(surface, trusted.positions, reach), SMALLEST_PART)
    if len(surface) >= FEWEST_FACES and method == "tsdf" and smoothing:
        surface = smoothed(surface, smoothing * voxel)
    if len(surface) < FEWEST_FACES:
        return None
    progress("mesh", steps - 2, steps)
    surface = drop_small_parts(surface, SMALLEST_PART)
    surface = drop_small_parts(repair(surface, most_faces, LARGEST_HOLE), SMALLEST_PART)
    progress("mesh", steps, steps)
    return surface if len(surface) >= FEWEST_FACES else None
