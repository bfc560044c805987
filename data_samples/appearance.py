"""How enamel and gum look: procedural colour, bumps, and a flash beside the lens.

Everything is a function of the position on the tissue, so that the views agree with each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter, map_coordinates

Array = npt.NDArray[np.float64]


class Noise:
    """Smooth random fields over space: mean 0, deviation 1, features about one unit wide."""

    def __init__(self, seed: int, channels: int = 4, size: int = 64) -> None:
        random = np.random.default_rng(seed)
        blocks = [
            gaussian_filter(random.normal(size=(size,) * 3), 1.1, mode="wrap")
            for _ in range(channels)
        ]
        self._blocks = [np.asarray(block / block.std(), np.float32) for block in blocks]

    def __call__(self, points: Array, channel: int = 0) -> Array:
        """Values [...] at points [..., 3]."""
        flat = 2.5 * points.reshape(-1, 3).T
        block = self._blocks[channel]
        return map_coordinates(block, flat, order=1, mode="grid-wrap").reshape(points.shape[:-1])

    def octaves(self, points: Array, count: int, channel: int = 0) -> Array:
        """Sum of octaves, each half as large and half as strong; deviation about 1."""
        weights = 0.6 ** np.arange(count)
        parts = [w * self(points * 2.03**n + 7.3 * n, channel) for n, w in enumerate(weights)]
        return np.asarray(sum(parts) / np.sqrt((weights**2).sum()))

    def veins(self, points: Array, width: float, channel: int = 0) -> Array:
        """Thin sheets (lines on a surface), 1 in their middle, about `width` units wide."""
        return np.exp(-((self(points, channel) / (2.2 * width)) ** 2))


def linear(*srgb: float) -> Array:
    """An sRGB colour in 0..255 as linear light."""
    return (np.array(srgb) / 255) ** 2.2


def mix(low: Array, high: Array, amount: Array) -> Array:
    """Blend colours [..., 3] by an amount [...] in 0..1."""
    share = np.clip(amount, 0, 1)[..., None]
    return low * (1 - share) + high * share


@dataclass(frozen=True)
class Surface:
    """What the light needs to know of each point: albedo [N, 3], gloss [N], bump [N, 3]."""

    albedo: Array
    gloss: Array
    bump: Array


def enamel(local: Array, height: Array, tooth: Array, canine: Array, noise: Noise) -> Surface:
    """Colour of crowns.

    Args:
        local: [N, 3] along the arch, from the tip to the root, outwards, mm.
        height: [N] height of the crown.
        tooth: [N] which tooth it is.
        canine: [N] 1 for canines (which are yellower), else 0.
        noise: the random fields.
    """
    p = local + np.stack([11.7 * tooth, 5.1 * tooth, 3.3 * tooth], -1)
    t = local[:, 1] / height
    shade = noise(np.stack([tooth * 3.1, tooth * 1.7, tooth * 0.3], -1))  # each tooth its own
    color = mix(linear(226, 214, 180), linear(205, 172, 112), (t - 0.35) / 0.65)
    color = mix(color, linear(206, 178, 124), 0.45 * canine + 0.07 * shade)
    edge = np.exp(-((np.maximum(t, 0) / 0.13) ** 2)) * (0.6 + 0.25 * noise(p * (0.8, 0.2, 0.3), 1))
    color = mix(color, linear(176, 184, 184), edge)
    # Mottling from clouds of several mm down to grains.
    clouds = noise.octaves(p * (0.3, 0.22, 0.3), 2, 1)
    grains = noise.octaves(p * (1.7, 1.3, 1.7), 3, 2)
    color = color * np.exp(0.10 * clouds + 0.14 * grains)[:, None]
    spots = np.clip(noise.octaves(p * (0.75, 0.95, 0.75), 2, 3) - 1.25, 0, 1)
    color = mix(color, linear(246, 243, 232), 0.9 * spots)
    stains = np.clip(noise.octaves(p * (0.9, 0.6, 0.9), 3, 0) - 1.35 + 1.0 * (t - 0.4), 0, 1.0)
    color = mix(color, linear(134, 92, 48), 0.5 * stains)
    pits = np.clip(noise(p * 2.6, 1) - 2.0, 0, 1)
    color = mix(color, linear(110, 76, 42), 0.8 * pits)
    # Craze lines: mostly upright, wavy, some bright and some brown.
    bent = p + 0.35 * np.stack([noise(p * 0.8, c) for c in (1, 2, 3)], -1)
    present = np.clip(noise(p * 0.25, 2) + 0.55, 0, 1)
    cracks = noise.veins(bent * (0.42, 0.1, 0.25), 0.018, 3) * present
    color = mix(color, linear(120, 88, 54), 0.75 * cracks)
    light = noise.veins(bent * (0.33, 0.17, 0.3) + 31, 0.02, 0) * np.clip(present, 0, 1)
    color = mix(color, linear(248, 244, 232), 0.6 * light)
    neck = np.exp(-(((t - 0.97) / 0.07) ** 2)) * np.clip(0.5 + 0.5 * noise(p * 0.9, 2), 0, 1)
    color = mix(color, linear(150, 104, 58), 0.6 * neck)
    ripples = np.stack([noise(p * (0.8, 0.8, 0.8), c) for c in (0, 1, 2)], -1)
    fine = np.stack([noise(p * (1.2, 4.5, 1.2), c) for c in (1, 2, 3)], -1)
    return Surface(color, np.full(len(t), 0.8), 0.030 * ripples + 0.016 * fine)


def gum(local: Array, world: Array, noise: Noise) -> Surface:
    """Colour of gums.

    Args:
        local: [N, 3] along the arch, from the occlusal plane, from the gum's edge, mm.
        world: [N, 3] position, mm.
        noise: the random fields.
    """
    depth = local[:, 2]
    p = np.stack([local[:, 0], local[:, 1] + 60 * (world[:, 1] > 0), 0.3 * depth], -1)
    border = 4.4 + 0.7 * noise(p * 0.2, 1)  # where attached gum ends and loose mucosa begins
    loose = 1 / (1 + np.exp(-(depth - border) / 0.7))
    color = mix(linear(214, 138, 134), linear(186, 82, 86), loose)
    color = mix(color, linear(186, 84, 90), 0.65 * np.exp(-np.maximum(depth, 0) / 0.7))
    clouds = noise.octaves(p * 0.22, 3, 2)
    grains = noise.octaves(p * 1.5, 3, 3)
    color = color * np.exp(0.13 * clouds + 0.16 * grains)[:, None]
    color = mix(color, linear(232, 174, 166), 0.5 * (1 - loose) * np.clip(noise(p * 0.55, 0), 0, 1))
    bent = p + 0.7 * np.stack([noise(p * 0.45, c) for c in (0, 1, 2)], -1)
    for scale, width, strength, channel in (
        (0.16, 0.022, 0.85, 0),
        (0.34, 0.032, 0.8, 1),
        (0.75, 0.05, 0.6, 2),
    ):
        here = np.clip(noise(p * scale * 0.8 + 9, 3) + 0.5, 0, 1)
        veins = noise.veins(bent * scale, width, channel) * here
        color = mix(color, linear(126, 24, 40), strength * veins * (0.25 + 0.75 * loose))
    blue = np.clip(noise.octaves(p * 0.3 + 17, 2, 1) - 0.8, 0, 1) * loose
    color = mix(color, linear(128, 62, 88), 0.5 * blue)
    ripples = np.stack([noise(p * 0.42, c) for c in (1, 2, 3)], -1)
    stipple = np.stack([noise(p * 1.5, c) for c in (0, 1, 2)], -1)
    bump = 0.10 * ripples + (0.075 * (1 - loose) + 0.02)[:, None] * stipple
    wet = np.clip(0.75 + 0.3 * noise(p * 0.5, 2), 0.1, 1.2)
    return Surface(color, wet, bump)


def unit(vectors: Array) -> Array:
    """Vectors [..., 3] at length 1."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)


def shade(
    surface: Surface, normals: Array, points: Array, eye: Array, light: Array, openness: Array
) -> Array:
    """Light [N, 3] that reaches the lens, linear, about 1 for bright enamel.

    The flash falls off with the square of the distance; highlights are a narrow and a broad lobe
    about the half vector (Blinn-Phong).

    Args:
        surface: colour, gloss and bumps of the points.
        normals: [N, 3] unit normals.
        points: [N, 3] world positions.
        eye, light: [3] lens and flash.
        openness: [N] share of the sky that a point sees, 0..1.
    """

    to_eye, to_light = unit(eye - points), light - points
    away = np.linalg.norm(to_light, axis=-1)
    to_light = to_light / away[:, None]
    smooth = unit(normals * np.sign((normals * to_eye).sum(-1, keepdims=True)))
    bumpy = unit(smooth + surface.bump)
    falloff = (100.0 / away) ** 2
    # Half the diffuse light uses the smooth normal: tissue is translucent.
    diffuse = 0.5 * sum(np.clip((n * to_light).sum(-1), 0, 1) for n in (smooth, bumpy))
    half = np.clip((bumpy * unit(to_eye + to_light)).sum(-1), 0, 1)
    highlight = surface.gloss * (0.85 * half**260 + 0.10 * half**36)
    ambient = 0.10 * openness + 0.03
    shadowed = 0.35 + 0.65 * np.clip(openness * 1.6, 0, 1)
    received = (1.12 * falloff * diffuse * shadowed + ambient)[:, None]
    # Light that bounces in crevices takes on the tissue's colour.
    albedo = surface.albedo ** (1 + 0.5 * (1 - openness))[:, None]
    return albedo * received + (falloff * highlight * shadowed)[:, None]
