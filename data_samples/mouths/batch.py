"""Write many photographs with their labels into a folder.

    python data_samples/mouths/__main__.py --count N --out FOLDER [--seed S] [--width 448]

Photograph k is `k.jpg`, with its labels (FDI numbers) in `k.png`; `index.json` says what
each shows.
The same seed gives the same bytes.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from .cameras import ROLES
from .mouth import Mouth, random_mouth
from .photo import Photograph, photograph

SHARES = (0.40, 0.22, 0.22, 0.08, 0.08)


def photographs(count: int, seed: int, width: int) -> Iterator[tuple[Mouth, Photograph]]:
    """Yield photographs, three or four of each mouth."""
    done, number = 0, 0
    while done < count:
        rng = np.random.default_rng([seed, number])
        mouth = random_mouth(rng)
        for _ in range(int(rng.integers(3, 5))):
            if done < count:
                role = str(rng.choice(ROLES, p=SHARES))
                shape = 0.75 if rng.random() < 0.5 else float(rng.uniform(0.56, 0.95))
                yield mouth, photograph(mouth, rng, role, width=width, height=round(width * shape))
                done += 1
        number += 1


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
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    index = {}
    for k, (mouth, photo) in enumerate(photographs(options.count, options.seed, options.width)):
        cv2.imwrite(
            str(options.out / f"{k}.jpg"), photo.image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 93]
        )
        cv2.imwrite(str(options.out / f"{k}.png"), photo.labels)
        index[str(k)] = describe(mouth, photo)
        if (k + 1) % 50 == 0 or k + 1 == options.count:  # what is there can be used already
            (options.out / "index.json").write_text(json.dumps(index, indent=1) + "\n")
