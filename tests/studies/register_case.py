"""Two visits of a toy mouth: textured balls for crowns, rendered exactly, some of them moved."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.artifacts.cameras import Camera, Cameras
from pipeline.artifacts.gaussians import Gaussians
from pipeline.artifacts.space.scale import Scale
from pipeline.artifacts.teeth import Crown, Dentition, Teeth
from pipeline.artifacts.views import View, Views
from pipeline.studies.register.visit import Look, Visit, teeth_points
from tests.studies.report_case import write_result

WIDTH, HEIGHT, FOCAL, DISTANCE = 256, 192, 400.0, 110.0
RADIUS = 4.2
UPPER = (15, 14, 13, 12, 11, 21, 22, 23, 24, 25)
#: Of each four pixels one becomes a Gaussian.
SPARSE = np.array([[True, False], [False, False]])
LOWER = (45, 44, 43, 42, 41, 31, 32, 33, 34, 35)
#: Teeth that moved between the visits: mm, degrees (rotation vector).
MOVED = {
    12: ((0.5, 0.2, 0.4), (3.0, -4.0, 2.0)),
    34: ((-0.2, 0.6, 0.3), (0.0, 5.0, 0.0)),
}


def toy_centres() -> dict[int, np.ndarray]:
    """FDI number -> [3] mm; x to the patient's left, y up, z forwards."""
    found = {}
    for row, y, size in ((UPPER, 4.6, 1.0), (LOWER, -4.6, 0.93)):
        for k, number in enumerate(row):
            angle = np.radians((k - 4.5) * 17.0)
            found[number] = np.array([28 * size * np.sin(angle), y, 28 * size * np.cos(angle) - 28])
    return found


def toy_camera(yaw: float, name: str, lift: float = 0.0) -> Camera:
    """Looks at the middle of the front from a yaw (degrees, positive from the patient's left)."""
    turn = Rotation.from_euler("yx", [-yaw, lift], degrees=True).as_matrix()
    pose = np.eye(4)
    pose[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ turn
    pose[:3, 3] = -pose[:3, :3] @ [0, 0, -12.0] + (0, 0, DISTANCE)
    return Camera(name, WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, pose)


def texture(points: np.ndarray, seed: int) -> np.ndarray:
    """[N] brightness of a crown's material at points [N, 3] of its own frame, mm."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(size=(24, 3)) * 2.2
    return 0.6 + 0.025 * np.sin(points @ waves.T + rng.uniform(0, 6.3, 24)).sum(1) / 2


def shaded(points: np.ndarray, normals: np.ndarray, seed: int) -> np.ndarray:
    """[N] brightness of smooth enamel with faint sharp marks, at points [N, 3] of a crown's frame.

    Args:
        points: mm.
        normals: [N, 3] in the camera's frame: the light goes with the camera, whatever a tooth did.
        seed: of the marks.
    """
    waves = np.random.default_rng(seed).normal(size=(24, 3))
    waves *= 8.0 / np.linalg.norm(waves, axis=1, keepdims=True)
    light = np.sin(normals @ np.array([[3.0, 1.0, 0.0], [-1.0, 4.0, 0.0], [6.0, 5.0, 0.0]]).T)
    return 0.5 + 0.1 * light.sum(1) + 0.012 * np.sin(points @ waves.T).sum(1) / 2


def photograph(
    camera: Camera, centres: Mapping[int, np.ndarray], motions: Mapping[int, np.ndarray],
    patient: int, noise: int, smooth: bool = False,
) -> Look:  # fmt: skip
    """Render balls with what each did since the first visit ([4, 4]); see `texture`, `shaded`."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
    rays = rays.reshape(-1, 3) @ camera.rotation  # in the world, 1 long along the axis
    depth = np.full(len(rays), np.inf)
    image = np.full(len(rays), 0.25)
    labels = np.zeros(len(rays), np.uint8)
    for number, centre in centres.items():
        motion = motions.get(number, np.eye(4))
        now = motion[:3, :3] @ centre + motion[:3, 3]
        a = (rays**2).sum(1)
        b = rays @ (camera.centre - now)
        c = float(((camera.centre - now) ** 2).sum() - RADIUS**2)
        inside = b**2 - a * c
        z = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / a, np.inf)
        nearer = z < depth
        depth[nearer], labels[nearer] = z[nearer], number
        points = camera.centre + z[nearer, None] * rays[nearer] - now
        own, seed = points @ motion[:3, :3], 1000 * patient + number
        if smooth:
            image[nearer] = shaded(own, points / RADIUS @ camera.rotation.T, seed)
        else:
            image[nearer] = texture(own, seed)
    grain = np.random.default_rng(noise).normal(0, 0.004, len(image))
    shape = camera.height, camera.width
    return Look(
        camera, (image + grain).reshape(shape).astype(np.float32), labels.reshape(shape),
        np.where(np.isfinite(depth), depth, 0).reshape(shape).astype(np.float32),
        np.ones(shape, bool),
    )  # fmt: skip


def toy_visit(
    name: str, motions: Mapping[int, np.ndarray] | None = None, patient: int = 1,
    turn: float = 0.0, smooth: bool = False, larger: int = 1,
) -> Visit:  # fmt: skip
    """A visit of four photographs.

    Args:
        name: of the visit.
        motions: what teeth did since the first visit.
        patient: another one has other surfaces, and teeth a little elsewhere.
        turn: degrees that the photographs are taken from further left.
        smooth: whether crowns have faint marks under light that goes with the camera.
        larger: so many times as wide the photographs are as the visit has them.
    """
    centres = toy_centres()
    if patient != 1:
        rng = np.random.default_rng(patient)
        centres = {n: c + rng.normal(0, 0.5, 3) for n, c in centres.items()}
    looks = []
    for k, yaw in enumerate((-42.0, -14.0, 14.0, 42.0)):
        camera = toy_camera(yaw + turn, f"{k:03d}", 2.0)
        noise = 97 * len(name) + k
        look = photograph(camera, centres, motions or {}, patient, noise, smooth)
        if larger > 1:
            big = camera.resized(larger * WIDTH, larger * HEIGHT)
            image = photograph(big, centres, motions or {}, patient, noise, smooth).image
            look = replace(look, larger=image)
        looks.append(look)
    return Visit(name, tuple(looks), teeth_points(looks))


def motion(centre: np.ndarray, shift: tuple[float, ...], turn: tuple[float, ...]) -> np.ndarray:
    """[4, 4] a shift (mm) and a turn (rotation vector, degrees) about a point."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(np.radians(turn)).as_matrix()
    matrix[:3, 3] = centre + shift - matrix[:3, :3] @ centre
    return matrix


def toy_motions() -> dict[int, np.ndarray]:
    """FDI number -> [4, 4] what the moved teeth did."""
    centres = toy_centres()
    return {number: motion(centres[number], *how) for number, how in MOVED.items()}


def write_visit(workspace: Path, visit: Visit, scale: Scale | None = None) -> Path:
    """The visit as the workspace of a finished run."""
    workspace.mkdir(parents=True)
    stages = ["views", "teeth", "init", "fit"]
    request = {"images": [], "preset": None, "overrides": [], "stages": stages, "from": None}
    (workspace / "request.json").write_text(json.dumps(request))
    views, dentitions, means, colors = [], [], [], []
    for look in visit.looks:
        name = look.camera.name
        image = np.repeat(look.image[..., None], 3, 2).clip(0, 1)
        views.append(View(name, image, source_name=f"right {name}.jpg"))
        rows: dict[str, list[Crown]] = {"upper": [], "lower": []}
        for number in (int(n) for n in np.unique(look.labels) if n):
            contours, _ = cv2.findContours(
                (look.labels == number).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
            )
            outline = max(contours, key=cv2.contourArea)[:, 0] + 0.5
            if len(outline) < 12:
                continue
            jaw = "upper" if number < 30 else "lower"
            middle = outline.mean(0)
            rows[jaw].append(
                Crown(jaw, middle, middle, None, None, None, None, 20.0, 20.0,  # type: ignore[arg-type]
                      outline=outline.astype(np.float64), number=number, doubt=0.01)
            )  # fmt: skip
        dentitions.append(
            Dentition(name, (WIDTH, HEIGHT), "front", tuple(rows["upper"]), tuple(rows["lower"]))
        )
        seen = (look.depth > 0) & np.kron(np.ones((HEIGHT // 2, WIDTH // 2), bool), SPARSE)
        means.append(look.points[seen])
        colors.append(look.image[seen])
    world = np.concatenate(means).astype(np.float32)
    count = len(world)
    sh = np.zeros((count, 16, 3), np.float32)
    sh[:, 0] = (np.concatenate(colors)[:, None] - 0.5) / 0.28209479
    quats = np.tile(np.float32([1, 0, 0, 0]), (count, 1))
    scene = Gaussians(
        world,
        quats,
        np.full((count, 3), np.log(0.2), np.float32),
        np.full(count, 4.0, np.float32),
        sh,
    )
    cameras = Cameras(
        tuple(look.camera for look in visit.looks), scale=scale or Scale("mm", "cameras")
    )
    files = [(view.name, sha256(view.image).hexdigest()) for view in views]
    write_result(workspace, "views", [Views(tuple(views))], sources=files)
    write_result(workspace, "teeth", [Teeth(tuple(dentitions))])
    write_result(workspace, "init", [cameras])
    write_result(workspace, "fit", [scene])
    return workspace
