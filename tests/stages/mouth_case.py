"""Photographs of generated mouths with exact outlines, numbers and cameras, as the reader would
hand them over. The mouths come from `data_samples/mouths`, which knows nothing of the code under
test: teeth of their own sizes, out of line, on arches of their own shapes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import pytest

from data_samples.mouths import Mouth, Photograph, photograph, random_mouth
from data_samples.mouths.cameras import Camera, look, role_at
from pipeline.artifacts.dental.fdi import (
    JAWS,
    is_left,
    is_primary,
    is_upper,
    permanent_of,
    primary_of,
)
from pipeline.artifacts.teeth import Dentition
from pipeline.artifacts.views import View, Views
from pipeline.geometry.rigid import angle_between
from stages.dentition.crowns import Outline, dentition_of, outline_of, with_outlines
from stages.dentition.far_side import far_side
from stages.teeth.read import numbered
from tests.stages.dental_arch_scene import pieces

WIDTH, HEIGHT = 512, 384
#: A wrong number is none if this much doubt is said beside it.
DOUBTED = 0.05
#: A textbook mouth where nothing else is said: nobody's, but without the generator's rarities.
CALM = {
    "dentition": "permanent", "missing": (18, 28, 38, 48), "bite": "normal", "overbite": 2.2,
    "overjet": 2.5, "cross": (0.0, 0.0), "crowding": 0.02, "twist": 5.0, "shift": 0.3,
    "tilt": 2.0, "diastema": 0.0, "midline": 0.4, "recession": 0.0, "papilla": 1.0,
    "braces_upper": False, "braces_lower": False, "conditions": (),
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """Photographs of one mouth, in the order of the yaws asked for."""

    photos: tuple[Photograph, ...]

    @property
    def views(self) -> Views:
        return Views(
            tuple(
                View(
                    f"{k:03d}",
                    photo.image.astype(np.float32) / np.float32(255),
                    source_name=f"photo{k}.jpg",
                    source_size=(photo.image.shape[1], photo.image.shape[0]),
                )
                for k, photo in enumerate(self.photos)
            )
        )

    def dentitions(self, **looks: Any) -> list[Dentition]:
        """Exact outlines of every photograph, put in order as the reader's are."""
        return [
            replace(
                _near_side(
                    dentition_of(
                        outlines_of(photo.labels, **looks),
                        f"{k:03d}",
                        (photo.image.shape[1], photo.image.shape[0]),
                        photo.view,
                    )
                ),
                on_jaws=pieces(photo.gum | (photo.labels > 0)),
            )
            for k, photo in enumerate(self.photos)
        ]

    @property
    def rotations(self) -> list[np.ndarray]:
        return [photo.cam_from_world[:3, :3] for photo in self.photos]


def _near_side(dentition: Dentition) -> Dentition:
    """Without what is seen across the mouth, which the reader leaves out as well."""
    numbers = numbered(dentition)
    kept = [
        outline_of(crown)
        for jaw in JAWS
        for crown, far in zip(dentition.crowns(jaw), far_side(numbers, jaw), strict=True)
        if not far
    ]
    return with_outlines(dentition, kept)


@contextmanager
def in_the_dark() -> Iterator[None]:
    """Photographs show nothing, and take a tenth of the time; their labels are the same."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "data_samples.mouths.photo.look_along",
            lambda stage, hit, light, eye: np.full((len(hit["t_hit"]), 3), -1.0),
        )
        patch.setattr(
            "data_samples.mouths.mouth.sky_share", lambda _, vertices, *more: np.ones(len(vertices))
        )
        yield


def mouth_case(
    seed: int,
    yaws: Sequence[float] = (-42.0, 3.0, 40.0),
    rolls: Sequence[float] = (4.0, -2.0, -5.0),
    distance: float = 125.0,
    side: float = 1.9,
    plain: bool = True,
    calm: bool = True,
    dark: bool = False,
    **options: Any,
) -> Case:
    """Photographs of a mouth at some yaws (degrees, from the patient's left positive).

    Args:
        side: focal length over the long side of the picture.
        plain: without lips, hands, noise.
        calm: without what is not asked for (`CALM`); else all at random.
        dark: for who looks at labels and cameras only (`in_the_dark`).
        options: of the mouth (`MouthOptions`).
    """
    rng = np.random.default_rng(seed)
    mouth = random_mouth(rng, **({**CALM, **options} if calm else options))
    photos = []
    for yaw, roll in zip(yaws, rolls, strict=True):
        role = role_at(yaw)
        focal = side * WIDTH
        view = look(yaw, 4.0, roll, distance, mouth.pivot)
        camera = Camera(WIDTH, HEIGHT, focal, focal, WIDTH / 2, HEIGHT / 2, view)
        with in_the_dark() if dark else nullcontext():
            photos.append(
                photograph(
                    mouth, rng, role, width=WIDTH, height=HEIGHT, bite="closed", camera=camera,
                    plain=plain,
                )
            )  # fmt: skip
    return Case(tuple(photos))


def outlines_of(
    labels: np.ndarray, least: float = 0.12, sure: float = 0.6, tell: bool = True
) -> list[Outline]:
    """The outlines of the crowns in a picture of FDI numbers, largest piece each.

    Args:
        labels: [H, W] FDI number of each pixel, 0: no tooth.
        least: crowns of less than this share of the median area are left out, as slivers are.
        sure: probability that looks give to the right place in the quadrant (see `looks_like`).
        tell: with looks; else every number is as likely.
    """
    found: dict[int, np.ndarray] = {}
    for number in (int(n) for n in np.unique(labels) if n):
        if number % 10 == 8:
            continue
        contours, _ = cv2.findContours(
            (labels == number).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
        )
        found[number] = max(contours, key=cv2.contourArea)[:, 0] + 0.5
    areas = {number: cv2.contourArea(c.astype(np.float32)) for number, c in found.items()}
    typical = float(np.median(list(areas.values())))
    return [
        Outline(
            found[number].astype(np.float64),
            "upper" if is_upper(number) else "lower",
            0.9,
            looks_like(number, sure) if tell else {},
        )
        for number in found
        if areas[number] > max(least * typical, 12)
    ]


def looks_like(number: int, sure: float) -> dict[int, float]:
    """What a fair reader says of a crown: the places beside the right one are likely too, the other
    side of the mouth is not excluded, and a primary tooth looks permanent, too, but far less than a
    permanent one: median odds of being primary are .25 to .01 in four real children, 2e-4 and less
    in eight adults."""
    place = permanent_of(number) % 10
    beside = [p for p in (place - 1, place + 1) if 1 <= p <= 7]
    shares = {place: sure} | {p: (1 - sure) / len(beside) for p in beside}
    upper, left = is_upper(number), is_left(number)
    result = {}
    for p, share in shares.items():
        for side, here in ((left, 0.85), (not left, 0.15)):
            quadrant = (2 if side else 1) if upper else (3 if side else 4)
            tooth = 10 * quadrant + p
            milk = 0.2 if is_primary(number) else 1e-4
            if p <= 5:
                result[primary_of(tooth)] = share * here * milk
                result[tooth] = share * here * (1 - milk)
            else:
                result[tooth] = share * here
    return result


def true_numbers(photo: Photograph, dentition: Dentition) -> dict[str, tuple[int, ...]]:
    """The numbers of the crowns of each row by the label map, 0 where a crown is none."""
    rows = {}
    for jaw in ("upper", "lower"):
        numbers = []
        for crown in dentition.crowns(jaw):  # type: ignore[arg-type]
            mask = np.zeros(photo.labels.shape, np.uint8)
            cv2.fillPoly(mask, [np.round(crown.outline - 0.5).astype(np.int32)], 1)
            values, counts = np.unique(photo.labels[mask > 0], return_counts=True)
            best = int(np.argmax(counts)) if len(counts) else 0
            numbers.append(
                int(values[best]) if len(counts) and counts[best] > 0.5 * mask.sum() else 0
            )
        rows[jaw] = tuple(numbers)
    return rows


def relative_errors(found: Sequence[np.ndarray], true: Sequence[np.ndarray]) -> list[float]:
    """Degrees between found and true relative rotations of all pairs."""
    return [
        angle_between(found[j] @ found[i].T, true[j] @ true[i].T)
        for i in range(len(true))
        for j in range(i + 1, len(true))
    ]


def arch_of(seed: int, **options: Any) -> dict[tuple[str, int], np.ndarray]:
    """(kind, FDI number) -> [3] mm: the landmarks of a generated mouth, as `Landmark` has them.

    A papilla or embrasure is named by the tooth nearer the patient's right.
    """
    rng = np.random.default_rng(seed)
    return landmarks_of(random_mouth(rng, **{**CALM, **options}))


def landmarks_of(mouth: Mouth) -> dict[tuple[str, int], np.ndarray]:
    """The landmarks of a mouth by its crowns' own frames: x to the distal side, y from the tip."""
    marks: dict[tuple[str, int], np.ndarray] = {}

    def nearest(tooth: Any, x: float, y: float) -> np.ndarray:
        outside = tooth.local[:, 2] >= np.median(tooth.local[:, 2])
        off = np.hypot(tooth.local[:, 0] - x, tooth.local[:, 1] - y) + 100 * ~outside
        return np.asarray(tooth.vertices[int(np.argmin(off))])

    for row in mouth.rows:
        for tooth in row.teeth:
            height = tooth.plan.height
            marks["zenith", tooth.plan.fdi] = nearest(tooth, 0.0, 0.92 * height)
            marks["tip", tooth.plan.fdi] = nearest(tooth, 0.0, 0.0)
        for right, left in pairwise(row.teeth):
            for name, share in (("papilla", 0.62), ("embrasure", 0.12)):
                sides = [
                    nearest(
                        tooth, tooth.side * toward * tooth.plan.width, share * tooth.plan.height
                    )
                    for tooth, toward in ((right, 0.5), (left, -0.5))
                ]
                marks[name, right.plan.fdi] = (sides[0] + sides[1]) / 2
    return marks


def wrong_numbers(photographed: Case, numbered: list[Dentition]) -> tuple[list[str], float]:
    """What has a wrong number without a doubt, and the share of the crowns named right."""
    wrong, right, total = [], 0, 0
    for photo, dentition in zip(photographed.photos, numbered, strict=True):
        truth = true_numbers(photo, dentition)
        for jaw in JAWS:
            for crown, true in zip(dentition.crowns(jaw), truth[jaw], strict=True):
                total += 1
                right += crown.number == true
                if crown.number not in (0, true) and crown.doubt < DOUBTED:
                    wrong.append(f"{dentition.kind}: {true} was named {crown.number}")
    return wrong, right / total
