"""`teeth.yaml`: what a person put right about the teeth, as the page `check.html` saves it.

::

    photographs:
      0_right.jpg:
        use: true
        kind: right
        mirrored: false
        crowns:
          - {at: [412, 300], tooth: 16}
          - {at: [80.5, 310], remove: true}
          - {at: [240, 296], split: [[238, 220], [243, 380]]}
        sha256: 5f8e0c1b7a29d364

Everything is optional. Coordinates are pixels of the photograph as it was taken, turned upright, so
that they outlive a change of the working size. Crowns are taken in the order given: a crown that
was split can be numbered below. `sha256` begins that of the photograph's file: of another picture
with the same name nothing here holds.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from pipeline.artifacts.dental.fdi import ALL_TEETH, THE_NUMBERS
from pipeline.errors import RequestError, nearest
from pipeline.untrusted.paths import user_path
from pipeline.untrusted.plain_yaml import read_plain_yaml

#: Name of the file in the workspace that is used by itself.
CORRECTIONS = "teeth.yaml"

Place = tuple[float, float]  # x, y in pixels of the upright photograph
Kind = Literal["front", "right", "left"]
KINDS: tuple[Kind, ...] = get_args(Kind)

#: Coordinates beyond this are those of no photograph.
FARTHEST = 1e6
_DIGITS = re.compile("[0-9a-f]{0,64}")


@dataclass(frozen=True)
class CrownCorrection:
    """What is wrong about one crown: one of `tooth`, `remove` and `split` is given.

    Attributes:
        at: a place on it.
        tooth: its FDI number.
        remove: it is no tooth.
        split: two places on the line that parts it in two.
    """

    at: Place
    tooth: int | None = None
    remove: bool = False
    split: tuple[Place, Place] | None = None


@dataclass(frozen=True)
class PhotoCorrection:
    """What is wrong about one photograph; None leaves things as they are.

    Attributes:
        use: False: leave it out; True: use it although it was set aside.
        kind: what it shows, turned back where it is mirrored.
        mirrored: it is a mirror image, or is none.
        crowns: in the order in which they are put right.
        sha256: how that of the photograph's file begins, "" where it isn't known.
    """

    use: bool | None = None
    kind: Kind | None = None
    mirrored: bool | None = None
    crowns: tuple[CrownCorrection, ...] = ()
    sha256: str = field(default="", compare=False)

    def is_of(self, sha256: str) -> bool:
        """May it be of the photograph whose file has this SHA-256 ("": not known)?"""
        return not sha256 or sha256.startswith(self.sha256)


@dataclass(frozen=True)
class Corrections:
    """All that was put right.

    Attributes:
        photographs: file name of the photograph (or its stem, or the view's name) -> what is wrong.
        file: where it stands, for messages.
    """

    photographs: Mapping[str, PhotoCorrection] = field(default_factory=dict)
    file: str = CORRECTIONS

    def __bool__(self) -> bool:
        return any(photo != PhotoCorrection() for photo in self.photographs.values())


def composed(name: str) -> str:
    """A photograph's name with its accents composed: some systems take them apart on copying."""
    return unicodedata.normalize("NFC", name)


def corrections_file(
    setting: object, request: Mapping[str, Any], named: str = "labels"
) -> Path | None:
    """The file of corrections that a run uses, if any.

    Args:
        setting: a file's path, or anything else for none named.
        request: what the user asked for (`workspace`: the folder that may hold a `teeth.yaml`).
        named: the setting's name, for messages.

    Raises:
        RequestError: the file named is not there.
    """
    if isinstance(setting, str | Path) and str(setting):
        path = user_path(setting, named)
        if not path.is_file():
            raise RequestError(f"{named}: there is no file {path}.")
        return path
    workspace = request.get("workspace")
    found = Path(workspace) / CORRECTIONS if workspace else None
    return found if found and (found.exists() or found.is_symlink()) else None


def corrections_beside(request: Mapping[str, Any]) -> Path | None:
    """The `teeth.yaml` that lies beside the photographs of a request, where none is used.

    Args:
        request: what the user asked for (`images`: photographs, or folders of them; `tell`: takes
            what there is to say; without it, None).
    """
    if "tell" not in request:
        return None
    for path in map(Path, request.get("images", ())):
        found = (path if path.is_dir() else path.parent) / CORRECTIONS
        if found.is_file():
            return found
    return None


def read_corrections(path: Path) -> Corrections:
    """Read a file of corrections.

    Raises:
        RequestError: it can't be read, or says something that isn't understood; the message names
            file, photograph and field.
    """
    tree = _mapping(read_plain_yaml(path), str(path), ("photographs",))
    entries = tree.get("photographs")
    if not isinstance(entries, dict | None):
        raise RequestError(
            f"{path}: 'photographs' must hold a photograph's name with what is wrong in it, not "
            f"{_shown(entries)}."
        )
    photographs = {
        name: _photo(entry, f"{path}, photograph '{name}'")
        for name, entry in (entries or {}).items()
    }
    return Corrections(photographs, str(path))


def _photo(entry: object, where: str) -> PhotoCorrection:
    given = _mapping(entry, where, ("use", "kind", "mirrored", "crowns", "sha256"))
    use, kind, crowns = given.get("use"), given.get("kind"), given.get("crowns")
    sha256 = given.get("sha256", "")
    for name in ("use", "mirrored"):
        if not isinstance(given.get(name), bool | None):
            raise RequestError(f"{where}: {name} must be true or false, not {_shown(given[name])}.")
    if kind is not None and kind not in KINDS:
        hint = nearest(kind, KINDS) if isinstance(kind, str) else ""
        raise RequestError(
            f"{where}: kind must be {', '.join(KINDS[:-1])} or {KINDS[-1]}, not {_shown(kind)}."
            f"{hint}"
        )
    if not isinstance(crowns, list | None):
        raise RequestError(f"{where}: crowns must be a list (- {{at: [x, y], tooth: 16}}).")
    if not isinstance(sha256, str) or not _DIGITS.fullmatch(sha256):
        raise RequestError(
            f"{where}: sha256 must be up to 64 digits 0-9 and a-f in quotes, not {_shown(sha256)}."
        )
    made = [_crown(item, f"{where}, crowns[{k}]") for k, item in enumerate(crowns or [])]
    return PhotoCorrection(use, kind, given.get("mirrored"), tuple(made), sha256)


def _crown(entry: object, where: str) -> CrownCorrection:
    given = _mapping(entry, where, ("at", "tooth", "remove", "split"))
    said = [name for name in ("tooth", "remove", "split") if name in given]
    if len(said) != 1 or "at" not in given:
        raise RequestError(
            f"{where} must say where the crown is (at: [x, y]) and one of tooth, remove and split; "
            f"it says {', '.join(given) or 'nothing'}."
        )
    at = _place(given["at"], f"{where}.at")
    if said == ["remove"]:
        if given["remove"] is not True:
            raise RequestError(f"{where}.remove can only be true; leave the line out otherwise.")
        return CrownCorrection(at, remove=True)
    if said == ["split"]:
        ends = given["split"]
        if not isinstance(ends, list) or len(ends) != 2:
            raise RequestError(
                f"{where}.split must be two places, [[x1, y1], [x2, y2]], not {_shown(ends)}."
            )
        start, end = (_place(end, f"{where}.split[{k}]") for k, end in enumerate(ends))
        if start == end:
            raise RequestError(f"{where}.split: both ends of the line are the same place.")
        return CrownCorrection(at, split=(start, end))
    tooth = given["tooth"]
    if isinstance(tooth, bool) or not isinstance(tooth, int) or tooth not in ALL_TEETH:
        raise RequestError(f"{where}.tooth: {_shown(tooth)} is no tooth's number. {THE_NUMBERS}.")
    return CrownCorrection(at, tooth=tooth)


def _mapping(entry: object, where: str, keys: tuple[str, ...]) -> dict[str, Any]:
    """A mapping with none but these keys; nothing at all is an empty one."""
    if entry is None:
        return {}
    if not isinstance(entry, dict):
        raise RequestError(f"{where} must hold {', '.join(keys)}, not {_shown(entry)}.")
    for name in entry:
        if name not in keys:
            raise RequestError(
                f"{where}: {_shown(name)} is not known here; known: {', '.join(keys)}."
                f"{nearest(name[:40], keys)}"
            )
    return entry


def _place(value: object, where: str) -> Place:
    numbers = value if isinstance(value, list) and len(value) == 2 else []
    good = [
        float(n) for n in numbers
        if isinstance(n, int | float) and not isinstance(n, bool) and abs(n) < FARTHEST
    ]  # fmt: skip
    if len(good) != 2:
        raise RequestError(
            f"{where} must be two numbers, [x, y] in pixels of the photograph, not {_shown(value)}."
        )
    return good[0], good[1]


def _shown(value: object) -> str:
    """A value as short text for a message."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:60]}…"
