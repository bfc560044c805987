"""Two visits against the truth: error per tooth, coverage of the intervals, refused pairs.

    python benchmarks/register.py --out DIR [--mouths 4] [--views 12] [--moved 5] [--width 512]
    python benchmarks/register.py --out DIR --views 3 --seeds 21,22,23 [--calibrate]
    python benchmarks/register.py --out DIR --views 12 --seeds 2 --exact

Mouths of our generator (`data_samples/mouths/visits.py`) in which given teeth moved by known
amounts; each visit is photographed anew, runs through the whole pipeline, and `register` compares
the two. A mouth whose folder is there already is not made or run again. Lengths are scaled to the
true size, so that errors are those of the movement; what a scale by textbook teeth adds is said.
`--exact` compares the same photographs with their true cameras, depths and outlines: what is still
wrong then does not come from the reconstruction. `--calibrate` says what factors and floors of the
intervals these mouths ask for, and what coverage each mouth gets from those of the others, and each
half of the mouths from those of the other half. After that, visits of different mouths are
compared, which must be refused.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # data_samples and tests

from data_samples.mouths.cameras import Camera as TrueCamera
from data_samples.mouths.mouth import build_mouth
from data_samples.mouths.moves import Move
from data_samples.mouths.options import random_options
from data_samples.mouths.rays import cast, ray_scene
from data_samples.mouths.visits import CALM, write_visits
from pipeline.artifacts.cameras import Camera
from pipeline.errors import PipelineError, ReconstructionError
from pipeline.geometry.similarity import robust_similarity
from pipeline.studies.register import comparing, solving
from pipeline.studies.register.comparing import Comparison, compare_visits
from pipeline.studies.register.movement import to_parts, tooth_axes
from pipeline.studies.register.visit import Look, Visit, read_visit, teeth_points

Array = npt.NDArray[np.float64]

#: What a visit needs to be compared.
STAGES = "views,teeth,init,align,sap,flow,fit"
#: What is asked for with twelve photographs: mm, degrees.
TARGET = (0.15, 1.5)
#: Shift and turn among the parts.
PARTS = (slice(0, 3), slice(3, 6))
#: Floors of each part that are tried, mm and degrees.
FLOORS = (
    (0.02, 0.03, 0.04, 0.06, 0.08, 0.1, 0.12, 0.15, 0.2, 0.25, 0.3),
    (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0),
)
#: The floor of each part against that of its kind: rotation is less sure than tip and torque.
BY_PART = (np.ones(3), np.array([1.0, 1.0, 1.5]))
#: Share of the teeth that are to be covered, and of the parts; and shares of the shifts and of the
#: turns that are tried until both are covered in so many teeth.
COVERED = 0.95
TRIED = np.arange(COVERED, 1.0, 0.005)
#: The largest factor of n teeth leaves out one new tooth of n + 1. Where that is more than may be
#: left out, the factor is made larger by this.
MARGIN = 1.5


@dataclass(frozen=True)
class Errors:
    """One row per tooth.

    Attributes:
        moved: [T] whether it truly moved.
        shift, turn: [T] error, mm and degrees.
        parts, half: [T, 6] error of each part, and half of its stated 95 % interval.
        deviation: [T, 6] that the interval was made from.
        certain: [T] whether it is said to have moved.
        basis: [T] what the interval stands on, a key of `comparing.FACTORS`.
    """

    moved: npt.NDArray[np.bool_]
    shift: Array
    turn: Array
    parts: Array
    half: Array
    deviation: Array
    certain: npt.NDArray[np.bool_]
    basis: npt.NDArray[np.str_]

    def of(self, which: npt.NDArray[np.bool_]) -> Errors:
        """Some of the teeth."""
        return Errors(*(getattr(self, k)[which] for k in Errors.__annotations__))

    def covered(self, half: Array) -> npt.NDArray[np.bool_]:
        """[T] whether shift and turn are both off by no more than intervals [T, 6] say."""
        shift = self.shift <= np.linalg.norm(half[:, :3], axis=1)
        return np.asarray(shift & (self.turn <= np.linalg.norm(half[:, 3:], axis=1)))


class Truth:
    """What teeth truly did, at the points that the first visit's run puts them at."""

    def __init__(self, visit: Visit, truth: dict[str, Any]) -> None:
        self.motions = truth["motions"]
        cameras = truth["visits"]["a"]
        self.points = {
            n: true_point(
                c, n, visit, cameras, np.array(truth["centres_a"].get(str(n), np.zeros(3)))
            )
            for n, c in visit.centres.items()
        }
        numbers = sorted(self.points)
        found = np.array([visit.centres[n] for n in numbers])
        true = np.array([self.points[n] for n in numbers])
        self.scale, self.rotation, _ = robust_similarity(found, true, np.ones(len(numbers)))

    def displacement(self, number: int) -> Array:
        """[6] in the frame of the first visit's run, but true mm, and rotation vector (rad)."""
        motion = np.array(self.motions.get(str(number), np.eye(4)))
        true = solving.displacement(motion, self.points[number])
        return np.concatenate([self.rotation.T @ true[:3], self.rotation.T @ true[3:]])


def true_point(
    centre: Array, number: int, visit: Visit, cameras: dict[str, Any], near: Array
) -> Array:
    """[3] where the rays of the true cameras through a crown's middle meet, in the true mouth.

    With one photograph, the point of the ray that is next to the true middle `near` [3].
    """
    matrix = 1e-3 * np.eye(3)
    vector = matrix @ near
    for look in visit.looks:
        if not (look.labels == number).any():
            continue
        pixel, _ = look.camera.project(centre[None])
        true = cameras[look.camera.name]
        x, y = pixel[0] * true["width"] / look.camera.width
        pose = np.array(true["cam_from_world"])
        ray = pose[:3, :3].T @ [(x - true["cx"]) / true["fx"], (y - true["cy"]) / true["fy"], 1.0]
        ray /= np.linalg.norm(ray)
        across = np.eye(3) - np.outer(ray, ray)
        matrix += across
        vector += across @ (-pose[:3, :3].T @ pose[:3, 3])
    return np.asarray(np.linalg.solve(matrix, vector))


def errors_of(found: Comparison, truth: dict[str, Any]) -> Errors:
    """Compare what came out with the truth."""
    known = Truth(found.first, truth)
    axes = tooth_axes(found.first.centres)
    size = np.repeat([known.scale, 1.0], 3)
    off, half, deviation, moved, certain = [], [], [], [], []
    for tooth in found.teeth:
        true = to_parts(axes[tooth.tooth]) @ known.displacement(tooth.tooth)
        off.append(size * tooth.parts - true)
        half.append(size * tooth.half)
        deviation.append(size * tooth.deviation)
        moved.append(str(tooth.tooth) in truth["motions"])
        certain.append(tooth.certain)
    parts = np.array(off)
    return Errors(
        np.array(moved), np.linalg.norm(parts[:, :3], axis=1),
        np.linalg.norm(parts[:, 3:], axis=1), parts, np.array(half),
        np.array(deviation), np.array(certain), np.array([tooth.basis for tooth in found.teeth]),
    )  # fmt: skip


def make(out: Path, seed: int, views: int, moved: int, width: int, run: bool = True) -> Path:
    """Photograph and (unless `run` is False) run both visits of a mouth; what is there is kept."""
    folder = out / f"mouth{seed}_{views}_{moved}"
    if not (folder / "truth.json").exists():
        write_visits(folder, seed, views, moved, width, plain=True, **CALM)
    for name in "ab" if run else "":
        work = folder / f"run_{name}"
        if not (work / "fit" / "current.json").exists():
            program = "from dentalsplat.command import main; main()"
            command = [sys.executable, "-c", program, "run", str(folder / name), "-w", str(work)]
            command += ["--stages", STAGES]
            with (folder / f"run_{name}.log").open("w") as log:
                subprocess.run(command, check=False, stdout=log, stderr=log)
    return folder


def exact_visits(folder: Path, truth: dict[str, Any]) -> tuple[Visit, Visit]:
    """Both visits with their true cameras, depths and outlines; only the pictures are as taken."""
    rng = np.random.default_rng([truth["seed"], 7])
    options = random_options(rng, **CALM)
    moves = {int(n): Move(**move) for n, move in truth["moves"].items()}
    visits = []
    for name in "ab":
        mouth = build_mouth(options, moves if name == "b" and moves else None)
        vertices, _ = mouth.posed(0.0)
        scene = ray_scene((vertices, mouth.triangles))
        looks = []
        for photograph, c in truth["visits"][name].items():
            width, height = c["width"], c["height"]
            lens = c["fx"], c["fy"], c["cx"], c["cy"]
            pose, shape = np.array(c["cam_from_world"]), (height, width)
            v, u = np.mgrid[:height, :width] + 0.5
            pixels = np.stack([u, v], -1).reshape(-1, 2)
            hit = cast(scene, TrueCamera(width, height, *lens, pose).rays(pixels))
            seen = np.isfinite(hit["t_hit"])
            labels = np.zeros(len(seen), np.uint8)
            labels[seen] = mouth.fdi[mouth.triangles[hit["primitive_ids"][seen], 0]]
            depth = np.where(seen, hit["t_hit"], 0).astype(np.float32).reshape(shape)
            picture = cv2.imread(str(folder / name / f"{photograph}.jpg"), cv2.IMREAD_GRAYSCALE)
            looks.append(
                Look(
                    Camera(photograph, width, height, *lens, pose),
                    np.float32(1 / 255) * np.asarray(picture, np.float32),
                    labels.reshape(shape), depth, np.ones(shape, bool),
                )
            )  # fmt: skip
        visits.append(Visit(f"exact_{name}", tuple(looks), teeth_points(looks), 1.0, "the truth"))
    return visits[0], visits[1]


def line(name: str, errors: Errors, which: npt.NDArray[np.bool_]) -> str:
    """A row of the table."""
    if not which.any():
        return f"{name:<24} none"
    shift, turn = errors.shift[which], errors.turn[which]
    inside = np.abs(errors.parts[which]) <= errors.half[which]
    covered = errors.covered(errors.half)[which]
    far, wide = (np.linalg.norm(errors.half[which][:, k], axis=1) for k in PARTS)
    good = (shift <= TARGET[0]) & (turn <= TARGET[1])
    return (
        f"{name:<24}{which.sum():4d} teeth  mm {np.median(shift):.3f} median "
        f"{np.quantile(shift, 0.9):.3f} p90 {shift.max():.3f} max  degrees {np.median(turn):.2f} "
        f"{np.quantile(turn, 0.9):.2f} {turn.max():.2f}  within target {100 * good.mean():.0f} %  "
        f"covered {covered.sum()}/{len(covered)}  parts {100 * inside.mean():.1f} %  "
        f"interval mm {np.median(far):.2f} degrees {np.median(wide):.1f}  "
        f"said to have moved {errors.certain[which].sum()}"
    )


def rank(count: int, share: float) -> int:
    """So many of some teeth are covered where a new one like them is with this probability.

    That is split conformal prediction; more than `count` where these are too few to say.
    """
    return int(np.ceil((count + 1) * share))


def enough(factors: Array, share: float) -> float:
    """The least factor with which a new tooth, like these [N], is covered with this probability."""
    least = rank(len(factors), share)
    if least > len(factors):
        return MARGIN * float(factors.max())
    return float(np.sort(factors)[least - 1])


def tightest(errors: Errors, kind: int, share: float) -> tuple[float, float]:
    """Factor, and floor times `BY_PART`, of shifts (kind 0) or turns (1): the tightest that do.

    They cover, of those that moved and of the others, this share of the lengths and `COVERED` of
    the parts.
    """
    which, length = PARTS[kind], (errors.shift, errors.turn)[kind]
    parts, deviation = errors.parts[:, which], np.maximum(errors.deviation[:, which], 1e-9)
    found = []
    for least in FLOORS[kind]:
        floor = least * BY_PART[kind]
        each = np.sqrt(np.maximum(parts**2 - floor**2, 0)) / deviation
        whole = np.sqrt(np.maximum(length**2 - (floor**2).sum(), 0) / (deviation**2).sum(1))
        factor = max(
            max(enough(whole[some], share), enough(each[some].ravel(), COVERED))
            for some in (errors.moved, ~errors.moved)
            if some.any()
        )
        half = np.hypot(factor * deviation, floor)
        found.append((float(np.log(np.linalg.norm(half, axis=1)).mean()), factor, least))
    return min(found)[1:]


def calibrated(errors: Errors) -> tuple[tuple[float, float], tuple[float, float, float]]:
    """Factors and floors that cover shift and turn in enough teeth most tightly.

    As `pipeline.studies.register.comparing.halves` takes them.
    """
    for share in TRIED:
        (shift, near), (turn, little) = (tightest(errors, kind, share) for kind in (0, 1))
        chosen = (shift, turn), (near, little, float(little * BY_PART[1][2]))
        covered = errors.covered(comparing.halves(errors.deviation, *chosen))
        if all(
            covered[some].sum() >= min(rank(int(some.sum()), COVERED), int(some.sum()))
            for some in (errors.moved, ~errors.moved)
        ):
            break
    return chosen


def calibrate(found: dict[int, Errors]) -> None:
    """Say what the mouths ask for, and how mouths fare with what others ask for.

    Each is judged by all the others, and each half of them by the other half; what intervals stand
    on, each for itself.
    """
    for basis in comparing.FACTORS:
        some = {s: e.of(e.basis == basis) for s, e in found.items() if (e.basis == basis).any()}
        if some:
            print(f"by {basis}:")
            _calibrate(some)


def _calibrate(found: dict[int, Errors]) -> None:
    factors, floors = calibrated(together(list(found.values())))
    print(f"calibrated on all: factors {np.round(factors, 2)}, floors {floors} (mm, degrees)")
    seeds = sorted(found)
    halves = [set(seeds[0::2]), set(seeds[1::2])]
    for name, folds in (("one by one", [{s} for s in seeds]), ("by halves", halves)):
        judged = []
        for fold in folds if len(seeds) > 1 else []:
            others = calibrated(together([found[s] for s in seeds if s not in fold]))
            for seed in sorted(fold):
                half = comparing.halves(found[seed].deviation, *others)
                judged.append(replace(found[seed], half=half))
        if judged:
            total = together(judged)
            print(line(f"left out {name}, moved", total, total.moved))
            print(line(f"left out {name}, others", total, ~total.moved))


def together(many: list[Errors]) -> Errors:
    """All teeth of several mouths."""
    return Errors(*(np.concatenate([getattr(e, k) for e in many]) for k in Errors.__annotations__))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--mouths", type=int, default=4)
    parser.add_argument("--seeds", help="of the mouths, such as 2,5; 1 to --mouths without it")
    parser.add_argument("--exact", action="store_true", help="true cameras, depths and outlines")
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--moved", type=int, default=5, help="teeth that move; 0: none")
    parser.add_argument("--width", type=int, default=512)
    parser.add_argument("--calibrate", action="store_true", help="what intervals ought to be")
    parser.add_argument("--no-pairs", action="store_true", help="leave different mouths out")
    chosen = parser.parse_args()
    visits: dict[int, tuple[Visit, Visit]] = {}
    found: dict[int, Errors] = {}
    seeds = range(1, chosen.mouths + 1)
    for seed in map(int, chosen.seeds.split(",")) if chosen.seeds else seeds:
        size = chosen.views, chosen.moved, chosen.width
        folder = make(chosen.out, seed, *size, run=not chosen.exact)
        truth = json.loads((folder / "truth.json").read_text())
        try:
            if chosen.exact:
                visits[seed] = exact_visits(folder, truth)
            else:
                visits[seed] = read_visit(folder / "run_a"), read_visit(folder / "run_b")
            compared = compare_visits(*visits[seed])
        except (PipelineError, ValueError) as error:
            print(f"mouth {seed}: {error}")
            continue
        errors = errors_of(compared, truth)
        found[seed] = errors
        print(line(f"mouth {seed}, moved", errors, errors.moved))
        print(line(f"mouth {seed}, not moved", errors, ~errors.moved), flush=True)
        print(f"  likeness {compared.likeness:.3f}, in place {compared.share:.2f}", flush=True)
    if found:
        total = together(list(found.values()))
        print(line("all moved", total, total.moved))
        print(line("all not moved", total, ~total.moved))
        if chosen.calibrate:
            calibrate(found)
    if chosen.no_pairs:
        return
    for first, second in permutations(visits, 2):
        try:
            compared = compare_visits(visits[first][0], visits[second][1])
            print(f"{first} with {second}: TAKEN, likeness {compared.likeness:.3f}")
        except ReconstructionError as error:
            print(f"{first} with {second}: refused: {str(error)[:160]}", flush=True)
    print(f"thresholds: likeness {comparing.LEAST_LIKENESS}, share {comparing.LEAST_SHARE}")


if __name__ == "__main__":
    main()
