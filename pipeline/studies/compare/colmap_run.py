"""Run COLMAP (through pycolmap) in a process of its own, so that a crash or its log harms nobody.

    python -m pipeline.studies.compare.colmap_run FOLDER

runs what FOLDER/request.json asks for, on FOLDER/images, into FOLDER/database.db and FOLDER/sparse.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.views import View, to_uint8, write_png
from pipeline.errors import RequestError
from pipeline.files import canonical_json, content_hash, folder_listing, read_json, write_json
from pipeline.geometry.models.colmap import quiet_pycolmap
from pipeline.installed import module_command
from pipeline.store import read_own, write_sealed
from pipeline.store.places import remove

#: COLMAP's options by step: what differs from its defaults.
Options = Mapping[str, Mapping[str, Any]]

#: What helps COLMAP where there are few views.
SPARSE: Options = {
    "extraction": {"sift.peak_threshold": 0.002, "sift.max_num_features": 12_000},
    "matching": {"sift.max_ratio": 0.88},
    "verification": {"min_num_inliers": 12},
    "mapping": {
        "min_model_size": 2,
        "min_num_matches": 8,
        "mapper.init_min_num_inliers": 30,
        "mapper.init_min_tri_angle": 2.0,
        "mapper.init_max_forward_motion": 1.0,
        "mapper.abs_pose_min_num_inliers": 10,
        "mapper.abs_pose_min_inlier_ratio": 0.1,
        "mapper.filter_min_tri_angle": 1.0,
        "triangulation.min_angle": 1.0,
        "triangulation.ignore_two_view_tracks": False,
    },
}
SETTINGS: Mapping[str, Options] = {"defaults": {}, "sparse": SPARSE}


@dataclass(frozen=True)
class Job:
    """What COLMAP is asked.

    Attributes:
        options: by step, what differs from COLMAP's defaults.
        single_camera: all images are of one camera.
        focals: image name -> focal length in pixels that is known (as COLMAP would take it from
            EXIF), for those images where it is.
        masked: there are masks in ``masks/``.
        seed: of COLMAP's random samples.
        threads: for matching; features (which are stored in the order in which they are found),
            verification and mapping take one, so that the result doesn't depend on them.
    """

    options: Options = field(default_factory=dict)
    single_camera: bool = True
    focals: Mapping[str, float] = field(default_factory=dict)
    masked: bool = False
    seed: int = 0
    threads: int = 1


def run_on_views(
    folder: Path, views: Sequence[View], options: Options, *, seed: int, threads: int,
    message: Callable[[str], None],
) -> dict[str, Any]:  # fmt: skip
    """Run COLMAP on prepared views, or take what an earlier call with the same input came to.

    The images are written as their files are stored (before EXIF orientation), at working size, so
    that the model is one of the photographs at another size; masks and EXIF's focal lengths are
    given to COLMAP too. In the models the images have the names of the photographs.

    Returns:
        ``models`` (number), ``seconds``, and ``failure`` (why it ended early) or None.
    """
    sizes = {(view.width, view.height) for view in views}
    known = [view.focal_px for view in views if view.focal_px]
    alike = len(sizes) == 1 and (not known or max(known) / min(known) < 1.02)
    job = Job(
        options, alike, {f"{v.name}.png": v.focal_px for v in views if v.focal_px},
        any(view.mask is not None for view in views), seed, threads,
    )  # fmt: skip
    fresh = folder.with_name(f"{folder.name}.new")
    remove(fresh)
    _write_images(fresh, views)
    key = _key(fresh, job, photo_names(views))
    done = read_own(folder / "run.json")
    # What a signal ended, or a lack of memory, may come to its end this time.
    asked = {"key": key, "failure": None}
    if done is not None and done | asked == done and done["made"] == _made(folder):
        remove(fresh)
        return done
    message(f"COLMAP ({folder.name.removeprefix('colmap_')}) on {len(views)} views")
    record = {"key": key, **run_job(fresh, job)}
    _rename(fresh / "sparse", photo_names(views))
    record["made"] = _made(fresh)
    write_sealed(fresh / "run.json", record)
    remove(folder)
    fresh.rename(folder)
    return record


def _made(folder: Path) -> str:
    """Hash of all files but the one that says it, and those that reading a database makes."""
    passing = ("run.json", "database.db-wal", "database.db-shm")
    listing = folder_listing(folder)
    return content_hash({name: entry for name, entry in listing.items() if name not in passing})


def photo_names(views: Sequence[View]) -> dict[str, str]:
    """Name of an image that COLMAP gets -> name of its photograph; empty where those are unclear.

    Views are numbered, and photographs may have numbers of their own: a model with the names of
    views could be taken for one of other photographs.
    """
    names = [view.source_name for view in views]
    if not all(names) or len(set(names)) < len(names):
        return {}
    return {f"{view.name}.png": view.source_name for view in views}


def _rename(sparse: Path, names: Mapping[str, str]) -> None:
    for path in sorted(sparse.glob("*/images.bin")):
        model = quiet_pycolmap().Reconstruction(str(path.parent))
        for image in model.images.values():
            image.name = names.get(image.name, image.name)
        model.write_binary(str(path.parent))


def _key(folder: Path, job: Job, names: Mapping[str, str]) -> str:
    import pycolmap

    asked = canonical_json(asdict(replace(job, threads=1)))
    images = content_hash(folder_listing(folder))
    return f"{images} {canonical_json(names)} {asked} {pycolmap.__version__}"


def _write_images(folder: Path, views: Sequence[View]) -> None:
    (folder / "images").mkdir(parents=True)
    for view in views:
        linear = view.working_from_source[:2, :2]
        write_png(folder / "images" / f"{view.name}.png", as_stored(to_uint8(view.image), linear))
        if view.mask is not None:
            (folder / "masks").mkdir(exist_ok=True)
            mask = as_stored(np.where(view.mask, np.uint8(255), np.uint8(0)), linear)
            write_png(folder / "masks" / f"{view.name}.png.png", mask)


def as_stored(
    pixels: npt.NDArray[np.uint8], working_from_source: npt.NDArray[np.float64]
) -> npt.NDArray[np.uint8]:
    """Turn an upright image back to how its file is stored.

    Args:
        pixels: [H, W] or [H, W, 3].
        working_from_source: [2, 2] linear part of the view's pixel transform: quarter turns and
            reflections, times scales.
    """
    if abs(working_from_source[0, 0]) < abs(working_from_source[0, 1]):  # x was y
        pixels = np.swapaxes(pixels, 0, 1)
        signs = working_from_source[0, 1], working_from_source[1, 0]
    else:
        signs = working_from_source[1, 1], working_from_source[0, 0]
    if signs[0] < 0:
        pixels = pixels[::-1]
    if signs[1] < 0:
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(pixels)


def run_job(folder: Path, job: Job) -> dict[str, Any]:
    """Run COLMAP on ``folder/images`` in another process.

    Returns:
        ``models`` (number in ``folder/sparse``), ``seconds``, ``failure`` or None.
    """
    write_json(folder / "request.json", asdict(job))
    begin = time.perf_counter()
    with (folder / "log.txt").open("w") as log:
        ended = subprocess.run(
            [*module_command("pipeline.studies.compare.colmap_run"), str(folder)],
            stdout=log, stderr=subprocess.STDOUT, check=False,
        )  # fmt: skip
    seconds = round(time.perf_counter() - begin, 2)
    failure = None
    if ended.returncode:
        lines = (folder / "log.txt").read_text(errors="replace").strip().splitlines()
        said = f": {lines[-1]}" if lines else ""
        failure = f"COLMAP ended with status {ended.returncode}{said}"
    models = len(list((folder / "sparse").glob("*/images.bin")))
    return {"models": models, "seconds": seconds, "failure": failure}


def reconstruct(folder: Path, job: Job) -> None:
    """Features, exhaustive matching and incremental mapping of ``folder/images``, in here."""
    import pycolmap

    database = folder / "database.db"
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = 1
    reader = pycolmap.ImageReaderOptions()
    if job.masked:
        reader.mask_path = str(folder / "masks")
    mode = pycolmap.CameraMode.SINGLE if job.single_camera else pycolmap.CameraMode.PER_IMAGE
    pycolmap.extract_features(
        database, folder / "images", camera_mode=mode, reader_options=reader,
        extraction_options=_changed(extraction, job.options.get("extraction", {})),
        device=pycolmap.Device.cpu,
    )  # fmt: skip
    _give_focals(database, job)
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = job.threads
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = job.seed
    pycolmap.match_exhaustive(
        database,
        matching_options=_changed(matching, job.options.get("matching", {})),
        verification_options=_changed(verification, job.options.get("verification", {})),
        device=pycolmap.Device.cpu,
    )
    mapping = pycolmap.IncrementalPipelineOptions()
    mapping.num_threads = mapping.mapper.num_threads = 1
    mapping.random_seed = mapping.mapper.random_seed = job.seed
    mapping.triangulation.random_seed = job.seed
    (folder / "sparse").mkdir()
    pycolmap.incremental_mapping(
        database, folder / "images", folder / "sparse",
        _changed(mapping, job.options.get("mapping", {})),
    )  # fmt: skip


def _changed(options: Any, changes: Mapping[str, Any]) -> Any:
    for name, value in changes.items():
        *parents, leaf = name.split(".")
        target = options
        for parent in parents:
            target = getattr(target, parent)
        setattr(target, leaf, value)
    return options


def _give_focals(path: Path, job: Job) -> None:
    """Tell COLMAP the focal lengths that it would have read from the photographs' EXIF data."""
    import pycolmap

    database = pycolmap.Database.open(str(path))
    said: dict[int, list[float]] = {}
    for image in database.read_all_images():
        if image.name in job.focals:
            said.setdefault(image.camera_id, []).append(job.focals[image.name])
    for camera in database.read_all_cameras():
        if camera.camera_id in said:
            camera.focal_length = float(np.median(said[camera.camera_id]))
            camera.has_prior_focal_length = True
            database.update_camera(camera)
    database.close()


def thresholds(options: Options) -> dict[str, float]:
    """What COLMAP's mapper asks for under these options, for the reasons of a failure."""
    import pycolmap

    made = _changed(pycolmap.IncrementalPipelineOptions(), options.get("mapping", {})).mapper
    return {
        "init_inliers": made.init_min_num_inliers,
        "init_angle": made.init_min_tri_angle,
        "pose_inliers": made.abs_pose_min_num_inliers,
    }


def main() -> None:
    folder = Path(sys.argv[1])
    asked = read_json(folder / "request.json")
    if not isinstance(asked, dict):
        raise RequestError(f"{folder / 'request.json'} is missing.")
    reconstruct(folder, Job(**json.loads(json.dumps(asked))))


if __name__ == "__main__":
    main()
