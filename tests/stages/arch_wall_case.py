"""Teeth on the wall of an upright cylinder, photographed from around it: all is known exactly."""

from dataclasses import replace

import numpy as np

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.dental.fdi import teeth_of
from pipeline.artifacts.teeth import Crown, Dentition
from pipeline.artifacts.views import View

RADIUS, DISTANCE = 25.0, 120.0
WIDTH, HEIGHT, FOCAL = 256, 160, 480.0
#: Angle from one tooth to the next, and of a crown's half; what a photograph shows of the wall.
PITCH, HALF, SHOWN = np.radians((12.0, 5.4, 50.0))
#: Heights of the rows: y is down.
ROWS = {"upper": (-9.0, -0.7), "lower": (0.7, 9.0)}


def camera_at(degrees: float, name: str) -> Camera:
    """A camera that looks at the axis from this side; 0: from the front, above: patient's left."""
    angle = np.radians(degrees)
    ahead = np.array([-np.sin(angle), 0.0, np.cos(angle)])
    right = np.array([np.cos(angle), 0.0, np.sin(angle)])
    rotation = np.stack([right, [0.0, 1.0, 0.0], ahead])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, rotation @ (DISTANCE * ahead)
    return Camera(name, WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, pose)


def depth_of(camera: Camera) -> np.ndarray:
    """[H, W] float32 z-depth of the wall, 0 beside it."""
    x = (np.arange(WIDTH) + 0.5 - camera.cx) / camera.fx
    # the camera stands at DISTANCE from the axis: (x z)^2 + (z - DISTANCE)^2 = RADIUS^2
    inside = DISTANCE**2 - (1 + x**2) * (DISTANCE**2 - RADIUS**2)
    z = np.where(inside > 0, (DISTANCE - np.sqrt(np.maximum(inside, 0))) / (1 + x**2), 0)
    return np.tile(z.astype(np.float32), (HEIGHT, 1))


def on_wall(angle: np.ndarray, y: np.ndarray) -> np.ndarray:
    """[N, 3] places at an angle around the axis (radians, 0: front) and a height."""
    return np.column_stack([RADIUS * np.sin(angle), y, -RADIUS * np.cos(angle)])


def crown_between(
    camera: Camera, jaw: str, start: float, end: float, numbers: dict[int, float]
) -> Crown:
    """A crown from one angle to another, with what it looks like."""
    low, high = ROWS[jaw]
    t = np.linspace(0, 1, 9)
    angles = np.concatenate([start + t * (end - start), end - t * (end - start)])
    heights = np.concatenate([np.full(9, low), np.full(9, high)])
    outline = camera.project(on_wall(angles, heights))[0]
    neck, edge = (low, high) if jaw == "upper" else (high, low)
    middle = np.array([(start + end) / 2])
    zenith, tip = (camera.project(on_wall(middle, np.array([y])))[0][0] for y in (neck, edge))
    return Crown(
        jaw=jaw, zenith=zenith, tip=tip, papilla_left=None, papilla_right=None,
        embrasure_left=None, embrasure_right=None, width=float(np.ptp(outline[:, 0])),
        height=float(np.ptp(outline[:, 1])), outline=outline, numbers=numbers,
        number=max(numbers, key=lambda number: numbers[number]), doubt=0.05,
    )  # fmt: skip


def looks_like(number: int, sure: float = 0.9) -> dict[int, float]:
    """Looks of a tooth that might be one of its neighbours."""
    row = teeth_of("upper" if number // 10 in (1, 2) else "lower")
    place = row.index(number)
    beside = [row[k] for k in (place - 1, place + 1) if 0 <= k < len(row)]
    return {number: sure} | dict.fromkeys(beside, (1 - sure) / len(beside))


def photographed(camera: Camera, numbers: dict[int, dict[int, float]] | None = None) -> Dentition:
    """All teeth that a camera shows.

    Args:
        camera: of the photograph.
        numbers: number -> its looks; of the others as of `looks_like`.
    """
    side = float(np.arctan2(camera.centre[0], -camera.centre[2]))
    rows = {}
    for jaw in ROWS:
        crowns = []
        for place, number in enumerate(teeth_of(jaw)):
            angle = (place - 6.5) * PITCH
            if abs(angle - side) + HALF < SHOWN:
                looks = (numbers or {}).get(number, looks_like(number))
                crowns.append(crown_between(camera, jaw, angle - HALF, angle + HALF, looks))
        rows[jaw] = tuple(crowns)
    return Dentition(camera.name, (WIDTH, HEIGHT), "front", rows["upper"], rows["lower"])


def case(degrees=(-50, -25, 0, 25, 50)):
    """Cameras, views and dentitions, all read right."""
    cameras = [camera_at(angle, f"{k:03d}") for k, angle in enumerate(degrees)]
    image = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    views = [View(camera.name, image) for camera in cameras]
    return cameras, views, [photographed(camera) for camera in cameras]


def truth_of(camera: Camera) -> list[int]:
    """The true numbers of `photographed`'s crowns, upper row first."""
    return [crown.number for crown in photographed(camera).all_crowns]


def split(camera: Camera, dentition: Dentition, number: int, looks: list[int]) -> Dentition:
    """The photograph with a crown of the upper row read as two, with looks of their own."""
    angle = (teeth_of("upper").index(number) - 6.5) * PITCH
    halves = (
        crown_between(camera, "upper", angle - HALF, angle, looks_like(looks[0])),
        crown_between(camera, "upper", angle, angle + HALF, looks_like(looks[1])),
    )
    row: list[Crown] = []
    for crown in dentition.upper:
        row += halves if crown.number == number else (crown,)
    return replace(dentition, upper=tuple(row))
