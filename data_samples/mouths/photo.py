"""Photographs of a mouth: rays, light, what surrounds the teeth, and the camera's electronics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from appearance import Surface
from make_samples import vertex_normals

from .cameras import ROLES, Camera, random_camera
from .develop import develop
from .light import Light, random_light, shade
from .mouth import Mouth, Tissue
from .rays import cast, ray_scene
from .surfaces import enamel, metal, soft
from .surround import fill_back, surround
from .tissue import cheek

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Photograph:
    """One photograph and what is in it.

    Attributes:
        image: [H, W, 3] uint8 sRGB.
        labels: [H, W] uint8 FDI number of the crown at the pixel's centre, 0 for anything else.
        gum: [H, W] bool: gum of the jaws, or what is fixed to the teeth before it.
        depth: [H, W] float32 z-depth of the mouth, mm; 0 where it is hidden or absent.
        camera: the exact camera (`fx`, `fy`, `cx`, `cy`, `cam_from_world`).
        view: front, right, left, upper or lower.
        bite: closed or open.
        opening: by how many mm the front teeth are parted (see `Mouth.posed`).
    """

    image: npt.NDArray[np.uint8]
    labels: npt.NDArray[np.uint8]
    gum: npt.NDArray[np.bool_]
    depth: npt.NDArray[np.float32]
    camera: Camera
    view: str
    bite: str
    opening: float

    @property
    def fx(self) -> float:
        return self.camera.fx

    @property
    def fy(self) -> float:
        return self.camera.fy

    @property
    def cx(self) -> float:
        return self.camera.cx

    @property
    def cy(self) -> float:
        return self.camera.cy

    @property
    def cam_from_world(self) -> Array:
        return self.camera.cam_from_world


@dataclass(frozen=True)
class Stage:
    """What the rays meet: the mouth as it is held for one photograph, with its cheeks."""

    mouth: Mouth
    scene: Any
    bare: Any  # without wires
    triangles: npt.NDArray[np.int32]
    vertices: Array
    normals: Array
    local: Array
    openness: Array
    fdi: npt.NDArray[np.uint8]
    tissue: npt.NDArray[np.uint8]
    tooth: npt.NDArray[np.int32]


def set_stage(mouth: Mouth, role: str, opening: float, rng: np.random.Generator) -> Stage:
    """Open the jaw, hold the cheeks away; occlusal views leave out the other jaw, as mirrors do."""
    vertices, normals = mouth.posed(opening)
    faces = mouth.triangles
    if role in ("upper", "lower"):
        keep = mouth.lower == (role == "lower")
        faces = faces[keep[faces[:, 0]]]
    openness = mouth.openness_closed if opening < 0.5 else mouth.openness_apart
    # Vertices just under the gum see nothing; enamel lets light in from all around.
    openness = np.where(mouth.tissue == Tissue.ENAMEL, np.maximum(openness, 0.33), openness)
    columns = [vertices, normals, mouth.local]
    more: list[list[Array]] = [[], [], []]
    count, extra = len(vertices), 0
    new_faces = [faces]
    if role in ("front", "right", "left"):
        for side in (-1, 1):
            near = role == ("left" if side > 0 else "right")
            angle = rng.uniform(85, 120) if near else rng.uniform(25, 60)
            sheet = cheek(mouth.rows[0], side, angle, rng)
            new_faces.append(sheet.triangles + count + extra)
            parts = (sheet.vertices, vertex_normals(sheet.vertices, sheet.triangles), sheet.local)
            for column, part in zip(more, parts, strict=True):
                column.append(part)
            extra += len(sheet.vertices)
    vertices, normals, local = (
        np.concatenate([column, *added]) for column, added in zip(columns, more, strict=True)
    )
    triangles = np.concatenate(new_faces).astype(np.int32)
    tissue = np.concatenate([mouth.tissue, np.full(extra, Tissue.CHEEK, np.uint8)])
    scene = ray_scene((vertices, triangles))
    wires = tissue[triangles[:, 0]] == Tissue.WIRE
    # The bare scene keeps the numbering of triangles: wires shrink to a point far away.
    bare = scene
    if wires.any():
        moved = np.where((tissue == Tissue.WIRE)[:, None], 1e5, vertices)
        bare = ray_scene((moved, triangles))
    return Stage(
        mouth, scene, bare, triangles, vertices, normals, local,
        np.concatenate([openness, np.full(extra, 0.75)]),
        np.concatenate([mouth.fdi, np.zeros(extra, np.uint8)]), tissue,
        np.concatenate([mouth.tooth, np.full(extra, -1, np.int32)]),
    )  # fmt: skip


def look_along(stage: Stage, hit: dict[str, npt.NDArray[Any]], light: Light, eye: Array) -> Array:
    """Light [N, 3] that comes along rays, linear; negative where there is nothing."""
    seen = np.isfinite(hit["t_hit"])
    corners = stage.triangles[hit["primitive_ids"][seen]]
    uv = hit["primitive_uvs"][seen].astype(float)
    weights = np.stack([1 - uv.sum(1), uv[:, 0], uv[:, 1]], 1)

    def interpolate(values: Array) -> Array:
        return np.einsum("nk,nk...->n...", weights, values[corners])

    points, local = interpolate(stage.vertices), interpolate(stage.local)
    tissue, tooth = stage.tissue[corners[:, 0]], stage.tooth[corners[:, 0]]
    albedo, bump, gloss = np.zeros_like(points), np.zeros_like(points), np.zeros(len(points))
    crown = tissue == Tissue.ENAMEL
    steel = tissue >= Tissue.BRACKET
    flesh = ~crown & ~steel
    dark = (stage.mouth.options.seed % 7) / 7
    for where, make in (
        (crown, lambda w: enamel(stage.mouth, local[w], tooth[w])),
        (flesh, lambda w: soft(stage.mouth, tissue[w], local[w], points[w])),
        (steel, lambda w: metal(stage.mouth.noise, points[w], dark)),
    ):
        if where.any():
            surface = make(where)
            albedo[where], gloss[where], bump[where] = surface.albedo, surface.gloss, surface.bump
    normals = interpolate(stage.normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    picture = np.full((len(seen), 3), -1.0)
    picture[seen] = shade(
        Surface(albedo, gloss, bump), normals, points, eye, light, interpolate(stage.openness)
    )
    return picture


def render(
    stage: Stage, camera: Camera, light: Light
) -> tuple[Array, npt.NDArray[np.uint8], npt.NDArray[np.bool_], npt.NDArray[np.float32]]:
    """Linear light [H, W, 3] (negative where there is nothing), labels, gum and depth [H, W].

    Pixels at edges get four more rays.
    """
    width, height = camera.width, camera.height
    v, u = np.mgrid[:height, :width] + 0.5
    centres = np.stack([u, v], -1).reshape(-1, 2)
    rays = camera.rays(centres)
    eye = -camera.cam_from_world[:3, :3].T @ camera.cam_from_world[:3, 3]
    hit = cast(stage.scene, rays)
    depth = hit["t_hit"]
    bare = hit
    if stage.bare is not stage.scene:
        bare = cast(stage.bare, rays)
    flat = np.zeros(len(rays), np.uint8)
    seen = np.isfinite(bare["t_hit"])
    met = stage.triangles[bare["primitive_ids"][seen], 0]
    flat[seen] = stage.fdi[met]
    gum = np.zeros(len(rays), bool)
    gum[seen] = stage.tissue[met] == Tissue.GUM
    depth = np.where(np.isfinite(depth), depth, 0).astype(np.float32).reshape(height, width)
    labels = flat.reshape(height, width)

    picture = look_along(stage, hit, light, eye).reshape(height, width, 3)
    kernel = np.ones((3, 3), np.uint8)
    jump = cv2.dilate(depth, kernel) - cv2.erode(depth, kernel) > 0.9
    differs = cv2.dilate(labels, kernel) != cv2.erode(labels, kernel)
    rows, columns = np.nonzero(jump | differs)
    total = picture[rows, columns].copy()
    for dx, dy in ((-0.375, -0.125), (0.125, -0.375), (0.375, 0.125), (-0.125, 0.375)):
        pixels = np.stack([columns + 0.5 + dx, rows + 0.5 + dy], -1)
        more = look_along(stage, cast(stage.scene, camera.rays(pixels)), light, eye)
        total += np.maximum(more, 0) * (total >= 0) + np.minimum(more, 0) * (total < 0)
    picture[rows, columns] = total / 5
    return picture, labels, gum.reshape(height, width), depth


def defocus(
    picture: Array, depth: npt.NDArray[np.float32], camera: Camera, rng: np.random.Generator
) -> Array:
    """Blur [H, W, 3] what lies far behind the teeth that the lens is focused on."""
    seen = depth > 0
    if not seen.any():
        return picture
    focus = float(np.quantile(depth[seen], rng.uniform(0.05, 0.5)))
    behind = np.where(seen, depth - focus, 40.0) / rng.uniform(15.0, 45.0)
    blurred = cv2.GaussianBlur(picture, (0, 0), rng.uniform(1.0, 2.2) * camera.width / 448)
    share = cv2.GaussianBlur(np.clip(behind - 0.3, 0, 1), (0, 0), 1.5)[..., None]
    return np.asarray(picture * (1 - share) + blurred * share)


def photograph(mouth: Mouth, rng: np.random.Generator, role: str, **overrides: Any) -> Photograph:
    """Take a photograph.

    Args:
        mouth: of what.
        rng: everything that is not given is sampled from it.
        role: front, right, left, upper or lower.
        overrides: `width` (448), `height` (336), pixels; `bite` (closed or open); `opening`, mm;
            `camera` (a `Camera`, taken as it is); `plain` (True: no lips, retractors or hands, even
            exposure, no noise).

    Raises:
        TypeError: for an unknown override. ValueError: for an unknown role.
    """
    unknown = set(overrides) - {"width", "height", "bite", "opening", "camera", "plain"}
    if unknown:
        raise TypeError(f"no such overrides of a photograph: {sorted(unknown)}")
    if role not in ROLES:
        raise ValueError(f"no such role: {role!r}; there are {ROLES}")
    occlusal = role in ("upper", "lower")
    bite = overrides.get("bite", "open" if occlusal or rng.random() < 0.15 else "closed")
    parted = mouth.options.opening if bite == "open" else 0.0
    opening = float(overrides.get("opening", max(parted, 25.0) if occlusal else parted))
    width, height = int(overrides.get("width", 448)), int(overrides.get("height", 336))
    camera = random_camera(mouth, role, opening, width, height, rng)
    camera = overrides.get("camera", camera)
    plain = bool(overrides.get("plain", False))
    stage = set_stage(mouth, role, opening, rng)
    light = random_light(camera.cam_from_world, rng, plain)
    picture, labels, gum, depth = render(stage, camera, light)
    picture = fill_back(picture, mouth, camera.fx / camera.cam_from_world[2, 3], role, rng)
    hidden = np.zeros(labels.shape, bool)
    if not plain:
        picture = defocus(picture, depth, camera, rng)
        picture, cover = surround(picture, mouth, camera, role, opening, rng)
        hidden = cover > 0.5
    labels, depth = np.where(hidden, 0, labels), np.where(hidden, 0, depth)
    return Photograph(
        develop(picture, rng, plain), labels.astype(np.uint8), gum & ~hidden,
        depth.astype(np.float32), camera, role, bite, opening,
    )  # fmt: skip
