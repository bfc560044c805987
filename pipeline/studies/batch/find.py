"""Which cases there are: folders of photographs below one folder, and what else lies there."""

from __future__ import annotations

import hashlib
import os
import re
import stat
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from shlex import quote

from pipeline.errors import RequestError
from pipeline.files import sha256_file
from pipeline.studies.batch.records import Case
from pipeline.studies.batch.sources import contents_of
from pipeline.untrusted.files import sort_of
from pipeline.untrusted.names import printable
from pipeline.untrusted.own import has_results, is_made
from pipeline.workspace import GENERIC_FOLDERS

#: Folders of folders of cases (a clinic, a year, a patient) are gone through this deep.
DEEPEST = 5
#: So many foreign files of a folder get a line each.
MOST_FOREIGN = 50
LONGEST_NAME = 60
#: Folders of pictures that go with the photographs of a case and are none.
BESIDE = {"masks", "mask", "depth", "depths", "thumbnails"}
#: Folders that systems make for what was deleted, for thumbnails, and for what only they read.
SYSTEMS = {
    "$recycle.bin", "#recycle", "@eadir", "__macosx", "lost+found", "system volume information",
}  # fmt: skip
#: Names that mean a device on Windows, whatever comes after a dot.
_DEVICES = re.compile(r"(?i)(con|prn|aux|nul|com\d|lpt\d)(\.|$)")


class Names:
    """Gives cases names for their files: plain ASCII, unique also where case does not count.

    A case keeps the name that it had in an earlier run of the batch.
    """

    def __init__(self, earlier: Mapping[str, str]) -> None:
        """
        Args:
            earlier: what people call a case -> its name.
        """
        self._earlier = dict(earlier)
        self._used = {name.casefold() for name in earlier.values()}

    def of(self, called: str) -> str:
        """The name of a case that people call so."""
        if called in self._earlier:
            return self._earlier[called]
        plain = unicodedata.normalize("NFKD", called).encode("ascii", "ignore").decode()
        name = re.sub(r"[^A-Za-z0-9._-]+", "_", plain.replace("/", "__")).strip("._-")
        name = name[:LONGEST_NAME].rstrip("._-") or "case"
        if _DEVICES.match(name):
            name = f"case_{name}"
        if name.casefold() in self._used:
            name += "-" + hashlib.sha256(called.encode(errors="surrogateescape")).hexdigest()[:8]
        number = 1
        while name.casefold() in self._used:
            number += 1
            name = f"{name}-{number}"
        self._used.add(name.casefold())
        self._earlier[called] = name
        return name


def find_cases(place: Path, names: Names) -> list[Case]:
    """The cases below a folder, in the order of their names, and a line for what is none.

    A folder with photographs, or with one film, is a case; a folder with folders only is gone
    through. Links are followed, each folder once.

    Raises:
        RequestError: there is no such folder, or it is a case itself.
    """
    try:
        entries = _entries(place)
    except OSError as error:
        raise RequestError(
            f"The cases {place} can't be read ({error.strerror or error}). Give a folder that "
            "holds a folder of photographs for each case, or a CSV file."
        ) from error
    kinds = [
        kind for path, kind in entries
        if not (kind == "folder" and (_goes_with(path) or _out_of_sight(path)))
    ]  # fmt: skip
    if "folder" not in kinds and "picture" in kinds:
        raise RequestError(
            f"{place} holds photographs itself, so it is one case. A batch is given the folder "
            f"that holds a folder for each case. To run this one: pipeline run {quote(str(place))}"
        )
    from stages.views.sampling import natural_key

    cases = list(_walk(place, place, (_identity(place),), {}))
    cases.sort(key=lambda case: natural_key(case.name))
    cases = _called_apart(cases)
    return [replace(case, id=names.of(case.name)) for case in cases]


def _called_apart(cases: Sequence[Case]) -> list[Case]:
    """Names of files are bytes: two of them may be written alike, and would be one case."""
    found: dict[str, Case] = {}
    for case in cases:
        name, number = case.name, 1
        while name in found:
            number += 1
            name = f"{case.name} ({number})"
        if number > 1 and not case.settled:
            why = "The name of another folder is written like that of this one. Rename it."
            case = Case("", case.name, settled="wrong", reason=why)
        found[name] = replace(case, name=name)
    return list(found.values())


def as_case(called: str, images: Sequence[str | Path], overrides: tuple[str, ...] = ()) -> Case:
    """A case of these photographs; where they can't be used, it says why."""
    from stages.views.find import find_images

    try:
        files = []
        for path in find_images(images).values():
            entry = path.stat()
            files.append((str(path), entry.st_size, entry.st_mtime_ns))
    except (RequestError, OSError, ValueError) as error:
        return Case("", called, overrides=overrides, settled="wrong", reason=str(error))
    given = tuple(os.path.abspath(path) for path in images)  # noqa: PTH100 - keeps links
    return Case("", called, given, overrides, tuple(files))


def mark_duplicates(cases: Sequence[Case], settings: Mapping[str, str]) -> list[Case]:
    """Say of each case whose photographs and settings are those of an earlier one that it is so.

    Only files of the same sizes are read. A case with corrections of its own is like no other.

    Args:
        settings: id -> hash of what the case is run with.
    """
    alike: dict[tuple[object, ...], list[Case]] = {}
    for case in cases:
        if not case.settled:
            sizes = tuple(sorted(size for _, size, _ in case.files))
            others = tuple((label, size) for label, _, size, _ in case.named)
            alike.setdefault((settings[case.id], sizes, others), []).append(case)
    first: dict[str, Case] = {}
    for group in alike.values():
        known: dict[tuple[str, ...], Case] = {}
        for case in group if len(group) > 1 else ():
            try:
                contents = tuple(sorted(sha256_file(Path(path)) for path, _, _ in case.files))
            except OSError:  # its own run says so
                continue
            contents += tuple(contents_of(case.named))
            if contents not in known:
                known[contents] = case
            elif not case.put:
                first[case.id] = known[contents]
    return [
        replace(
            case, settled="duplicate", like=first[case.id].id,
            reason=f"It holds the same photographs as {first[case.id].name}, byte for byte, and "
            "has the same settings: what came of them stands there.",
        )
        if case.id in first else case
        for case in cases
    ]  # fmt: skip


def _walk(
    root: Path, folder: Path, above: tuple[tuple[int, int], ...], seen: dict[tuple[int, int], str]
) -> Iterator[Case]:
    """What a folder of folders holds."""
    foreign = 0
    entries = _entries(folder)
    pictures = any(kind == "picture" for _, kind in entries)
    # Links come last: a folder is called as it is itself, not as a link to it.
    for path, kind in sorted(entries, key=lambda entry: entry[0].is_symlink()):
        called = printable(str(path.relative_to(root)))
        if kind == "folder" and pictures and _goes_with(path):
            why = "A folder that goes with the photographs beside it: not looked into."
            yield Case("", called, settled="skipped", reason=why)
            continue
        if kind == "folder":
            yield from _folder(root, path, called, above, seen)
            continue
        if path.name.startswith("."):  # .DS_Store and the like
            continue
        foreign += 1
        if foreign <= MOST_FOREIGN:
            yield Case("", called, settled="skipped", reason=_foreign(kind))
    if foreign > MOST_FOREIGN:
        called = printable(str(folder.relative_to(root) / "..."))
        more = foreign - MOST_FOREIGN
        yield Case("", called, settled="skipped", reason=f"{more} more files that are no cases.")


def _foreign(kind: str) -> str:
    if kind == "picture":
        return "A photograph beside the folders of the cases: put it into the folder of its case."
    if kind == "film":
        return "A film beside the folders of the cases: put it into a folder of its own."
    if kind == "other":
        return "A file beside the folders of the cases, neither photograph nor film."
    return f"It is {kind}, not a folder of photographs."


def _folder(
    root: Path,
    folder: Path,
    called: str,
    above: tuple[tuple[int, int], ...],
    seen: dict[tuple[int, int], str],
) -> Iterator[Case]:
    """One folder: a case, folders of cases, or neither."""
    if why := _out_of_sight(folder):
        yield Case("", called, settled="skipped", reason=f"{why}: not looked into.")
        return
    try:
        identity, entries = _identity(folder), _entries(folder)
    except OSError as error:
        why = f"The folder can't be read ({error.strerror or error}). Mend its permissions."
        yield Case("", called, settled="wrong", reason=why)
        return
    if identity in above:
        yield Case("", called, settled="skipped", reason="A link to a folder that it lies in.")
        return
    if identity in seen:
        why = f"A link to the folder of {seen[identity]}, which is a case already."
        yield Case("", called, settled="skipped", reason=why)
        return
    pictures = [path for path, kind in entries if kind == "picture" and path.name[0] != "."]
    films = [path for path, kind in entries if kind == "film" and path.name[0] != "."]
    inner = [path for path, kind in entries if kind == "folder" and not _out_of_sight(path)]
    if pictures or films:
        seen[identity] = called
        yield _leaf(folder, called, pictures, films, inner)
    elif len(inner) == 1 and inner[0].name.lower() in GENERIC_FOLDERS:
        yield from _folder(root, inner[0], called, (*above, identity), seen)
    elif inner and len(above) <= DEEPEST:
        yield from _walk(root, folder, (*above, identity), seen)
    elif has_results(folder):
        why = "Runs have put there what they made, and there are no photographs beside it."
        yield Case("", called, settled="skipped", reason=why)
    elif inner:
        why = f"Folders are gone through {DEEPEST} deep, and this one lies deeper."
        yield Case("", called, settled="wrong", reason=why)
    else:
        yield as_case(called, [folder])  # which says what it holds instead


def _goes_with(folder: Path) -> bool:
    return folder.name.lower() in BESIDE


def _out_of_sight(folder: Path) -> str:
    """What a folder is that people don't put photographs into; empty: not such a one."""
    if folder.name.startswith("."):
        return "A hidden folder"
    return "A folder of the system's own" if folder.name.lower() in SYSTEMS else ""


def _leaf(
    folder: Path, called: str, pictures: list[Path], films: list[Path], inner: list[Path]
) -> Case:
    more = [path for path in inner if not _goes_with(path) and _holds_pictures(path)]
    if more:
        why = (
            f"It holds photographs and also a folder of photographs ({printable(more[0].name)}): "
            "it can't be told whether that is one case or several. Move them apart, or list the "
            "cases in a CSV file."
        )
        return Case("", called, settled="wrong", reason=why)
    if not pictures and len(films) > 1:
        why = f"It holds {len(films)} films; a case is one. Put each into a folder of its own."
        return Case("", called, settled="wrong", reason=why)
    return as_case(called, [folder] if pictures else films)


def _holds_pictures(folder: Path) -> bool:
    try:
        return any(kind in ("picture", "film") for _, kind in _entries(folder))
    except OSError:
        return False


def _entries(folder: Path) -> list[tuple[Path, str]]:
    """What lies in a folder, without what runs have put there: each with ``folder``, ``picture``,
    ``film``, ``other``, or a description of what it is else."""
    from stages.views.find import is_photograph, is_video
    from stages.views.sampling import natural_key

    found = []
    with_results = has_results(folder)
    for name in sorted(os.listdir(folder), key=natural_key):  # noqa: PTH208
        path = folder / name
        if with_results and is_made(path):
            continue
        try:
            mode = path.stat().st_mode
        except FileNotFoundError:
            kind = "a link that leads nowhere"
        except OSError as error:
            kind = f"something that can't be read ({error.strerror or error})"
        else:
            file = "picture" if is_photograph(path) else "film" if is_video(path) else "other"
            kind = "folder" if stat.S_ISDIR(mode) else sort_of(mode) or file
        found.append((path, kind))
    return found


def _identity(folder: Path) -> tuple[int, int]:
    entry = folder.stat()
    return entry.st_dev, entry.st_ino
