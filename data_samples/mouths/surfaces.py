"""Colours and bumps of the tissues of one mouth (linear light)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from appearance import Noise, Surface, linear, mix
from gums import smoothstep

from .mouth import Mouth, Tissue

Array = npt.NDArray[np.float64]


def enamel(mouth: Mouth, local: Array, tooth: npt.NDArray[np.int32]) -> Surface:
    """Crowns: local positions [N, 3] on the teeth [N] of a mouth."""
    o, noise, teeth = mouth.options, mouth.noise, mouth.teeth
    rng = np.random.default_rng([o.seed, 11])
    own = rng.normal(size=len(teeth))[tooth]
    height = np.array([t.plan.height for t in teeth])[tooth]
    canine = np.array([t.plan.sort == "canine" for t in teeth], float)[tooth]
    milk = np.array([t.plan.primary for t in teeth], float)[tooth]
    what = dict(o.conditions)
    state = np.array([what.get(t.plan.fdi, "") for t in teeth])[tooth]
    p = local + np.stack([11.7 * tooth, 5.1 * tooth, 3.3 * tooth], -1)
    t = local[:, 1] / height

    yellow = np.clip(o.shade + o.shade_spread * own + 0.12 * canine - 0.5 * milk * o.shade, 0, 1.2)
    light = mix(linear(246, 244, 236), linear(226, 202, 154), yellow)
    neck = mix(linear(234, 224, 202), linear(196, 154, 98), yellow)
    color = mix(light, neck, smoothstep(0.3, 1.05, t))
    edge = np.exp(-((np.maximum(t, 0) / 0.12) ** 2)) * (0.6 + 0.25 * noise(p * (0.8, 0.2, 0.3), 1))
    color = mix(color, linear(168, 178, 182), edge * o.translucency * (1 - 0.6 * milk))
    color = (
        color
        * np.exp(0.05 * noise.octaves(p * (0.3, 0.22, 0.3), 2, 1) + 0.025 * noise(p * 1.5, 2))[
            :, None
        ]
    )
    white = np.clip(noise.octaves(p * (0.6, 0.8, 0.6), 2, 3) - 1.3, 0, 1)
    color = mix(color, linear(248, 246, 238), 0.8 * white)
    dirt = noise.octaves(p * (0.8, 0.6, 0.8), 3, 0)
    stain = smoothstep(0, 2.0, dirt - 2.1 + 1.3 * o.stains + 0.8 * (t - 0.4))
    color = mix(color, linear(134, 92, 48), 0.6 * stain)
    film = smoothstep(0.0, 1.4, smoothstep(0.55, 1.0, t) * o.plaque * 1.5 + 0.3 * dirt - 0.7)
    color = mix(color, linear(206, 176, 104), 0.7 * film)
    root = smoothstep(1.05, 1.25, t)
    color = mix(color, linear(196, 150, 92), 0.8 * root)
    gloss = 0.85 - 0.5 * film - 0.3 * root

    if o.conditions:
        shape = noise(p * 0.45, 2)
        for name, target, cover, shine in (
            ("metal", linear(150, 150, 152), np.full_like(t, 0.97), 2.0),
            ("gold", linear(206, 160, 74), np.full_like(t, 0.97), 2.0),
            ("grey", linear(132, 120, 104), np.full_like(t, 0.65), 0.8),
            (
                "filling",
                linear(232, 222, 200),
                smoothstep(0.1, 0.3, shape) * smoothstep(1.1, 0.8, t),
                0.7,
            ),
            ("amalgam", linear(70, 72, 78), smoothstep(0.5, 0.7, shape + 0.9 - 2.2 * t), 0.9),
            (
                "mottled",
                linear(120, 72, 34),
                0.8 * smoothstep(0.0, 1.8, dirt + 0.2) * smoothstep(1, 0.6, t),
                0.6,
            ),
        ):
            share = cover * (state == name)
            color, gloss = mix(color, target, share), gloss * (1 - share) + shine * share
        decay = (state == "caries") * smoothstep(0.9, 1.7, noise(p * 0.4, 1) + 0.7 * t)
        color = mix(color, linear(112, 66, 30), 0.85 * decay)
        color = mix(color, linear(28, 18, 12), smoothstep(0.6, 1.0, decay))
        gloss = gloss * (1 - 0.8 * decay)
    ripples = np.stack([noise(p * 0.7, c) for c in (0, 1, 2)], -1)
    return Surface(color, gloss, 0.035 * ripples)


def soft(mouth: Mouth, tissue: npt.NDArray[np.uint8], local: Array, world: Array) -> Surface:
    """Gums, mucosa, tongue and cheeks: what, where on the tissue, and where in the world."""
    o, noise = mouth.options, mouth.noise
    depth = local[:, 2]
    p = np.stack([local[:, 0], local[:, 1] + 60 * (world[:, 1] > 0), 0.3 * depth], -1)
    border = 4.4 + 0.8 * noise(p * 0.2, 1)  # where attached gum ends and loose mucosa begins
    loose = 1 / (1 + np.exp(-(depth - border) / 0.8))
    pale = mix(linear(236, 170, 168), linear(160, 84, 78), np.full_like(depth, o.gum_tone))
    deep = mix(linear(214, 112, 122), linear(140, 40, 46), np.full_like(depth, o.gum_tone))
    color = mix(pale, deep, loose)
    margin = np.exp(-np.maximum(depth, 0) / (0.6 + 1.6 * o.inflamed))
    swollen = margin * (0.35 + 0.65 * o.inflamed * (0.6 + 0.4 * noise(p * 0.3, 2)))
    color = mix(color, linear(176, 50, 62), swollen)
    color = color * np.exp(0.08 * noise.octaves(p * 0.22, 2, 2) + 0.05 * noise(p * 1.4, 3))[:, None]
    color = mix(color, linear(240, 190, 184), 0.5 * (1 - loose) * np.clip(noise(p * 0.5, 0), 0, 1))
    if o.pigment:
        dark = np.exp(-(((depth - 3.0) / 2.6) ** 2)) * smoothstep(
            -0.6, 0.9, noise.octaves(p * 0.16, 2, 0)
        )
        color = mix(color, linear(74, 38, 34), 0.75 * o.pigment * dark)
    gum = tissue == Tissue.GUM
    bent = p + 0.8 * np.stack([noise(p * 0.4, c) for c in (0, 1, 2)], -1)
    for scale, width, strength, channel in (
        (0.15, 0.022, 0.5, 0),
        (0.34, 0.03, 0.5, 1),
        (0.8, 0.05, 0.35, 2),
    ):
        here = np.clip(noise(p * scale * 0.8 + 9, 3) + 0.5, 0, 1)
        veins = noise.veins(bent * scale, width, channel) * here * (0.12 + 0.88 * loose)
        color = mix(color, linear(142, 26, 44), strength * veins * (tissue != Tissue.TONGUE))
    streaks = noise(bent * (0.9, 0.08, 0.2), 1) * loose * gum
    color = color * np.exp(0.07 * streaks)[:, None]
    other = mix(linear(206, 120, 116), linear(150, 70, 66), np.full_like(depth, o.gum_tone))
    palate = tissue == Tissue.MUCOSA
    color = np.where(palate[:, None], 0.4 * color + 0.6 * other, color)
    tongue = tissue == Tissue.TONGUE
    rough = np.exp(0.16 * noise(p[tongue] * 1.6, 1) + 0.1 * noise.octaves(p[tongue] * 0.3, 2, 2))
    color[tongue] = linear(196, 112, 112) * rough[:, None]
    ripples = np.stack([noise(p * 0.42, c) for c in (1, 2, 3)], -1)
    stipple = np.stack([noise(p * 1.5, c) for c in (0, 1, 2)], -1)
    bump = 0.12 * ripples + (0.07 * (1 - loose) + 0.025 + 0.15 * tongue)[:, None] * stipple
    wet = np.clip(0.75 + 0.35 * noise(p * 0.5, 2), 0.1, 1.3) * np.where(tongue, 0.3, 1.0)
    return Surface(color, wet, bump)


def metal(noise: Noise, world: Array, dark: float) -> Surface:
    """Brackets and wires."""
    tone = 196 - 130 * dark
    color = np.tile(linear(tone, tone, tone + 4), (len(world), 1))
    bump = 0.25 * np.stack([noise(world * 0.9, c) for c in (1, 2, 3)], -1)
    return Surface(color, np.full(len(world), 2.2), bump)
