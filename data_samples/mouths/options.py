"""What varies from mouth to mouth: one frozen record per mouth, sampled at random."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

DENTITIONS = ("permanent", "primary", "mixed")
BITES = ("normal", "deep", "open", "edge", "reverse", "overjet")


@dataclass(frozen=True)
class MouthOptions:
    """One mouth.

    Attributes:
        dentition: permanent (11-48), primary (51-85), or mixed.
        missing: FDI numbers that are not there.
        bite: how the front teeth meet: normal, deep, open, edge (to edge), reverse (lower teeth in
            front), overjet (lower teeth far behind).
        overbite, overjet: of the central incisors, mm (vertical, horizontal).
        cross: the upper arch is narrower than normal on the right and left by this, mm.
        size: of all teeth and arches, 1 is the textbook.
        arch_width, arch_power: width of the arches against the textbook's at equal length; exponent
            of their shape (2 a parabola, 3 a U).
        size_spread: relative deviation of the size of each tooth.
        crown_height: of all crowns against their widths, 1 is the textbook.
        crowding: share of the front teeth's room that is lacking (negative: gaps all over).
        twist, shift, tilt: deviations of each tooth's rotation (deg), place (mm), and lean (deg).
        diastema: gap between the upper central incisors, mm.
        midline: shift of the lower jaw to the left, mm.
        recession: how far the gum has drawn back from the necks, mm (negative: it covers them).
        papilla: how well the gum fills the gaps between the teeth, 0..1.
        opening: gap between the front teeth in photographs with the teeth apart, mm.
        braces_upper, braces_lower: brackets and a wire.
        wear: 0..1, how much of the cusps and edges is worn off.
        shade: of enamel, 0 white to 1 yellow-brown; shade_spread: deviation of each tooth's.
        stains, plaque, translucency: 0..1.
        gum_tone: 0 pale pink to 1 dark; pigment, inflamed: 0..1.
        conditions: (FDI number, what) pairs: metal, gold, amalgam, filling, grey, caries, mottled.
        seed: of everything else.
    """

    dentition: str
    missing: tuple[int, ...]
    bite: str
    overbite: float
    overjet: float
    cross: tuple[float, float]
    size: float
    arch_width: float
    arch_power: float
    size_spread: float
    crown_height: float
    crowding: float
    twist: float
    shift: float
    tilt: float
    diastema: float
    midline: float
    recession: float
    papilla: float
    opening: float
    braces_upper: bool
    braces_lower: bool
    wear: float
    shade: float
    shade_spread: float
    stains: float
    plaque: float
    translucency: float
    gum_tone: float
    pigment: float
    inflamed: float
    conditions: tuple[tuple[int, str], ...]
    seed: int


def _overbite(bite: str, rng: np.random.Generator) -> tuple[float, float]:
    """Overbite and overjet in mm for a sort of bite."""
    low, high, near, far = {
        "normal": (1.0, 3.8, 1.8, 3.6),
        "deep": (4.0, 6.5, 1.8, 5.0),
        "open": (-5.0, -0.4, 1.0, 4.5),
        "edge": (-0.3, 0.4, -0.6, 0.8),
        "reverse": (0.3, 3.0, -3.5, -1.5),
        "overjet": (1.0, 5.0, 5.0, 9.0),
    }[bite]
    return float(rng.uniform(low, high)), float(rng.uniform(near, far))


def _missing(dentition: str, rng: np.random.Generator) -> tuple[int, ...]:
    """Teeth that were lost or have not come yet."""
    gone: set[int] = set()
    if dentition == "permanent":
        for quadrant in (1, 2, 3, 4):
            if rng.random() < 0.85:
                gone.add(10 * quadrant + 8)
            if rng.random() < 0.15:
                gone |= {10 * quadrant + 7, 10 * quadrant + 8}
        if rng.random() < 0.10:  # premolars taken out for an orthodontic treatment
            number = int(rng.choice([4, 5]))
            gone |= {10 * q + number for q in (1, 2, 3, 4)}
        for _ in range(int(rng.choice([0, 1, 2, 3, 6], p=[0.58, 0.18, 0.12, 0.07, 0.05]))):
            number = int(
                rng.choice([1, 2, 3, 4, 5, 6, 7], p=[0.07, 0.13, 0.05, 0.2, 0.2, 0.25, 0.1])
            )
            gone.add(10 * int(rng.integers(1, 5)) + number)
    else:
        for _ in range(int(rng.choice([0, 1, 2, 3], p=[0.55, 0.2, 0.15, 0.1]))):
            base = 50 if dentition == "primary" or rng.random() < 0.6 else 10
            if base == 50:
                number = int(rng.choice([1, 2, 3, 4, 5], p=[0.35, 0.2, 0.05, 0.25, 0.15]))
            else:
                number = int(rng.choice([1, 2], p=[0.3, 0.7]))
            gone.add(base + 10 * int(rng.integers(0, 4)) + number)
    return tuple(sorted(gone))


def _conditions(dentition: str, rng: np.random.Generator) -> tuple[tuple[int, str], ...]:
    """Teeth with something about them."""
    found: dict[int, str] = {}
    numbers = np.arange(1, 8 if dentition == "permanent" else 6)
    base = 0 if dentition == "permanent" else 40

    def some(what: str, count: int, weights: list[float]) -> None:
        share = np.array(weights[: len(numbers)])
        for _ in range(count):
            quadrant = int(rng.integers(1, 5))
            number = int(rng.choice(numbers, p=share / share.sum()))
            found[base + 10 * quadrant + number] = what

    back, any_ = [0.2, 0.2, 0.2, 1, 1.5, 3, 2], [1.0] * 7
    for what, chance, weights in (
        ("metal", 0.08, back),
        ("gold", 0.02, back),
        ("amalgam", 0.16, back),
        ("filling", 0.12, any_),
        ("grey", 0.08, any_),
        ("caries", 0.22, any_),
    ):
        if rng.random() < chance:
            some(what, int(rng.integers(1, 4)), weights)
    if rng.random() < 0.08:
        some("mottled", 14, any_)
    return tuple(sorted(found.items()))


def random_options(rng: np.random.Generator, **overrides: Any) -> MouthOptions:
    """Sample one mouth; overrides are attributes of `MouthOptions`, taken as they are.

    Raises:
        TypeError: for an override that is no attribute.
    """
    unknown = set(overrides) - {field.name for field in fields(MouthOptions)}
    if unknown:
        raise TypeError(f"no such options of a mouth: {sorted(unknown)}")
    dentition = overrides.get("dentition", str(rng.choice(DENTITIONS, p=[0.74, 0.14, 0.12])))
    bite = overrides.get("bite", str(rng.choice(BITES, p=[0.52, 0.14, 0.10, 0.08, 0.06, 0.10])))
    overbite, overjet = _overbite(bite, rng)
    untidy = float(rng.beta(1.1, 2.2))  # 0 a textbook row, 1 badly out of line
    young = dentition != "permanent"
    braces = not young and rng.random() < 0.10
    both = rng.random() < 0.75
    one_sided = float(rng.uniform(1.5, 4.5)) if rng.random() < 0.10 else 0.0
    two_sided = float(rng.uniform(1.5, 4.0)) if rng.random() < 0.05 else 0.0
    cross = (one_sided or two_sided, two_sided)
    crowding = 0.16 * untidy * rng.uniform(0, 1) if rng.random() < 0.7 else -0.09 * rng.random()
    if young:
        crowding = -0.10 * rng.random()
    old = float(rng.beta(1.0, 2.5)) * (not young)
    chosen: dict[str, Any] = {
        "dentition": dentition,
        "missing": _missing(dentition, rng),
        "bite": bite,
        "overbite": overbite * (0.7 if young else 1.0),
        "overjet": overjet * (0.8 if young else 1.0),
        "cross": cross if rng.random() < 0.5 else cross[::-1],
        "size": float(rng.normal(1.0, 0.04)),
        "arch_width": float(rng.normal(1.0, 0.06)),
        "arch_power": float(rng.uniform(2.0, 2.75)),
        "size_spread": float(rng.uniform(0.015, 0.05)),
        "crown_height": 1.0,
        "crowding": float(crowding),
        "twist": 3.0 + 14.0 * untidy,
        "shift": 0.2 + 1.1 * untidy,
        "tilt": 1.5 + 4.5 * untidy,
        "diastema": float(rng.uniform(0.6, 3.5)) if rng.random() < 0.12 else 0.0,
        "midline": float(rng.normal(0, 0.9)),
        "recession": float(2.6 * old * rng.random() - 0.8 * rng.random()),
        "papilla": float(np.clip(1.0 - 0.9 * old * rng.random(), 0.25, 1.0)),
        "opening": float(rng.choice([rng.uniform(1.0, 8.0), rng.uniform(8.0, 28.0)])),
        "braces_upper": bool(braces),
        "braces_lower": bool(braces and both),
        "wear": float(rng.beta(1.0, 3.0)),
        "shade": float(np.clip(rng.beta(1.3, 2.2), 0, 1)) * (0.45 if young else 1.0),
        "shade_spread": float(rng.uniform(0.03, 0.14)),
        "stains": float(rng.beta(1.0, 3.0)),
        "plaque": float(rng.beta(1.0, 3.5)),
        "translucency": float(rng.random()),
        "gum_tone": float(rng.beta(1.2, 1.8)),
        "pigment": float(rng.random()) if rng.random() < 0.35 else 0.0,
        "inflamed": float(rng.beta(1.0, 2.0)),
        "conditions": _conditions(dentition, rng),
        "seed": int(rng.integers(2**31)),
    }
    return MouthOptions(**{**chosen, **overrides})
