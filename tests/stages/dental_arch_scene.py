"""A small made-up dentition with exact depth: crowns on two arches, seen by three cameras.

Surfaces are functions of the angle about a vertical axis and of the height, as real crowns nearly
are; rays are intersected by marching. Nothing here uses the code under test.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import cv2
import numpy as np

from pipeline.artifacts.dental.fdi import Jaw, teeth_of
from pipeline.artifacts.teeth import Crown, Dentition
from stages.init.dental.landmarks import Landmark
from stages.init.dental.solution import ArchFit, PlacedView

#: The arches curve around (0, y, -AXIS). It is no anatomy that the code assumes: a narrower arch
#: (its charts lie around 26), flatter crowns (2.6) and a camera further away (125 mm).
AXIS = 24.0
BULGE = 2.1
WIDTH, HEIGHT = 200, 120
FOCAL = 495.0
DISTANCE = 145.0
TEETH = {"upper": teeth_of("upper")[3:11], "lower": teeth_of("lower")[3:11]}
CROWN_ANGLE = 0.29  # radians per crown: 7 mm on a radius of 24
CROWN_HEIGHT = 8.0
GUM = np.array([0.72, 0.36, 0.36])
GLOVE = np.array([0.93, 0.88, 0.84])


@dataclass(frozen=True)
class JawModel:
    """Radius and kind of surface at (angle, height)."""

    jaw: Jaw
    radius: float
    edge: float  # y of the biting edges

    @property
    def up(self) -> float:
        return 1.0 if self.jaw == "upper" else -1.0

    def centres(self) -> dict[int, float]:
        """Angle of each tooth's middle; positive to the patient's left."""
        count = len(TEETH[self.jaw])
        return {t: (k - (count - 1) / 2) * CROWN_ANGLE for k, t in enumerate(TEETH[self.jaw])}

    def surface(self, angle: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Radius, and 0 for nothing, 1 for gum, 2 for tooth."""
        across = np.mod(angle / CROWN_ANGLE + len(TEETH[self.jaw]) / 2, 1.0) * 2 - 1
        along = self.up * (y - self.edge)  # mm from the biting edge
        arched = CROWN_HEIGHT - 1.8 * across**2
        bump = 1.2 * (1 - np.abs(across) ** BULGE) * np.clip(1.3 - 0.05 * (along - 5) ** 2, 0, 1)
        radius = self.radius + np.where(along < arched, bump, 0.4 * (1 - np.abs(across) ** BULGE))
        inside = np.abs(angle) < CROWN_ANGLE * len(TEETH[self.jaw]) / 2
        kind = np.where(along < arched, 2, 1)
        return radius, np.where((along > 0) & inside, kind, 0)

    def point(self, angle: float, along: float) -> np.ndarray:
        y = self.edge + self.up * along
        radius, _ = self.surface(np.array(angle), np.array(y))
        return np.array([radius * np.sin(angle), y, radius * np.cos(angle) - AXIS])

    def landmarks(self) -> dict[Landmark, np.ndarray]:
        marks = {}
        centres = self.centres()
        teeth = list(centres)
        for k, tooth in enumerate(teeth):
            marks[Landmark("zenith", tooth)] = self.point(centres[tooth], CROWN_HEIGHT)
            marks[Landmark("tip", tooth)] = self.point(centres[tooth], 0.05)
            if k + 1 < len(teeth):
                angle = (centres[tooth] + centres[teeth[k + 1]]) / 2
                pair = (tooth, teeth[k + 1])
                marks[Landmark("papilla", *pair)] = self.point(angle, CROWN_HEIGHT - 1.8)
                marks[Landmark("embrasure", *pair)] = self.point(angle, 0.3)
        return marks


JAWS = (JawModel("upper", 24.0, 0.0), JawModel("lower", 21.5, 1.0))


def texture(points: np.ndarray) -> np.ndarray:
    """Smooth random grey [...] around 0 with detail down to about 1 mm."""
    rng = np.random.default_rng(5)
    waves = rng.normal(size=(60, 3)) * rng.uniform(0.6, 3.0, size=(60, 1))
    return np.sin(points @ waves.T + rng.uniform(0, 6, 60)).sum(-1) / np.sqrt(60)


def camera(yaw: float) -> np.ndarray:
    a = np.radians(yaw)
    toward = np.array([np.sin(a), 0.03, np.cos(a)])
    toward /= np.linalg.norm(toward)
    right = np.cross([0, 1, 0], toward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(right, toward), -toward])
    pose[:3, 3] = -pose[:3, :3] @ (np.array([0, 0.5, -8]) + DISTANCE * toward)
    return pose


def render(pose: np.ndarray, glove: bool, exposure: float):  # type: ignore[no-untyped-def]
    """Image, exact z-depth, jaw (0 none, 1 upper, 2 lower) and kind of each pixel."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    ray = np.stack([(x - WIDTH / 2) / FOCAL, (y - HEIGHT / 2) / FOCAL, np.ones_like(x)], -1)
    ray = ray @ pose[:3, :3]
    centre = -pose[:3, :3].T @ pose[:3, 3]
    depth = np.full((HEIGHT, WIDTH), np.inf)
    jaw_of = np.zeros((HEIGHT, WIDTH), int)
    kind_of = np.zeros((HEIGHT, WIDTH), int)
    steps = np.arange(DISTANCE - 24, DISTANCE + 10, 0.5)

    def gap(model: JawModel, z: np.ndarray):  # type: ignore[no-untyped-def]
        p = centre + z[..., None] * ray
        radius, kind = model.surface(np.arctan2(p[..., 0], p[..., 2] + AXIS), p[..., 1])
        return np.hypot(p[..., 0], p[..., 2] + AXIS) - radius, kind

    for number, model in enumerate(JAWS, 1):
        before, _ = gap(model, np.full((HEIGHT, WIDTH), steps[0]))
        found = np.zeros((HEIGHT, WIDTH), bool)
        for near, far in itertools.pairwise(steps):
            after, _ = gap(model, np.full((HEIGHT, WIDTH), far))
            crossing = (before > 0) & (after <= 0) & ~found
            if not crossing.any():
                before = after
                continue
            z = near + (far - near) * before / np.where(before > after, before - after, 1)
            z, kind = np.clip(z, near, far), gap(model, np.clip(z, near, far))[1]
            hit = (before > 0) & (after <= 0) & (kind > 0) & ~found
            nearer = hit & (z < depth)
            depth[nearer], jaw_of[nearer], kind_of[nearer] = z[nearer], number, kind[nearer]
            found |= hit
            before = after
    points = centre + np.where(np.isfinite(depth), depth, 0)[..., None] * ray
    grey = 0.05 * texture(points)[..., None]
    tooth = np.array([0.80, 0.76, 0.62])
    image = np.where((kind_of == 2)[..., None], tooth, GUM) + grey
    image = np.where((kind_of == 0)[..., None], [0.10, 0.04, 0.04], image) * exposure
    depth = np.where(np.isfinite(depth), depth, 0)
    if glove:  # a finger over the gum of the upper jaw
        finger = (y < HEIGHT / 2 - 32) & (kind_of != 2)
        image = np.where(finger[..., None], GLOVE, image)
        kind_of = np.where(finger, 3, kind_of)
    return np.clip(image, 0, 1).astype(np.float32), depth.astype(np.float32), jaw_of, kind_of


def outline(mask: np.ndarray) -> np.ndarray:
    """[K, 2] polygon around what a mask shows, piece by piece."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return np.concatenate([c[:, 0] + 0.5 for c in contours])


def pieces(mask: np.ndarray) -> tuple[np.ndarray, ...]:
    """[K, 2] polygons around what a mask shows, and around its holes."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    return tuple(contour[:, 0] + 0.5 for contour in contours)


def scene(yaws=(-40.0, 0.0, 40.0), missing=None, exposures=(0.9, 1.0, 1.0)):  # type: ignore[no-untyped-def]
    """Images, valid masks, dentitions, fit; and exact depth, jaw and kind maps.

    `missing`: a tooth that no photograph names (its crown is there all the same).
    """
    shape: dict[Landmark, np.ndarray] = {}
    for model in JAWS:
        shape |= model.landmarks()
    images, dentitions, placed, truth = [], [], [], []
    roles = {-40.0: "right", 0.0: "frontal", 40.0: "left"}
    for yaw, exposure in zip(yaws, exposures, strict=True):
        pose = camera(yaw)
        image, depth, jaw, kind = render(pose, glove=yaw < 0, exposure=exposure)
        images.append(image)
        truth.append((depth, jaw, kind))
        crowns, names = {}, {}
        for number, model in enumerate(JAWS, 1):
            kept = [t for t in TEETH[model.jaw] if t != missing]
            facing = [t for t in kept if abs(np.degrees(model.centres()[t]) - yaw) < 75]
            # All the jaw's enamel is outlined in one piece, and all crowns have the same landmarks.
            around = outline((kind == 2) & (jaw == number))
            ends = [np.array([WIDTH / 2, edge(around[:, 1])]) for edge in (np.min, np.max)]
            zenith, tip = ends if model.jaw == "upper" else ends[::-1]
            crown = Crown(model.jaw, zenith, tip, None, None, None, None, 15.0, 22.0)
            whole = replace(crown, outline=around)
            crowns[model.jaw] = (whole, *(crown,) * (len(facing) - 1))
            names[model.jaw] = tuple(facing)
        size = (WIDTH, HEIGHT)
        rows = crowns["upper"], crowns["lower"]
        on_jaws = pieces((kind == 1) | (kind == 2))
        dentitions.append(Dentition("", size, "other", *rows, 0.0, 50.0, on_jaws=on_jaws))
        placed.append(
            PlacedView(pose, FOCAL, roles.get(yaw, "between"), names["upper"], names["lower"], 0.5)
        )
    fit = ArchFit(tuple(placed), dict(shape), shape, 50.0)
    valid = [np.ones((HEIGHT, WIDTH), bool) for _ in images]
    return images, valid, dentitions, fit, truth
