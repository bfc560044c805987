"""A made-up patient's landmarks, and what cameras see of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.artifacts.dental.fdi import JAWS
from pipeline.artifacts.teeth import Crown, Dentition
from stages.init.dental.cameras.bundle import nominal_rotation
from stages.init.dental.numbering.arch import ArchOptions, fit_arch
from stages.init.dental.numbering.sightings import upright
from stages.init.dental.template import (
    EMBRASURE,
    PAPILLA,
    TIP,
    ZENITH,
    landmark_index,
    landmark_names,
    tooth_at,
)
from tests.stages.mouth_case import arch_of, looks_like

WIDTH, HEIGHT = 512, 384
CENTRE = np.array([0.0, 0.0, -16.0])


def patient(seed: int) -> np.ndarray:
    """[L, 3] landmarks of a generated mouth: another arch and other teeth than the textbook's."""
    marks = arch_of(seed, arch_power=2.5, arch_width=1.04, size=1.0)
    points = np.empty((len(landmark_names()), 3))
    for jaw in JAWS:
        for kind, name in ((ZENITH, "zenith"), (TIP, "tip")):
            for position in range(14):
                at = landmark_index(jaw, kind, position)
                points[at] = marks[name, tooth_at(jaw, position)]
        for kind, name in ((PAPILLA, "papilla"), (EMBRASURE, "embrasure")):
            for position in range(13):
                at = landmark_index(jaw, kind, position)
                points[at] = marks[name, tooth_at(jaw, position)]
    return points


def photograph(
    points: np.ndarray, yaw: float, roll: float = 0.0, seed: int = 0, focal: float = 950.0
) -> tuple[Dentition, np.ndarray, tuple[tuple[int, ...], tuple[int, ...]]]:
    """What a camera at a yaw sees of the crowns that face it; its pose; the true teeth."""
    rng = np.random.default_rng(seed)
    turn = np.array(
        [[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1.0]]
    )
    pose = np.eye(4)
    pose[:3, :3] = nominal_rotation(yaw, 6.0)
    pose[:3, 3] = np.array([0.0, 0.0, 118.0]) - pose[:3, :3] @ CENTRE
    pose[:3] = turn @ pose[:3]
    camera = points @ pose[:3, :3].T + pose[:3, 3]
    pixels = focal * camera[:, :2] / camera[:, 2:] + np.array([WIDTH / 2, HEIGHT / 2])
    pixels = pixels + rng.normal(scale=0.6, size=pixels.shape)
    flat = upright(pixels, roll, WIDTH, HEIGHT)
    rows: list[tuple[Crown, ...]] = []
    teeth: list[tuple[int, ...]] = []
    for jaw in JAWS:
        shown = []
        for position in range(14):
            left = landmark_index(jaw, PAPILLA, max(position - 1, 0))
            right = landmark_index(jaw, PAPILLA, min(position, 12))
            across = flat[right, 0] - flat[left, 0] if 0 < position < 13 else 20.0
            zenith = pixels[landmark_index(jaw, ZENITH, position)]
            inside = 8 < zenith[0] < WIDTH - 8 and 8 < zenith[1] < HEIGHT - 8
            if across > 9 and inside:
                shown.append(position)
        first = max((p for p in shown if p - 1 not in shown and p <= 7), default=shown[0])
        shown = [p for p in shown if p >= first]
        gap = next((p for p in range(first, 14) if p not in shown), 14)
        shown = list(range(first, gap))
        crowns = []
        for k, position in enumerate(shown):

            def at(kind: int, index: int, jaw: str = jaw) -> np.ndarray:
                return pixels[landmark_index(jaw, kind, index)]  # type: ignore[arg-type]

            at_left, at_right = k == 0, k == len(shown) - 1
            crowns.append(
                Crown(
                    jaw=jaw,
                    zenith=at(ZENITH, position),
                    tip=at(TIP, position),
                    papilla_left=None if at_left else at(PAPILLA, position - 1),
                    papilla_right=None if at_right else at(PAPILLA, position),
                    embrasure_left=None if at_left else at(EMBRASURE, position - 1),
                    embrasure_right=None if at_right else at(EMBRASURE, position),
                    width=50.0,
                    height=50.0,
                    cut_left=at_left,
                    cut_right=at_right,
                    numbers=looks_like(tooth_at(jaw, position), 0.6),
                )
            )
        rows.append(tuple(crowns))
        teeth.append(tuple(tooth_at(jaw, p) for p in shown))
    return (
        Dentition("", (WIDTH, HEIGHT), "other", rows[0], rows[1], roll, 90.0),
        pose,
        (teeth[0], teeth[1]),
    )


def fit(dentitions: list[Dentition | None], options: ArchOptions, **more: object):
    """`fit_arch` without photographs: landmarks alone."""
    count = len(dentitions)
    images = [np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)] * count
    valid = [np.ones((HEIGHT, WIDTH), bool)] * count
    focals = more.get("focals", [None] * count)
    return fit_arch(
        dentitions, images, valid, focals, replace(options, dense_rounds=0),
        int(more.get("threads", 1)), lambda *_: None,
    )  # fmt: skip


def rotation_errors(result, poses: list[np.ndarray]) -> list[float]:
    """Degrees between true and found relative rotations of neighbours."""
    errors = []
    found = [view.cam_from_world[:3, :3] for view in result.views]
    true = [pose[:3, :3] for pose in poses]
    for i in range(len(true) - 1):
        off = (found[i + 1] @ found[i].T) @ (true[i + 1] @ true[i].T).T
        errors.append(float(np.degrees(np.arccos(np.clip((np.trace(off) - 1) / 2, -1, 1)))))
    return errors


def three(yaws: tuple[float, ...] = (-42.0, 0.0, 42.0), rolls: tuple[float, ...] = (0, 0, 0)):
    points = patient(4)
    shots = [
        photograph(points, y, r, seed=i) for i, (y, r) in enumerate(zip(yaws, rolls, strict=True))
    ]
    return [s[0] for s in shots], [s[1] for s in shots], [s[2] for s in shots]
