"""Brackets put on between two visits say nothing of what the teeth did."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.errors import ReconstructionError
from pipeline.studies.register.comparing import compare_visits
from pipeline.studies.register.visit import Look, Visit, teeth_points, without_braces
from tests.studies.register_case import MOVED, RADIUS, toy_centres, toy_motions, toy_visit

#: Half of a bracket's width, and how far it stands out, mm.
HALF, OUT = 1.6, 1.5
METAL = 0.1


def bracketed(look: Look) -> Look:
    """A black bracket on each crown, where it faces outwards."""
    image, depth = look.image.copy(), look.depth.copy()
    moved = toy_motions()
    for number, centre in toy_centres().items():
        motion = moved.get(number, np.eye(4))
        now = motion[:3, :3] @ centre + motion[:3, 3]
        outwards = (now - (0, now[1], -28)) / np.linalg.norm(now - (0, now[1], -28))
        away = np.linalg.norm(look.points - (now + RADIUS * outwards), axis=-1)
        on = (away < HALF) & (look.labels == number)
        image[on], depth[on] = METAL, depth[on] - OUT
    return replace(look, image=image, depth=depth)


def coloured(look: Look) -> np.ndarray:
    """[H, W, 3] yellowish enamel, grey metal, red around the crowns."""
    tint = np.where((look.image > 2 * METAL)[..., None], (1.05, 1.0, 0.8), (1.0, 1.0, 1.0))
    tint = np.where((look.labels > 0)[..., None], tint, (2.0, 0.6, 0.6))
    return (look.image[..., None] * tint).astype(np.float32)


def visit_of(looks: tuple[Look, ...]) -> Visit:
    return Visit("braces", looks, teeth_points(looks))


def upper(looks: tuple[Look, ...]) -> tuple[Look, ...]:
    """Photographs on which the upper teeth alone have numbers."""
    return tuple(replace(a, labels=np.where(a.labels < 30, a.labels, 0)) for a in looks)


def told(visit: Visit) -> Visit:
    return without_braces(visit, [coloured(look) for look in visit.looks])


def test_teeth_are_followed_under_braces_that_were_put_on() -> None:
    first = toy_visit("before")
    looks = tuple(bracketed(look) for look in toy_visit("after", toy_motions()).looks)
    with pytest.raises(ReconstructionError, match="two visits of one patient"):
        compare_visits(*(visit_of(upper(some[::2])) for some in (first.looks, looks)))
    found = compare_visits(first, told(visit_of(looks)))
    teeth = {tooth.tooth: tooth for tooth in found.teeth}
    assert set(MOVED) <= set(teeth)
    for number, (shift, _) in MOVED.items():
        assert teeth[number].displacement[:3] == pytest.approx(shift, abs=0.3)
    assert not [n for n, tooth in teeth.items() if tooth.certain and n not in MOVED]


def test_what_brackets_cover_is_told_and_painted_over() -> None:
    (plain,) = toy_visit("plain").looks[1:2]
    visit = visit_of((bracketed(plain),))
    (look,) = told(visit).looks
    metal = look.image == np.float32(METAL)
    assert look.hardware is not None
    assert look.hardware[metal].mean() > 0.95
    assert (look.hardware & (look.labels > 0)).sum() < 3 * metal.sum()
    assert not look.enamel[look.hardware].any()
    assert np.abs(look.without_hardware - plain.image)[metal].mean() < 0.1
    for number, centre in told(visit).centres.items():
        assert centre == pytest.approx(visit.centres[number]), "metal is part of where a tooth is"


def test_a_visit_without_braces_stays_as_it_is() -> None:
    visit = toy_visit("plain")
    assert told(visit) is visit
