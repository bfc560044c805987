"""Write many photographs with their labels into a folder.

    python data_samples/mouths/__main__.py --count N --out FOLDER
        [--seed S] [--jobs J] [--patients WHOSE]

Photograph k is `k.jpg`, with its labels in `k.png` (FDI numbers; 1: gum; 0: anything else);
`index.json` says what each shows.
The same seed gives the same bytes, with any number of jobs.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from functools import partial
from itertools import chain, count, islice
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from .cameras import ROLES
from .mouth import Mouth, random_mouth
from .photo import Photograph, photograph

PATIENTS = ("anybody", "orthodontic", "children")
#: So many of the orthodontic patients wear braces.
BRACES = 0.7
#: Of the roles of `cameras.ROLES`.
SHARES = (0.40, 0.22, 0.22, 0.08, 0.08)
#: What gum is in the files of labels.
GUM = np.uint8(1)


def options_of(patients: str, rng: np.random.Generator) -> dict[str, Any]:
    """What is chosen of a mouth because of whose it is (one of `PATIENTS`); the rest is random.

    Orthodontic patients: most wear braces, and arches range from narrow to wide and from a parabola
    to a U.
    """
    if patients == "children":
        return {"dentition": str(rng.choice(["primary", "mixed"]))}
    if patients == "orthodontic":
        braces = rng.random() < BRACES
        return {
            "dentition": "permanent",
            "arch_width": float(rng.normal(1.0, 0.08)),
            "arch_power": float(rng.uniform(2.0, 3.3)),
            "braces_upper": bool(braces),
            "braces_lower": bool(braces and rng.random() < 0.75),
        }
    return {}


def photographs_of(
    number: int, seed: int, width: int, patients: str = "anybody"
) -> list[tuple[Mouth, Photograph]]:
    """Three or four photographs of one mouth, of one of `PATIENTS`."""
    rng = np.random.default_rng([seed, number])
    mouth = random_mouth(rng, **options_of(patients, rng))
    result = []
    for _ in range(int(rng.integers(3, 5))):
        role = str(rng.choice(ROLES, p=SHARES))
        shape = 0.75 if rng.random() < 0.5 else float(rng.uniform(0.56, 0.95))
        photo = photograph(mouth, rng, role, width=width, height=round(width * shape))
        result.append((mouth, photo))
    return result


def photographs(
    wanted: int, seed: int, width: int, jobs: int = 1, patients: str = "anybody"
) -> Iterator[tuple[Mouth, Photograph]]:
    """Yield so many photographs, made by so many processes."""
    made = partial(photographs_of, seed=seed, width=width, patients=patients)
    if jobs < 2:
        yield from islice(chain.from_iterable(map(made, count())), wanted)
        return
    with get_context("spawn").Pool(jobs, cv2.setNumThreads, (1,)) as pool:
        # At least three of each mouth; what is too much ends with the pool.
        mouths = pool.imap(made, range(-(-wanted // 3)))
        yield from islice(chain.from_iterable(mouths), wanted)


def describe(mouth: Mouth, photo: Photograph) -> dict[str, Any]:
    """The entry of `index.json`."""
    camera = photo.camera
    return {
        "view": photo.view,
        "bite": photo.bite,
        "primary": mouth.options.dentition == "primary",
        "dentition": mouth.options.dentition,
        "braces": mouth.options.braces_upper or mouth.options.braces_lower,
        "mouth": mouth.options.seed,
        "opening_mm": round(photo.opening, 3),
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "cam_from_world": camera.cam_from_world.tolist(),
        "teeth": sorted(int(n) for n in np.unique(photo.labels) if n),
    }


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--width", type=int, default=448, help="of the pictures, pixels")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--patients", choices=PATIENTS, default=PATIENTS[0], help="whose mouths")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    index = {}
    made = photographs(options.count, options.seed, options.width, options.jobs, options.patients)
    for k, (mouth, photo) in enumerate(made):
        cv2.imwrite(
            str(options.out / f"{k}.jpg"), photo.image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 93]
        )
        labels = np.where(photo.gum & (photo.labels == 0), GUM, photo.labels)
        cv2.imwrite(str(options.out / f"{k}.png"), labels)
        index[str(k)] = describe(mouth, photo)
        if (k + 1) % 50 == 0 or k + 1 == options.count:  # what is there can be used already
            (options.out / "index.json").write_text(json.dumps(index, indent=1) + "\n")
