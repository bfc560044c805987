"""Render the sample cases: a synthetic mouth with exact cameras and depth.

    python data_samples/make_samples.py [--out FOLDER] [--seed 7] [--width 512] [--only CASE]

Nothing here is anybody's: shapes and colours are procedural. The same seed, sizes and library
versions give the same bytes.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import open3d as o3d

sys.path.insert(0, str(Path(__file__).resolve().parent))
from anatomy import LOWER, UPPER, grow_teeth, turn
from appearance import Noise, Surface, enamel, gum, shade
from gums import grow_gum

Array = npt.NDArray[np.float64]
DEPTH_PER_MM = 200
FOCAL = 1.95  # in widths: a macro lens


@dataclass(frozen=True)
class Mouth:
    """One mesh of everything: per-vertex data for shading.

    Attributes:
        scene: for casting rays.
        triangles: [M, 3].
        vertices, normals, local: [N, 3].
        openness: [N] 0..1, share of the sky that a vertex sees.
        tooth: [N] index of the tooth, -1 for gum.
        height, canine: [N] of the tooth.
    """

    scene: Any
    triangles: npt.NDArray[np.int32]
    vertices: Array
    normals: Array
    local: Array
    openness: Array
    tooth: Array
    height: Array
    canine: Array


def vertex_normals(vertices: Array, triangles: npt.NDArray[np.int32]) -> Array:
    """[N, 3] unit normals: area-weighted mean of the faces around."""
    corners = vertices[triangles]
    faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.stack(
        [
            np.bincount(triangles.ravel(), np.repeat(faces[:, axis], 3), len(vertices))
            for axis in range(3)
        ],
        -1,
    )
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def sky_share(scene: Any, vertices: Array, normals: Array, rays: int) -> Array:
    """[N] share of the hemisphere (cosine-weighted) that is open within 9 mm."""
    index = np.arange(rays) + 0.5
    radius, angle = np.sqrt(index / rays), 2.399963 * index
    x, y, z = radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - index / rays)
    helper = np.where(np.abs(normals[:, :1]) < 0.7, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    side = np.cross(normals, helper)
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-12)
    other = np.cross(normals, side)
    open_ = np.zeros(len(vertices))
    for k in range(rays):
        towards = x[k] * side + y[k] * other + z[k] * normals
        batch = np.concatenate([vertices + 0.05 * normals, towards], 1).astype(np.float32)
        hit = scene.test_occlusions(o3d.core.Tensor(batch), tfar=9.0, nthreads=1)
        open_ += ~hit.numpy()
    return open_ / rays


def build_mouth(seed: int, detail: int = 72, step: float = 0.16, rays: int = 48) -> Mouth:
    """Grow teeth and gums. `detail` and `step` set how fine the meshes are."""
    random = np.random.default_rng(seed)
    vertices, normals, locals_, faces, tooth_index, heights, canines = [], [], [], [], [], [], []
    offset = 0

    def add(v: Array, outward: Array, local: Array, f: Any, tooth: int, h: float, c: float) -> None:
        nonlocal offset
        vertices.append(v)
        normals.append(outward)
        locals_.append(local)
        faces.append(f + offset)
        tooth_index.append(np.full(len(v), float(tooth)))
        heights.append(np.full(len(v), h))
        canines.append(np.full(len(v), c))
        offset += len(v)

    for jaw in (UPPER, LOWER):
        teeth = grow_teeth(jaw, random, detail)
        for tooth in teeth:
            outward = vertex_normals(tooth.vertices, tooth.triangles)
            middle = tooth.vertices.mean(0)
            if ((tooth.vertices - middle) * outward).sum() < 0:
                outward = -outward
            canine = float(tooth.kind == "canine")
            add(
                tooth.vertices, outward, tooth.local, tooth.triangles,
                tooth.index, tooth.height, canine,
            )  # fmt: skip
        sheet = grow_gum(jaw, teeth, random, step)
        outward = vertex_normals(sheet.vertices, sheet.triangles)
        if outward[:, 2].sum() < 0:
            outward = -outward
        add(sheet.vertices, outward, sheet.local, sheet.triangles, -1, 1.0, 0.0)

    triangles = np.concatenate(faces).astype(np.int32)
    all_vertices, all_normals = np.concatenate(vertices), np.concatenate(normals)
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        o3d.core.Tensor(all_vertices.astype(np.float32)),
        o3d.core.Tensor(triangles.astype(np.uint32)),
    )
    return Mouth(
        scene, triangles, all_vertices, all_normals, np.concatenate(locals_),
        sky_share(scene, all_vertices, all_normals, rays),
        np.concatenate(tooth_index), np.concatenate(heights), np.concatenate(canines),
    )  # fmt: skip


@dataclass(frozen=True)
class Shot:
    """Where one photograph is taken from: angles in degrees, distance and aim in mm."""

    name: str
    yaw: float
    elevation: float = 0.0
    roll: float = 0.0
    distance: float = 112.0
    aim: tuple[float, float] = (0.0, 0.0)

    def cam_from_world(self) -> Array:
        """[4, 4] OpenCV camera from world, mm. Negative yaw: from the patient's right."""
        pivot = np.array([0.0, 0.0, -17.0])
        flip = np.diag([1.0, -1.0, -1.0])
        turned = turn(2, self.roll) @ flip @ turn(0, self.elevation) @ turn(1, -self.yaw)
        matrix = np.eye(4)
        matrix[:3, :3] = turned
        matrix[:3, 3] = -turned @ pivot + (-self.aim[0], self.aim[1], self.distance)
        return matrix


def pixel_rays(cam_from_world: Array, focal: float, width: int, height: int) -> Array:
    """[H, W, 6] float32 origins and directions whose length along the optical axis is 1."""
    v, u = np.mgrid[:height, :width] + 0.5
    local = np.stack([(u - width / 2) / focal, (v - height / 2) / focal, np.ones_like(u)], -1)
    rotation, translation = cam_from_world[:3, :3], cam_from_world[:3, 3]
    origin = np.broadcast_to(-rotation.T @ translation, local.shape)
    return np.concatenate([origin, local @ rotation], -1).astype(np.float32)


def render(
    mouth: Mouth, noise: Noise, shot: Shot, width: int, height: int, samples: int = 2
) -> Array:
    """Render [H, W, 3] linear light with `samples` squared rays per pixel."""
    w2c = shot.cam_from_world()
    rays = pixel_rays(w2c, FOCAL * width * samples, width * samples, height * samples)
    hit = mouth.scene.cast_rays(o3d.core.Tensor(rays), nthreads=1)
    seen = np.isfinite(hit["t_hit"].numpy()).ravel()
    corners = mouth.triangles[hit["primitive_ids"].numpy().ravel()[seen]]
    uv = hit["primitive_uvs"].numpy().reshape(-1, 2)[seen].astype(float)
    weights = np.stack([1 - uv.sum(1), uv[:, 0], uv[:, 1]], 1)

    def interpolate(values: Array) -> Array:
        return np.einsum("nk,nk...->n...", weights, values[corners])

    points, local = interpolate(mouth.vertices), interpolate(mouth.local)
    tooth = mouth.tooth[corners[:, 0]]
    is_tooth = tooth >= 0
    albedo, bump, gloss = np.zeros_like(points), np.zeros_like(points), np.zeros(len(points))
    first = corners[is_tooth, 0]
    for where, surface in (
        (is_tooth, enamel(local[is_tooth], mouth.height[first], tooth[is_tooth],
                          mouth.canine[first], noise)),
        (~is_tooth, gum(local[~is_tooth], points[~is_tooth], noise)),
    ):  # fmt: skip
        albedo[where], gloss[where], bump[where] = surface.albedo, surface.gloss, surface.bump
    eye = -w2c[:3, :3].T @ w2c[:3, 3]
    flash = eye + w2c[:3, :3].T @ np.array([6.0, -14.0, 0.0])
    normals = interpolate(mouth.normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    shaded = shade(
        Surface(albedo, gloss, bump), normals, points, eye, flash, interpolate(mouth.openness)
    )
    picture = np.tile(np.array([0.006, 0.0035, 0.003]), (rays.shape[0] * rays.shape[1], 1))
    picture[seen] = np.clip(shaded, 0, 1.3)
    picture = picture.reshape(height, samples, width, samples, 3)
    return picture.mean((1, 3))


def develop(picture: Array, random: np.random.Generator) -> npt.NDArray[np.uint8]:
    """Lens blur, sensor noise and gamma: [H, W, 3] linear light to 8-bit sRGB."""
    blurred = cv2.GaussianBlur(picture, (0, 0), 0.45)
    vignette_y, vignette_x = np.mgrid[
        -1 : 1 : picture.shape[0] * 1j, -1 : 1 : picture.shape[1] * 1j
    ]
    blurred = blurred * (1 - 0.10 * (vignette_x**2 + vignette_y**2) / 2)[..., None]
    noisy = blurred + random.normal(size=picture.shape) * np.sqrt(3e-6 + 5e-5 * blurred)
    return np.asarray(np.rint(255 * np.clip(noisy, 0, 1) ** (1 / 2.2)), np.uint8)


def render_depth(mouth: Mouth, shot: Shot, width: int, height: int) -> npt.NDArray[np.uint16]:
    """[H, W] uint16 z-depth at the pixel centres, mm * 200; 0 where there is nothing."""
    rays = pixel_rays(shot.cam_from_world(), FOCAL * width, width, height)
    depth = mouth.scene.cast_rays(o3d.core.Tensor(rays), nthreads=1)["t_hit"].numpy()
    return np.asarray(np.rint(np.where(np.isfinite(depth), depth, 0) * DEPTH_PER_MM), np.uint16)


def three_photos() -> list[Shot]:
    """Right buccal, frontal, left buccal, as a clinic takes them (but nearer to each other)."""
    return [
        Shot("right_buccal", -22.0, -1.5, 1.0, 114, (-4.0, 0.5)),
        Shot("frontal", 0.5, 1.0, -0.6, 112, (0.3, -0.4)),
        Shot("left_buccal", 22.5, 0.5, -1.2, 115, (4.2, 0.2)),
    ]


def twelve_frames(seed: int) -> list[Shot]:
    """A sweep from the right buccal to the left buccal side, held by hand."""
    random = np.random.default_rng(seed + 1)
    t = np.linspace(-1, 1, 12)

    def sway(size: float) -> Array:
        knots = random.normal(size=5)
        return size * np.interp(t, np.linspace(-1, 1, 5), knots)

    elevation, roll, distance = sway(1.8), sway(1.2), 114 + sway(2.0)
    across, down = 8.5 * t + sway(0.7), sway(0.6)
    return [
        Shot(f"{n:03d}", 45 * t[n], elevation[n], roll[n], distance[n], (across[n], down[n]))
        for n in range(12)
    ]


def write_case(
    folder: Path, suffix: str, shots: list[Shot], mouth: Mouth, noise: Noise,
    width: int, height: int, seed: int, quality: int,
) -> None:  # fmt: skip
    """Write photographs, half-size depth and `transforms.json`."""
    (folder / "depth").mkdir(parents=True, exist_ok=True)
    frames = []
    for number, shot in enumerate(shots):
        random = np.random.default_rng([seed, 2, number])
        pixels = develop(render(mouth, noise, shot, width, height), random)
        settings = [cv2.IMWRITE_JPEG_QUALITY, quality]
        cv2.imwrite(str(folder / f"{shot.name}{suffix}"), pixels[..., ::-1], settings)
        depth = render_depth(mouth, shot, width // 2, height // 2)
        smallest = [cv2.IMWRITE_PNG_COMPRESSION, 9]
        cv2.imwrite(str(folder / "depth" / f"{shot.name}.png"), depth, smallest)
        w2c = shot.cam_from_world()
        frames.append(
            {
                "file_path": f"{shot.name}{suffix}",
                "depth_file_path": f"depth/{shot.name}.png",
                "yaw_degrees": round(shot.yaw, 4),
                "transform_matrix": (np.linalg.inv(w2c) @ np.diag([1.0, -1, -1, 1])).tolist(),
                "w2c_opencv": w2c.tolist(),
            }
        )
    about = {
        "camera_model": "OPENCV", "fl_x": FOCAL * width, "fl_y": FOCAL * width,
        "cx": width / 2, "cy": height / 2, "w": width, "h": height,
        "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "units": "mm",
        "conventions": "transform_matrix: camera to world, OpenGL axes (x right, y up, z back), as "
        "nerfstudio. w2c_opencv: world to camera, OpenCV axes (x right, y down, z forward), exact. "
        "Pixel centres at .5. World: x to the patient's left, y up, z out of the mouth.",
        "depth_unit": f"uint16 PNG, value / {DEPTH_PER_MM} = z-depth in mm, 0 = nothing there; "
        "half the size of the photographs (intrinsics halved), at its own pixel centres",
        "depth_per_mm": DEPTH_PER_MM, "depth_w": width // 2, "depth_h": height // 2,
        "frames": frames,
    }  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps(about, indent=1) + "\n")


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    here = Path(__file__).resolve().parent
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=here)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--width", type=int, default=512)
    parser.add_argument("--quality", type=int, default=92, help="of the JPEGs")
    parser.add_argument("--only", choices=("three_photos", "twelve_frames"))
    options = parser.parse_args(arguments)
    mouth, noise = build_mouth(options.seed), Noise(options.seed)
    height = options.width * 3 // 4
    cases = {"three_photos": three_photos(), "twelve_frames": twelve_frames(options.seed)}
    for name, shots in cases.items():
        if options.only in (None, name):
            write_case(
                options.out / name, ".jpg", shots, mouth, noise,
                options.width, height, options.seed, options.quality,
            )  # fmt: skip


if __name__ == "__main__":
    main()
