"""A second photograph from one side, of the same mouth or of another: do the two match?

    python benchmarks/nearby.py --count 30 [--first 0] [--jobs 2] [--out DIR]
    python benchmarks/nearby.py --photographs FOLDER ...

To three photographs of a generated mouth comes a fourth one, of the same mouth and of another, in
the same light, from the right, the front, or the left in turn, with a camera of its own. For each
angle between the two the share of dense matches is told (least, median, most), and what became of
the four: a scene of all, a scene without the fourth, without another one, or none. That is what
`ArchOptions.nearby` and `min_nearby_share` are held against. OUT keeps photographs and readings.

Of a FOLDER of one patient's photographs (of a film, seven) each pair that is matched is told.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import combinations, pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))  # not mouths of data_samples

from mouths import ROLES, SIZE, Conditions, make_photographs, one_light
from triads_data import BESIDE, Item, Photo
from triads_run import Outcome, Runner

from data_samples.mouths import photo
from data_samples.mouths.mouth import random_mouth
from pipeline.geometry.rigid import angle_between
from stages.init.dental.solution import ArchFit

#: Whose the fourth one is, and bounds of the angles that are told apart (degrees).
SAME, OTHER = "same", "other"
ANGLES = (0, 10, 15, 20, 30, 180)
#: So many of a folder's pictures are matched.
PICTURES, MOST = (".jpg", ".jpeg", ".png"), 7
#: Seed of another patient's mouth, beyond that of the first one.
APART = 50_000


def fourth(folder: Path, seed: int, whose: str) -> tuple[Path, str]:
    """A photograph of this mouth or of another one, and its role; made once."""
    role = ROLES[seed % len(ROLES)]
    path = folder / f"{whose}_{role}.jpg"
    if not path.exists():
        # the first three of this mouth come of its seed too: what is random here is not theirs
        patient = np.random.default_rng([5, seed + (APART if whose == OTHER else 0)])
        mouth = random_mouth(patient, dentition="permanent")
        with one_light(seed):
            taken = photo.photograph(
                mouth, np.random.default_rng([7, seed]), role, bite="closed", width=SIZE[0],
                height=SIZE[1],
            )  # fmt: skip
        cv2.imwrite(str(path), taken.image[..., ::-1])
    return path, role


def run_mouth(seed: int, out: Path) -> list[dict[str, Any]]:
    """What came of the four photographs, once with each of the two fourth ones."""
    cv2.setNumThreads(1)
    conditions = Conditions({"dentition": "permanent"}, one_light=True)
    folder = out / conditions.folder(seed)
    make_photographs(folder, seed, conditions)
    rows = []
    for whose in (SAME, OTHER):
        path, role = fourth(folder, seed, whose)
        photos = [Photo(folder.name, folder / f"{stem}.jpg", stem) for stem in ROLES]
        photos.append(Photo(whose, path, path.stem))
        outcome = Runner(out / "readings", 1, {"method": "dental"}).run(
            Item(f"{folder.name}_{whose}", BESIDE, tuple(photos))
        )
        rows.append({"seed": seed, "whose": whose, "role": role, **figures(outcome, role)})
    return rows


def figures(outcome: Outcome, role: str) -> dict[str, Any]:
    """How the fourth photograph matches the one of its role, by the first fit of all four."""
    row: dict[str, Any] = {"end": end_of(outcome), "angle": None, "share": None}
    fit = outcome.first_fit
    if fit is None or len(fit.views) <= len(ROLES):
        return row
    pair = ROLES.index(role), len(ROLES)
    return row | {
        "angle": angle_of(fit, *pair),
        "share": share_of(fit, *pair),
        "doubts": fit.doubts,
    }


def pairs_of(folder: Path, readings: Path) -> list[str]:
    """Angle and share of each pair of one patient's photographs that is matched."""
    paths = sorted(p for p in folder.iterdir() if p.suffix.lower() in PICTURES)
    spread = np.linspace(0, len(paths) - 1, min(len(paths), MOST)).round().astype(int)
    photos = tuple(Photo(folder.name, paths[k], paths[k].stem) for k in spread)
    fit = Runner(readings, 1, {"method": "dental"}).run(Item(folder.name, BESIDE, photos)).first_fit
    lines = []
    for i, j in combinations(range(len(photos)), 2):
        share = share_of(fit, i, j)
        if fit is not None and share is not None:
            names = f"{photos[i].shown}, {photos[j].shown}"
            lines.append(f"{folder.name}: {names}: {angle_of(fit, i, j):.1f} degrees, {share:.3f}")
    return lines


def angle_of(fit: ArchFit, i: int, j: int) -> float | None:
    """Degrees between two views; None where one is not placed."""
    one, other = fit.views[i], fit.views[j]
    if one is None or other is None:
        return None
    return angle_between(one.cam_from_world[:3, :3], other.cam_from_world[:3, :3])


def share_of(fit: ArchFit | None, i: int, j: int) -> float | None:
    """What dense matches cover of two views; None where they are not matched."""
    names = (f"dense_share_{i}_{j}", f"dense_share_{j}_{i}")
    return next((fit.figures[name] for name in names if fit and name in fit.figures), None)


def end_of(outcome: Outcome) -> str:
    """All four, without the fourth, without another, or none."""
    if not outcome.accepted:
        return "none"
    out = {f"{k:03d}" for k in range(len(ROLES) + 1)} - set(outcome.placed)
    if not out:
        return "all"
    return "without it" if out == {f"{len(ROLES):03d}"} else "without another"


def summary(rows: list[dict[str, Any]]) -> str:
    """A table: whose, from how far, and what became of it."""
    lines = ["| whose | degrees | pairs | share of matches | ends |", "|---" * 5 + "|"]
    for whose in (SAME, OTHER):
        mine = [row for row in rows if row["whose"] == whose]
        for low, high in pairwise(ANGLES):
            here = [r for r in mine if r["angle"] is not None and low <= r["angle"] < high]
            lines.append(_line(whose, f"{low} to {high}", here))
        lines.append(_line(whose, "not placed", [r for r in mine if r["angle"] is None]))
    return "\n".join(lines)


def _line(whose: str, where: str, rows: list[dict[str, Any]]) -> str:
    shares = [row["share"] for row in rows if row["share"] is not None]
    told = " / ".join(f"{s:.3f}" for s in np.quantile(shares, (0, 0.5, 1))) if shares else "-"
    ends = ", ".join(f"{end} {count}" for end, count in Counter(r["end"] for r in rows).items())
    return f"| {whose} | {where} | {len(rows)} | {told} | {ends or '-'} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=0, help="mouths")
    parser.add_argument("--photographs", type=Path, nargs="*", default=[], metavar="FOLDER")
    parser.add_argument("--first", type=int, default=0, help="seed of the first")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, help="folder that is kept")
    options = parser.parse_args()
    if not options.count and not options.photographs:
        print("Nothing to do without --count or --photographs.")
        return
    with tempfile.TemporaryDirectory() as scratch:
        out = options.out or Path(scratch)
        for folder in options.photographs:
            print(*pairs_of(folder, out / "readings"), sep="\n", flush=True)
        if not options.count:
            return
        rows = []
        with ProcessPoolExecutor(options.jobs, mp_context=get_context("forkserver")) as pool:
            seeds = range(options.first, options.first + options.count)
            for found in pool.map(partial(run_mouth, out=out), seeds):
                rows += found
                for row in found:
                    print(json.dumps(row), flush=True)
        print(summary(rows))


if __name__ == "__main__":
    main()
