"""Two visits of one patient: some teeth have moved in between, by amounts that are known.

    python -m data_samples.mouths.visits --out FOLDER --seed 5 --views 12 [--moved 4] [--width 512]

FOLDER/a and FOLDER/b get the photographs of the two visits (`000.jpg`, ...), FOLDER/truth.json the
exact cameras of both and what each tooth did. With `--moved 0` nothing moves: only cameras, light
and noise differ.

Crowns, gums' texture and colours are the same in both visits; the gum grows anew around the teeth
where they stand.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from .cameras import Camera, look, role_at
from .mouth import Mouth, build_mouth
from .moves import Move, axes_of, motion_of
from .options import random_options
from .photo import Photograph, photograph


def random_moves(numbers: list[int], count: int, rng: np.random.Generator) -> dict[int, Move]:
    """Moves of so many teeth, such as some months of treatment make: up to 1.5 mm and 8 degrees.

    Teeth are chosen among the second premolars and what lies before them.
    """
    front = [n for n in numbers if n % 10 <= 5]
    chosen = rng.choice(front, size=min(count, len(front)), replace=False)
    moves = {}
    for number in sorted(int(n) for n in chosen):
        mesial, buccal, extrusion = rng.uniform(-1, 1, 3) * (0.5, 1.2, 0.8)
        tip, torque, rotation = rng.uniform(-1, 1, 3) * (5.0, 6.0, 8.0)
        values = (mesial, buccal, extrusion, tip, torque, rotation)
        moves[number] = Move(*(round(float(v), 3) for v in values))
    return moves


def write_visits(
    out: Path, seed: int, views: int, moved: int, width: int = 512, reach: float = 50.0,
    plain: bool = False, **overrides: Any,
) -> None:  # fmt: skip
    """Write both visits' photographs and the truth.

    Args:
        out: folder.
        seed: of the mouth, of what moves, and of the photographs.
        views: photographs of each visit, from one side to the other.
        moved: how many teeth move.
        width: of the pictures, pixels.
        reach: degrees from the middle to the first and last photograph.
        plain: without lips, hands, noise (see `photograph`).
        overrides: options of the mouth (`MouthOptions`).
    """
    rng = np.random.default_rng([seed, 7])
    options = random_options(rng, **overrides)
    first = build_mouth(options)
    moves = random_moves(sorted(t.plan.fdi for t in first.teeth), moved, rng)
    truth: dict[str, Any] = {"seed": seed, "units": "mm", "moves": {}, "motions": {}, "visits": {}}
    for row in first.rows:
        for tooth in row.teeth:
            move = moves.get(tooth.plan.fdi)
            if move is not None:
                truth["moves"][str(tooth.plan.fdi)] = asdict(move)
                motion = motion_of(row.arch, tooth, move)
                truth["motions"][str(tooth.plan.fdi)] = motion.tolist()
    truth["axes"] = {
        str(t.plan.fdi): axes_of(row.arch, t).tolist() for row in first.rows for t in row.teeth
    }
    for number, name in enumerate("ab"):
        mouth = first if name == "a" or not moves else build_mouth(options, moves)
        rng = np.random.default_rng([seed, 8, number])
        folder = out / name
        folder.mkdir(parents=True, exist_ok=True)
        cameras = {}
        for k, photo in enumerate(sweep(mouth, rng, views, width, (reach, reach), plain)):
            camera = photo.camera
            quality = [cv2.IMWRITE_JPEG_QUALITY, 95]
            cv2.imwrite(str(folder / f"{k:03d}.jpg"), photo.image[..., ::-1], quality)
            cameras[f"{k:03d}"] = {
                "width": camera.width, "height": camera.height, "fx": camera.fx, "fy": camera.fy,
                "cx": camera.cx, "cy": camera.cy, "cam_from_world": camera.cam_from_world.tolist(),
            }  # fmt: skip
        truth["visits"][name] = cameras
        centres = {str(n): c.round(4).tolist() for n, c in mouth.tooth_centres().items()}
        truth[f"centres_{name}"] = centres
    (out / "truth.json").write_text(json.dumps(truth, indent=1) + "\n")


def sweep(
    mouth: Mouth, rng: np.random.Generator, views: int, width: int, reach: tuple[float, float],
    plain: bool = False,
) -> Iterator[Photograph]:  # fmt: skip
    """Photographs of a closed mouth from its right to its left, by a camera held by hand.

    Args:
        views: how many.
        width: of the pictures, pixels.
        reach: degrees from the middle to the first and last, at least and at most.
        plain: as in `write_visits`.
    """
    distance, side = float(rng.uniform(115, 150)), float(rng.uniform(1.75, 2.0))
    end = float(rng.uniform(*reach)) if reach[0] < reach[1] else reach[0]
    for yaw in np.linspace(-end, end, views):
        camera = _camera(mouth, yaw, distance, side * distance / 125, width, rng)
        yield photograph(
            mouth, rng, role_at(float(yaw)), width=camera.width, height=camera.height,
            bite="closed", camera=camera, plain=plain,
        )  # fmt: skip


def _camera(
    mouth: Mouth, yaw: float, distance: float, side: float, width: int, rng: np.random.Generator
) -> Camera:
    """A camera that looks at the front teeth, held by hand: a little off everywhere."""
    pivot = mouth.pivot + rng.normal(size=3) * 0.8
    roll, elevation = float(rng.normal() * 2.5), 4.0 + float(rng.normal() * 2.0)
    view = look(yaw + float(rng.normal() * 1.5), elevation, roll, distance, pivot)
    height, focal = width * 3 // 4, side * width
    return Camera(width, height, focal, focal, width / 2, height / 2, view)


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--moved", type=int, default=4, help="teeth that move")
    parser.add_argument("--width", type=int, default=512, help="of the pictures, pixels")
    parser.add_argument("--plain", action="store_true", help="no lips, hands, noise")
    parser.add_argument("--calm", action="store_true", help="an adult's tidy mouth")
    chosen = parser.parse_args(arguments)
    calm = CALM if chosen.calm else {}
    write_visits(
        chosen.out, chosen.seed, chosen.views, chosen.moved, chosen.width, plain=chosen.plain,
        **calm,
    )  # fmt: skip


#: An adult without the generator's rarities, as patients in treatment mostly are.
CALM: dict[str, Any] = {
    "dentition": "permanent", "missing": (18, 28, 38, 48), "bite": "normal", "cross": (0.0, 0.0),
    "braces_upper": False, "braces_lower": False, "conditions": (),
}  # fmt: skip

if __name__ == "__main__":
    main()
