"""Features and matching: known answers on made-up descriptors and textures."""

import cv2
import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from stages.init.sfm.matching.features import (
    Features,
    copies_of,
    describe,
    detect_features,
    joined,
    merge_points,
    reduced,
    squeezed,
)
from stages.init.sfm.matching.match import (
    candidate_pairs,
    match_features,
    overlap_counts,
    select_pairs,
)
from stages.init.sfm.reconstruct import weakly_linked
from tests.stages.init_scene import texture


def make_features(positions, descriptors):
    count = len(positions)
    return Features(
        positions=np.asarray(positions, np.float64),
        descriptors=np.asarray(descriptors, np.float32),
        scales=np.linspace(1, 9, count).astype(np.float32),
        squeezes=np.ones(count, np.float32),
        points=np.arange(count),
    )


def random_descriptors(count, seed):
    raw = np.random.default_rng(seed).gamma(0.5, 1.0, (count, 128))
    return np.rint(512 * raw / np.linalg.norm(raw, axis=1, keepdims=True)).astype(np.float32)


def pair_of_views(count=300, strangers=100, noise=4, seed=0):
    """Two views of `count` common keypoints, shuffled in the second, and of others."""
    rng = np.random.default_rng(seed)
    common = random_descriptors(count, seed)
    order = rng.permutation(count)
    first = make_features(
        rng.uniform(0, 500, (count + strangers, 2)),
        np.concatenate([common, random_descriptors(strangers, seed + 1)]),
    )
    shaken = np.clip(common[order] + np.rint(rng.normal(0, noise, (count, 128))), 0, 255)
    second = make_features(
        rng.uniform(0, 500, (count + strangers, 2)),
        np.concatenate([shaken, random_descriptors(strangers, seed + 2)]),
    )
    return first, second, {(int(i), k) for k, i in enumerate(order)}


def test_matches_are_the_true_ones():
    first, second, truth = pair_of_views()
    found = {(int(i), int(j)) for i, j in match_features(first, second)}
    assert len(found & truth) >= 0.97 * len(truth)
    assert len(found - truth) <= 3


def test_matches_do_not_depend_on_block_or_blas_threads(monkeypatch):
    first, second, _ = pair_of_views(400, 200, noise=12)
    expected = match_features(first, second)
    with threadpool_limits(2, "blas"):
        np.testing.assert_array_equal(match_features(first, second), expected)
    monkeypatch.setattr("stages.init.sfm.matching.match.BLOCK_ROWS", 37)
    np.testing.assert_array_equal(match_features(first, second), expected)


def test_a_second_candidate_elsewhere_makes_a_match_ambiguous_but_not_one_close_by():
    first, second, _ = pair_of_views(50, 0, noise=0)
    index = int(match_features(first, second)[0, 1])
    for offset, kept in ((1.0, True), (100.0, False)):
        twin = make_features(
            np.vstack([second.positions, second.positions[index] + offset]),
            np.vstack([second.descriptors, second.descriptors[index]]),
        )
        assert (len(match_features(first, twin)) == 50) is kept


def test_matches_between_the_same_cells_are_given_once():
    first, second, _ = pair_of_views(40, 0)
    doubled = [
        make_features(np.vstack([f.positions] * 2), np.vstack([f.descriptors] * 2))
        for f in (first, second)
    ]
    assert len(match_features(*doubled)) <= 40


def test_no_features_no_matches():
    first, _, _ = pair_of_views(20, 0)
    empty = make_features(np.zeros((0, 2)), np.zeros((0, 128)))
    assert match_features(first, empty).shape == (0, 2)
    assert match_features(empty, first).shape == (0, 2)


def test_overlap_is_larger_for_views_that_share_more():
    first, second, _ = pair_of_views(200, 0)
    _, stranger, _ = pair_of_views(200, 0, seed=50)
    counts = overlap_counts([first, second, stranger], [(0, 1), (0, 2)], 150)
    assert counts[0, 1] > 50 > 5 > counts[0, 2]


def test_candidate_pairs_of_a_sequence_grow_linearly():
    assert len(candidate_pairs(5, False, 4)) == 10
    assert len(candidate_pairs(100, False, 4)) == 4950
    pairs = candidate_pairs(100, True, 4)
    assert len(pairs) < 100 * 9
    assert {(0, 1), (0, 4), (0, 8), (0, 64), (98, 99)} <= set(pairs)
    assert (0, 5) not in pairs


def test_selected_pairs_are_each_views_best():
    counts = {(i, j): 100 - abs(i - j) for i in range(24) for j in range(i + 1, 24)}
    pairs = select_pairs(counts, 24, 4)
    assert len(pairs) <= 24 * 4
    assert {(k, k + 1) for k in range(23)} <= set(pairs)
    assert (0, 23) not in pairs


def test_merged_points_share_the_first_one_nearby():
    leaders = merge_points(np.array([[0, 0], [10, 0], [0.5, 0], [1.4, 0], [10, 1.0]]))
    np.testing.assert_array_equal(leaders, [0, 1, 0, 3, 1])
    assert merge_points(np.zeros((0, 2))).shape == (0,)


@pytest.mark.parametrize("squeeze", [1.0, 0.5])
def test_keypoints_of_a_squeezed_copy_lie_on_the_image(squeeze):
    gray = np.zeros((120, 160), np.uint8)
    cv2.GaussianBlur(cv2.circle(gray, (100, 60), 6, 255, -1), (0, 0), 2, dst=gray)
    assert squeezed(gray, squeeze).shape == (120, round(160 * squeeze))
    found = detect_features(gray, np.ones(gray.shape, bool), squeezes=(squeeze,))
    distance = np.linalg.norm(found.positions - (100.5, 60.5), axis=1)
    assert distance.min() < 0.5


def test_no_keypoints_outside_the_mask_and_the_same_ones_inside():
    gray = texture()
    mask = np.zeros(gray.shape, bool)
    mask[40:120, 30:90] = True
    everywhere = detect_features(gray, np.ones(gray.shape, bool))
    inside = detect_features(gray, mask)
    column, row = inside.positions.astype(int).T
    assert 20 < len(inside) < len(everywhere)
    assert mask[row, column].all()
    assert np.all(inside.descriptors == np.rint(inside.descriptors))
    np.testing.assert_allclose(np.linalg.norm(inside.descriptors, axis=1), 512, rtol=0.02)


@pytest.mark.parametrize("threads", [1, 3])
def test_features_found_on_several_threads_are_those_of_one(tmp_path, threads):
    grays, everywhere = [texture(seed) for seed in range(3)], np.ones((160, 200), bool)
    squeezes = (1.0, 0.5)
    copies = [copy for gray in grays for copy in copies_of(gray, squeezes, 0.0)]
    found = describe(copies, True, 0.002, 6000, threads, tmp_path)
    for view, gray in enumerate(grays):
        alone = detect_features(gray, everywhere, squeezes=squeezes)
        together = detect_features(
            gray, everywhere, squeezes=squeezes, described=found[2 * view : 2 * view + 2]
        )
        np.testing.assert_array_equal(together.positions, alone.positions)
        np.testing.assert_array_equal(together.descriptors, alone.descriptors)
        np.testing.assert_array_equal(together.scales, alone.scales)
    assert not list(tmp_path.iterdir())


def test_copies_that_come_later_leave_the_indices_of_features_as_they_are():
    gray, everywhere = texture(), np.ones((160, 200), bool)
    whole = detect_features(gray, everywhere, squeezes=(1.0, 0.71, 0.5))
    plain = detect_features(gray, everywhere, squeezes=(1.0,))
    both = joined(plain, detect_features(gray, everywhere, squeezes=(0.71, 0.5)))
    np.testing.assert_array_equal(both.points, whole.points)
    np.testing.assert_array_equal(both.positions, whole.positions)
    np.testing.assert_array_equal(whole.plain().positions, plain.positions)
    np.testing.assert_array_equal(whole.plain().points, plain.points)


def test_views_with_less_than_two_links_or_outside_the_largest_group_are_weak():
    ring = [(0, 1), (1, 2), (2, 3), (0, 3)]
    assert weakly_linked(ring, 4) == set()
    assert weakly_linked([(0, 1), (1, 2)], 3) == {0, 2}
    assert weakly_linked([*ring, (4, 5)], 6) == {4, 5}
    assert weakly_linked([(0, 1)], 2) == set()
    assert weakly_linked([], 2) == {0, 1}


def test_features_of_a_reduced_image_are_enlarged_to_its_own_pixels():
    small, inside = reduced(np.zeros((768, 1024), np.uint8), np.ones((768, 1024), bool), 640)
    assert small.shape == inside.shape == (480, 640)
    assert inside.all()
    features = make_features([[320.0, 240.0]], random_descriptors(1, 0)).enlarged((1.6, 1.6))
    np.testing.assert_allclose(features.positions, [[512.0, 384.0]])
    np.testing.assert_allclose(features.scales, [1.6])


def test_a_small_image_is_not_reduced():
    gray, valid = np.zeros((384, 512), np.uint8), np.ones((384, 512), bool)
    assert reduced(gray, valid, 640)[0] is gray
