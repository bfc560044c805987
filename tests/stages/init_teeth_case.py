"""What was read and what was found of three photographs of a ball with crowns."""

import numpy as np

from pipeline.artifacts.teeth import Crown, Dentition, Teeth
from pipeline.artifacts.views import View, Views
from stages.init.dental.landmarks import Landmark
from stages.init.dental.reconstruct import Reconstruction, with_numbers
from stages.init.dental.solution import ArchFit, PlacedView
from stages.init.dental.surface.dense import ArchSurface, SurfaceView

SIZE = (96, 128)
FOCAL = 240.0


def side_pose(yaw, distance=120.0):
    """A camera of the arch frame (y up, z to the front) that looks at its origin."""
    angle = np.radians(yaw)
    centre = distance * np.array([np.sin(angle), 0, np.cos(angle)])
    forward = -centre / distance
    down = np.array([0.0, -1, 0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([np.cross(down, forward), down, forward])
    pose[:3, 3] = -pose[:3, :3] @ centre
    return pose


def ball_depth(pose, radius=20.0):
    """z-depth [H, W] of a ball about the origin, 0 beside it."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    ray = np.stack([(u - SIZE[1] / 2) / FOCAL, (v - SIZE[0] / 2) / FOCAL, np.ones(SIZE)], -1)
    centre = pose[:3, 3]
    a, b = (ray**2).sum(-1), ray @ centre
    inside = b**2 - a * (centre @ centre - radius**2)
    depth = np.where(inside > 0, (b - np.sqrt(np.maximum(inside, 0))) / a, 0)
    return depth.astype(np.float32)


#: FDI number of each crown of a photograph as all photographs together have it, 0: no tooth.
UPPER, LOWER = (12, 11, 21), (41, 0, 31)


def read_teeth(count=3, aside=(), numbers=UPPER):
    """What the stage `teeth` hands over: three crowns a row, 20 pixels wide; numbers in doubt."""
    dentitions = []
    for k in range(count):
        rows = {}
        for jaw, top, teeth_of_row in (("upper", 20, numbers), ("lower", 50, LOWER)):
            crowns = []
            for column, number in enumerate(teeth_of_row):
                left = 30 + 20 * column
                corners = np.add([[0, 0], [19, 0], [19, 28], [0, 28]], [left, top])
                top_middle = np.array([left + 9.5, top])
                crowns.append(
                    Crown(
                        jaw, top_middle, top_middle + np.array([0, 28]), *[None] * 4, 19.0, 28.0,
                        outline=corners.astype(float), number=number, doubt=0.4,
                    )
                )  # fmt: skip
            rows[jaw] = tuple(crowns)
        dentitions.append(
            Dentition(
                f"{k:03d}", SIZE[::-1], "front", rows["upper"], rows["lower"], 0.0, 58.0,
                set_aside="it shows one jaw only" if k in aside else "",
            )
        )  # fmt: skip
    return Teeth(tuple(dentitions))


def found_teeth(yaws=(-40, 0, 40)):
    poses = [side_pose(yaw) for yaw in yaws]
    maps = [ball_depth(pose) for pose in poses]
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(5000, 3))
    normals = (direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.float32)
    surface = ArchSurface(
        views=tuple(
            SurfaceView(depth, np.zeros((*SIZE, 3), np.float32), np.where(depth > 0, 5, 1).astype(
                np.float32)) for depth in maps
        ),
        positions=20 * normals, colors=np.full((5000, 3), 0.7, np.float32), normals=normals,
        confidence=np.full(5000, 4, np.float32), tooth=np.ones(5000, bool),
        faces=np.zeros((0, 3), np.int32), gains=np.ones((len(yaws), 3)),
    )  # fmt: skip
    landmarks = {
        Landmark("papilla", 12, 11): np.array([-8.0, 4, 0]),
        Landmark("papilla", 11, 21): np.array([0.0, 4, 0]),
        Landmark("embrasure", 12, 11): np.array([-9.0, 0, 0]),
        Landmark("embrasure", 11, 21): np.array([0.0, 0, 0]),
    }
    views = tuple(
        PlacedView(pose, FOCAL, role, UPPER, LOWER, 0.5, (0.1, 0.0, 0.0), (0.0, 1.0, 0.0))
        for pose, role in zip(poses, ("right", "frontal", "left"), strict=True)
    )
    fit = ArchFit(views, landmarks, landmarks, margin=40.0)
    picture = np.zeros((20, 30, 3), np.uint8)
    numbered = [
        with_numbers(dentition, view, fit)
        for dentition, view in zip(read_teeth(len(yaws)).views, views, strict=True)
    ]
    return Reconstruction(list(photographs(len(yaws)).views), numbered, fit, surface, picture)


def photographs(count=3):
    """Brighter to the right."""
    ramp = np.linspace(0.2, 0.8, SIZE[1], dtype=np.float32)
    image = np.broadcast_to(ramp[:, None], (*SIZE, 3))
    return Views(
        tuple(View(f"{k:03d}", image.copy(), source_name=f"p{k}.jpg") for k in range(count))
    )
