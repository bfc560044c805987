"""What surrounds the teeth in a photograph: lips, skin, retractors, fingers, probes.

These are layers in the picture, each a relief (height in pixels) that is lit like the rest. Lengths
are mm until `scale` (pixels per mm at the teeth) turns them into pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from appearance import linear
from gums import smoothstep

from .cameras import Camera
from .mouth import Mouth

Array = npt.NDArray[np.float64]
SKINS = (
    (236, 196, 172),
    (222, 172, 142),
    (198, 140, 106),
    (158, 104, 74),
    (112, 70, 50),
    (82, 52, 40),
)
GLOVES = ((92, 128, 190), (226, 220, 208), (70, 80, 150), (238, 236, 236), (60, 60, 66))


def clouds(shape: tuple[int, int], size: float, rng: np.random.Generator) -> Array:
    """Smooth noise [H, W], mean 0, deviation 1, features of about `size` pixels."""
    step = max(size / 3, 1.0)
    small = (int(shape[0] / step) + 6, int(shape[1] / step) + 6)
    field = cv2.GaussianBlur(rng.normal(size=small), (0, 0), 1.4)
    field = cv2.resize(field / field.std(), (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
    return np.asarray(field, np.float64)


@dataclass(frozen=True)
class Canvas:
    """Coordinates of a picture about the middle of the mouth.

    Attributes:
        x, y: [H, W] mm at the depth of the teeth, along and across the biting line (y upwards).
        scale: pixels per mm.
        lights: [L, 3] directions of the light for the layers.
        rng: for everything random.
    """

    x: Array
    y: Array
    scale: float
    lights: Array
    rng: np.random.Generator

    def lit(self, height: Array, albedo: Array, gloss: float | Array, sharp: float = 60) -> Array:
        """Light [H, W, 3] from a relief [H, W] in mm with a colour [3] or [H, W, 3]."""
        gy, gx = np.gradient(height * self.scale)
        normal = np.stack([-gx, -gy, np.ones_like(gx)], -1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        light = np.zeros((*height.shape, 3))
        for towards in self.lights:
            diffuse = np.clip((normal @ towards + 0.1) / 1.1, 0, 1)
            half = np.add(towards, (0, 0, 1))
            shine = np.clip(normal @ (half / np.linalg.norm(half)), 0, 1) ** sharp
            light += (
                albedo * (0.95 * diffuse + 0.05)[..., None] + (gloss * shine)[..., None]
            ) / len(self.lights)
        return light


def _canvas(
    mouth: Mouth, camera: Camera, role: str, opening: float, rng: np.random.Generator
) -> Canvas:
    centres = mouth.tooth_centres(opening)
    numbers = np.array(list(centres))
    points = np.array(list(centres.values()))
    if role in ("right", "left"):
        mask = np.isin(numbers // 10, (2, 3, 6, 7) if role == "left" else (1, 4, 5, 8))
        mask &= (numbers % 10 >= 2) & (numbers % 10 <= 5)
    elif role == "front":
        mask = numbers % 10 <= 3
    else:
        mask = np.isin(numbers // 10, (1, 2, 5, 6) if role == "upper" else (3, 4, 7, 8))
    middle = points[mask if mask.any() else slice(None)].mean(0)
    pixel = camera.project(middle[None])[0]
    axis = camera.cam_from_world[:3, :3] @ np.array([0.0, 1.0, 0.0])
    if role in ("upper", "lower"):
        axis = camera.cam_from_world[:3, :3] @ np.array([0.0, 0.0, 1.0])
    up = axis[:2] / max(float(np.linalg.norm(axis[:2])), 1e-6)
    scale = camera.fx / pixel[2]
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    du, dv = (u - pixel[0]) / scale, (v - pixel[1]) / scale
    towards = rng.normal(size=(int(rng.integers(1, 3)), 2)) * 0.25
    lights = np.concatenate([towards, np.ones((len(towards), 1))], 1)
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    return Canvas(-du * up[1] + dv * up[0], du * up[0] + dv * up[1], float(scale), lights, rng)


def _blend(under: Array, over: Array, alpha: Array) -> Array:
    return under * (1 - alpha[..., None]) + over * alpha[..., None]


def fill_back(
    picture: Array, mouth: Mouth, scale: float, role: str, rng: np.random.Generator
) -> Array:
    """Fill what is empty (negative) in [H, W, 3] linear light: the back of the mouth, mucosa."""
    tone, shape = mouth.options.gum_tone, picture.shape[:2]
    dark = linear(150 - 50 * tone, 44, 48) * rng.uniform(0.05, 0.5)
    if role in ("upper", "lower") or (role != "front" and rng.random() < 0.6):
        dark = linear(176 - 50 * tone, 74, 78) * rng.uniform(0.25, 0.8)
    back = dark * np.exp(0.2 * clouds(shape, 8 * scale, rng))[..., None]
    return _blend(np.maximum(picture, 0), back, np.clip(-picture.min(-1), 0, 1))


def surround(
    picture: Array, mouth: Mouth, camera: Camera, role: str, opening: float,
    rng: np.random.Generator,
) -> tuple[Array, Array]:  # fmt: skip
    """Put the mouth into a face.

    Args:
        picture: [H, W, 3] linear light of the mouth.
        mouth, camera, role, opening: how it was rendered.
        rng: for everything random.

    Returns:
        The picture [H, W, 3], and how much of the mouth is covered [H, W] 0..1.
    """
    canvas = _canvas(mouth, camera, role, opening, rng)
    tone = mouth.options.gum_tone
    skin = np.random.default_rng([mouth.options.seed, 3])
    tone_at = np.clip(tone * 4 + skin.normal() * 0.9, 0, len(SKINS) - 1.001)
    low = int(tone_at)
    share = tone_at - low
    skin_color = (1 - share) * linear(*SKINS[low]) + share * linear(*SKINS[low + 1])
    smile = role == "front" and rng.random() < 0.10
    if role in ("upper", "lower"):
        inside = _around_arch(mouth, camera, canvas, role, opening)
    else:
        inside = _opening(canvas, role, opening, smile)
    picture, cover = _lips(picture, canvas, role, inside, skin_color, smile)
    picture, cover = _hands(picture, cover, canvas, role)
    return picture, cover


def _around_arch(mouth: Mouth, camera: Camera, canvas: Canvas, role: str, opening: float) -> Array:
    """Distance [H, W] inwards from lips that follow an arch seen from above or below, mm."""
    rng = canvas.rng
    row = mouth.rows[0 if role == "upper" else 1]
    line = row.arch.at(np.linspace(row.teeth[0].along, row.teeth[-1].along, 60))[0]
    back = line[[-1, 0]] + (0.0, 0.0, -60.0) + np.array([[12.0, 0, 0], [-12.0, 0, 0]])
    points = np.concatenate([line, back])
    if row.up < 0:
        motion = mouth.jaw_motion(opening)
        points = points @ motion[:3, :3].T + motion[:3, 3]
    outline = np.rint(camera.project(points)[:, :2]).astype(np.int32)
    pad = max(camera.width, camera.height)
    mask = np.zeros((camera.height + 2 * pad, camera.width + 2 * pad), np.uint8)
    cv2.fillPoly(mask, [outline + pad], 1)
    away = [cv2.distanceTransform(m, cv2.DIST_L2, 5) for m in (mask, 1 - mask)]
    signed = cv2.GaussianBlur(away[0] - away[1], (0, 0), 3.0 * canvas.scale)
    inside = np.asarray(signed[pad:-pad, pad:-pad], np.float64)
    uneven = 1.2 * clouds(inside.shape, 14 * canvas.scale, rng)
    return np.asarray(inside / canvas.scale + rng.uniform(3.5, 9.0) + uneven, np.float64)


def _opening(canvas: Canvas, role: str, opening: float, smile: bool) -> Array:
    """Distance [H, W] inwards from the rim of the lips, mm (negative outside)."""
    rng = canvas.rng
    if role == "front":
        half = rng.uniform(28, 46)
        top, bottom = rng.uniform(13, 30, 2)
    else:
        half = rng.uniform(22, 42)
        top, bottom = rng.uniform(12, 28, 2)
    if smile:
        half, top, bottom = rng.uniform(22, 32), rng.uniform(5, 11), rng.uniform(3, 9)
    top, bottom = top + 0.3 * opening, bottom + 0.6 * opening
    power = rng.uniform(1.8, 3.2)
    x = canvas.x + rng.normal() * 1.5
    lean = rng.normal() * 0.08
    y = canvas.y + rng.normal() * 1.0 + lean * x
    tall = np.where(y > 0, top, bottom)
    level = (np.abs(x / half) ** power + np.abs(y / tall) ** power) ** (1 / power)
    level = level + 0.03 * clouds(x.shape, 20 * canvas.scale, rng)
    return (1 - level) * min(half, (top + bottom) / 2)


def _lips(
    picture: Array, canvas: Canvas, role: str, inside: Array, skin: Array, smile: bool
) -> tuple[Array, Array]:
    """Lips, the skin around them, and a retractor that holds them."""
    rng, shape = canvas.rng, picture.shape[:2]
    out = -inside
    # The lips throw a shadow on what is behind them.
    shadow = 1 - rng.uniform(0.15, 0.7) * np.exp(-np.maximum(inside, 0) / rng.uniform(1.5, 6.0))
    picture = picture * shadow[..., None]

    wet = rng.uniform(2, 7)
    lip = wet + rng.uniform(5, 11)
    red = linear(*(rng.normal(size=3) * 10 + (188, 84, 88)).clip(0, 255)) * (0.5 + 0.5 * skin[0])
    vermilion = 0.55 * red + 0.45 * skin * (1.0, 0.75, 0.75)
    rough = clouds(shape, 1.2 * canvas.scale, rng)
    patches = clouds(shape, 9 * canvas.scale, rng)
    around = np.arctan2(canvas.y, canvas.x)
    wrinkles = np.sin(around * int(rng.integers(50, 90)) + 2.5 * patches) * smoothstep(
        wet, wet + 3, out
    )
    wrinkles = wrinkles * smoothstep(lip, lip - 2, out)
    edge = out + 0.5 * patches
    color = red + smoothstep(wet - 2, wet + 2, edge)[..., None] * (vermilion - red)
    color = color + smoothstep(lip - 1.0, lip + 1.0, edge)[..., None] * (skin - color)
    grain = 0.05 + 0.05 * rng.random()
    color = color * np.exp(0.10 * patches + grain * clouds(shape, 3, rng))[..., None]
    if rng.random() < 0.25:  # stubble
        hair = (rng.random(shape) > 0.985).astype(float) * smoothstep(lip + 2, lip + 8, edge)
        longer = cv2.dilate(hair, np.ones((max(2, int(canvas.scale * 0.3)), 1)))
        color = color * (1 - 0.7 * longer)[..., None]
    thick = rng.uniform(2.5, 5.5)
    height = thick * np.sin(np.clip(out / (wet + lip) * np.pi, 0, 0.62 * np.pi))
    height = height + 0.06 * wrinkles + 0.06 * rough + 0.25 * patches
    gloss = 0.55 * smoothstep(wet + 2, wet - 1, edge) + 0.12
    near = rng.uniform(0.55, 1.25)
    rim = near * canvas.lit(height, color, gloss)
    alpha = smoothstep(-0.35, 0.35, out)
    picture = _blend(picture, rim, alpha)
    cover = alpha
    chance = rng.random()
    if smile or chance < 0.22:
        return picture, cover
    sort = "clear" if chance < 0.72 else "white" if chance < 0.88 else "metal"
    return _retractor(picture, cover, canvas, out, sort, role)


def _retractor(
    picture: Array, cover: Array, canvas: Canvas, out: Array, sort: str, role: str
) -> tuple[Array, Array]:
    """A rim of plastic or metal along the lips: all around, or along one part of them."""
    rng = canvas.rng
    width = rng.uniform(2.0, 6.0) if sort != "metal" else rng.uniform(1.5, 3.0)
    start = rng.uniform(-1.5, 0.5)
    t = (out - start) / width
    body = smoothstep(0.0, 0.08, t) * smoothstep(1.0, 0.92, t)
    height = width * 0.5 * np.sqrt(np.clip(1 - (2 * t - 1) ** 2, 0, 1))
    around = np.arctan2(canvas.y, canvas.x)
    if rng.random() < 0.6:  # it holds the corners, or one of them
        middle = rng.choice([0.0, np.pi]) if role != "front" or rng.random() < 0.2 else None
        reach = rng.uniform(0.5, 1.6)
        away = (
            np.abs(np.angle(np.exp(1j * (around - middle))))
            if middle is not None
            else np.abs(np.angle(np.exp(2j * around))) / 2
        )
        body = body * smoothstep(reach, reach - 0.15, away)
    if sort == "clear":
        gy, gx = np.gradient(height * canvas.scale)
        v, u = np.mgrid[: out.shape[0], : out.shape[1]].astype(np.float32)
        push = 1.2 * canvas.scale
        bent = cv2.remap(
            picture.astype(np.float32),
            (u + push * np.clip(gx, -1.5, 1.5)).astype(np.float32),
            (v + push * np.clip(gy, -1.5, 1.5)).astype(np.float32),
            cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT,
        ).astype(np.float64)  # fmt: skip
        tint = linear(235, 228, 226)
        shine = canvas.lit(height, np.zeros(3), rng.uniform(0.6, 1.6), 25)
        lines = np.exp(-(((t - 0.12) / 0.05) ** 2)) + np.exp(-(((t - 0.88) / 0.06) ** 2))
        modulated = np.clip(0.5 + 0.6 * clouds(out.shape, 8 * canvas.scale, rng), 0, 1.4)
        haze = rng.uniform(0.06, 0.3)
        plastic = bent * (0.92 - haze) + haze * tint + shine * modulated[..., None]
        plastic = plastic + (0.35 * lines * modulated)[..., None]
        picture = _blend(picture, plastic, body)
    else:
        tone = linear(232, 230, 226) if sort == "white" else linear(120, 120, 124)
        tone = tone * rng.uniform(0.7, 1.0)
        if sort == "metal":
            height = height + 0.05 * clouds(out.shape, 4 * canvas.scale, rng)
        picture = _blend(
            picture, canvas.lit(height, tone, 0.4 if sort == "white" else 1.2, 30), body
        )
    return picture, np.maximum(cover, body)


def _capsule(
    canvas: Canvas, start: Array, end: Array, radius: float, taper: float = 1.0
) -> tuple[Array, Array, Array]:
    """Alpha, height (mm) and position along (0..1) of a rounded bar between two points, mm."""
    axis = end - start
    length = float(np.linalg.norm(axis))
    axis = axis / max(length, 1e-6)
    px, py = canvas.x - start[0], canvas.y - start[1]
    along = np.clip(px * axis[0] + py * axis[1], 0, length)
    size = radius * (1 + (taper - 1) * along / max(length, 1e-6))
    away = np.hypot(px - along * axis[0], py - along * axis[1]) / size
    blur = 0.5 / max(canvas.scale * radius, 1e-6)
    alpha = smoothstep(1 + blur, 1 - blur, away)
    return alpha, size * np.sqrt(np.clip(1 - away**2, 0, 1)), along / max(length, 1e-6)


def _hands(picture: Array, cover: Array, canvas: Canvas, role: str) -> tuple[Array, Array]:
    """Gloved or bare fingers, handles of retractors, a probe."""
    rng, shape = canvas.rng, picture.shape[:2]

    def lay(alpha: Array, layer: Array) -> None:
        nonlocal picture, cover
        cast = cv2.GaussianBlur(alpha, (0, 0), 1.2 * canvas.scale)
        picture = picture * (1 - 0.35 * cast * (1 - alpha))[..., None]
        picture = _blend(picture, layer, alpha)
        cover = np.maximum(cover, alpha)

    def rim_point(angle: float, reach: float) -> Array:
        return np.array([np.cos(angle) * 30 * reach, np.sin(angle) * 16 * reach])

    if rng.random() < 0.16:
        angle = rng.uniform(0, 2 * np.pi)
        tip = rim_point(angle, rng.uniform(0.9, 1.4))
        far = tip + 60 * np.array([np.cos(angle), np.sin(angle)]) + rng.normal(size=2) * 15
        color = linear(*GLOVES[int(rng.integers(len(GLOVES)))])
        if rng.random() < 0.2:
            color = linear(*SKINS[int(rng.integers(len(SKINS)))])
        for n in range(int(rng.integers(1, 3))):
            shift = np.array([-np.sin(angle), np.cos(angle)]) * 15 * n
            alpha, height, _ = _capsule(canvas, tip + shift, far + shift, rng.uniform(6, 9), 1.2)
            height = height + 0.12 * clouds(shape, 2.5 * canvas.scale, rng)
            lay(alpha, rng.uniform(0.5, 1.1) * canvas.lit(height, color, 0.15, 20))
    if role in ("right", "left") and rng.random() < 0.35:  # the handle of a clear retractor
        angle = rng.choice([-1, 1]) * rng.uniform(0.6, 2.5)
        tip = rim_point(angle, rng.uniform(1.0, 1.3))
        far = tip + 50 * np.array([np.cos(angle + rng.normal() * 0.8), np.sin(angle)])
        alpha, height, _ = _capsule(canvas, tip, far, rng.uniform(3, 6))
        shine = canvas.lit(height, np.zeros(3), 1.3, 30)
        haze = rng.uniform(0.1, 0.45)
        layer = picture * (1 - haze) + haze * linear(226, 220, 220) + shine
        lay(alpha, layer)
    if rng.random() < 0.07:
        tip = np.array([rng.uniform(-20, 20), rng.uniform(-5, 5)])
        up = 1.0 if rng.random() < 0.7 else -1.0
        bend = tip + np.array([rng.normal() * 2, up * rng.uniform(8, 16)])
        far = bend + np.array([rng.normal() * 12, up * 50])
        for a, b, radius in ((tip, bend, 0.3), (bend, far, 0.5)):
            alpha, height, t = _capsule(canvas, a, b, radius * rng.uniform(0.9, 1.5), 1.5)
            bands = 1 - 0.85 * (np.sin(t * 28) > 0.4) * (radius == 0.3)
            layer = canvas.lit(height, linear(110, 112, 116), 1.0, 12) * bands[..., None]
            lay(alpha, layer)
    return picture, cover
