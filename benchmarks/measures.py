"""What an orthodontist measures, from whole runs: how far off, and is that said?

    python benchmarks/measures.py [--mouths 20] [--first 700] [--views 3] [--jobs 2] [--out DIR]
                                  [--dentition permanent|primary|mixed]

Grows mouths with all sorts of bites, takes three photographs of each, 44 degrees apart, in one
light and through one lens (or --views of a film from side to side), runs the stages on them at
512 px, and compares the measurements of `teeth.json` with the crowns' own meshes. Beside them,
scale: the size of things in the scene over their true one; and surface: how far the crowns in the
scene lie from the true ones after one similarity (over all that the photographs show of them). OUT
keeps photographs and workspaces, which makes the next run quicker.
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

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # data_samples and tests

from mouths import ARCH_POWERS, ARCH_WIDTH, ARCH_WIDTH_SPREAD

from data_samples.mouths import photograph, random_mouth
from data_samples.mouths.cameras import Camera, look, role_at
from data_samples.mouths.options import DENTITIONS
from data_samples.mouths.visits import CALM
from tests.stages.measured_mouth import truth

BITES, SHARES = ("normal", "deep", "overjet", "edge"), (0.5, 0.2, 0.2, 0.1)
#: Degrees from the patient's left of the first and last photograph: three, and of a film.
REACH, FILM_REACH = 44.0, 50.0
SIZE = (640, 480)
#: Crowns as a whole are taller or lower by this standard deviation.
CROWN_HEIGHTS = 0.09
SETTINGS = (
    "views.long_side=512", "export.video=false", "export.mesh=false", "export.colmap=false",
)  # fmt: skip


def make_photographs(folder: Path, seed: int, views: int, dentition: str) -> None:
    """Photographs of a mouth, and in `truth/` what is true of it and them; once."""
    if (folder / "truth" / "truth.json").exists():
        return
    (folder / "truth").mkdir(parents=True, exist_ok=True)
    form = np.random.default_rng([6, seed])
    mouth = random_mouth(
        np.random.default_rng([3, seed]),
        **CALM | {"bite": str(form.choice(BITES, p=SHARES)), "dentition": dentition},
        arch_width=float(form.normal(ARCH_WIDTH, ARCH_WIDTH_SPREAD)),
        arch_power=float(form.uniform(*ARCH_POWERS)),
        crown_height=float(np.exp(CROWN_HEIGHTS * form.normal())),
    )
    rng = np.random.default_rng([4, seed])
    width, height = SIZE
    focal = 1.9 * width * float(rng.uniform(0.95, 1.1))
    reach = REACH if views == 3 else FILM_REACH
    for number, yaw in enumerate(np.linspace(-reach, reach, views)):
        turned, tilt, roll = rng.normal(size=3) * (3.0, 2.0, 3.0)
        pose = look(float(yaw + turned), 4.0 + float(tilt), float(roll), 125.0, mouth.pivot)
        camera = Camera(width, height, focal, focal, width / 2, height / 2, pose)
        role = role_at(float(yaw))
        photo = photograph(
            mouth, rng, role, width=width, height=height, bite="closed", camera=camera, plain=True
        )
        name = f"{number}_{role}" if views == 3 else f"{number:03d}"
        cv2.imwrite(str(folder / f"{name}.jpg"), photo.image[..., ::-1])
        np.savez_compressed(
            folder / "truth" / f"{number}.npz", depth=np.where(photo.labels > 0, photo.depth, 0),
            focal=focal, pose=pose,
        )  # fmt: skip
    (folder / "truth" / "truth.json").write_text(json.dumps(truth(mouth)))


def run(out: Path, views: int, dentition: str, seed: int) -> dict[str, Any] | None:
    """The measurements of one mouth, each with what is true; None if it was refused."""
    name = f"{seed}_{views}_{dentition}"
    photographs, workspace = out / "photographs" / name, out / "workspaces" / name
    make_photographs(photographs, seed, views, dentition)
    settings = [word for setting in SETTINGS for word in ("--set", setting)]
    subprocess.run(
        [sys.executable, "-m", "dentalsplat", "run", str(photographs), "-w", str(workspace), "-q",
         *settings], check=False, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    file = workspace / "results" / "teeth.json"
    if not file.exists():
        return None
    true = json.loads((photographs / "truth" / "truth.json").read_text())
    found = json.loads(file.read_text())["measurements"]
    scale, surface = compare_crowns(workspace, photographs)
    entries = [e | {"true": true[e["name"]]} for e in found if e["name"] in true]
    return {"seed": seed, "entries": entries, "scale": scale, "surface": surface}


def compare_crowns(workspace: Path, photographs: Path) -> tuple[float, list[float]]:
    """Size of the crowns in the scene over their true one, and how far they are from the true ones
    after one similarity: mm, median and 90 % of what the photographs show."""
    from pipeline.artifacts.cameras import Camera as PlacedCamera
    from pipeline.artifacts.space.frames import frame_of
    from pipeline.geometry.similarity import robust_similarity
    from pipeline.studies.report.reading import read_case
    from stages.splatting.frame import move_cameras, move_gaussians
    from stages.splatting.rendering import render

    case = read_case(workspace)
    cameras, gaussians = case.latest("cameras"), case.latest("gaussians")
    assert cameras is not None and gaussians is not None
    frame = frame_of(cameras, "auto").from_world
    gaussians = move_gaussians(gaussians, frame)
    ratios, scene, truths = [], [], []
    for camera in move_cameras(cameras.cameras, frame):
        view = render(gaussians, camera, threads=1)
        true = np.load(photographs / "truth" / f"{int(camera.name)}.npz")
        size = camera.width, camera.height
        depth = cv2.resize(true["depth"], size, interpolation=cv2.INTER_NEAREST)
        focal = float(true["focal"]) * camera.width / SIZE[0]
        true_camera = PlacedCamera(
            camera.name, *size, focal, focal, size[0] / 2, size[1] / 2, true["pose"]
        )
        known = (view.alpha > 0.9) & (depth > 0)
        ratios.append(np.median((view.depth / camera.fx * focal)[known] / depth[known]))
        scene.append(camera.unproject(view.depth)[known])
        truths.append(true_camera.unproject(depth)[known])
    points, theirs = np.concatenate(scene), np.concatenate(truths)
    size_of_it, turn, shift = robust_similarity(points, theirs, np.ones(len(points)))
    off = np.linalg.norm(theirs - size_of_it * points @ turn.T - shift, axis=1)
    return float(np.mean(ratios)), np.quantile(off, [0.5, 0.9]).tolist()


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
    parser.add_argument("--views", type=int, default=3, help="3, or as many as a film has")
    parser.add_argument("--dentition", choices=DENTITIONS, default="permanent")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(args.jobs) as jobs:
        seeds = range(args.first, args.first + args.mouths)
        one = partial(run, args.out or Path(scratch), args.views, args.dentition)
        scenes = [scene for scene in jobs.map(one, seeds) if scene is not None]
    print(f"scenes: {len(scenes)} of {args.mouths}")
    entries = [entry for scene in scenes for entry in scene["entries"]]
    for name in dict.fromkeys(entry["name"] for entry in entries):
        mine = [entry for entry in entries if entry["name"] == name]
        measured = [e for e in mine if e["value"] is not None and not e["estimated"]]
        estimated = [e for e in mine if e["value"] is not None and e["estimated"]]
        for label, part in ((name, measured), (f"{name}, estimated", estimated)):
            if part:
                print(describe(label, part))
    scales = np.log([scene["scale"] for scene in scenes])
    print(f"scale: {100 * scales.mean():+.1f} % on average, +- {100 * scales.std():.1f} %")
    surfaces = np.array([scene["surface"] for scene in scenes])
    middle, most = np.median(surfaces, axis=0)
    print(f"surface: off by {middle:.2f} mm in the median, 90 % of it by at most {most:.2f}")


if __name__ == "__main__":
    main()
