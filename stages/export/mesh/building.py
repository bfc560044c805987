"""From a scene to its mesh: what the mesh is made of, the work itself, and a process that does it.

Fusing, refitting and simplifying use one core for as long as the video takes; in a process of their
own they share the time.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.points import Points
from pipeline.artifacts.views import to_uint8
from pipeline.errors import StageError
from pipeline.installed import module_command
from stages.export.mesh.surface import (
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

if TYPE_CHECKING:
    from stages.export.scene import Scene

Progress = Callable[..., None]

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
class MeshTask:
    """What a mesh is made of.

    Attributes:
        method: ``tsdf`` from the frames, or ``poisson`` from the points.
        lenses, poses: [K, 6] width, height, fx, fy, cx, cy and [K, 4, 4] of the frames' cameras.
        images: K times [H, W, 3] uint8; depths: K times [H, W] float32, 0 where not trusted.
        positions, normals, colors: [N, 3] of the points that support the mesh.
        reach: how near such a point must be, world units.
        voxel: of the fused field, world units.
        smoothing: voxels that the refit evens out; 0: no refit.
        octree: depth of the octree for ``poisson``.
        most_faces: triangles, at most.
    """

    method: str
    lenses: npt.NDArray[np.float64]
    poses: npt.NDArray[np.float64]
    images: tuple[npt.NDArray[np.uint8], ...]
    depths: tuple[npt.NDArray[np.float32], ...]
    positions: npt.NDArray[np.float32]
    normals: npt.NDArray[np.float32]
    colors: npt.NDArray[np.float32]
    reach: float
    voxel: float
    smoothing: float
    octree: int
    most_faces: int

    def save(self, path: Path) -> None:
        """Write it, as an ``.npz``."""
        named = {
            f"{name}_{k}": array
            for name in ("images", "depths") for k, array in enumerate(getattr(self, name))
        }  # fmt: skip
        numbers = [self.reach, self.voxel, self.smoothing, self.octree, self.most_faces]
        with path.open("wb") as file:
            np.savez(
                file, method=self.method, lenses=self.lenses, poses=self.poses,
                positions=self.positions, normals=self.normals, colors=self.colors,
                numbers=np.array(numbers, np.float64), **named,
            )  # fmt: skip

    @classmethod
    def load(cls, path: Path) -> MeshTask:
        """Read what `save` wrote."""
        with np.load(path, allow_pickle=False) as data:
            reach, voxel, smoothing, octree, most = data["numbers"].tolist()
            count = len(data["lenses"])
            return cls(
                str(data["method"]), data["lenses"], data["poses"],
                tuple(data[f"images_{k}"] for k in range(count)),
                tuple(data[f"depths_{k}"] for k in range(count)),
                data["positions"], data["normals"], data["colors"],
                reach, voxel, smoothing, int(octree), int(most),
            )  # fmt: skip


def mesh_task(
    scene: Scene,
    method: str,
    resolution: int,
    smoothing: float,
    between_views: int,
    reach_behind: float,
    confidence: float,
    most_faces: int,
    progress: Progress,
) -> MeshTask | None:
    """Collect what the mesh is made of; the frames are rendered.

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
        The task, or None if there is too little to make a mesh of.
    """
    from stages.export.pictures.orbits import between

    orbit = scene.orbit
    voxel = 2 * orbit.radius / resolution
    trusted: Points = scene.points[scene.points.confidence > confidence]
    if len(trusted) < FEWEST_FACES:
        return None
    reach = max(SUPPORT_VOXELS * voxel, SUPPORT_REACH * spacing(trusted.positions))
    cameras: list[Camera] = []
    images, depths = [], []
    if method == "tsdf":
        extra = between(orbit, scene.cameras, between_views) if between_views else []
        cameras = [*scene.cameras, *extra]
    for index, camera in enumerate(cameras):
        progress("mesh", index, len(cameras))
        seen = scene.seen[index] if index < len(scene.seen) else scene.render(camera)
        eye_to_centre = float(np.linalg.norm(camera.centre - orbit.centre))
        farthest = eye_to_centre + reach_behind * orbit.radius
        depth = trusted_depth(seen.depth, seen.alpha, farthest)
        if camera.name in scene.masks:
            depth = np.where(scene.masks[camera.name], depth, np.float32(0))
        images.append(to_uint8(seen.image))
        depths.append(depth)
    lenses = [[c.width, c.height, c.fx, c.fy, c.cx, c.cy] for c in cameras]
    return MeshTask(
        method, np.array(lenses, np.float64).reshape(-1, 6),
        np.array([c.cam_from_world for c in cameras], np.float64).reshape(-1, 4, 4),
        tuple(images), tuple(depths), trusted.positions, trusted.normals, trusted.colors,
        reach, voxel, smoothing, int(np.clip(np.ceil(np.log2(resolution)), 5, DEEPEST_OCTREE)),
        most_faces,
    )  # fmt: skip


def make_mesh(task: MeshTask) -> Mesh | None:
    """Reconstruct the surface, clean and simplify it; None if too little is left."""
    if task.method == "poisson":
        oriented = np.linalg.norm(task.normals, axis=1) > 0.5
        if oriented.sum() < FEWEST_FACES:
            return None
        points = (task.positions[oriented], task.normals[oriented], task.colors[oriented])
        surface, _ = poisson(*points, task.octree)
    else:
        cameras = [
            Camera("", int(width), int(height), fx, fy, cx, cy, pose)
            for (width, height, fx, fy, cx, cy), pose in zip(task.lenses, task.poses, strict=True)
        ]
        frames = zip(cameras, task.images, task.depths, strict=True)
        surface = fuse_depths(frames, task.voxel, 5 * task.voxel)
    surface = drop_small_parts(keep_near(surface, task.positions, task.reach), SMALLEST_PART)
    if len(surface) >= FEWEST_FACES and task.method == "tsdf" and task.smoothing:
        surface = smoothed(surface, task.smoothing * task.voxel)
    if len(surface) < FEWEST_FACES:
        return None
    surface = drop_small_parts(surface, SMALLEST_PART)
    surface = drop_small_parts(repair(surface, task.most_faces, LARGEST_HOLE), SMALLEST_PART)
    return surface if len(surface) >= FEWEST_FACES else None


class MeshHere:
    """`make_mesh` when its result is asked for: where there is one core, nothing is gained."""

    def __init__(self, task: MeshTask | None) -> None:
        self._task = task

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def result(self) -> Mesh | None:
        return None if self._task is None else make_mesh(self._task)


class MeshProcess:
    """`make_mesh` in a process of its own; leaving the context ends it.

    Args:
        task: what to make.
        folder: to exchange files in; none of them is left there.
    """

    def __init__(self, task: MeshTask, folder: Path) -> None:
        self._task, self._mesh = folder / "mesh_task.tmp", folder / "mesh_made.tmp"
        self._log = folder / "mesh_log.tmp"
        task.save(self._task)
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [*module_command(__name__), str(self._task), str(self._mesh)],
                stdin=subprocess.DEVNULL, stdout=log, stderr=log,
            )  # fmt: skip

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        for path in (self._task, self._mesh, self._log):
            path.unlink(missing_ok=True)

    def result(self) -> Mesh | None:
        """Wait for the mesh.

        Raises:
            StageError: the process failed.
        """
        status = self._process.wait()
        if status != 0:
            said = self._log.read_text(errors="replace").strip().splitlines()
            raise StageError(
                f"The mesh could not be made: its process ended with status {status}"
                f"{f' ({said[-1]})' if said else ''}. The rest is kept; export.mesh=false leaves "
                "the mesh out."
            )
        with np.load(self._mesh, allow_pickle=False) as data:
            if not data["found"]:
                return None
            return Mesh(data["vertices"], data["faces"], data["colors"])


def main(task: str, out: str) -> None:
    """Make the mesh of a task's file."""
    mesh = make_mesh(MeshTask.load(Path(task)))
    with Path(out).open("wb") as file:
        if mesh is None:
            np.savez(file, found=False)
        else:
            np.savez(file, found=True, vertices=mesh.vertices, faces=mesh.faces, colors=mesh.colors)


if __name__ == "__main__":
    main(*sys.argv[1:])
