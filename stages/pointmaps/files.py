"""Pointmaps made elsewhere: a folder of `.npz`, one per pair of photographs.

Each file holds what `pipeline.artifacts.pointmaps` writes:

- ``points_i`` [h, w, 3] and ``points_j_in_i`` [h, w, 3], in the camera frame of i (x right, y
  down, z ahead),
- ``confidence_i`` and ``confidence_j`` [h, w], raw, >= 1; exactly 1 means that nothing is known,
- ``names``: the two photographs; without it the file's name says it: ``<i>_<j>.npz``,
- ``transform_i`` and ``transform_j`` [3, 3], where the maps don't cover their photograph exactly:
  the affine map to pixels of the map (centres at .5) from pixels of the view at working size, or
  from stored pixels of the original file where ``transform_from`` is "source".

A name is a file name of a photograph (with or without its suffix) or the neutral name of a view.
Without a transform, a map of another size than its view must have the same shape: it is a scaled
copy.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.pointmaps import PointmapPair
from pipeline.artifacts.views import View
from pipeline.errors import RequestError, nearest
from pipeline.untrusted.arrays import read_arrays
from pipeline.untrusted.files import UnusableFile
from stages.pointmaps.prepare import clean_map, resample_map

#: What a file must hold.
KEYS = ("points_i", "points_j_in_i", "confidence_i", "confidence_j")
#: Shapes differ if their aspects do by more than this (rounding to whole pixels differs less).
_SAME_ASPECT = 0.01
#: OpenCV resamples no larger ones.
_MOST_PIXELS = 32_000

Matrix = npt.NDArray[np.float64]


@dataclass(frozen=True)
class PairFile:
    """A file and the numbers of the views that it speaks of."""

    path: Path
    first: int
    second: int


def pointmap_files(folder: Path | None) -> list[Path]:
    """The `.npz` files of a folder, sorted by name.

    Raises:
        RequestError: no folder was named, it does not exist, or holds none.
    """
    if folder is None:
        raise RequestError(
            "init.method is files, but no folder of pointmaps is named. Give it: --set "
            "init.pointmap.files=FOLDER."
        )
    if not folder.is_dir():
        raise RequestError(f"init.pointmap.files: there is no folder {folder}.")
    found = sorted(folder.glob("*.npz"))
    if not found:
        raise RequestError(
            f"init.pointmap.files: the folder {folder} holds no .npz file; one per pair is "
            f"expected, with the arrays {', '.join(KEYS)} and the names of the two photographs."
        )
    return found


def match_names(files: Sequence[Path], views: Sequence[View], meaning: str) -> list[PairFile]:
    """Find the views that each file speaks of.

    Args:
        files: the `.npz` files.
        views: the photographs.
        meaning: "source": names are file names of the photographs; "neutral": names of the views;
            "auto": whichever explains all files.

    Raises:
        RequestError: names that fit no view, that fit both ways, or two files for one pair.
    """
    if meaning not in ("auto", "source", "neutral"):
        raise RequestError(
            f"init.pointmap.file_names is '{meaning}'; choose auto, source or neutral."
        )
    keys = {"source": _by_source(views), "neutral": {v.name: k for k, v in enumerate(views)}}
    stated = [_stated_names(path) for path in files]
    attempts: dict[str, list[tuple[int, int] | None]] = {
        name: [_lookup(path, pair, known) for path, pair in zip(files, stated, strict=True)]
        for name, known in keys.items()
        if meaning in ("auto", name)
    }
    complete = {name: found for name, found in attempts.items() if None not in found}
    if len(complete) == 2 and complete["source"] != complete["neutral"]:
        raise RequestError(
            f"The names of the pointmaps ({files[0].name}) are both file names of photographs and "
            "names of views, and mean different ones. Say which: "
            "init.pointmap.file_names=source or neutral."
        )
    if not complete:
        best = max(attempts.values(), key=lambda found: sum(one is not None for one in found))
        worst = best.index(None)
        given = stated[worst]
        what = (
            f"the names {given[0][:80]} and {given[1][:80]}"
            if given
            else "no names, and its file name"
        )
        allowed = sorted({name for known in keys.values() for name in known})
        stranger = next((name for name in given or () if Path(name).name not in allowed), "")
        raise RequestError(
            f"{files[worst]} holds {what} which are no two of the photographs in use "
            f"({', '.join(v.source_name or v.name for v in views)})."
            f"{nearest(stranger, allowed) if stranger else ''} Name the photographs in the array "
            "names, or the file <i>_<j>.npz, and leave out files of photographs that are held out "
            "or set aside."
        )
    result: list[PairFile] = []
    seen: dict[tuple[int, int], Path] = {}
    for path, pair in zip(files, next(iter(complete.values())), strict=True):
        assert pair is not None
        if pair in seen:
            raise RequestError(f"{seen[pair]} and {path} are both about the same pair; remove one.")
        seen[pair] = path
        result.append(PairFile(path, *pair))
    return sorted(result, key=lambda one: (one.first, one.second))


def read_pairs(
    files: Sequence[PairFile],
    views: Sequence[View],
    edge_jump: float,
    progress: Callable[[str, int, int], None],
) -> Iterator[PointmapPair]:
    """Read the files one by one, at the pixels of the views, cleaned.

    Raises:
        RequestError: a broken file, an array that is missing or of the wrong shape or range.
    """
    for done, one in enumerate(files):
        progress("pointmaps", done, len(files))
        yield _read(one, views[one.first], views[one.second], edge_jump)
    progress("pointmaps", len(files), len(files))


def _by_source(views: Sequence[View]) -> dict[str, int]:
    """Names of the photographs' files, with and without suffix, where they are unambiguous."""
    result: dict[str, int] = {}
    for spelling in (lambda name: name, lambda name: Path(name).stem):
        names = [spelling(view.source_name) for view in views]
        for k, name in enumerate(names):
            if name and names.count(name) == 1:
                result.setdefault(name, k)
    return result


def _stated_names(path: Path) -> tuple[str, str] | None:
    arrays, _ = _arrays(path, ("names",))
    if "names" not in arrays:
        return None
    given = np.atleast_1d(arrays["names"])
    if given.dtype.kind not in "US":
        raise RequestError(f"{path}: the array names holds {given.dtype}, not names.")
    if given.shape != (2,):
        raise RequestError(f"{path}: the array names holds {given.size} names instead of 2.")
    names = [name.decode("latin-1") if isinstance(name, bytes) else name for name in given.tolist()]
    return names[0], names[1]


def _lookup(
    path: Path, stated: tuple[str, str] | None, known: Mapping[str, int]
) -> tuple[int, int] | None:
    """View numbers of a file; without stated names, every way to part its file name is tried."""
    if stated is not None:
        candidates = [stated, (Path(stated[0]).name, Path(stated[1]).name)]
    else:
        parts = path.stem.split("_")
        candidates = [("_".join(parts[:k]), "_".join(parts[k:])) for k in range(1, len(parts))]
    found = sorted(
        {(known[a], known[b]) for a, b in candidates if a in known and b in known and a != b}
    )
    return found[0] if len(found) == 1 else None


def _arrays(path: Path, wanted: Iterable[str]) -> tuple[dict[str, npt.NDArray[Any]], list[str]]:
    try:
        return read_arrays(path, wanted)
    except UnusableFile as error:
        raise RequestError(f"{path} {error}; write it again.") from error


def _read(one: PairFile, first: View, second: View, edge_jump: float) -> PointmapPair:
    matrices = ("transform_i", "transform_j")
    found, names = _arrays(one.path, (*KEYS, *matrices, "transform_from"))
    missing = [key for key in KEYS if key not in found]
    if missing:
        raise RequestError(
            f"{one.path} lacks {', '.join(missing)}; it holds {', '.join(names)[:400]}."
        )
    for key in (*KEYS, *matrices):
        if key in found and found[key].dtype.kind not in "biuf":
            raise RequestError(f"{one.path}: {key} holds {found[key].dtype}, not numbers.")
    with np.errstate(over="ignore"):
        arrays = {key: np.asarray(found[key], np.float32) for key in KEYS}
    transforms = {key: np.asarray(found[key], np.float64) for key in matrices if key in found}
    said = found.get("transform_from", np.array("working"))
    origin = str(said.item())[:40] if said.size == 1 else f"{said.size} words"
    if origin not in ("working", "source"):
        raise RequestError(f"{one.path}: transform_from is '{origin}', not working or source.")
    maps = []
    for view, suffix, points in (
        (first, "i", arrays["points_i"]),
        (second, "j", arrays["points_j_in_i"]),
    ):
        confidence = arrays[f"confidence_{suffix}"]
        _check(one.path, suffix, points, confidence)
        matrix = transforms.get(f"transform_{suffix}")
        if matrix is not None and not _is_affine(matrix):
            raise RequestError(
                f"{one.path}: transform_{suffix} is not an affine 3x3 matrix of numbers that can "
                "be inverted."
            )
        if matrix is not None and origin == "source":
            matrix = matrix @ np.linalg.inv(view.working_from_source)
        points, confidence = clean_map(points, confidence)
        if matrix is None and confidence.shape != (view.height, view.width):
            matrix = _scaled(one.path, suffix, confidence.shape, view)
        if matrix is not None:
            points, confidence = resample_map(
                points, confidence, matrix, (view.width, view.height), edge_jump
            )
        confidence = np.where(view.valid(), confidence, np.float32(1))
        maps.append((points, confidence))
    return PointmapPair(first.name, second.name, maps[0][0], maps[1][0], maps[0][1], maps[1][1])


def _is_affine(matrix: npt.NDArray[np.float64]) -> bool:
    """Whether it is [3, 3], takes pixels to pixels, and back."""
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        return False
    away = bool(np.abs(matrix).max() > 1e9)
    return not away and matrix[2].tolist() == [0, 0, 1] and abs(np.linalg.det(matrix)) > 1e-12


def _check(
    path: Path, suffix: str, points: npt.NDArray[np.float32], confidence: npt.NDArray[np.float32]
) -> None:
    if points.ndim != 3 or points.shape[-1] != 3 or confidence.shape != points.shape[:2]:
        raise RequestError(
            f"{path}: the points of {suffix} have the shape {points.shape} and their confidence "
            f"{confidence.shape}; [h, w, 3] and [h, w] are expected."
        )
    if not 2 <= min(confidence.shape) <= max(confidence.shape) <= _MOST_PIXELS:
        raise RequestError(
            f"{path}: the maps of {suffix} have {confidence.shape[1]}x{confidence.shape[0]} "
            f"pixels; from 2 to {_MOST_PIXELS} a side are possible."
        )
    finite = confidence[np.isfinite(confidence)]
    if len(finite) and finite.max() <= 1 and finite.min() < 1:
        raise RequestError(
            f"{path}: confidence_{suffix} is not above 1 anywhere. Raw confidence is expected, "
            "where 1 means that nothing is known: for one in 0..1, add 1."
        )


def _scaled(path: Path, suffix: str, shape: tuple[int, ...], view: View) -> Matrix:
    """The transform of a map that shows the whole view at another size."""
    across, down = shape[1] / view.width, shape[0] / view.height
    if abs(across / down - 1) > _SAME_ASPECT:
        raise RequestError(
            f"{path}: the map of {suffix} has {shape[1]}x{shape[0]} pixels, its photograph "
            f"{view.source_name or view.name} {view.width}x{view.height}: not a scaled copy. Give "
            f"transform_{suffix} (pixel of the map from pixel of the photograph), or set "
            "views.long_side so that they fit."
        )
    return np.diag([across, down, 1.0])
