"""Films of generated mouths by a hand that rests and shakes: frames even in time or in difference.

    python benchmarks/resting_films.py --out DIR [--seeds 300,304] [--paces rests,start,steady]

Each film has 120 frames, ten a second, from one side of the mouth to the other: `rests` stays at
both ends and in the middle, `start` at its beginning for half the time, `steady` nowhere. Films
that are there are taken. Twelve frames are fitted; six others, spread over the arch, are held out.
Prints what `evaluate` says of them, and how many frames were placed.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import av
import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # data_samples

from data_samples.mouths.cameras import Camera, look, role_at
from data_samples.mouths.mouth import build_mouth
from data_samples.mouths.options import random_options
from data_samples.mouths.photo import photograph
from data_samples.mouths.visits import CALM
from pipeline.store import Store

Array = npt.NDArray[np.float64]

COUNT, RATE = 120, 10
WIDTH, HEIGHT = 512, 384
DISTANCE, FOCAL = 130.0, 1.976 * WIDTH  # millimetres, pixels
#: Seconds -> degrees from the middle.
PACES = {
    "rests": ([0, 4, 6, 9, 11, 12], [-44, -44, 0, 0, 44, 44]),
    "start": ([0, 6, 12], [-44, -44, 44]),
    "steady": ([0, 12], [-44, 44]),
}
HELD_OUT = (-36, -22, -8, 8, 22, 36)  # degrees
STAGES = "views,teeth,init,align,sap,flow,fit,evaluate"


def shaken(rng: np.random.Generator, deviation: float) -> Array:
    """[COUNT] what a hand is off by: half a second is much the same."""
    smooth = gaussian_filter1d(rng.normal(size=COUNT), 5)
    return np.asarray(smooth * deviation * np.sqrt(2 * np.sqrt(np.pi) * 5))


def make_film(folder: Path, seed: int, pace: str) -> None:
    """``film.mp4``, ``transforms.json`` and ``held_out.json`` of one mouth."""
    if (folder / "held_out.json").is_file():
        return
    folder.mkdir(parents=True, exist_ok=True)
    mouth = build_mouth(random_options(np.random.default_rng([seed, 7]), **CALM))
    rng = np.random.default_rng([seed, 8, 0])
    yaw = gaussian_filter1d(np.interp(np.arange(COUNT) / RATE, *PACES[pace]), 2, mode="nearest")
    yaw = yaw + shaken(rng, 1.2)
    elevation, roll = 4 + shaken(rng, 1.5), shaken(rng, 1.5)
    aside = np.stack([shaken(rng, 0.6) for _ in range(3)], 1)
    frames = []
    with av.open(str(folder / "film.mp4"), "w") as container:
        stream: Any = container.add_stream("libx264", rate=RATE)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.options = {"crf": "16", "x264-params": f"keyint={RATE}:min-keyint={RATE}"}
        for k in range(COUNT):
            view = look(yaw[k], elevation[k], roll[k], DISTANCE, mouth.pivot + aside[k])
            camera = Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, view)
            shown = photograph(
                mouth, np.random.default_rng([seed, 9]), role_at(float(yaw[k])), width=WIDTH,
                height=HEIGHT, bite="closed", camera=camera, plain=True,
            )  # fmt: skip
            noise = np.random.default_rng([seed, k]).normal(0, 1.5, shown.image.shape)
            pixels = np.clip(shown.image + noise, 0, 255).astype(np.uint8)
            for packet in stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")):
                container.mux(packet)
            world_from_cam = np.linalg.inv(view)
            pose = world_from_cam @ np.diag([1.0, -1, -1, 1])
            frames.append({"file_path": f"film.mp4#{k}", "transform_matrix": pose.tolist()})
        for packet in stream.encode():
            container.mux(packet)
    lens = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    truth = {**lens, "w": WIDTH, "h": HEIGHT, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(truth))
    inner = yaw[1:-1]
    held = sorted({int(np.argmin(abs(inner - angle))) + 1 for angle in HELD_OUT})
    (folder / "held_out.json").write_text(json.dumps(held))


def measured(folder: Path, sampling: str) -> str:
    """What a run with frames so sampled comes to, in a line."""
    held = ",".join(f"film.mp4#{k}" for k in json.loads((folder / "held_out.json").read_text()))
    workspace = folder / sampling
    done = subprocess.run(
        [sys.executable, "-m", "pipeline.cli", "run", str(folder / "film.mp4"), "-q",
         "-w", str(workspace), "--frames", "12", "--stages", STAGES,
         "--set", f"views.sampling={sampling}", "--set", f"views.held_out=[{held}]",
         "--set", f"evaluate.ground_truth={folder / 'transforms.json'}"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    result = Store(workspace).current("evaluate")
    if done.returncode or result is None:
        return done.stderr.strip().splitlines()[-1][:100] if done.stderr else "nothing came out"
    figures = result.manifest["summary"]
    return (
        f"{figures['held_out_refined_psnr']:.2f} dB in unseen frames, "
        f"{figures['views']} placed, {figures.get('rotation_error_deg', float('nan')):.2f} degrees"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", default="300,304")
    parser.add_argument("--paces", default="rests,start")
    asked = parser.parse_args()
    for seed in map(int, asked.seeds.split(",")):
        for pace in asked.paces.split(","):
            folder = asked.out.resolve() / f"{seed}_{pace}"
            make_film(folder, seed, pace)
            for sampling in ("time", "difference"):
                print(f"{folder.name} {sampling:10} {measured(folder, sampling)}", flush=True)


if __name__ == "__main__":
    main()
