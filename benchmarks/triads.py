"""Real mouths: which cases become a scene, with which numbers, and what must not pass.

    python benchmarks/triads.py --data DIR [--out DIR] [--only CASE,...] [--mixes N] [--larger N]
                                [--series] [--pairs] [--leave-one-out] [--threads 2] [--jobs 1]
                                [--set FIELD=VALUE ...]

DIR holds `triads/` (three photographs and `truth.json` per patient) and perhaps `series/`
(everything that a clinic took). Each case goes through the stages views, teeth and init as on the
command line (init.method=dental, or as --set says). --mixes adds up to N mixes (120: all six
sorts) of which none may become a scene unless what is wrong is put right: sides swapped in the
file names must pass like the case itself. --larger adds up to N of four to six photographs: three
of a patient and one or two of another, which may become a scene without these, and two or all three
of each. --pairs takes two photographs of each case instead, the front and one side, and as mixes
all ways to put another patient's in, or to mirror one. --series gives whole folders. OUT gets
`triads.json` with every figure, `curve.png`, contact sheets (`cases_*.png`, `turned_*.png`,
`series_*.png`, `mixes_*.png`: mixes that were accepted) and `readings/`, which makes the next run
quicker: readings count again where neither the photograph nor the reader has changed.

Found: a truth point lies inside a crown. Right: that crown has the point's number. A wrong number
that is shown as doubtful is listed (with ?), but does not make a scene wrong. Points on crowns
that are partly seen count apart. Epipolar errors are of zeniths and papillae with numbers that two
photographs share, under the cameras found.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import yaml
from triads_data import (
    BOTH,
    CASE,
    LARGER,
    SERIES,
    SORTS,
    SWAPPED,
    Item,
    make_larger,
    make_mixed_pairs,
    make_mixes,
    make_pairs,
    read_cases,
    read_series,
)
from triads_pictures import captioned, draw_curve, overlay_row, write_sheets
from triads_run import Outcome, Picture, Runner
from triads_scores import (
    Row,
    curve,
    is_good,
    is_wrong,
    leave_one_out,
    lowest_threshold,
    score_item,
    unmarked,
)

Line = Callable[[Row], str]
#: Characters of a reason that a line of the table shows.
SHOWN = 110
#: Items after which the figures are written, in case that a long run is ended.
KEPT_EVERY = 12
#: Wrong numbers that it lists.
LISTED = 5


def sheet_rows(row: Row, outcome: Outcome) -> dict[str, Picture]:
    """Name of a contact sheet -> what it shows of an item: of mixes those that were accepted."""
    state = "accepted" if row["accepted"] else "refused"
    state += "" if row["right"] else ", would be wrong"
    text = f"{row['name']}: {state}  {row['why_not']}"[:190].encode("ascii", "replace").decode()
    name = {CASE: "cases", SERIES: "series"}.get(row["sort"], "mixes")
    if name == "mixes" and not row["accepted"]:
        return {}
    rows: dict[str, Picture] = {}
    overlay = overlay_row(outcome, row["sort"])
    if overlay is not None:
        rows[name] = captioned(overlay, text)
    if row["accepted"] and "surface_turned" in outcome.pictures and name != "mixes":
        rows["turned"] = captioned(outcome.pictures["surface_turned"], text)
    return rows


def case_line(row: Row) -> str:
    """One line of the table of cases."""
    whole, partial, epipolar = row["whole"], row["partial"], row.get("epipolar")
    wrong = ", ".join(
        f"{w['photo'][0]}: {w['truth']} named {w['said']}" + ("" if unmarked(w) else "?")
        for w in row["wrong"][:LISTED]
    )
    if len(row["wrong"]) > LISTED:
        wrong += f" and {len(row['wrong']) - LISTED} more"
    seconds = " / ".join(f"{row['seconds'].get(s, 0):.1f}" for s in ("views", "teeth", "init"))
    cells = (
        row["name"],
        "yes" if row["accepted"] else "no",
        f"{whole['found']}/{whole['points']} ({whole['in_one_crown']})",
        f"{whole['right']} ({whole['right_place']})",
        f"{partial['right']}/{partial['points']}",
        wrong or "-",
        "-" if row["confidence"] is None else f"{row['confidence']:.3g}",
        f"{epipolar['px']:.1f} ({100 * epipolar['of_band']:.1f} %)" if epipolar else "-",
        seconds,
        " ".join(row["doubts"])[:SHOWN] or row["why_not"][:SHOWN],
    )
    return f"| {' | '.join(cells)} |"


CASE_HEAD = (
    "| case | scene | found (in one crown) | right (place) | partial, right | wrong numbers "
    "| confidence | epipolar, px (of band) | s: views / teeth / init | why not |\n"
    + "|---" * 10 + "|"
)  # fmt: skip


def series_line(row: Row) -> str:
    """One line of the table of series."""
    aside = "; ".join(f"{photo}: {why}" for photo, why in row["set_aside"].items())
    cells = (
        row["name"], "yes" if row["accepted"] else "no", "yes" if row["chosen_right"] else "NO",
        ", ".join(row["used"]), aside,
        f"{row['whole']['right']}/{row['whole']['points']}",
        " ".join(row["doubts"])[:SHOWN] or row["why_not"][:SHOWN],
    )  # fmt: skip
    return f"| {' | '.join(cells)} |"


SERIES_HEAD = (
    "| series | scene | chosen right | used | set aside | numbers right | why not |\n"
    + "|---" * 7 + "|"
)  # fmt: skip


def totals(rows: Sequence[Row]) -> dict[str, Any]:
    """What the whole comes to."""
    cases = [row for row in rows if row["sort"] == CASE]
    passed = [row for row in cases if row["accepted"]]
    points = sum(row["whole"]["points"] for row in passed)
    result: dict[str, Any] = {
        "cases": len(cases),
        "accepted": len(passed),
        "accepted_with_a_wrong_number": sum(bool(row["wrong"]) for row in passed),
        "accepted_with_one_that_is_not_marked": sum(
            any(unmarked(entry) for entry in row["wrong"]) for row in passed
        ),
        "right_numbers_refused": sum(row["right"] for row in cases if not row["accepted"]),
        "points_found_in_all": _share(cases, "found"),
        "points_right_in_all": _share(cases, "right"),
        "points_in_right_place_in_all": _share(cases, "right_place"),
        "points_in_one_crown_in_all": _share(cases, "in_one_crown"),
        "points_in_accepted": points,
        "points_right_in_accepted": _share(passed, "right"),
    }
    series = [row for row in rows if row["sort"] == SERIES]
    if series:
        result["series"] = len(series)
        result["series_chosen_right"] = sum(row["chosen_right"] for row in series)
        result["series_accepted"] = sum(row["accepted"] for row in series)
    accepted = {row["name"]: row["accepted"] for row in cases}
    for sort in (*SORTS, *LARGER):
        mixes = [row for row in rows if row["sort"] == sort]
        if not mixes:
            continue
        result[sort] = {
            "mixes": len(mixes),
            "accepted": sum(row["accepted"] for row in mixes),
            "accepted_wrong": sum(row["accepted"] and is_wrong(row) for row in mixes),
        }
        if sort == BOTH:
            result[sort]["told"] = sum(
                "fit each other, and so do" in row["why_not"] for row in mixes
            )
        if sort == SWAPPED:
            same = sum(row["accepted"] == accepted.get(row["patients"][0]) for row in mixes)
            result[sort]["as_unswapped"] = same
    return result


def _share(rows: Sequence[Row], key: str) -> float | None:
    points = sum(row["whole"]["points"] for row in rows)
    return round(sum(row["whole"][key] for row in rows) / points, 4) if points else None


def thresholds(rows: Sequence[Row]) -> dict[str, Any]:
    """The curve, the threshold that it gives, and each case under the others' threshold."""
    threshold = lowest_threshold(rows)
    sure = [row for row in rows if row["confidence"] is not None]
    left_out = leave_one_out(rows)
    return {
        "lowest_that_accepts_no_wrong": threshold if threshold > -float("inf") else None,
        "cases_right_above_it": sum(
            row["sort"] == CASE and row["right"] and row["confidence"] >= threshold for row in sure
        ),
        "leave_one_out": left_out,
        "leave_one_out_passes": sum(entry["passes"] for entry in left_out),
        "leave_one_out_accepted_wrong": sum(entry["accepted_wrong"] for entry in left_out),
        "curve": curve(rows),
    }


def decided_shares(rows: Sequence[Row]) -> tuple[float, float]:
    """Shares of the good and of the wrong items that the pipeline accepted."""
    good = [row["accepted"] for row in rows if is_good(row)]
    wrong = [row["accepted"] for row in rows if is_wrong(row)]
    return sum(good) / max(len(good), 1), sum(wrong) / max(len(wrong), 1)


@dataclass
class Results:
    """What was found so far: figures, and rows of the contact sheets by their names."""

    rows: list[Row]
    sheets: dict[str, list[Picture]]

    def add(
        self, items: Iterable[tuple[Row, dict[str, Picture]]], line: Line, folder: Path
    ) -> None:
        """Take in items as they are done, with a line each (none where it is empty)."""
        for number, (row, pictures) in enumerate(items, start=1):
            self.rows.append(row)
            if number % KEPT_EVERY == 0:
                self.write_figures(folder)
            for name, picture in pictures.items():
                self.sheets.setdefault(name, []).append(picture)
            if text := line(row):
                print(text, flush=True)

        self.write_figures(folder)
        for name, sheet in self.sheets.items():
            write_sheets(folder, name, sheet)

    def write_figures(self, folder: Path) -> None:
        """`triads.json` and the curve."""
        found = thresholds(self.rows)
        content = {"totals": totals(self.rows), "thresholds": found, "items": self.rows}
        (folder / "triads.json").write_text(json.dumps(content, indent=1, default=str) + "\n")
        threshold = found["lowest_that_accepts_no_wrong"]
        draw_curve(folder / "curve.png", found["curve"], decided_shares(self.rows), threshold)


def run_item(runner: Runner, item: Item) -> tuple[Row, dict[str, Picture]]:
    """Figures and pictures of one item."""
    outcome = runner.run(item)
    row = score_item(item, outcome)
    return row, sheet_rows(row, outcome)


def run_items(
    runner: Runner, items: Sequence[Item], jobs: int
) -> Iterator[tuple[Row, dict[str, Picture]]]:
    """Run items in their order, in as many processes as `jobs`."""
    if jobs == 1:
        yield from map(partial(run_item, runner), items)
        return
    spawn = get_context("spawn")
    with ProcessPoolExecutor(jobs, spawn, _end_with_parent, (os.getpid(),)) as pool:
        yield from pool.map(partial(run_item, runner), items)


def _end_with_parent(parent: int) -> None:
    """Let no process of the pool outlive a benchmark that was killed."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(2)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def mix_line(row: Row) -> str:
    """Mixes that were accepted, and swapped ones that were not."""
    if row["accepted"] and is_wrong(row):
        return f"- ACCEPTED: {row['name']}, confidence {row['confidence']:.3g}"
    if row["accepted"] and row["sort"] != SWAPPED:
        return f"- put right: {row['name']}; used {', '.join(row['used'])}"
    if row["sort"] == SWAPPED and not row["accepted"]:
        return f"- refused: {row['name']}: {' '.join(row['doubts'])[:SHOWN]}"
    return ""


def settings_of(texts: Sequence[str]) -> dict[str, Any]:
    """FIELD=VALUE with dots -> nested settings of `init`."""
    settings: dict[str, Any] = {"method": "dental"}
    for text in texts:
        path, value = text.split("=", 1)
        *parents, leaf = path.split(".")
        target = settings
        for parent in parents:
            target = target.setdefault(parent, {})
        target[leaf] = yaml.safe_load(value)
    return settings


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder with triads and series")
    parser.add_argument("--out", type=Path, help="folder for figures, pictures and readings")
    parser.add_argument("--only", default="", help="cases, with commas between them")
    parser.add_argument("--mixes", type=int, default=0, metavar="N", help="so many mixes too")
    parser.add_argument("--larger", type=int, default=0, metavar="N", help="so many of four to six")
    parser.add_argument("--pairs", action="store_true", help="the front and one side alone")
    parser.add_argument("--series", action="store_true", help="whole folders too")
    parser.add_argument("--leave-one-out", action="store_true", help="print it for the thresholds")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--jobs", type=int, default=1, help="processes that run mixes")
    parser.add_argument("--set", nargs="*", default=[], metavar="FIELD=VALUE", help="of init")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        run(options, options.out or Path(scratch))


def run(options: argparse.Namespace, folder: Path) -> None:
    """Everything that was asked for."""
    folder.mkdir(parents=True, exist_ok=True)
    every = read_cases(options.data)
    only = set(filter(None, options.only.split(",")))
    cases = [case for case in every if not only or case.name in only]
    series = read_series(options.data, cases)
    runner = Runner(folder / "readings", options.threads, settings_of(options.set))
    results = Results([], {})
    rows = results.rows
    print(CASE_HEAD)
    shown = make_pairs(cases) if options.pairs else cases
    results.add(run_items(runner, shown, 1), case_line, folder)
    if options.series:
        print(f"\n{SERIES_HEAD}")
        results.add(run_items(runner, series, 1), series_line, folder)
    if options.mixes or options.larger:
        mixes = (
            make_mixed_pairs(cases)[: options.mixes]
            if options.pairs
            else make_mixes(cases, series, options.mixes)
        )
        mixes += make_larger(cases, options.larger)
        print(f"\n{len(mixes)} mixes:")
        # A coarse surface will do: only whether there is one counts.
        coarse = settings_of([*options.set, "dental.chart_density=5", "dental.cloud_spacing=1.0"])
        runner = Runner(folder / "readings", max(1, options.threads // options.jobs), coarse)
        results.add(run_items(runner, mixes, options.jobs), mix_line, folder)
    print(f"\n{json.dumps(totals(rows), indent=1)}")
    found = thresholds(rows)
    print(
        f"lowest confidence that accepts no wrong one: {found['lowest_that_accepts_no_wrong']}; "
        f"{found['cases_right_above_it']} of {len(shown)} cases are right and above it"
    )
    if options.leave_one_out:
        for entry in found["leave_one_out"]:
            print(f"- {entry}")
        print(f"leave one out: {found['leave_one_out_passes']} of {len(shown)} cases pass")
    if options.out:
        print(f"figures and sheets: {folder}")


if __name__ == "__main__":
    main()
