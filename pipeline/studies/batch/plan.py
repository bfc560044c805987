"""What a batch has to do: which cases there are, and which of them are finished already."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from shlex import quote
from typing import Any

from pipeline.errors import RequestError, nearest
from pipeline.files import read_json
from pipeline.studies.batch.find import Names, find_cases, mark_duplicates
from pipeline.studies.batch.listing import read_cases
from pipeline.studies.batch.records import (
    FAILED,
    FINAL,
    Case,
    is_finished,
    new_record,
    read_case,
    workspace_of,
)
from pipeline.studies.batch.sources import settings_of, with_others
from pipeline.untrusted.own import BATCH

#: Seconds that a plan takes without a word.
PATIENCE = 2.0


@dataclass(frozen=True)
class Plan:
    """The cases of a batch.

    Attributes:
        cases: all, in their order.
        settings: id -> hash of what it is run with.
        records: id -> what is known of it now.
        waiting: those that are to be run.
        retried: ids of those that are run again though they came to an end.
        asked: what it was made from.
        earlier: names of the cases that were known before.
    """

    cases: list[Case]
    settings: dict[str, str]
    records: dict[str, dict[str, Any]]
    waiting: list[Case]
    retried: set[str]
    asked: tuple[Any, ...]
    earlier: Mapping[str, str]

    def again(self) -> Plan:
        """The same plan, with what another batch has done meanwhile."""
        _, out, *_, retry, keep, _ = self.asked
        if _earlier(out) != self.earlier:
            return make_plan(*self.asked)
        records, waiting, retried = _standing(self.cases, self.settings, out, retry, keep)
        return replace(self, records=records, waiting=waiting, retried=retried)


def make_plan(
    place: Path,
    out: Path,
    preset: str | None,
    overrides: tuple[str, ...],
    stages: tuple[str, ...] | None,
    retry: Sequence[str],
    keep: str = "workspace",
    tell: Callable[[str], None] = lambda message: None,
) -> Plan:
    """Find the cases and what is known of them; nothing is written.

    Args:
        tell: hears of it where that takes a while.

    Raises:
        RequestError: a setting, the place, or a name to retry is wrong, or there is no case.
    """
    settings_for = lru_cache(maxsize=None)(settings_of)
    settings_for(preset, overrides, stages)  # a wrong setting is refused before anything else
    out_inside = Path(os.path.realpath(out)).is_relative_to(os.path.realpath(place))
    if out_inside and place.is_dir():
        raise RequestError(
            f"The results would lie in {out}, among the cases themselves. Choose a folder outside "
            f"{place}: -o."
        )
    earlier = _earlier(out)
    names = Names(earlier)
    said = time.monotonic()
    cases = find_cases(place, names) if place.is_dir() else _listed(place, names)
    cases = _known_again(cases, earlier, out)
    settings: dict[str, str] = {}
    for number, case in enumerate(cases):
        if time.monotonic() > said + PATIENCE:
            said = math.inf
            tell(f"Looking at the settings and photographs of {len(cases)} cases, once.")
        try:
            found = settings_for(preset, overrides + case.overrides, stages)
        except RequestError as error:
            cases[number] = replace(case, settled="wrong", reason=str(error))
            settings[case.id] = ""
            continue
        settings[case.id] = found.key
        if not case.settled:
            cases[number] = with_others(case, found, workspace_of(out.absolute(), case))
    cases = mark_duplicates(cases, settings)
    if all(case.settled == "skipped" for case in cases):
        raise RequestError(
            f"There is no case in {place}. It should hold a folder of photographs for each case."
        )
    records, waiting, retried = _standing(cases, settings, out, retry, keep)
    asked = (place, out, preset, overrides, stages, retry, keep, tell)
    return Plan(cases, settings, records, waiting, retried, asked, earlier)


def _standing(
    cases: Sequence[Case], settings: Mapping[str, str], out: Path, retry: Sequence[str], keep: str
) -> tuple[dict[str, dict[str, Any]], list[Case], set[str]]:
    """How the cases stand by their records: `Plan.records`, `Plan.waiting` and `Plan.retried`."""
    records: dict[str, dict[str, Any]] = {}
    waiting = []
    retried = _retried(cases, out, retry)
    for case in cases:
        before = None if case.settled else read_case(out, case.id)
        if case.settled:
            records[case.id] = new_record(case, case.settled, case.reason)
        elif (
            before
            and is_finished(before, case, settings[case.id])
            and before["name"] == case.name
            and case.id not in retried
            and not (keep == "results" and before["state"] == "done" and not before["kept"])
        ):
            records[case.id] = _as_it_is(out, case, before)
        else:
            records[case.id] = new_record(case, "waiting")
            waiting.append(case)
    return records, waiting, retried


def _as_it_is(out: Path, case: Case, record: dict[str, Any]) -> dict[str, Any]:
    """The record of a finished case, without links to what has been moved or deleted since.

    It is not run again for that: whoever needs the room may have put it elsewhere.
    """
    workspace = workspace_of(out, case)
    here = {name: link for name, link in record["links"].items() if (workspace / link).exists()}
    if here == record["links"]:
        return record
    gone = sorted(set(record["links"]) - set(here))
    why = (
        f"Not there any more, moved or deleted: {', '.join(gone)} (cases/{case.id} in the folder "
        f"of the batch). --retry {quote(case.name)} makes it anew."
    )
    return {**record, "links": here, "reason": " ".join(filter(None, [record["reason"], why]))}


def check_folder(out: Path, place: Path, cases: Sequence[Case], *, chosen: bool) -> None:
    """Make sure that a folder does not hold another batch.

    Cases may have moved, or have been copied; and in a folder that the user chose, cases of another
    place may join those that are there.

    Args:
        chosen: whether the user named the folder.

    Raises:
        RequestError: it holds one, whose cases are still where they were.
    """
    before = _place_of(out)
    if before is None or before.samefile(place):
        return
    if not chosen:
        raise RequestError(
            f"{out} holds the results of other cases, those of {before}. Choose another folder for "
            f"the cases of {place}: -o. If they are the same cases, name this one: "
            f"-o {quote(str(out))}"
        )
    for case in cases:
        record = read_case(out, case.id)
        if record is not None and _is_another(case, record):
            raise RequestError(
                f"{out} holds the results of other cases, those of {before}, and one of them has "
                f"the name {case.name} too, with other photographs. Choose another folder for the "
                f"cases of {place}: -o."
            )


def _place_of(out: Path) -> Path | None:
    """Where the cases lie that a batch's folder was last used for, if they still are there."""
    with suppress(OSError, ValueError):
        told = read_json(out / BATCH)
        if isinstance(told, dict) and isinstance(told.get("cases"), str):
            place = Path(told["cases"])
            return place if place.exists() else None
    return None


def _is_another(case: Case, record: Mapping[str, Any]) -> bool:
    """Are a record's files still there, and none of the case's by its place or its size?"""
    before = {value for path, size, _ in record["files"] for value in (path, size)}
    now = {value for path, size, _ in case.files for value in (path, size)}
    if not now or not before.isdisjoint(now):
        return False
    paths = [Path(path) for path, _, _ in record["files"]]
    return any(path.is_absolute() and path.is_file() for path in paths)


def _listed(place: Path, names: Names) -> list[Case]:
    if not place.exists():
        near = [path.name for path in place.parent.iterdir()] if place.parent.is_dir() else []
        raise RequestError(
            f"There is no folder or file {place}.{nearest(place.name, near)} Give a folder that "
            "holds a folder of photographs for each case, or a CSV file."
        )
    return read_cases(place, names)


def _earlier(out: Path) -> dict[str, str]:
    """What people call a case -> its name, from the records of earlier runs."""
    found: dict[str, str] = {}
    for path in sorted((out / "records").glob("*.json")):
        record = read_case(out, path.stem)
        if record is not None:
            found[record["name"]] = record["id"]
    return found


def _known_again(cases: Sequence[Case], earlier: Mapping[str, str], out: Path) -> list[Case]:
    """Cases that were renamed or moved keep the files that they have: what was computed, and what
    a person has put right. They are known by their photographs, which are no longer where they were
    (others may be in two lists, with other settings)."""
    here = {case.name for case in cases}
    left: dict[tuple[tuple[str, int, int], ...], str] = {}
    for name, known in earlier.items():
        record = None if name in here else read_case(out, known)
        if record and record["files"] and not os.path.lexists(record["files"][0][0]):
            left[_photographs(record["files"])] = known
    found = []
    for case in cases:
        if case.files and not case.settled and case.name not in earlier:
            case = replace(case, id=left.pop(_photographs(case.files), case.id))
        found.append(case)
    return found


def _photographs(files: Sequence[Sequence[Any]]) -> tuple[tuple[str, int, int], ...]:
    """Name, bytes and time of files, of those that lie where the first does: masks do not."""
    parts = [(*os.path.split(path), size, time) for path, size, time in files]
    return tuple(sorted((name, *stamp) for folder, name, *stamp in parts if folder == parts[0][0]))


def _retried(cases: Sequence[Case], out: Path, retry: Sequence[str]) -> set[str]:
    """Ids of the cases that are to be run again.

    Raises:
        RequestError: there is no case of a name.
    """
    known: Mapping[str, str] = {name: case.id for case in cases for name in (case.name, case.id)}
    found: set[str] = set()
    for name in retry:
        asked: dict[str, tuple[str, ...]] = {}
        if name == "failed":
            asked |= {case.id: FAILED for case in cases}
        if name in known:  # also where a case is called 'failed'
            asked[known[name]] = FINAL
        if not asked:
            raise RequestError(
                f"--retry {name}: there is no such case. It may be 'failed', or the name of a case "
                f"as the summary has it.{nearest(name, known)}"
            )
        for case, states in asked.items():
            record = read_case(out, case)
            if record is not None and record["state"] in states:
                found.add(case)
    return found
