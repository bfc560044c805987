"""A true surface: distances to it, and how cameras see it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.errors import RequestError
from pipeline.untrusted.files import UnusableFile
from pipeline.untrusted.paths import user_path
from pipeline.untrusted.scenes.meshes import read_mesh

Array = npt.NDArray[np.float64]


class Mesh:
    """A triangle mesh to measure distances to and to cast rays at.

    Attributes:
        vertices: [V, 3] float64.
        diagonal: length of the diagonal of its bounding box.
    """

    def __init__(self, vertices: Array, triangles: npt.NDArray[np.integer]) -> None:
        """
        Args:
            vertices: [V, 3]; triangles: [T, 3] indices of them.
        """
        import open3d as o3d

        self.vertices = np.asarray(vertices, np.float64)
        self.diagonal = float(np.linalg.norm(np.ptp(self.vertices, axis=0)))
        # single precision is at its best around the origin
        self.middle = 0.5 * (self.vertices.min(0) + self.vertices.max(0))
        self.scene = o3d.t.geometry.RaycastingScene()
        self.scene.add_triangles(
            _tensor((self.vertices - self.middle).astype(np.float32)),
            _tensor(np.asarray(triangles).astype(np.uint32)),
        )

    @classmethod
    def read(cls, path: Path, setting: str) -> Mesh:
        """Read a .ply, .stl or .obj.

        Args:
            path: the file.
            setting: name of the setting that gave it, for messages.

        Raises:
            RequestError: there is no such file, it is damaged, or it holds no triangles.
        """
        path = user_path(path, setting)
        try:
            return cls(*read_mesh(path))
        except UnusableFile as error:
            raise RequestError(
                f"{setting}: {path} {error}. Give a triangle mesh as .ply, .stl or .obj."
            ) from error

    def closest(self, points: Array) -> Array:
        """[N, 3] the points of the surface nearest to points [N, 3]."""
        local = _tensor((points - self.middle).astype(np.float32))
        found = self.scene.compute_closest_points(local)["points"].numpy()
        return np.asarray(found, np.float64) + self.middle

    def distances(self, points: Array) -> Array:
        """[N] distances of points [N, 3] from the surface."""
        return np.asarray(np.linalg.norm(points - self.closest(points), axis=1))

    def depth(self, camera: Camera) -> Array:
        """[H, W] z at which a camera sees the surface at each pixel's centre; 0 where it does not.

        Args:
            camera: in the world of the mesh.
        """
        v, u = np.mgrid[: camera.height, : camera.width] + 0.5
        local = np.stack(
            [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1
        )
        origin = np.broadcast_to(camera.centre - self.middle, local.shape)
        rays = np.concatenate([origin, local @ camera.rotation], -1).astype(np.float32)
        hit = self.scene.cast_rays(_tensor(rays))["t_hit"].numpy()
        return np.where(np.isfinite(hit), hit, 0).astype(np.float64)


def _tensor(values: npt.NDArray[Any]) -> Any:
    """The array as Open3D wants it."""
    import open3d as o3d

    core: Any = o3d.core  # its stubs lack the arguments' defaults
    return core.Tensor(np.ascontiguousarray(values))


def distance_figures(distances: Array) -> dict[str, float]:
    """Median, mean and 90 % quantile of distances [N]."""
    return {
        "median": float(np.median(distances)),
        "mean": float(distances.mean()),
        "p90": float(np.quantile(distances, 0.9)),
    }
