"""Enamel and gum under lights of their own, and what they say of whose mouth it is."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.artifacts.views import View
from stages.init.dental.cameras.unrolled import PairFigures
from stages.init.dental.numbering.arch_options import ArchOptions
from stages.init.dental.numbering.colours import ColourDistance, colour_distances
from stages.init.dental.numbering.confidence import (
    Evidence,
    _badly_exposed,
    _stranger,
    same_mouth,
)
from stages.init.dental.numbering.rivals import Margins
from stages.init.dental.place import of_several_days, one_sitting

ENAMEL, GUM = (0.62, 0.55, 0.42), (0.38, 0.16, 0.15)  # linear light


def photograph(
    enamel: tuple[float, ...] = ENAMEL, gum: tuple[float, ...] = GUM, gains: object = 1.0
) -> tuple[np.ndarray, SimpleNamespace]:
    """Six crowns in gum, as a camera with these gains shows them."""
    light = np.tile(np.array(gum), (120, 200, 1))
    mask = np.zeros((120, 200), bool)
    for x in range(20, 180, 27):
        mask[40:80, x : x + 22] = True
    light[mask] = enamel
    light = np.clip(light * gains, 0, 1) * np.random.default_rng(0).uniform(0.97, 1.03, light.shape)
    image = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return image.astype(np.float32), crowns(mask)


def crowns(mask: np.ndarray, on_jaws: np.ndarray | None = None) -> SimpleNamespace:
    """A dentition of this mask; without `on_jaws` all around it is gum."""
    everywhere = np.ones(mask.shape, bool)
    return SimpleNamespace(
        mask=mask, band_height=60.0, on_jaws_mask=everywhere if on_jaws is None else on_jaws
    )


def distances(*photographs: tuple[np.ndarray, SimpleNamespace]) -> list[ColourDistance]:
    images, dentitions = zip(*photographs, strict=True)
    return colour_distances(list(images), list(dentitions))


def test_a_white_balance_changes_hues_and_no_contrast() -> None:
    same = distances(photograph(), photograph(gains=0.8))
    assert max(d.one_light for d in same) < 1.5 and max(d.any_light for d in same) < 0.1
    other = distances(photograph(), photograph(gains=(1.15, 1.0, 0.85)))
    assert min(d.one_light for d in other) > 3
    assert max(d.any_light for d in other) < 0.1


def test_another_patients_gum_is_another_in_any_light() -> None:
    found = distances(photograph(), photograph(), photograph(gum=(0.30, 0.20, 0.22)))
    assert found[2].one_light > 3 and found[2].any_light > 3
    assert max(d.any_light for d in found[:2]) < 0.1


def test_brackets_are_not_the_colour_of_enamel() -> None:
    """A photograph shows more of them than the other, as that from the front does."""

    def braced(width: int) -> tuple[np.ndarray, SimpleNamespace]:
        image, dentition = photograph()
        for x in range(20, 180, 27):
            image[47:67, x + 11 - width // 2 : x + 11 + width // 2] = (0.25, 0.24, 0.26)
        return image, dentition

    found = distances(braced(10), braced(18))
    assert max(d.one_light for d in found) < 0.5 and max(d.any_light for d in found) < 0.1
    other = distances(braced(10), braced(18), photograph(gum=(0.30, 0.20, 0.22)))
    assert other[2].one_light > 3, "another patient's gum is another's beside braces, too"


def test_a_lip_and_the_dark_behind_an_open_bite_are_no_gum() -> None:
    image, dentition = photograph()
    on_jaws = np.ones(dentition.mask.shape, bool)
    on_jaws[:42] = on_jaws[76:110] = False
    covered = np.where((on_jaws | dentition.mask)[..., None], image, np.float32(0.02))
    told = distances(photograph(), (covered, crowns(dentition.mask, on_jaws)))
    assert max(max(d.one_light, d.any_light) for d in told) < 0.5
    assert min(d.one_light for d in distances(photograph(), (covered, dentition))) > 3
    # where all is taken for lip, it is better than nothing
    nowhere = crowns(dentition.mask, np.zeros_like(on_jaws))
    other = distances(photograph(), (photograph(gum=(0.30, 0.20, 0.22))[0], nowhere))
    assert min(d.one_light for d in other) > 3


def test_a_photograph_without_gum_says_nothing() -> None:
    image, dentition = photograph()
    everything = crowns(np.ones((120, 200), bool))
    found = distances((image, dentition), (image, everything))
    assert [(d.one_light, d.any_light) for d in found] == [(0.0, 0.0)] * 2


def evidence(one_light: float, any_light: float, common: float, share: float) -> Evidence:
    colours = [ColourDistance(1.0, 1.0)] * 2 + [ColourDistance(one_light, any_light)]
    pairs = {(0, 1): PairFigures(50, 0.04, 0.005), (1, 2): PairFigures(50, share, 0.005)}
    return Evidence(
        Margins(30.0, 30.0, 30.0), [60.0, 60.0, common], {}, colours, [100.0] * 3, pairs
    )


@pytest.mark.parametrize(
    ("one_light", "any_light", "common", "share", "same"),
    [
        (1.0, 1.0, 40.0, 0.0, True),  # one light: matches are not asked for
        (5.0, 1.0, 40.0, 0.03, True),  # another light, all else agrees
        (5.0, 1.0, 40.0, 0.0, False),  # ... but nothing matches
        (5.0, 5.0, 40.0, 0.03, False),  # ... but gum and enamel differ
        (5.0, 1.0, -60.0, 0.03, False),  # ... but the teeth stand elsewhere
    ],
)
def test_what_colours_no_longer_say_the_rest_must_make_good(
    one_light: float, any_light: float, common: float, share: float, same: bool
) -> None:
    found = same_mouth(evidence(one_light, any_light, common, share), ArchOptions())
    assert (found.sureness >= 0) == same
    assert found.odd == 2 or one_light == 1.0
    assert found.sureness == max(found.one_light, found.any_light)


def test_the_cameras_clock_speaks_for_one_mouth_or_against_it() -> None:
    seen = evidence(5.0, 1.0, 40.0, 0.01)
    unknown, one, several = (
        same_mouth(seen, ArchOptions(one_sitting=said)).sureness for said in (None, True, False)
    )
    assert several < unknown < one
    assert one - unknown == pytest.approx(unknown - several)


@pytest.mark.parametrize(
    ("times", "said"),
    [
        ((0.0, 60.0, 90.0), True),
        ((0.0, None, 90.0), None),
        ((0.0, 60.0, 7200.0), None),
        ((86400.0 * 12, 60.0, 0.0), False),
    ],
)
def test_a_sitting_is_some_minutes_and_days_are_several(
    times: tuple[float | None, ...], said: bool | None
) -> None:
    views = [
        View(name, np.zeros((4, 4, 3)), source_name=f"{name}.jpg", taken_after=t)
        for name, t in zip("abc", times, strict=True)
    ]
    assert one_sitting(views) is said
    warned = of_several_days(views)
    assert len(warned) == (said is False)
    assert said is not False or "a.jpg was taken 12 days after c.jpg" in warned[0]


def test_all_that_makes_a_photograph_a_stranger_is_named() -> None:
    told = _stranger("a.jpg", places_fit=False)
    assert all(cause in told for cause in ("another patient", "mirrored", "upside down"))


def test_a_photograph_with_far_too_much_or_too_little_light_is_called_so() -> None:
    found = distances(photograph(), photograph(), photograph(gains=2.5))
    assert max(d.white for d in found[:2]) < 0.01
    told = _badly_exposed("abc", found)
    assert "far too bright is c (" in told and "less light" in told and "darker" not in told
    assert not _badly_exposed("ab", found[:2])
    told = _badly_exposed("abc", distances(photograph(gains=0.25), photograph(), photograph()))
    assert "far too dark is a (4.0 times darker than the others)" in told and "more light" in told
