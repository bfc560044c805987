"""What an orthodontist measures, from whole runs: how far off, and is that said?

    python benchmarks/measures.py [--mouths 20] [--first 700] [--jobs 2] [--out DIR]

Grows adults' mouths with all sorts of bites, takes three photographs of each, 44 degrees apart, in
one light and through one lens, runs the stages on them at 512 px, and compares the measurements of
`teeth.json` with the crowns' own meshes. Beside them, scale: the size of things in the scene over
their true one. OUT keeps photographs and workspaces, which makes the next run quicker.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # data_samples and tests

from mouths import ARCH_POWERS, ARCH_WIDTH, ARCH_WIDTH_SPREAD

from data_samples.mouths import photograph, random_mouth
from data_samples.mouths.cameras import Camera, look
from data_samples.mouths.visits import CALM
from tests.stages.measured_mouth import truth

Array = npt.NDArray[np.float64]
BITES, SHARES = ("normal", "deep", "overjet", "edge"), (0.5, 0.2, 0.2, 0.1)
ROLES = (("right", -44.0), ("front", 0.0), ("left", 44.0))
SIZE = (640, 480)
#: Crowns as a whole are taller or lower by this standard deviation.
CROWN_HEIGHTS = 0.09
SETTINGS = (
    "views.long_side=512", "export.video=false", "export.mesh=false", "export.colmap=false",
)  # fmt: skip


def make_photographs(folder: Path, seed: int) -> None:
    """Three photographs of a mouth, and in `truth/` what is true of it and them; once."""
    if (folder / "truth" / "truth.json").exists():
        return
    (folder / "truth").mkdir(parents=True, exist_ok=True)
    form = np.random.default_rng([6, seed])
    mouth = random_mouth(
        np.random.default_rng([3, seed]),
        **CALM | {"bite": str(form.choice(BITES, p=SHARES))},
        arch_width=float(form.normal(ARCH_WIDTH, ARCH_WIDTH_SPREAD)),
        arch_power=float(form.uniform(*ARCH_POWERS)),
        crown_height=float(np.exp(CROWN_HEIGHTS * form.normal())),
    )
    rng = np.random.default_rng([4, seed])
    centres = np.array(list(mouth.tooth_centres().values()))
    pivot = (centres.min(0) + centres.max(0)) / 2 * [1, 1, 0] + [0, 0, -12.0]
    width, height = SIZE
    focal = 1.9 * width * float(rng.uniform(0.95, 1.1))
    for number, (role, yaw) in enumerate(ROLES):
        turned, tilt, roll = rng.normal(size=3) * (3.0, 2.0, 3.0)
        pose = look(yaw + float(turned), 4.0 + float(tilt), float(roll), 125.0, pivot)
        camera = Camera(width, height, focal, focal, width / 2, height / 2, pose)
        photo = photograph(
            mouth, rng, role, width=width, height=height, bite="closed", camera=camera, plain=True
        )
        cv2.imwrite(str(folder / f"{number}_{role}.jpg"), photo.image[..., ::-1])
        np.savez_compressed(
            folder / "truth" / f"{number}.npz",
            millimetres=np.where(photo.labels > 0, photo.depth / focal * width, 0),
        )
    (folder / "truth" / "truth.json").write_text(json.dumps(truth(mouth)))


def run(out: Path, seed: int) -> list[dict[str, Any]] | None:
    """The measurements of one mouth, each with what is true; None if it was refused."""
    photographs, workspace = out / "photographs" / str(seed), out / "workspaces" / str(seed)
    make_photographs(photographs, seed)
    settings = [word for setting in SETTINGS for word in ("--set", setting)]
    subprocess.run(
        ["pipeline", "run", str(photographs), "-w", str(workspace), "-q", *settings], check=False,
        stderr=subprocess.DEVNULL,
    )  # fmt: skip
    file = workspace / "results" / "teeth.json"
    if not file.exists():
        return None
    true = json.loads((photographs / "truth" / "truth.json").read_text())
    found = json.loads(file.read_text())["measurements"]
    scale = enlarged(workspace, photographs)
    return [{**entry, "true": true[entry["name"]], "seed": seed, "scale": scale} for entry in found]


def enlarged(workspace: Path, photographs: Path) -> float:
    """Size of the crowns in the scene over their true one."""
    from pipeline.artifacts.space.frames import frame_of
    from pipeline.studies.report.reading import read_case
    from stages.splatting.frame import move_cameras, move_gaussians
    from stages.splatting.rendering import render

    case = read_case(workspace)
    cameras, gaussians = case.latest("cameras"), case.latest("gaussians")
    assert cameras is not None and gaussians is not None
    frame = frame_of(cameras, "auto").from_world
    gaussians = move_gaussians(gaussians, frame)
    ratios = []
    for number, camera in enumerate(move_cameras(cameras.cameras, frame)):
        view = render(gaussians, camera, threads=1)
        true = np.load(photographs / "truth" / f"{number}.npz")["millimetres"]
        true = cv2.resize(true, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST)
        known = (view.alpha > 0.9) & (true > 0)
        ratios.append(np.median((view.depth / camera.fx * camera.width)[known] / true[known]))
    return float(np.mean(ratios))


def describe(name: str, entries: list[dict[str, Any]]) -> str:
    """One measurement over all mouths."""
    true, value, said = np.array([[e["true"], e["value"], e["uncertainty"]] for e in entries]).T
    off = value - true
    return (
        f"{name:24s} {len(entries):3d}  error {np.sqrt(np.mean(off**2)):5.2f} mm RMS, "
        f"{off.mean():+.2f} on average; said {np.median(said):5.2f} (19 of 20), "
        f"{(np.abs(off) <= said).sum()} within; true {true.mean():.2f} +- {true.std():.2f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mouths", type=int, default=20)
    parser.add_argument("--first", type=int, default=700)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(args.jobs) as jobs:
        seeds = range(args.first, args.first + args.mouths)
        results = list(jobs.map(partial(run, args.out or Path(scratch)), seeds))
    entries = [entry for result in results if result is not None for entry in result]
    print(f"scenes: {sum(result is not None for result in results)} of {args.mouths}")
    for name in dict.fromkeys(entry["name"] for entry in entries):
        mine = [entry for entry in entries if entry["name"] == name]
        measured = [e for e in mine if e["value"] is not None and not e["estimated"]]
        estimated = [e for e in mine if e["value"] is not None and e["estimated"]]
        for label, part in ((name, measured), (f"{name}, estimated", estimated)):
            if part:
                print(describe(label, part))
    scales = np.log([result[0]["scale"] for result in results if result])
    print(f"scale: {100 * scales.mean():+.1f} % on average, +- {100 * scales.std():.1f} %")


if __name__ == "__main__":
    main()
