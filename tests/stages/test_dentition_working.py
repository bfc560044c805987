"""Teeth at one working size: there and back without loss, whatever the photographs' size."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from pipeline.artifacts.teeth import Teeth
from pipeline.artifacts.views import View
from stages.dentition.crowns import Outline, dentition_of
from stages.dentition.working import resized_dentition, working_view

SIZE = (512, 384)


def row_of_teeth():
    """Six crowns at odd places of a small photograph."""
    square = np.array([[0, 0], [50, 0], [50, 61], [0, 61]])
    outlines = [
        Outline(square + np.array([60.123 + 51.37 * k, 100.077 + 70 * (jaw == "lower")]), jaw)
        for jaw in ("upper", "lower")
        for k in range(3)
    ]
    gum = np.array([[30.111, 60.333], [300.457, 70.2], [290.9, 330.05], [25.0, 310.77]])
    return replace(dentition_of(outlines, "000", SIZE, "front"), on_jaws=(gum,))


def written(dentition, folder):
    folder.mkdir()
    Teeth((dentition,)).save(folder)
    return Teeth.load(folder).views[0]


@pytest.mark.parametrize("size", [(1024, 768), (1280, 960), (2048, 1536), (1000, 750)])
def test_teeth_that_were_enlarged_and_written_come_back_the_same(size, tmp_path):
    small = row_of_teeth()
    there = written(resized_dentition(small, size), tmp_path / "large")
    back = written(resized_dentition(there, SIZE), tmp_path / "back")
    assert back.size == SIZE
    written(small, tmp_path / "small")
    first, second = (
        json.loads((tmp_path / name / "teeth.json").read_text()) for name in ("small", "back")
    )
    assert first == second


def test_teeth_are_enlarged_with_the_photograph():
    small = row_of_teeth()
    large = resized_dentition(small, (1024, 768))
    assert large.mask.shape == (768, 1024)
    assert large.mask.sum() == pytest.approx(4 * small.mask.sum(), rel=0.05)
    share = large.on_jaws_mask.mean() / small.on_jaws_mask.mean()
    assert share == pytest.approx(1, rel=0.02)
    assert large.band_height == pytest.approx(2 * small.band_height, abs=0.02)


def test_a_photograph_reduced_is_the_one_that_was_prepared_small():
    pixels = np.random.default_rng(0).integers(0, 256, (768, 1024, 3), dtype=np.uint8)
    small = cv2.resize(pixels, SIZE, interpolation=cv2.INTER_AREA)
    mask = np.zeros((768, 1024), bool)
    mask[:, 512:] = True
    view = View("000", pixels.astype(np.float32) / np.float32(255), mask, focal_px=2000.0)
    reduced = working_view(view)
    np.testing.assert_array_equal(reduced.image, small.astype(np.float32) / np.float32(255))
    assert reduced.mask is not None
    assert reduced.mask[:, 256:].all() and not reduced.mask[:, :256].any()
    assert reduced.focal_px == 1000.0
    assert working_view(reduced) is reduced
    assert working_view(replace(view, mask=None)).mask is None
