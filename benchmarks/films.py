"""Numbers of teeth in films of synthetic mouths: photograph by photograph, and agreed on.

    python benchmarks/films.py --seeds 300,301,302 --folder runs/films

Makes a film of each mouth (`data_samples/mouths`; those that are there are taken), in 12, 10, 9 or
6 frames, every other mouth a tidy adult's. Places it as a run does, and counts the crowns whose
number is that of most of their pixels: as `teeth` read them, and as `init` wrote them. Also the
numbers that a film lists though none of the crowns seen has it, and those it lacks.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # data_samples

from data_samples.mouths.mouth import build_mouth
from data_samples.mouths.options import random_options
from data_samples.mouths.visits import CALM, sweep
from pipeline.artifacts.teeth import Dentition, Teeth, filled
from pipeline.store import Store

FRAMES = (12, 10, 9, 6)
WIDTH = 512
REACH = 38.0, 50.0  # degrees from the middle to the ends


def make_film(folder: Path, seed: int) -> None:
    """Photographs of one mouth with a label picture each."""
    if (folder / "mouth.json").is_file():
        return
    calm = CALM if seed % 2 == 0 else {}
    options = random_options(np.random.default_rng([seed, 7]), **calm)
    mouth, rng = build_mouth(options), np.random.default_rng([seed, 8, 0])
    for name in ("photos", "labels"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    views = FRAMES[seed % len(FRAMES)]
    for k, photo in enumerate(sweep(mouth, rng, views, WIDTH, REACH)):
        quality = [cv2.IMWRITE_JPEG_QUALITY, 95]
        cv2.imwrite(str(folder / "photos" / f"{k:03d}.jpg"), photo.image[..., ::-1], quality)
        cv2.imwrite(str(folder / "labels" / f"{k:03d}.png"), photo.labels)
    teeth = sorted(t.plan.fdi for t in mouth.teeth)
    (folder / "mouth.json").write_text(json.dumps({"is": options.dentition, "teeth": teeth}))


def truths(dentition: Dentition, labels: Path) -> list[int]:
    """The number of most of each crown's pixels; 0: of none."""
    picture = cv2.imread(str(labels), cv2.IMREAD_GRAYSCALE)
    picture = cv2.resize(picture, dentition.size, interpolation=cv2.INTER_NEAREST)
    result = []
    for crown in dentition.all_crowns:
        counts = np.bincount(picture[filled((crown,), dentition.size)], minlength=1)
        best = int(np.argmax(counts)) if counts.sum() else 0
        result.append(best if counts[best] > counts.sum() / 2 else 0)
    return result


def counted(teeth: Teeth, placed: set[str], labels: Path) -> dict[str, int]:
    """Right numbers, crowns with a true one, numbers listed wrongly and lacking."""
    right = crowns = 0
    listed: set[int] = set()
    true: set[int] = set()
    for dentition in teeth.chosen:
        if dentition.name not in placed:
            continue
        wanted = truths(dentition, labels / f"{dentition.name}.png")
        for crown, number in zip(dentition.all_crowns, wanted, strict=True):
            listed |= {crown.number} - {0}
            true |= {number} - {0}
            crowns += number > 0
            right += crown.number == number > 0
    return {
        "right": right, "crowns": crowns,
        "wrong": len(listed - true), "lacking": len(true - listed),
    }  # fmt: skip


def scored(folder: Path) -> dict[str, Any]:
    """One film, placed: the counts before and after; empty where it is not placed."""
    workspace = folder / "run"
    command = [
        sys.executable, "-m", "dentalsplat", "run", str(folder / "photos"), "-w", str(workspace),
        "--stages", "views,teeth,init", "--set", f"views.long_side={WIDTH}",
    ]  # fmt: skip
    if subprocess.run(command, capture_output=True, check=False).returncode:
        return {}
    store = Store(workspace)
    read, init = store.current("teeth"), store.current("init")
    assert read is not None and init is not None
    placed = {camera.name for camera in store.load(init, "cameras").cameras}
    return {
        stage: counted(store.load(result, "teeth"), placed, folder / "labels")
        for stage, result in (("teeth", read), ("init", init))
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", default="300,301,302,303", help="of the mouths")
    parser.add_argument("--folder", type=Path, default=Path("runs/films"))
    chosen = parser.parse_args()
    sums: dict[str, dict[str, int]] = {}
    for seed in map(int, chosen.seeds.split(",")):
        folder = chosen.folder / f"{seed}"
        make_film(folder, seed)
        figures = scored(folder)
        print(seed, json.loads((folder / "mouth.json").read_text())["is"], figures, flush=True)
        for stage, counts in figures.items():
            total = sums.setdefault(stage, dict.fromkeys(counts, 0))
            for name, value in counts.items():
                total[name] += value
    for stage, counts in sums.items():
        print(f"{stage}: {counts}, {counts['right'] / counts['crowns']:.4f} right")


if __name__ == "__main__":
    main()
