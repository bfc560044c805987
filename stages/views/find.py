"""Find the files that a request means: folders, files, patterns, one film; and their masks."""

from __future__ import annotations

import glob
import os
import stat
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from shlex import quote

from pipeline.errors import RequestError, nearest
from pipeline.untrusted.files import PHOTOGRAPH, UnusableFile, opened, sort_of
from pipeline.untrusted.films import KNOWN as KNOWN_FILMS
from pipeline.untrusted.names import printable
from pipeline.untrusted.own import has_results, is_made, made_around
from pipeline.untrusted.paths import matching, names_folder
from pipeline.untrusted.pictures import DICOM_MARK, KNOWN, SUFFIXES
from stages.views.sampling import natural_key

IMAGE_SUFFIXES = (*SUFFIXES, ".dcm", ".dicom")
VIDEO_SUFFIXES = (
    ".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".wmv", ".3gp", ".mts",
    ".m2ts", ".ts",
)  # fmt: skip
#: Of pictures in formats that are not read: such a one in a folder is missed, not meant for others.
OTHER_PICTURES = (
    ".avif", ".gif", ".jxl", ".jp2", ".psd",
    ".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2", ".raf", ".pef", ".srw",
)  # fmt: skip
MASK_PREFIX = "masks/"
#: Names of folders with photographs, beside others with depth maps or masks.
USUAL_FOLDERS = {"images", "photos", "photographs", "frames", "rgb"}


@dataclass(frozen=True)
class Entry:
    """What a folder holds: a name, and whether it is a folder itself."""

    path: Path
    is_folder: bool


def list_folder(folder: Path) -> list[Entry]:
    """What lies directly in a folder, hidden files left out, in natural order.

    Raises:
        RequestError: it can't be read.
    """
    try:
        with os.scandir(folder) as found:
            entries = [Entry(Path(e.path), e.is_dir()) for e in found if e.name[:1] != "."]
    except PermissionError as error:
        raise RequestError(
            f"The folder {folder} can't be read: permission denied. Give yourself the right to "
            "read it (chmod u+rx), or copy the photographs elsewhere."
        ) from error
    except OSError as error:
        raise RequestError(
            f"The folder {folder} can't be read: {error.strerror or error}. Check that the disk or "
            "network share is there, or copy the photographs elsewhere."
        ) from error
    return sorted(entries, key=lambda entry: natural_key(entry.path.name))


def is_image(path: PurePath) -> bool:
    return path.suffix.lower() in IMAGE_SUFFIXES


def is_photograph(path: Path) -> bool:
    """Is it a picture by its name, or a DICOM file without a suffix, as archives write them?

    Names of these end in digits: ``IM_0001``, ``1.2.840.113619.2.5``. Only such are looked into.
    """
    if is_image(path):
        return True
    no_suffix = not path.suffix or path.suffix[1:].isdigit()
    if not no_suffix or path.name.upper() == "DICOMDIR":  # that is a list of files
        return False
    place, mark = DICOM_MARK
    try:
        with opened(path, PHOTOGRAPH) as file:
            return file.read(place + len(mark))[place:] == mark
    except (UnusableFile, OSError):
        return False


def is_video(path: PurePath) -> bool:
    return path.suffix.lower() in VIDEO_SUFFIXES


def find_images(
    requested: Sequence[str | Path], tell: Callable[[str], None] = lambda message: None
) -> dict[str, Path]:
    """Expand a request to label -> file, in natural order.

    Args:
        requested: folders (the images directly in them), image files, patterns such as
            ``photos/*.jpg``, or one video.
        tell: called with what a pattern matches or a folder holds and is not taken.

    Returns:
        Labels are file names; where two files share one, the folder's name comes before it.

    Raises:
        RequestError: something is missing, unreadable or not an image; a video among images;
            nothing.
    """
    files: dict[Path, None] = {}
    for item in requested:
        for path in _expand(item, tell):
            files[Path(os.path.abspath(path))] = None  # noqa: PTH100 (keeps symbolic links)
    paths = list(files)
    videos = [path for path in paths if is_video(path)]
    if videos:
        if len(paths) > 1:
            others = "other videos" if len(videos) == len(paths) else "photographs"
            raise RequestError(
                f"The video {printable(videos[0].name)} was named together with {others} "
                f"({len(paths)} files in all). A case is either one video or a set of photographs: "
                "name only the video, or only the photographs."
            )
        return {printable(videos[0].name): videos[0]}
    if not paths:
        raise RequestError(
            "No photograph was named. Name a folder of photographs, several files, or a video."
        )
    labels = _labels(paths)
    return {label: labels[label] for label in sorted(labels, key=natural_key)}


def find_masks(folder: Path, labels: Iterable[str]) -> dict[str, Path]:
    """Match mask files to images by name: label of the image -> mask file.

    A mask is named as its image, with its own suffix (``a.png`` for ``a.jpg``) or after it
    (``a.jpg.png``, as COLMAP has it).

    Raises:
        RequestError: the folder is missing or unreadable; a mask fits no image, or several; two
            masks fit one.
    """
    folder = Path(folder).expanduser()
    labels = list(labels)
    if not _stat(folder):
        raise RequestError(
            f"The mask folder {folder} does not exist. Correct views.masks, or leave it out to use "
            "the whole of every photograph."
        )
    found: dict[str, Path] = {}
    for entry in list_folder(folder):
        mask = entry.path
        if entry.is_folder or not is_image(mask):
            continue
        _refuse_special(mask, "The mask")
        stem = printable(mask.stem)
        fitting = [label for label in labels if PurePath(label).name == stem]
        fitting = fitting or [label for label in labels if PurePath(label).stem == stem]
        if len(fitting) != 1:
            problem = (
                f"several photographs ({', '.join(fitting[:3])})" if fitting else "no photograph"
            )
            raise RequestError(
                f"The mask {mask.name} in {folder} fits {problem}. A mask bears the name of its "
                f"photograph, as {PurePath(labels[0]).stem}.png for {labels[0]}. Rename or remove "
                "it."
            )
        if fitting[0] in found:
            raise RequestError(
                f"Two masks in {folder}, {found[fitting[0]].name} and {mask.name}, fit the "
                f"photograph {fitting[0]}. Remove one."
            )
        found[fitting[0]] = mask
    if not found:
        raise RequestError(
            f"The mask folder {folder} holds no masks ({_describe(list_folder(folder))}). Masks "
            "are images named as the photographs, bright where these may be used."
        )
    return found


def held_labels(labels: Iterable[str], held_out: Sequence[str]) -> tuple[str, ...]:
    """The labels that `held_out` names, by file name or by stem, in their own order.

    Raises:
        RequestError: a name fits no photograph, or several.
    """
    labels = list(labels)
    found = set()
    for name in map(printable, held_out):
        fitting = [label for label in labels if name in (label, PurePath(label).name)]
        fitting = fitting or [label for label in labels if PurePath(label).stem == name]
        if len(fitting) != 1:
            problem = f"several ({', '.join(fitting[:3])})" if fitting else "none of them"
            numbered = [label for label in labels if "#" in label]  # of a film or a sheet
            plain = [PurePath(label).stem for label in labels if label not in numbered]
            hint = nearest(name, plain)
            how = "Give file names, with or without suffix"
            if numbered:
                how += f"; of what is in a film or a sheet with the number, as in {numbered[-1]}"
            raise RequestError(
                f"views.held_out: of the {len(labels)} photographs given, '{name}' names "
                f"{problem}.{hint} {how}."
            )
        found.add(fitting[0])
    return tuple(label for label in labels if label in found)


def _expand(item: str | Path, tell: Callable[[str], None]) -> list[Path]:
    path = Path(item).expanduser()
    status = _stat(path)
    if status is None:
        if glob.has_magic(str(path)):
            return _expand_pattern(path, tell)
        raise RequestError(
            f"There is no file or folder {path}.{_hint(path)} Name a folder of photographs, "
            "several files, a pattern in quotes such as 'photos/*.jpg', or a video."
        )
    if stat.S_ISDIR(status.st_mode):
        return _expand_folder(path, tell)
    _refuse_special(path, "Among the photographs,")
    if not is_photograph(path) and not is_video(path):
        raise RequestError(
            f"The file {printable(path.name)} is neither a photograph nor a video by its name "
            f"('{path.suffix or 'no suffix'}'). Photographs are {KNOWN}; videos are "
            f"{KNOWN_FILMS}. Convert it, or leave it out."
        )
    return [path]


def _expand_pattern(path: Path, tell: Callable[[str], None]) -> list[Path]:
    matches = matching(path)
    found = [m for m in matches if not m.is_dir() and (is_photograph(m) or is_video(m))]
    ours = {folder: _made_here(folder, path) for folder in {match.parent for match in found}}
    usable = [match for match in found if not ours[match.parent]]
    made = sorted(f"{name}/" for name in set(ours.values()) if name)
    some = ", ".join(made[:3]) + (", ..." if made[3:] else "")
    if made and usable:
        tell(
            f"{len(found) - len(usable)} pictures and films that the pattern matches lie in what "
            f"earlier runs have made ({some} of a workspace) and were left out. To use them all "
            "the same, name their folder."
        )
    if not usable:
        what = "matches nothing"
        if matches:
            what = f"matches {len(matches)} files, none of them a photograph"
        if made:
            what += f", only what earlier runs have made ({some} of a workspace)"
        raise RequestError(
            f"The pattern {path} {what}. Check the folder and the suffix (patterns tell JPG from "
            "jpg), and put it in quotes so that the shell leaves it alone."
        )
    for match in usable:
        _refuse_special(match, "Among the photographs,")
    return usable


def _made_here(folder: Path, pattern: Path) -> str:
    """What a folder that a pattern leads into is called, if runs have made what it holds and the
    pattern doesn't name it; else nothing."""
    unnamed = (own for own in made_around(folder / "_") if not names_folder(pattern, own))
    return next((own.name for own in unnamed), "")


def _refuse_special(path: Path, what: str) -> None:
    """Nothing but regular files is read: a pipe would make the run wait for ever."""
    status = _stat(path)
    sort = sort_of(status.st_mode) if status is not None else None  # missing: said when it is read
    if sort is not None:
        raise RequestError(
            f"{what} {path} is {sort}, not a file. Remove it, or name the photographs one by one."
        )


def _expand_folder(folder: Path, tell: Callable[[str], None]) -> list[Path]:
    entries = list_folder(folder)
    images = [entry.path for entry in entries if not entry.is_folder and is_photograph(entry.path)]
    for image in images:
        _refuse_special(image, "Among the photographs,")
    if images:
        _tell_of_others(folder, entries, {image.stem for image in images}, tell)
        return images
    videos = [entry.path.name for entry in entries if is_video(entry.path)]
    advice = f"Photographs are {KNOWN}."
    with_results = has_results(folder)
    if videos:
        advice = f"To use the video, name it: {folder / videos[0]}"
    else:
        inside = [
            entry.path
            for entry in entries
            if entry.is_folder and not (with_results and is_made(entry.path))
            and any(is_photograph(e.path) for e in _try_list(entry.path))
        ]  # fmt: skip
        if with_results and not inside:
            advice = (
                "Runs have put there what they made. To go on with a workspace: pipeline run -w "
                f"{quote(str(folder))}"
            )
        if inside:
            likely = min(inside, key=lambda path: path.name.lower() not in USUAL_FOLDERS)
            advice = f"Did you mean the folder in it: {likely}"
    raise RequestError(f"There is no photograph in {folder} ({_describe(entries)}). {advice}")


def _tell_of_others(
    folder: Path, entries: Sequence[Entry], read: set[str], tell: Callable[[str], None]
) -> None:
    """Say which pictures of a folder are in formats that are not read, and which films are not, but
    for those that lie there as a photograph too, as cameras and phones write both.

    Args:
        read: stems of the photographs that are taken.
    """

    def left_out(suffixes: Sequence[str]) -> list[Path]:
        files = [entry.path for entry in entries if not entry.is_folder]
        return [p for p in files if p.suffix.lower() in suffixes and p.stem not in read]

    if others := left_out(OTHER_PICTURES):
        them = "it" if len(others) == 1 else "them"
        tell(
            f"{_some(others)} in {folder}: left out, for photographs are read as {KNOWN}. To use "
            f"{them} too, save {them} as JPEG."
        )
    if films := left_out(VIDEO_SUFFIXES):
        tell(
            f"{_some(films)} in {folder}: left out, for a case is either one video or a set of "
            f"photographs. To use the video instead, name it: {films[0]}"
        )


def _some(files: Sequence[Path]) -> str:
    names = ", ".join(printable(path.name) for path in files[:3])
    return names + (", ..." if files[3:] else "")


def _try_list(folder: Path) -> list[Entry]:
    try:
        return list_folder(folder)
    except RequestError:
        return []


def _describe(entries: Sequence[Entry]) -> str:
    """What a folder holds, in a few words."""
    if not entries:
        return "it is empty"
    shown = ", ".join(entry.path.name + ("/" if entry.is_folder else "") for entry in entries[:4])
    more = f" and {len(entries) - 4} more" if len(entries) > 4 else ""
    return f"it holds {shown}{more}"


def _stat(path: Path) -> os.stat_result | None:
    try:
        return path.stat()
    except PermissionError as error:
        raise RequestError(
            f"{path} can't be read: permission denied. Give yourself the right to read the folder "
            "it lies in, or copy the photographs elsewhere."
        ) from error
    except (OSError, ValueError):  # missing, a loop of links, a name too long
        return None


def _hint(path: Path) -> str:
    """The name nearest to a missing one, from the folder where it should lie."""
    parent = path.parent
    names = [entry.path.name for entry in _try_list(parent)] if parent.is_dir() else []
    return nearest(path.name, names)


def _labels(paths: Sequence[Path]) -> dict[str, Path]:
    """Shortest names that tell the files apart: file name, or with as many folders as it takes."""
    labels: dict[str, Path] = {}
    waiting, depth = list(paths), 1
    while waiting:
        tails = {path: printable("/".join(path.parts[-depth:])) for path in waiting}
        counts: dict[str, int] = {}
        for tail in tails.values():
            counts[tail] = counts.get(tail, 0) + 1
        unique = [path for path in waiting if counts[tails[path]] == 1 or depth > len(path.parts)]
        for path in unique:
            tail = tails[path]
            label = f"images/{tail}" if tail.startswith(MASK_PREFIX) else tail
            while label in labels:  # a name that shows as another one is
                label = f"{label}_"
            labels[label] = path
        waiting = [path for path in waiting if path not in set(unique)]
        depth += 1
    return labels
