"""The camera's electronics: exposure, colour, contrast, blur, noise, JPEG."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def develop(picture: Array, rng: np.random.Generator, plain: bool) -> npt.NDArray[np.uint8]:
    """[H, W, 3] linear light to 8-bit sRGB."""
    picture = np.maximum(picture, 0)
    if plain:
        blurred = cv2.GaussianBlur(picture, (0, 0), 0.45)
        return np.asarray(np.rint(255 * np.clip(blurred, 0, 1) ** (1 / 2.2)), np.uint8)
    height, width = picture.shape[:2]
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    fade = 1 - rng.uniform(0, 0.3) * (x**2 + y**2) / 2 + rng.normal() * 0.08 * x
    fade = fade + rng.normal() * 0.08 * y
    exposure = 2 ** float(np.clip(rng.normal() * 0.42 - 0.05, -1.2, 1.1))
    tint = np.exp(rng.normal(size=3) * (0.10, 0.04, 0.14) + (0.0, -0.04, 0.08))
    tint /= tint.mean()
    light = picture * np.maximum(fade, 0.3)[..., None] * exposure * tint
    blur = float(rng.choice([0.3, 0.5, 0.9, 1.6], p=[0.5, 0.3, 0.14, 0.06])) * width / 448
    light = cv2.GaussianBlur(light, (0, 0), max(blur, 0.3))
    if rng.random() < 0.08:  # shaken
        length = int(rng.integers(3, 7))
        kernel = np.zeros((length, length))
        cv2.line(kernel, (0, int(rng.integers(length))), (length - 1, int(rng.integers(length))), 1)
        light = cv2.filter2D(light, -1, kernel / kernel.sum())
    glow = cv2.GaussianBlur(np.clip(light, 0, 1.2), (0, 0), width / 30)
    light = light + rng.uniform(0, 0.08) * glow
    grain = float(np.exp(rng.uniform(np.log(0.2), np.log(6))))
    noise = rng.normal(size=light.shape)
    if rng.random() < 0.5:  # coarser grains after a camera's own smoothing
        noise = cv2.GaussianBlur(noise, (0, 0), 0.7) * 1.8
    light = light + noise * np.sqrt(grain * (3e-6 + 6e-5 * np.maximum(light, 0)))
    shoulder = rng.uniform(0.5, 0.95)  # soft clipping of the brightest parts
    light = np.clip(light, 0, None)
    over = np.maximum(light - shoulder, 0)
    light = np.minimum(light, shoulder) + (1 - shoulder) * (
        1 - np.exp(-over / max(1 - shoulder, 0.02))
    )
    srgb = np.clip(light, 0, 1) ** (1 / 2.2)
    contrast = rng.uniform(0, 0.8)
    srgb = srgb * (1 - contrast) + contrast * (srgb * srgb * (3 - 2 * srgb))
    grey = srgb.mean(-1, keepdims=True)
    srgb = grey + (srgb - grey) * rng.uniform(0.9, 1.35)
    pixels = np.rint(255 * np.clip(srgb, 0, 1)).astype(np.uint8)
    quality = int(rng.integers(55, 97))
    _, data = cv2.imencode(".jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert decoded is not None  # it was encoded just above
    return np.asarray(decoded[..., ::-1], np.uint8, order="C")
