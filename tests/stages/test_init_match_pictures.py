"""Matches drawn for people: which pairs, where the lines go, and what the table says."""

import json

import numpy as np

from pipeline.artifacts.views import View
from pipeline.stage import LocalContext
from stages.init.config import InitConfig
from stages.init.sfm.matching.pictures import (
    DIMMED,
    GAP,
    LONG_SIDE,
    Links,
    match_pictures,
    match_table,
    pairs_to_draw,
)
from stages.init.sfm.matching.two_view import Correspondences
from stages.init.write import save_matches


def grey(name, width=200, height=100):
    return View(name, np.full((height, width, 3), 0.4, np.float32))


def matches(*pairs):
    """Each pair: (x, y) in the first, (x, y) in the second."""
    first = np.array([a for a, _ in pairs], float).reshape(-1, 2)
    second = np.array([b for _, b in pairs], float).reshape(-1, 2)
    count = np.arange(len(pairs))
    return Correspondences(np.stack([count, count], 1), first, second, np.ones(len(pairs), bool))


def links(views, weights, used=(), found=None, verified=None):
    some = matches(((10, 10), (20, 20)))
    return Links(
        tuple(views), found or dict.fromkeys(weights, some),
        verified or dict.fromkeys(weights, np.array([0])), weights, frozenset(used),
    )  # fmt: skip


def test_the_pairs_that_hold_all_together_come_first():
    views = [grey(f"{k:03d}") for k in range(4)]
    weights = {(0, 1): 9.0, (1, 2): 8.0, (0, 2): 7.0, (2, 3): 1.0, (0, 3): 0.5}
    all_used = links(views, weights, weights)
    assert pairs_to_draw(all_used, 9) == [(0, 1), (1, 2), (2, 3), (0, 2), (0, 3)]
    assert pairs_to_draw(all_used, 2) == [(0, 1), (1, 2)]
    assert pairs_to_draw(links(views, weights, [(0, 2), (2, 3)]), 9) == [(0, 2), (2, 3)]
    assert pairs_to_draw(links(views, weights), 9)[:3] == [(0, 1), (1, 2), (2, 3)], "none used"
    assert pairs_to_draw(links(views, {}), 9) == []


def test_verified_matches_are_green_and_the_others_red():
    views = [grey("000"), grey("001", 150, 120)]
    found = {(0, 1): matches(((40, 20), (30, 20)), ((40, 80), (30, 80)))}
    drawn = match_pictures(links(views, {(0, 1): 1.0}, [(0, 1)], found, {(0, 1): np.array([0])}), 5)
    ((name, picture),) = drawn.items()
    assert name == "matches_000_001"
    assert picture.shape == (120, 200 + GAP + 150, 3)
    top, bottom = picture[20, 100].astype(int), picture[80, 100].astype(int)
    assert top[1] > top[0] + 50, "green"
    assert bottom[0] > bottom[1] + 50, "red"
    assert abs(int(picture[50, 100, 0]) - round(255 * 0.4 * DIMMED)) <= 1, "no line between them"
    assert (picture[110, :200] == 255).all(), "beneath the lower picture"
    assert (picture[:, 203] == 255).sum() > 300, "the gap"


def test_large_photographs_are_scaled_and_masks_darken():
    mask = np.zeros((600, 1200), bool)
    mask[:, 600:] = True
    view = View("000", np.full((600, 1200, 3), 0.8, np.float32), mask)
    found = {(0, 1): matches(((1199, 300), (1, 300)))}
    drawn = match_pictures(links([view, view], {(0, 1): 1.0}, (), found), 1)
    picture = drawn["matches_000_000"]
    assert picture.shape == (LONG_SIDE // 2, 2 * LONG_SIDE + GAP, 3)
    assert picture[10, 10, 0] < 0.5 * picture[10, LONG_SIDE - 10, 0]


def test_what_is_written(tmp_path):
    views = [grey("000"), grey("001"), grey("002")]
    some = links(views, {(0, 1): 2.0, (1, 2): 1.0}, [(0, 1)])
    assert match_table(some)["pairs"][1] == {
        "views": ["001", "002"], "matches": 1, "verified": 1, "evidence": 1.0, "used": False
    }  # fmt: skip
    written = []
    for name in ("a", "b"):
        context = LocalContext(InitConfig(), tmp_path / name)
        save_matches(context, some, 12)
        folder = tmp_path / name / "pictures"
        written.append({path.name: path.read_bytes() for path in folder.iterdir()})
        assert sorted(context.result("pictures").images) == ["matches_000_001"]
    assert written[0] == written[1]
    assert json.loads(written[0]["matches.json"]) == match_table(some)
