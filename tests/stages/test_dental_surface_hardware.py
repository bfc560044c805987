"""Brackets before the crowns: told by their colour, and raised to where they stand."""

from __future__ import annotations

import dataclasses
import functools

import cv2
import numpy as np
import pytest

from stages.init.dental.surface.dense import ArchSurface, dense_surface
from stages.init.dental.surface.photos.tissue import find_hardware
from tests.stages.dental_arch_scene import FOCAL, HEIGHT, JAWS, WIDTH, camera, scene

#: How high the brackets' fronts stand before the crowns, and half their width and height (mm).
STAND, HALF = 2.2, (1.7, 1.4)
BLACK, STEEL = (0.13, 0.13, 0.14), (0.62, 0.63, 0.66)
YAWS = (-40.0, 0.0, 40.0)
UPPER = JAWS[0]


@dataclasses.dataclass(frozen=True)
class Painted:
    """Attributes:
    image: [H, W, 3] float32 the photograph with brackets.
    fronts: by tooth [H, W] bool of what shows the front of its bracket.
    boxes: [H, W] bool of all that shows brackets.
    depth: by tooth the z-depth of the middle of its bracket's front, mm.
    """

    image: np.ndarray
    fronts: dict[int, np.ndarray]
    boxes: np.ndarray
    depth: dict[int, float]


def with_brackets(image: np.ndarray, yaw: float, colour: tuple[float, ...]) -> Painted:
    """Boxes on the upper crowns that face a camera."""
    pose = camera(yaw)
    centre = -pose[:3, :3].T @ pose[:3, 3]

    def filled(points: np.ndarray) -> np.ndarray:
        local = points @ pose[:3, :3].T + pose[:3, 3]
        pixels = local[:, :2] / local[:, 2:] * FOCAL + (WIDTH / 2, HEIGHT / 2) - 0.5
        hull = cv2.convexHull(np.rint(pixels).astype(np.int32))
        return cv2.fillConvexPoly(np.zeros((HEIGHT, WIDTH), np.uint8), hull, 1) > 0

    fronts, depth = {}, {}
    boxes = np.zeros((HEIGHT, WIDTH), bool)
    for tooth, angle in UPPER.centres().items():
        base = UPPER.point(angle, 4.0)
        out, along = np.array([np.sin(angle), 0, np.cos(angle)]), np.array([np.cos(angle), 0, 0])
        along[2] = -np.sin(angle)
        if out @ (centre - base) < 0.3 * np.linalg.norm(centre - base):
            continue
        front = base + STAND * out
        corners = np.array(
            [front + x * HALF[0] * along + [0, y * HALF[1], 0] for x in (-1, 1) for y in (-1, 1)]
        )
        fronts[tooth] = filled(corners)
        boxes |= filled(np.concatenate([corners, corners - STAND * out]))
        depth[tooth] = float(pose[2, :3] @ front + pose[2, 3])
    return Painted(
        np.where(boxes[..., None], colour, image).astype(np.float32), fronts, boxes, depth
    )


@functools.cache
def plain():  # type: ignore[no-untyped-def]
    return scene(YAWS)


@functools.cache
def painted(colour: tuple[float, ...]) -> list[Painted]:
    return [with_brackets(i, yaw, colour) for i, yaw in zip(plain()[0], YAWS, strict=True)]


@functools.cache
def surface(colour: tuple[float, ...] | None) -> ArchSurface:
    images, valid, dentitions, fit, _ = plain()
    if colour is not None:
        images = [photo.image for photo in painted(colour)]
    return dense_surface(images, valid, dentitions, fit, threads=2)


@pytest.mark.parametrize("colour", [BLACK, STEEL], ids=["black", "steel"])
def test_brackets_are_told_by_their_colour(colour: tuple[float, ...]) -> None:
    tooth = plain()[4][1][2] == 2
    lab = cv2.cvtColor(painted(colour)[1].image, cv2.COLOR_RGB2Lab) * np.float32([2.55, 1, 1])
    score = find_hardware(lab, tooth, FOCAL / 145)
    boxes = painted(colour)[1].boxes & tooth
    inner = cv2.erode(boxes.astype(np.uint8), np.ones((3, 3))) > 0
    far = tooth & (cv2.dilate(boxes.astype(np.uint8), np.ones((5, 5))) == 0)
    assert score[inner].mean() > 0.8
    assert score[far].mean() < 0.05


@pytest.mark.parametrize("colour", [BLACK, STEEL], ids=["black", "steel"])
def test_brackets_stand_before_the_crowns(colour: tuple[float, ...]) -> None:
    frontal, photo = surface(colour).views[1], painted(colour)[1]
    for tooth in (12, 11, 21, 22):
        shown = cv2.erode(photo.fronts[tooth].astype(np.uint8), np.ones((5, 5))) > 0
        off = np.median(frontal.depth[shown]) - photo.depth[tooth]
        assert abs(off) < 1, (tooth, off)  # of 2.2; a bracket's flanks leave room for so much


def test_crowns_stay_where_they_are_beside_brackets() -> None:
    with_them, without = surface(BLACK).views[1].depth, surface(None).views[1].depth
    boxes = painted(BLACK)[1].boxes
    crowns = (plain()[4][1][2] == 2) & (cv2.dilate(boxes.astype(np.uint8), np.ones((9, 9))) == 0)
    crowns &= (with_them > 0) & (without > 0)
    assert np.median(np.abs(with_them - without)[crowns]) < 0.1


def test_flanks_of_brackets_are_not_laid_on_what_is_behind_them() -> None:
    """Beyond the canines the frontal photograph shows flanks, and those from the sides fronts."""
    photo = painted(BLACK)[1]
    first, last = (np.flatnonzero(photo.fronts[tooth].any(0)) for tooth in (13, 23))
    beyond = photo.boxes.copy()
    beyond[:, first.min() : last.max() + 1] = False
    assert (surface(None).views[1].depth[beyond] > 0).mean() > 0.25, "crowns behind them are shown"
    assert not surface(BLACK).views[1].depth[beyond].any()
    assert (surface(BLACK).views[1].depth[photo.fronts[11]] > 0).all()


def test_one_photograph_alone_raises_nothing() -> None:
    """Nothing tells how high it stands."""
    images, valid, dentitions, fit, _ = plain()
    alone = dataclasses.replace(fit, views=(None, fit.views[1], None))
    depths = [
        dense_surface(shown, valid, dentitions, alone, threads=2).views[1].depth
        for shown in (images, [photo.image for photo in painted(BLACK)])
    ]
    both = (depths[0] > 0) & (depths[1] > 0)
    assert np.abs(depths[0] - depths[1])[both].max() < 1e-3


def test_threads_change_nothing() -> None:
    images, valid, dentitions, fit, _ = plain()
    images = [photo.image for photo in painted(BLACK)]
    again = dense_surface(images, valid, dentitions, fit, threads=1)
    np.testing.assert_array_equal(again.views[1].depth, surface(BLACK).views[1].depth)
