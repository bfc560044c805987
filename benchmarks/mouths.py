"""Three photographs of generated mouths: are the numbers and the angles between cameras right?

    python benchmarks/mouths.py --count 30 [--first 0] [--bite open] [--mouth crowding=-0.1 ...]
                                [--one-light] [--jobs 2] [--out DIR]

Every photograph has a lens, a distance, a crop and a light of its own, so that most are refused for
their colours: numbers and angles are those of the fit, whatever becomes of it. With --one-light the
flash, the exposure and the development of a mouth's three are the same. Angles are between
the photograph from the front and those from the sides; a true camera whose principal point is not
in the middle of its photograph counts as turned to what is. What the fit believes is the standard
deviation that it gives itself. Places agree where they alone would pass for one mouth's in all
three photographs. With --bite or --mouth all mouths are grown-ups', with that bite and with those
attributes of `MouthOptions`. OUT keeps photographs and readings, which makes the next run quicker.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import numpy.typing as npt
import yaml
from films import truths
from scipy.spatial.transform import Rotation
from triads_data import CASE, Item, Photo
from triads_run import Outcome, Runner

from data_samples.mouths import photo
from data_samples.mouths.mouth import random_mouth
from data_samples.mouths.options import BITES
from pipeline.geometry.rigid import angle_between
from stages.dentition.overlay import DOUBT_SHOWN
from stages.init.dental.numbering.arch_options import ArchOptions

Floats = npt.NDArray[np.float64]
ROLES = ("right", "front", "left")
#: Pairs of them whose angle counts.
PAIRS = ((0, 1), (1, 2))
SIZE = (1024, 768)
#: The generator's own arches are narrower than people's (30 and 47 mm between the cusps of upper
#: canines and first molars; grown-ups have 34 and 52), and who expects people's finds the cameras
#: nearer together than they were. These are as deep for their width as people's.
ARCH_WIDTH, ARCH_WIDTH_SPREAD, ARCH_POWERS = 1.04, 0.06, (2.5, 3.3)


@dataclass(frozen=True)
class Conditions:
    """What all mouths of a run have in common.

    Attributes:
        mouth: overrides of `random_mouth`.
        one_light: the three photographs of a mouth are lit, exposed and developed alike.
    """

    mouth: dict[str, Any]
    one_light: bool = False

    def folder(self, seed: int) -> str:
        """A name of the mouth's photographs, as of no other."""
        said = sorted((k, v) for k, v in self.mouth.items() if k != "dentition")
        words = [f"{k}={json.dumps(v)}" for k, v in said] + ["one-light"] * self.one_light
        return "_".join(["mouth", *words, f"{seed:04d}"])


@contextmanager
def one_light(seed: int) -> Iterator[None]:
    """Every photograph's flash and development come from the same seed."""

    def alike(function: Callable[..., Any], part: int) -> Callable[..., Any]:
        def call(first: Any, rng: np.random.Generator, plain: bool) -> Any:
            return function(first, np.random.default_rng([part, seed]), plain)

        return call

    with ExitStack() as stack:
        for part, name in enumerate(("random_light", "develop")):
            stack.enter_context(patch.object(photo, name, alike(vars(photo)[name], part)))
        yield


def make_photographs(folder: Path, seed: int, conditions: Conditions) -> None:
    """Three photographs of a mouth, labels beside them, cameras in `truth.json`; once."""
    if (folder / "truth.json").exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng([5, seed])
    form = np.random.default_rng([6, seed])
    arch = {
        "arch_width": float(form.normal(ARCH_WIDTH, ARCH_WIDTH_SPREAD)),
        "arch_power": float(form.uniform(*ARCH_POWERS)),
    }
    mouth = random_mouth(rng, **{**arch, **conditions.mouth})
    cameras = []
    for stem in ROLES:
        with one_light(seed) if conditions.one_light else nullcontext():
            taken = photo.photograph(mouth, rng, stem, bite="closed", width=SIZE[0], height=SIZE[1])
        cv2.imwrite(str(folder / f"{stem}.jpg"), taken.image[..., ::-1])
        cv2.imwrite(str(folder / f"{stem}.png"), taken.labels)
        camera = taken.camera
        cameras.append(
            {
                "cam_from_world": camera.cam_from_world.tolist(), "focal": camera.fx,
                "middle": [camera.cx, camera.cy],
            }
        )  # fmt: skip
    truth = {"dentition": mouth.options.dentition, "cameras": cameras}
    (folder / "truth.json").write_text(json.dumps(truth))


def turned_to_middle(camera: dict[str, Any]) -> Floats:
    """[3, 3] camera from world of a camera of `truth.json`, turned so that its axis goes through
    the middle of the photograph."""
    x, y = np.array(camera["middle"]) - np.array(SIZE) / 2
    axis = np.array([-x, -y, camera["focal"]])
    turn = Rotation.align_vectors([[0.0, 0.0, 1.0]], [axis / np.linalg.norm(axis)])[0]
    return np.asarray(turn.as_matrix() @ np.array(camera["cam_from_world"])[:3, :3])


def numbers(outcome: Outcome, folder: Path, names: dict[str, str]) -> dict[str, int]:
    """Crowns whose number is right, wrong, and wrong but marked as doubtful."""
    found = {"right": 0, "wrong": 0, "marked": 0}
    for seen in outcome.teeth.views if outcome.teeth else ():
        true = truths(seen, folder / f"{names[seen.name]}.png")
        for crown, number in zip(seen.all_crowns, true, strict=True):
            if crown.number and number:
                right = number == crown.number
                found["right" if right else "wrong"] += 1
                found["marked"] += not right and crown.doubt > DOUBT_SHOWN
    return found


def run_mouth(seed: int, out: Path, conditions: Conditions) -> dict[str, Any]:
    """One mouth: what the fit made of it, against the truth."""
    cv2.setNumThreads(1)
    folder = out / conditions.folder(seed)
    make_photographs(folder, seed, conditions)
    truth = json.loads((folder / "truth.json").read_text())
    photos = tuple(Photo(folder.name, folder / f"{stem}.jpg", stem) for stem in ROLES)
    outcome = Runner(out / "readings", 1, {"method": "dental"}).run(Item(folder.name, CASE, photos))
    names = {v.name: Path(v.source_name).stem for v in outcome.views.views}
    row: dict[str, Any] = {
        "seed": seed, "dentition": truth["dentition"], "accepted": outcome.accepted,
        "doubts": list(outcome.fit.doubts) if outcome.fit else [outcome.message],
        "off": [], "believed": [], "places": None, **numbers(outcome, folder, names),
    }  # fmt: skip
    if outcome.fit is None:
        return row
    figures = outcome.fit.figures
    places = [value for name, value in figures.items() if name.startswith("common_mouth")]
    row["places"] = min(places, default=None)
    placed = {
        names[name]: view.cam_from_world[:3, :3]
        for name, view in zip(outcome.fitted, outcome.fit.views, strict=True)
        if view is not None
    }
    if len(placed) < len(ROLES):
        return row
    order = [names[name] for name in outcome.fitted]
    true = {s: turned_to_middle(c) for s, c in zip(ROLES, truth["cameras"], strict=True)}
    for a, b in PAIRS:
        one, two = ROLES[a], ROLES[b]
        turn, found = true[two] @ true[one].T, placed[two] @ placed[one].T
        row["off"].append(angle_between(turn, found))
        i, j = sorted((order.index(one), order.index(two)))
        row["believed"].append(figures.get(f"angle_deviation_{i}_{j}", np.nan))
    return row


def summary(rows: list[dict[str, Any]]) -> str:
    """A line for grown-ups' mouths, and one for children's."""
    lines = []
    for name, mine in (
        ("permanent", [r for r in rows if r["dentition"] == "permanent"]),
        ("primary, mixed", [r for r in rows if r["dentition"] != "permanent"]),
    ):
        if not mine:
            continue
        least = ArchOptions().common_mouth_by_chance
        agree = sum(r["places"] is not None and r["places"] >= least for r in mine)
        right, wrong, marked = (sum(r[k] for r in mine) for k in ("right", "wrong", "marked"))
        off = np.array([angle for r in mine for angle in r["off"]])
        believed = np.array([angle for r in mine for angle in r["believed"]])
        angles = "no angles"
        if len(off):
            half, most = np.quantile(off, (0.5, 0.9))
            angles = (
                f"{len(off)} angles off by {half:.1f} (90 %: {most:.1f}) degrees, believed to be "
                f"known to {np.nanmedian(believed):.1f}"
            )
        lines.append(
            f"{name}: {len(mine)} mouths, {sum(r['accepted'] for r in mine)} scenes, places agree "
            f"in {agree}; numbers "
            f"{right} right, {wrong} wrong ({marked} marked); {angles}"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=0, help="mouths")
    parser.add_argument("--first", type=int, default=0, help="seed of the first")
    parser.add_argument("--bite", choices=BITES, help="of all of them")
    parser.add_argument("--mouth", nargs="+", default=[], metavar="FIELD=VALUE", help="all have it")
    parser.add_argument("--one-light", action="store_true", help="photographs are lit alike")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, help="folder that is kept")
    options = parser.parse_args()
    if not options.count:
        print("Nothing to do without --count.")
        return
    said = {name: yaml.safe_load(value) for name, value in (s.split("=", 1) for s in options.mouth)}
    said |= {"bite": options.bite} if options.bite else {}
    conditions = Conditions({"dentition": "permanent", **said} if said else {}, options.one_light)
    with tempfile.TemporaryDirectory() as scratch:
        out = options.out or Path(scratch)
        seeds = range(options.first, options.first + options.count)
        rows = []
        with ProcessPoolExecutor(options.jobs, mp_context=get_context("forkserver")) as pool:
            work = partial(run_mouth, out=out, conditions=conditions)
            for row in pool.map(work, seeds):
                rows.append(row)
                print(json.dumps(row), flush=True)
        print(summary(rows))
        if options.out:
            (out / "mouths.json").write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
