"""Flashes beside the lens, and how tissue throws their light back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from appearance import Surface, unit

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Light:
    """The light of one photograph.

    Attributes:
        flashes: [L, 3] positions in the world, mm, each as strong as the others.
        strength: of all flashes together at `reach`.
        reach: distance at which `strength` holds, mm.
        falloff: exponent of the fall with distance (2 for a point).
        ambient: light from everywhere.
        gloss: factor of all highlights.
    """

    flashes: Array
    strength: float
    reach: float
    falloff: float
    ambient: float
    gloss: float


def random_light(cam_from_world: Array, rng: np.random.Generator, plain: bool) -> Light:
    """One flash, two, or a ring about the lens."""
    rotation, translation = cam_from_world[:3, :3], cam_from_world[:3, 3]
    away = translation[2]
    sort = "one" if plain else str(rng.choice(["one", "two", "ring"], p=[0.35, 0.3, 0.35]))
    if sort == "one":
        angle = rng.uniform(0, 2 * np.pi)
        spots = np.array([[np.cos(angle), np.sin(angle), 0]]) * rng.uniform(0.03, 0.3) * away
    elif sort == "two":
        half = rng.uniform(0.12, 0.55) * away
        spots = np.array([[-half, 0, 0], [half, 0, 0]]) + rng.normal(size=3) * (5, 8, 0)
    else:
        angles = np.linspace(0, 2 * np.pi, 5)[:-1, None] + rng.random()
        circle = np.concatenate([np.cos(angles), np.sin(angles), 0 * angles], 1)
        spots = circle * rng.uniform(25, 45)
    return Light(
        (spots - translation) @ rotation, rng.uniform(1.0, 1.25), float(away),
        float(rng.uniform(1.5, 3.5) * (away / 150) ** 0.5), rng.uniform(0.03, 0.22),
        float(rng.uniform(0.4, 1.6)),
    )  # fmt: skip


def shade(
    surface: Surface, normals: Array, points: Array, eye: Array, light: Light, openness: Array
) -> Array:
    """Light [N, 3] that reaches the lens, linear, about 1 for bright enamel.

    As `appearance.shade`, for several flashes of any strength.

    Args:
        surface: colour, gloss and bumps of the points.
        normals: [N, 3] unit normals.
        points: [N, 3] world positions, mm.
        eye: [3] the lens.
        light: the flashes.
        openness: [N] share of the sky that a point sees, 0..1.
    """
    to_eye = unit(eye - points)
    smooth = unit(normals * np.sign((normals * to_eye).sum(-1, keepdims=True)))
    bumpy = unit(smooth + surface.bump)
    shadowed = 0.2 + 0.8 * np.clip(openness * 1.9, 0, 1)
    direct, highlight = np.zeros(len(points)), np.zeros(len(points))
    for flash in light.flashes:
        to_light = flash - points
        away = np.linalg.norm(to_light, axis=-1)
        to_light = to_light / away[:, None]
        falloff = (light.reach / away) ** light.falloff / len(light.flashes)
        # Tissue is translucent: light wraps about it, and half of it does not see the bumps.
        wrapped = [np.clip(((n * to_light).sum(-1) + 0.22) / 1.22, 0, 1) for n in (smooth, bumpy)]
        direct += falloff * 0.5 * (wrapped[0] + wrapped[1])
        half = np.clip((bumpy * unit(to_eye + to_light)).sum(-1), 0, 1)
        highlight += falloff * (1.1 * half**320 + 0.09 * half**30)
    received = light.strength * direct * shadowed + light.ambient * openness + 0.02
    # Light that bounces in crevices takes on the tissue's colour.
    albedo = surface.albedo ** (1 + 0.45 * (1 - openness))[:, None]
    shine = light.gloss * surface.gloss * highlight * np.clip(openness * 1.6, 0, 1)
    return albedo * received[:, None] + shine[:, None]
