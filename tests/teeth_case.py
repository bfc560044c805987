"""Photographs of a row of boxes for teeth, with their numbers: what a run hands to `check.html`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.artifacts.dental.fdi import Jaw, is_upper
from pipeline.artifacts.teeth import Dentition, Teeth
from pipeline.artifacts.views import View, Views
from stages.dentition.crowns import Outline, dentition_of

#: Pixels of the working image, and how many of the original one of them is.
WIDTH, HEIGHT, SCALE = 300, 200, 4
SIDE = 30
UPPER, LOWER = (13, 12, 11, 21, 22, 23), (43, 42, 41, 31, 32, 33)
NAMES = ("0_right.jpg", "1_front.jpg", "2_<left>.jpg")


def middle(place: int, jaw: Jaw) -> tuple[float, float]:
    """The middle of a box in the working image."""
    return 60 + SIDE * (place + 0.5), 80.0 if jaw == "upper" else 122.0


def original(place: int, jaw: Jaw) -> tuple[float, float]:
    """The same in the original photograph."""
    x, y = middle(place, jaw)
    return SCALE * x, SCALE * y


def box(place: int, jaw: Jaw, number: int, doubt: float = 0.05) -> Outline:
    x, y = middle(place, jaw)
    across, along = SIDE / 2 - 1, 18.0
    corners = [(-across, -along), (across, -along), (across, along), (-across, along)]
    polygon = np.array([(x + dx, y + dy) for dx, dy in corners])
    return Outline(polygon, jaw, 0.9, {number: 0.7, number % 10 + 50: 0.2}, number, doubt)


def dentition(
    name: str, kind: str = "front", upper: Sequence[int] = UPPER, lower: Sequence[int] = LOWER
) -> Dentition:
    outlines = [box(k, "upper", number) for k, number in enumerate(upper)]
    outlines += [box(k, "lower", number) for k, number in enumerate(lower)]
    assert all(is_upper(number) for number in upper if number)
    return dentition_of(outlines, name, (WIDTH, HEIGHT), kind, roll=0.0)


def views(names: Sequence[str] = NAMES, corner: tuple[int, int] = (0, 0)) -> Views:
    """The photographs; with a corner (x, y), each is cut out of a larger picture there."""
    cut = np.array([[1.0, 0, -corner[0]], [0, 1, -corner[1]], [0, 0, 1]])
    size = SCALE * WIDTH + 2 * corner[0], SCALE * HEIGHT + 2 * corner[1]
    shade = np.linspace(0.2, 0.8, WIDTH, dtype=np.float32)
    image = np.broadcast_to(shade[None, :, None], (HEIGHT, WIDTH, 3)).copy()
    return Views(
        tuple(
            View(f"{k:03d}", image, working_from_source=np.diag([1 / SCALE, 1 / SCALE, 1.0]) @ cut,
                 source_size=size, source_name=name, source_sha256=f"{k}" * 64)
            for k, name in enumerate(names)
        )
    )  # fmt: skip


def teeth(set_aside: str = "") -> Teeth:
    """Three photographs; the last is set aside for the reason given."""
    made = [dentition(f"{k:03d}", kind) for k, kind in enumerate(("right", "front", "left"))]
    return Teeth((*made[:2], replace(made[2], set_aside=set_aside)))


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path
