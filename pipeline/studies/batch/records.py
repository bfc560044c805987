"""What a batch knows of a case: one small file each, and what the words in it mean."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from pipeline.store import read_own, write_sealed

#: State of a case -> what it means, as the summary says it.
STATES = {
    "done": "reconstructed",
    "refused": "could not be reconstructed",
    "wrong": "can't be used as it is",
    "fault": "a fault of ours",
    "killed": "ended from outside, or for its memory or time",
    "duplicate": "the same as another case",
    "skipped": "no case",
    "running": "being worked on",
    "waiting": "not begun",
    "stopped": "interrupted; goes on with the same command",
}
#: A case in one of these is not run again unless something that it depends on changes.
FINAL = ("done", "refused", "wrong", "fault", "killed")
#: Those that `--retry failed` means.
FAILED = ("refused", "wrong", "fault", "killed")
#: What is settled of a case before anything runs; empty: it is to be run.
Settled = Literal["", "wrong", "duplicate", "skipped"]

FOLDERS = ("cases", "records", "thumbnails", "logs")

#: What a file beside the photographs is for, its path, bytes and time of change (ns); without a
#: path: what is wrong with it.
Other = tuple[str, str, int, int]


@dataclass(frozen=True)
class Case:
    """A case, or what stands where one might be.

    Attributes:
        id: name of its files in the batch's folder: safe and unique on every system.
        name: what people call it: its place among the cases.
        images: what `pipeline run` is given.
        overrides: settings of its own.
        files: path, bytes and time of change (ns) of each photograph.
        named: other files that its settings name.
        put: files that a person has put into its workspace, as the teeth put right.
        settled: the state that it has before anything runs; empty: it is to be run.
        reason: why it is in that state.
        like: id of the case that it is the same as.
    """

    id: str
    name: str
    images: tuple[str, ...] = ()
    overrides: tuple[str, ...] = ()
    files: tuple[tuple[str, int, int], ...] = ()
    named: tuple[Other, ...] = ()
    put: tuple[Other, ...] = ()
    settled: Settled = ""
    reason: str = ""
    like: str = ""

    def to_dict(self) -> dict[str, Any]:
        """As JSON values."""
        return asdict(self)

    @classmethod
    def from_dict(cls, value: Mapping[str, Any]) -> Case:
        """What `to_dict` gave, after a way through JSON."""
        lists = {name: tuple(value[name]) for name in ("images", "overrides")}
        files = {name: tuple(map(tuple, value[name])) for name in ("files", "named", "put")}
        return cls(**{**value, **lists, **files})

    @property
    def stamps(self) -> list[list[Any]]:
        """All its files as a record has them."""
        others = [[path or label, *stamp] for label, path, *stamp in (*self.named, *self.put)]
        return [*map(list, self.files), *others]


def workspace_of(out: Path, case: Case) -> Path:
    """The folder of a case's own in that of a batch."""
    return out / "cases" / case.id


def record_path(out: Path, case: str) -> Path:
    """The file that says what came of a case."""
    return out / "records" / f"{case}.json"


def read_case(out: Path, case: str) -> dict[str, Any] | None:
    """What came of a case; None: nothing is known, or the file is damaged or of another kind."""
    found = read_own(record_path(out, case))
    return found if found is not None and set(found) >= _EMPTY else None


def write_case(out: Path, record: dict[str, Any]) -> None:
    """Replace the record of a case in one step."""
    write_sealed(record_path(out, record["id"]), record)


def new_record(case: Case, state: str, reason: str = "", **more: Any) -> dict[str, Any]:
    """A record of a case with nothing measured yet."""
    return {
        "id": case.id, "name": case.name, "state": state, "reason": reason, "like": case.like,
        "files": case.stamps, "contents": [], "settings": "", "session": "", "attempts": 0,
        "host": "", "seconds": None, "peak_memory_mb": None, "teeth": None, "placed": None,
        "photographs": len(case.files) or None, "psnr": None, "ssim": None, "measured": {},
        "warnings": [], "kept": "", "left_out": [], "bytes": None, "links": {}, **more,
    }  # fmt: skip


def is_finished(record: Mapping[str, Any] | None, case: Case, settings: str) -> bool:
    """Does a record say what came of exactly this, by the files' sizes and times?"""
    return (
        record is not None
        and record["state"] in FINAL
        and record["settings"] == settings
        and record["files"] == case.stamps
    )


_EMPTY = set(new_record(Case("", ""), ""))
