"""What stays of a case: a picture for the summary, and with ``--keep results`` the results."""

from __future__ import annotations

import re
import shutil
import textwrap
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import groupby
from pathlib import Path

from pipeline.files import fsync_tree, read_json, temporary_beside, write_atomic, write_json
from pipeline.pages.page import CHECK, REPORT
from pipeline.stage import stage_names
from pipeline.store import Store
from pipeline.store.places import is_folder, is_there, remove, size_of
from pipeline.untrusted.own import REQUEST

#: Bytes that a case may have with ``--keep results``; and what the files may have together that a
#: case is kept for: photographs of 1024 pixels make a viewer page of 8 to 10 MB.
MOST_KEPT, MOST_WANTED = 8_000_000, 12_000_000
#: Those files, by the end of the name, most wanted first.
WANTED = (
    ".txt", ".json", ".csv", "viewer.html", "mesh.ply", "mesh_without_scale.ply", REPORT,
)  # fmt: skip
#: What is kept next; what then has no room is left out, and said. The full splats (14 MB), COLMAP's
#: model and the points are for further computing: they come last.
ORDER = (
    *WANTED, "mesh.glb", "mesh_without_scale.glb", ".spz", ".sog", ".mp4", CHECK, ".glb", ".stl",
    ".png", "points.ply", ".ply",
)  # fmt: skip
#: Long side of the summary's pictures, pixels.
THUMBNAIL = 160
#: Files of a workspace that only runs need; the stages' folders besides.
_WORKING = (REQUEST, "pages.json", "profile")
#: A link of the report to a file in `results/`.
_RESULT_LINK = re.compile(r'<li[^>]*><a href="(results/[^"]+)">[^<]*</a></li>')
#: What scene.json calls itself.
SCENE = "dentalsplat export 2"
#: What is kept while it is made, when it is whole, and while a new run may replace it.
_MAKING, _MADE, _BEFORE = ".results.part", ".results", ".results.before"


def keep_results(workspace: Path) -> list[str]:
    """Keep the results of a case and the pages about it, within limits; the rest is deleted.

    A kill at any moment loses nothing: call it again.

    Returns:
        Names of what was left out for its size.
    """
    results, making, made = (workspace / name for name in ("results", _MAKING, _MADE))
    left_out: list[str] = []
    if not is_there(made) and (results.is_symlink() or not is_there(results)):
        remove(making)
        making.mkdir()
        left_out = _copy_within(results, workspace, making)
        _tell(making, sorted(set(left_out) - {REPORT, CHECK}))
        fsync_tree(making)
        making.rename(made)
    if is_there(made):
        if results.is_symlink() or is_there(results):
            remove(results)
        made.rename(results)
    for name in (*stage_names(), *_WORKING):
        remove(workspace / name)
    for page in (REPORT, CHECK):
        if page in left_out:
            remove(workspace / page)
    _unlink_missing(workspace / REPORT)
    return left_out


@contextmanager
def kept_aside(workspace: Path) -> Iterator[None]:
    """While a case is run anew: what an earlier run kept makes room for a link to new results.

    It comes back where there are none; after a kill, when the case is run again.
    """
    results, before = workspace / "results", workspace / _BEFORE
    for name in (_MAKING, _MADE):
        remove(workspace / name)
    if is_folder(results):
        remove(before)
        results.rename(before)
    try:
        yield
    finally:
        if is_there(before) and not is_there(results):
            before.rename(results)
        remove(before)


def _copy_within(results: Path, workspace: Path, into: Path) -> list[str]:
    """Copy results, most wanted first, as far as there is room; returns what was left out.

    Of both jaws' meshes of one kind there are both or none.
    """
    entries = list(results.iterdir())
    pages = [workspace / page for page in (REPORT, CHECK) if (workspace / page).is_file()]
    taken = 0
    left_out = []
    for (rank, _), group in groupby(sorted([*entries, *pages], key=_rank), key=_rank):
        together = list(group)
        size = sum(map(size_of, together))
        most = MOST_WANTED if rank < len(WANTED) else MOST_KEPT
        if any(entry.is_dir() for entry in together) or taken + size > most:
            left_out += [entry.name for entry in together]
            continue
        taken += size
        for entry in together:
            if entry.parent == results:
                _copy(entry, into / entry.name)
    return left_out


def _tell(results: Path, left_out: Sequence[str]) -> None:
    """Say in both lists of files, for people and for programs, which were left out."""
    readme, scene = results / "README.txt", results / "scene.json"
    told = read_json(scene)
    why = "Left out by 'pipeline batch --keep results'"
    if left_out and readme.is_file():
        said = f"{why}: {', '.join(left_out)}."
        write_atomic(readme, f"{readme.read_text()}\n{textwrap.fill(said, 100)}\n")
    if left_out and isinstance(told, dict) and told.get("format") == SCENE:
        for listed in (told["files"], told["frame"]["file_from_frame"]):
            for name in left_out:
                listed.pop(name, None)
        told["skipped"] |= dict.fromkeys(left_out, why)
        write_json(scene, told)


def _unlink_missing(report: Path) -> None:
    """Take the links to results that were left out off the report."""
    if report.is_file():
        before = report.read_text()
        after = _RESULT_LINK.sub(
            lambda link: link[0] if is_there(report.parent / link[1]) else "", before
        )
        if after != before:
            write_atomic(report, after)


def _rank(path: Path) -> tuple[int, str]:
    """How much a file is wanted, and the name that it shares with that of the other jaw."""
    exact = [k for k, end in enumerate(ORDER) if path.name == end]
    ending = [k for k, end in enumerate(ORDER) if path.name.endswith(end)]
    return min(exact or ending or [len(ORDER)]), path.name.replace("_lower", "_upper")


def _copy(source: Path, target: Path) -> None:
    """A second name for the same bytes where the disk can, else a copy."""
    try:
        target.hardlink_to(source)
    except OSError:
        shutil.copyfile(source, target)


def thumbnail_of(out: Path, case: str) -> Path:
    """The picture of a case that the summary of a batch shows."""
    return out / "thumbnails" / f"{case}.jpg"


def write_thumbnail(workspace: Path, path: Path, contents: Collection[str], *, scene: bool) -> None:
    """Write a small JPEG of what came out, or of the first photograph; nothing where neither is.

    Args:
        contents: what was read, as the record of the case has it: of other photographs, which the
            workspace may hold from before, no picture is taken.
        scene: whether the results are what came out.
    """
    candidates = [workspace / "results" / "preview.png"] if scene else []
    candidates += _photographs(workspace, contents)
    candidates = [candidate for candidate in candidates if candidate.is_file()]
    if not candidates:
        return
    import cv2

    from pipeline.artifacts.views import jpeg_bytes, read_png
    from pipeline.pages.pictures import QUALITY, shrunk

    for candidate in candidates:
        with suppress(OSError, ValueError, cv2.error):
            image = shrunk(read_png(candidate)[..., :3], THUMBNAIL)
            jpeg = jpeg_bytes(image, QUALITY)
            temporary = temporary_beside(path)
            temporary.write_bytes(jpeg)
            temporary.replace(path)
            return


def _photographs(workspace: Path, contents: Collection[str]) -> list[Path]:
    """The first prepared photograph, if what is in use was prepared from these."""
    found = Store(workspace).current("views")
    if found is None:
        return []
    read = found.manifest["key_material"]["sources"]
    if not all(f"views: {label} {hashed}" in contents for label, hashed in read):
        return []
    return sorted((found.folder / "views" / "images").glob("*.png"))[:1]
