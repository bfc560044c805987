"""Teeth and gum told from lips, cheeks and retractors, on generated mouths."""

from __future__ import annotations

import functools

import numpy as np

from data_samples.mouths import Photograph, photograph, random_mouth
from pipeline.artifacts.teeth import Dentition, filled_polygons
from stages.dentition.crowns import mirrored_dentition
from stages.teeth.read import read_photograph


@functools.cache
def mouth_with_lips() -> tuple[Photograph, Dentition]:
    """The front of a mouth with lips and cheeks, and what the reader says of it."""
    rng = np.random.default_rng(24)
    mouth = random_mouth(rng, dentition="permanent", conditions=())
    photo = photograph(mouth, rng, "front", width=448, height=336, bite="closed")
    image = photo.image.astype(np.float32) / np.float32(255)
    valid = np.ones(photo.labels.shape, bool)
    return photo, read_photograph(image, valid, "000").dentition


def test_lips_and_cheeks_are_told_from_teeth_and_gum() -> None:
    photo, dentition = mouth_with_lips()
    truth = photo.gum | (photo.labels > 0)
    assert 0.2 < truth.mean() < 0.9  # there is something of either
    found = dentition.on_jaws_mask
    assert (found & truth).sum() / (found | truth).sum() > 0.85
    gum = photo.gum
    assert found[gum].mean() > 0.9


def test_nothing_is_told_of_where_the_photograph_does_not_count() -> None:
    photo, _ = mouth_with_lips()
    image = photo.image.astype(np.float32) / np.float32(255)
    valid = np.ones(photo.labels.shape, bool)
    valid[:, :200] = False
    on_jaws = read_photograph(image, valid, "000").dentition.on_jaws
    assert on_jaws
    size = (photo.labels.shape[1], photo.labels.shape[0])
    assert not filled_polygons(on_jaws, size)[:, :196].any()


def test_a_picture_turned_over_shows_the_same() -> None:
    dentition = mouth_with_lips()[1]
    over = mirrored_dentition(dentition).on_jaws_mask
    assert (over[:, ::-1] == dentition.on_jaws_mask).mean() > 0.995
