"""Outlines of two rows of crowns whose shape is a formula."""

from __future__ import annotations

import numpy as np

from pipeline.artifacts.dental.fdi import Jaw
from stages.dentition.crowns import Outline

SIZE = (600, 400)
MIDDLE = np.array(SIZE) / 2
UPPER_WIDTHS = (44.0, 40.0, 50.0, 56.0, 56.0, 48.0, 42.0)
LOWER_WIDTHS = (40.0, 38.0, 36.0, 36.0, 38.0, 40.0)
HEIGHT, RISE, ROUND = 70.0, 16.0, 6.0


def shape(width: float, jaw: Jaw, bump: float = 0.0) -> np.ndarray:
    """[K, 2] crown about the middle of its biting edge: an arched gum line, rounded corners.

    Args:
        bump: place of the zenith along the row, share of half the width.
    """
    u = np.linspace(-1, 1, 41)
    reach = np.where(u > bump, 1 - bump, 1 + bump)
    gum = -HEIGHT + RISE * ((u - bump) / reach) ** 2
    edge = -ROUND * u**4
    points = np.concatenate(
        [np.stack([u, gum], 1), np.stack([u, edge], 1)[::-1]]
    ) * np.array([width / 2, 1])  # fmt: skip
    return points if jaw == "upper" else points * [1, -1]


def row(widths: tuple[float, ...], jaw: Jaw, gaps: dict[int, float] | None = None) -> list[float]:
    """Middles along the row, centred; gaps: index -> free space before the crown."""
    free = gaps or {}
    starts = np.cumsum([0.0, *widths[:-1]]) + np.cumsum(
        [free.get(k, 0) for k in range(len(widths))]
    )
    middles = starts + np.array(widths) / 2
    return list(middles - (starts[-1] + widths[-1]) / 2)


def turned(points: np.ndarray, degrees: float) -> np.ndarray:
    """Clockwise (y down) about the picture's middle."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return (points - MIDDLE) @ np.array([[c, s], [-s, c]]) + MIDDLE


def mouth(
    degrees: float = 0.0, jaws: tuple[Jaw, ...] = ("upper", "lower"), bump: float = 0.0,
    gaps: dict[int, float] | None = None, apart: float = 2.0,
) -> list[Outline]:  # fmt: skip
    """Two rows of crowns, the biting edges `apart`, turned clockwise."""
    outlines = []
    for jaw in jaws:
        widths = UPPER_WIDTHS if jaw == "upper" else LOWER_WIDTHS
        level = -apart / 2 if jaw == "upper" else apart / 2
        for k, (x, width) in enumerate(zip(row(widths, jaw, gaps), widths, strict=True)):
            points = shape(width, jaw, bump) + MIDDLE + [x, level]
            outlines.append(
                Outline(turned(points, degrees), jaw, 0.9, {11: 1.0}, number=k + 1, doubt=0.3)
            )
    return outlines
