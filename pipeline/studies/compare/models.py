"""COLMAP's models, in the pixels of the prepared views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.views import View
from pipeline.errors import RequestError
from pipeline.geometry.models.known_cameras import (
    matching_cameras,
    model_files,
    numbered,
    pinhole_camera,
    read_cameras,
)
from pipeline.geometry.models.model_points import ModelPoints, read_model_points
from pipeline.untrusted.paths import user_path


@dataclass(frozen=True)
class Model:
    """The largest model of a COLMAP run.

    Attributes:
        folder: of its files.
        cameras: view name -> pinhole camera at working size, in the model's world.
        points: the sparse points.
        sizes: registered images of each model of the run, largest first.
    """

    folder: Path
    cameras: dict[str, Camera]
    points: ModelPoints
    sizes: tuple[int, ...]


def model_folders(path: Path) -> list[Path]:
    """The folders with a COLMAP model in them: `path` itself, or the numbered ones below it."""
    path = user_path(path, "--colmap")
    for parent in (path, path / "sparse"):
        if _is_model(parent):
            return [parent]
        found = [entry for entry in numbered(parent) if _is_model(entry)]
        if found:
            return found
    return []


def _is_model(folder: Path) -> bool:
    return any(
        all((folder / f"{stem}{suffix}").is_file() for stem in ("cameras", "images", "points3D"))
        for suffix in (".bin", ".txt")
    )


def read_largest(path: Path, views: Sequence[View]) -> Model:
    """Read the model with most registered images, then most points, of those in a folder.

    Raises:
        RequestError: there is none, it is damaged, or fewer than two views have a camera in it.
    """
    setting, folders = "--colmap", model_folders(path)
    if not folders:
        raise RequestError(
            f"{setting}: {path} holds no COLMAP model. Give the folder with cameras, images and "
            "points3D (.bin or .txt), or the one that holds such folders by number."
        )
    read = []
    for number, folder in enumerate(folders):
        files = model_files(folder, setting)
        cameras, _ = read_cameras(files.values(), setting)
        points = read_model_points(folder)
        read.append((len(cameras), len(points), -number, folder, cameras, points))
    sizes = tuple(sorted((entry[0] for entry in read), reverse=True))
    folder, cameras, points = max(read, key=lambda entry: entry[:3])[3:]
    known = matching_cameras(cameras, views, setting)
    return Model(
        folder=folder,
        cameras={
            v.name: pinhole_camera(v, known[v.name], setting) for v in views if v.name in known
        },
        points=points,
        sizes=sizes,
    )


def read_truth(path: Path, views: Sequence[View]) -> tuple[dict[str, Camera], str]:
    """True cameras of views by name, and the units of their world.

    Raises:
        RequestError: the file can't be read, or fewer than two views have a camera there.
    """
    setting = "--ground-truth"
    cameras, scale = read_cameras(model_files(path, setting).values(), setting)
    known = matching_cameras(cameras, views, setting)
    return {
        v.name: pinhole_camera(v, known[v.name], setting) for v in views if v.name in known
    }, scale.units
