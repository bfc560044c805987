"""Dense stereo on a rendered scene with exact depth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.artifacts.confidence import COMPLETED
from pipeline.geometry.normals import depth_normals
from stages.stereo.aggregate import aggregate, decide
from stages.stereo.appearance import highlights, to_gray
from stages.stereo.fill import continued
from stages.stereo.options import DenseOptions, DenseView
from stages.stereo.polish import polish, source_maps
from stages.stereo.reconstruct import dense_depths
from stages.stereo.sgbm import sgbm_depth
from stages.stereo.sources import inverse_depth_range, scene_points, select_sources
from stages.stereo.sweep import cost_volume, stack_sources
from stages.stereo.tiles import TILE, Volume, full_ranges, ranges_around, tile_grid
from tests.stages.dense_scene import camera, render, scene

# On so small an image depth changes four times as fast from pixel to pixel: smaller penalties.
OPTIONS = DenseOptions(planes=48, max_planes=48, speckle=10, p1=0.02, p2=0.5)
DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "scan_video_a"


def everywhere(images: list[np.ndarray]) -> list[np.ndarray]:
    return [np.ones(image.shape[:2], bool) for image in images]


def relative_error(found: DenseView, truth: np.ndarray) -> np.ndarray:
    known = found.depth > 0
    return np.abs(found.depth - truth)[known] / truth[known]


def same(a: list[DenseView], b: list[DenseView]) -> bool:
    fields = ("depth", "confidence", "normal", "filled")
    return all(
        getattr(x, name).tobytes() == getattr(y, name).tobytes()
        for x, y in zip(a, b, strict=True)
        for name in fields
    )


@pytest.fixture(scope="module")
def three():
    cameras, images, depths, sparse = scene((-9.0, 0.0, 9.0))
    calls: list[tuple[int, int]] = []
    found = dense_depths(
        images, everywhere(images), cameras, sparse, OPTIONS, 2, lambda *step: calls.append(step)
    )
    return cameras, images, depths, sparse, found, calls


def test_depth_is_right_and_most_of_it_is_there(three):
    _, _, depths, _, found, calls = three
    for view, truth in zip(found, depths, strict=True):
        error = relative_error(view, truth)
        assert (view.depth > 0).mean() > 0.55
        assert np.median(error) < 0.003
        assert np.percentile(error, 95) < 0.03
    assert calls == [(1, 3), (2, 3), (3, 3)]


def test_the_quick_preview_is_right_where_it_says_something():
    cameras, images, depths, sparse = scene((-6.0, 0.0, 6.0))
    quick = replace(OPTIONS, method="sgbm")
    found = dense_depths(images, everywhere(images), cameras, sparse, quick, 2, lambda *_: None)
    for view, truth in zip(found, depths, strict=True):
        assert (view.depth > 0).mean() > 0.3
        assert np.median(relative_error(view, truth)) < 0.012
    again = dense_depths(images, everywhere(images), cameras, sparse, quick, 1, lambda *_: None)
    assert same(found, again)


@pytest.mark.parametrize("angle", [25.0, 50.0])
def test_the_quick_preview_of_views_whose_matches_are_partly_outside(angle):
    cameras, images, depths, sparse = scene((-angle, 0.0, angle))
    quick = replace(OPTIONS, method="sgbm")
    found = dense_depths(images, everywhere(images), cameras, sparse, quick, 2, lambda *_: None)
    for view, truth in zip(found, depths, strict=True):
        assert (view.depth > 0).mean() > (0.1 if angle < 30 else -1)
        assert not (view.depth > 0).any() or np.median(relative_error(view, truth)) < 0.012


def test_the_quick_preview_of_views_above_each_other():
    """The scene turned by a quarter: rectified lines are columns."""
    cameras, images, depths, _ = scene((-6.0, 6.0))
    turn = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    upright = [
        replace(
            camera, width=camera.height, height=camera.width, fx=camera.fy, fy=camera.fx,
            cx=camera.cy, cy=camera.width - camera.cx, cam_from_world=turn @ camera.cam_from_world,
        )
        for camera in cameras
    ]  # fmt: skip
    grays = [to_gray(np.ascontiguousarray(np.rot90(image))) for image in images]
    truth = np.rot90(depths[0])
    all_of_it = np.ones(truth.shape, bool)
    ends = (1 / truth.max(), 1 / truth.min())
    found = sgbm_depth(grays[0], all_of_it, upright[0], grays[1], all_of_it, upright[1], ends, 5)
    known = found > 0
    assert known.mean() > 0.3
    assert np.median(np.abs(found - truth)[known] / truth[known]) < 0.012


def test_confidence_is_one_only_where_nothing_is_known_and_higher_where_depth_is_better(three):
    _, _, depths, _, found, _ = three
    error = np.concatenate([relative_error(v, t) for v, t in zip(found, depths, strict=True)])
    trust = np.concatenate([v.confidence[v.depth > 0] for v in found])
    for view in found:
        guessed = (view.depth == 0) & (view.filled > 0)
        assert (view.confidence >= 1).all()
        assert (view.confidence[view.filled == 0] == 1).all()
        assert ((view.confidence[guessed] > 1) & (view.confidence[guessed] < COMPLETED)).all()
        assert (view.confidence[view.depth > 0] > 1.25).all()
    low, high = trust < np.quantile(trust, 0.2), trust > np.quantile(trust, 0.8)
    assert np.percentile(error[high], 90) < np.percentile(error[low], 90)


def test_fill_agrees_with_depth_and_never_stands_before_another_view_s_surface(three):
    cameras, _, _, _, found, _ = three
    for k, view in enumerate(found):
        known = view.depth > 0
        assert np.array_equal(view.filled[known], view.depth[known])
        guessed = ~known & (view.filled > 0)
        assert guessed.any()
        points = cameras[k].unproject(view.filled)[guessed]
        for other, lens in zip(found, cameras, strict=True):
            pixels, depth = lens.project(points)
            cell = np.floor(pixels).astype(int)
            inside = ((cell >= 0) & (cell < (lens.width, lens.height))).all(1)
            seen = other.depth[cell[inside, 1], cell[inside, 0]]
            assert not ((seen > 0) & (depth[inside] < seen * 0.979)).any()


def test_normals_of_the_ball(three):
    cameras, _, depths, _, found, _ = three
    points = cameras[1].unproject(depths[1])
    outward = points - np.array([0.0, 0.0, 3.6])
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    centre = np.zeros(depths[1].shape, bool)
    centre[38:58, 52:76] = True
    centre &= found[1].depth > 0
    cosine = (found[1].normal * outward).sum(-1)[centre]
    assert np.median(cosine) > 0.95
    exact = depth_normals(depths[1], np.ones_like(depths[1]), cameras[1], 1.0)
    assert np.median((exact * outward).sum(-1)[38:58, 52:76]) > 0.995


def test_any_thread_count_gives_the_same_bytes(three):
    cameras, images, _, sparse, found, _ = three
    alone = dense_depths(images, everywhere(images), cameras, sparse, OPTIONS, 1)
    assert same(alone, found)


def test_masked_pixels_get_nothing_and_are_not_used(three):
    cameras, images, depths, sparse, _, _ = three
    valid = everywhere(images)
    for mask in valid:
        mask[:, :40] = False
    spoiled = [image.copy() for image in images]
    for image in spoiled:
        image[:, :40] = np.random.default_rng(0).random((96, 40, 3), np.float32)
    found = dense_depths(spoiled, valid, cameras, sparse, OPTIONS, 2)
    clean = dense_depths(images, valid, cameras, sparse, OPTIONS, 2)
    for view, untouched, truth in zip(found, clean, depths, strict=True):
        assert (view.depth[:, :40] == 0).all()
        assert (view.filled[:, :40] == 0).all()
        assert (view.confidence[:, :40] == 1).all()
        assert np.median(relative_error(view, truth)) < 0.003
        # What is masked must not reach what is not, but for the penalty at the mask's edge.
        assert np.mean(view.depth[:, 44:] != untouched.depth[:, 44:]) < 0.2


def test_views_of_different_size():
    cameras, images, depths, sparse = scene((-9.0, 0.0, 9.0), ((128, 96), (112, 84), (96, 110)))
    found = dense_depths(images, everywhere(images), cameras, sparse, OPTIONS, 2)
    for view, truth in zip(found, depths, strict=True):
        assert view.depth.shape == view.filled.shape == truth.shape
        assert view.normal.shape == (*truth.shape, 3)
        assert np.median(relative_error(view, truth)) < 0.004


def test_views_that_cannot_be_compared_give_no_depth():
    cameras, images, _, sparse = scene((0.0, 0.0))
    found = dense_depths(images, everywhere(images), cameras, sparse, OPTIONS, 1)
    for view in found:
        assert not view.depth.any()
        assert (view.confidence == 1).all()
    single = dense_depths(images[:1], everywhere(images[:1]), cameras[:1], sparse[:1], OPTIONS, 1)
    assert not single[0].depth.any()


def test_a_backdrop_without_texture_falls_behind(three):
    cameras, images, depths, sparse, _, _ = three
    dark = [
        np.where((depth > 4.1)[..., None], np.float32(0.03), image)
        for image, depth in zip(images, depths, strict=True)
    ]
    found = dense_depths(dark, everywhere(dark), cameras, sparse, OPTIONS, 2)
    for view, truth in zip(found, depths, strict=True):
        backdrop = (truth > 4.1) & (view.depth == 0)
        assert backdrop.mean() > 0.3
        guess = view.filled[backdrop]
        assert (guess > 0).mean() > 0.9
        known = view.depth[view.depth > 0]
        assert np.percentile(guess[guess > 0], 10) > np.percentile(known, 80)
        assert np.median(guess[guess > 0]) > known.max()


def test_highlights_are_found_and_bright_enamel_is_not():
    image = np.full((60, 80, 3), (0.86, 0.82, 0.68), np.float32)
    image[20:26, 30:38] = 1.0
    image[:, 60:] = (0.7, 0.4, 0.4)
    image[40:44, 66:70] = (0.8, 0.7, 0.7)
    bright = highlights(image, grow=0) > 0
    assert bright[20:26, 30:38].all()
    assert bright[40:44, 66:70].all()
    assert bright.sum() == 6 * 8 + 4 * 4


def test_sources_have_a_useful_angle_and_lie_on_both_sides():
    angles = (-40.0, -12.0, -1.0, 0.0, 11.0, 14.0, 80.0)
    cameras = [camera(f"{k}", angle) for k, angle in enumerate(angles)]
    _, depth = render(cameras[3])
    points = cameras[3].unproject(depth).reshape(-1, 3)[::50]
    chosen = select_sources(3, cameras, points, 3)
    assert set(chosen[:2]) in ({1, 4}, {1, 5})
    assert 2 not in chosen
    assert 6 not in select_sources(3, cameras, points, 6)


def test_depth_range_holds_the_scene_though_sparse_points_have_outliers(three):
    cameras, _, depths, sparse, _, _ = three
    points = scene_points(cameras, sparse)
    points[1] = np.concatenate([points[1], [[*cameras[1].centre[:2], 0.01]]])
    far, near = inverse_depth_range(cameras[1], points[1], np.concatenate(points))
    assert 1 / far > depths[1].max()
    assert depths[1].min() * 0.5 < 1 / near < depths[1].min()


def test_memory_is_bounded_by_fewer_planes(three):
    cameras, images, depths, sparse, _, _ = three
    small = replace(OPTIONS, max_volume=24 * 128 * 96)
    found = dense_depths(images, everywhere(images), cameras, sparse, small, 2)
    coarse = replace(OPTIONS, planes=24, max_planes=24)
    assert same(found, dense_depths(images, everywhere(images), cameras, sparse, coarse, 2))
    assert np.median(relative_error(found[1], depths[1])) < 0.01


def test_wrong_input_is_refused(three):
    cameras, images, _, sparse, _, _ = three
    with pytest.raises(ValueError, match="per view"):
        dense_depths(images[:2], everywhere(images), cameras, sparse, OPTIONS, 1)
    with pytest.raises(ValueError, match="view 000"):
        dense_depths(
            [image[:-1] for image in images], everywhere(images), cameras, sparse, OPTIONS, 1
        )
    with pytest.raises(ValueError, match="sweep"):
        dense_depths(
            images, everywhere(images), cameras, sparse, replace(OPTIONS, method="magic"), 1
        )


@pytest.mark.real_data
@pytest.mark.skipif(not DATA.is_dir(), reason="no real data here")
def test_three_frames_of_the_scan_video():
    """Frames 17 degrees apart, exact cameras: a tenth of a millimetre on teeth and gums."""
    import json

    import cv2

    from pipeline.artifacts.cameras import Camera

    meta = json.loads((DATA / "transforms.json").read_text())
    cameras, images, depths, masks, sparse = [], [], [], [], []
    for number in (7, 11, 15):
        frame = meta["frames"][number]
        bgr = cv2.imread(str(DATA / frame["file_path"]))
        images.append(np.ascontiguousarray(bgr[..., ::-1]).astype(np.float32) / 255)
        depths.append(cv2.imread(str(DATA / frame["depth_file_path"]), -1) / np.float32(200))
        masks.append(cv2.imread(str(DATA / frame["mask_path"]), 0))
        cameras.append(
            Camera(
                f"{number:03d}", meta["w"], meta["h"], meta["fl_x"], meta["fl_y"],
                meta["cx"], meta["cy"], np.array(frame["w2c_opencv"]),
            )
        )  # fmt: skip
        seen = cameras[-1].unproject(depths[-1])[depths[-1] > 0]
        sparse.append(seen[:: len(seen) // 150].astype(np.float32))
    found = dense_depths(images, everywhere(images), cameras, sparse, DenseOptions(), 2)
    error, count = [], 0
    for view, truth, mask in zip(found, depths, masks, strict=True):
        good = (view.depth > 0) & (mask > 0)
        error.append(np.abs(view.depth - truth)[good])
        count += int(good.sum())
    millimetres = np.concatenate(error)
    assert count > 300_000
    assert np.median(millimetres) < 0.1
    assert np.percentile(millimetres, 90) < 0.45
    assert np.mean(millimetres > 2) < 0.02


def test_polish_brings_disturbed_depth_back_to_the_surface():
    cameras, images, depths, _ = scene((-9.0, 0.0, 9.0))
    grays = [to_gray(image) for image in images]
    usable = everywhere(images)
    stack, sizes = stack_sources([grays[0], grays[2]], [usable[0], usable[2]])
    maps = source_maps(cameras[1], [cameras[0], cameras[2]])
    truth = depths[1].astype(np.float32)
    rng = np.random.default_rng(4)
    disturbed = truth * (1 + 0.02 * rng.normal(size=truth.shape)).astype(np.float32)
    disturbed[rng.random(truth.shape) < 0.2] = 0  # holes are filled from beside
    score = np.zeros(truth.shape, np.float32)

    def polished(passes: int) -> np.ndarray:
        return polish(
            grays[1], usable[1], stack, sizes, maps, disturbed, score, passes, 7, 0.02, 1
        )[0]

    def error(found: np.ndarray) -> float:
        known = found > 0
        return float(np.median(np.abs(found - truth)[known] / truth[known]))

    np.testing.assert_allclose(polished(0), disturbed, rtol=1e-6)
    found = polished(3)
    assert error(found) < 0.3 * error(disturbed)
    assert (found > 0).mean() > 0.97
    assert polished(3).tobytes() == found.tobytes()


def test_polish_is_an_option_of_the_sweep(three):
    cameras, images, depths, sparse, *_ = three
    options = replace(OPTIONS, polish=1)
    found = dense_depths(images, everywhere(images), cameras, sparse, options, 2, lambda *_: None)
    for view, truth in zip(found, depths, strict=True):
        assert np.median(relative_error(view, truth)) < 0.003
    again = dense_depths(images, everywhere(images), cameras, sparse, options, 1, lambda *_: None)
    assert same(found, again)


def test_ranges_hold_what_the_coarser_level_found():
    shape, planes = (3 * TILE[0] + 5, 2 * TILE[1] + 3), 100
    down, across = tile_grid(shape)
    position = np.linspace(0, 1, shape[1] // 2, dtype=np.float32) * np.ones(
        (shape[0] // 2, 1), np.float32
    )
    ranges = ranges_around(position, np.ones(position.shape, bool), shape, planes)
    assert ranges.shape == (down * across, 2) == full_ranges(shape, planes).shape
    assert (ranges[:, 0] >= 0).all() and (ranges[:, 1] <= planes).all()
    for x in range(shape[1]):
        plane = position[0, min(x // 2, position.shape[1] - 1)] * (planes - 1)
        low, high = ranges[x // TILE[1]]
        assert low <= plane < high
    assert (ranges[0::across, 1] < planes).all()  # the left ones don't look at the far end


def test_what_is_not_used_or_went_astray_alone_widens_no_range():
    shape, planes = (2 * TILE[0], 2 * TILE[1]), 100
    position = np.full((shape[0] // 2, shape[1] // 2), 0.5, np.float32)
    usable = np.ones(position.shape, bool)
    plain = ranges_around(position, usable, shape, planes)
    disturbed, seen = position.copy(), usable.copy()
    disturbed[2, 3], disturbed[5, 7] = 0, 1
    disturbed[:, -5:], seen[:, -5:] = 0.9, False
    np.testing.assert_array_equal(ranges_around(disturbed, seen, shape, planes), plain)
    seen[:] = False  # nothing is known: everything that was found counts
    ranges = ranges_around(disturbed, seen, shape, planes)
    assert ranges[1, 1] > 0.9 * planes > plain[1, 1]


def test_costs_inside_a_range_are_those_of_the_full_sweep():
    rng = np.random.default_rng(0)
    gray = rng.uniform(0, 1, (40, 60)).astype(np.float32)
    usable = rng.uniform(0, 1, gray.shape) > 0.1
    stack, sizes = stack_sources([np.roll(gray, 2, 1)], [usable])
    shift = np.eye(3)[None] + np.arange(6)[:, None, None] * np.array(
        [[0, 0, 1.0], [0] * 3, [0] * 3]
    )
    homographies = shift.reshape(6, 1, 9).astype(np.float32)
    whole = cost_volume(gray, np.ones_like(usable), stack, sizes, homographies, 5)
    part = full_ranges(gray.shape, 6)
    part[:] = 1, 4
    some = cost_volume(
        gray, np.ones_like(usable), stack, sizes, homographies, 5, ranges=part
    )  # fmt: skip
    np.testing.assert_array_equal(unpacked(some)[:, :, 1:4], unpacked(whole)[:, :, 1:4])
    assert np.isnan(unpacked(some)[:, :, [0, 4, 5]]).all()
    assert (unpacked(whole).argmin(2) == 2).mean() > 0.7
    even = np.ones_like(gray)
    by_tiles = aggregate(whole, even, 0.1)
    at_once = aggregate(Volume.of(unpacked(whole)), even, 0.1)
    np.testing.assert_array_equal(unpacked(by_tiles), at_once.values.reshape(whole.shape))
    for found, wanted in zip(
        decide(by_tiles, whole), decide(at_once, Volume.of(unpacked(whole))), strict=True
    ):
        np.testing.assert_array_equal(found, wanted)


def unpacked(volume: Volume) -> np.ndarray:
    """[H, W, D], not a number beyond the ranges."""
    whole = np.full(volume.shape, np.nan, np.float32)
    across = tile_grid(volume.shape[:2])[1]
    for tile, (low, high) in enumerate(volume.ranges):
        y, x = tile // across * TILE[0], tile % across * TILE[1]
        part = whole[y : y + TILE[0], x : x + TILE[1], low:high]
        values = volume.values[volume.starts[tile] :][: TILE[0] * TILE[1] * (high - low)]
        part[:] = values.reshape(*TILE, high - low)[: part.shape[0], : part.shape[1]]
    return whole


def test_a_guess_goes_on_from_what_is_known_beside_it():
    guess = np.full((60, 200), np.float32(10))
    guess[:5] = 0
    known = np.zeros_like(guess)
    known[:, :50] = 10.4
    known[30, 20] = 14  # of something else
    gray = np.full_like(guess, 0.5)
    found = continued(guess, known, gray, most=1.0, reach_px=20.0)
    assert not found[:5].any()
    np.testing.assert_allclose(found[10:, 50], 10.37, atol=0.02)
    np.testing.assert_allclose(found[10:, 190], 10, atol=0.01)
    assert (np.diff(found[40, 50:]) <= 1e-6).all()
    edge = gray.copy()
    edge[:, 60:] = 0.9
    beyond = continued(guess, known, edge, most=1.0, reach_px=20.0)
    assert (beyond[10:, 55] > 10.3).all()
    np.testing.assert_allclose(beyond[10:, 62:], 10, atol=0.02)


def test_a_guess_with_nothing_beside_it_stays():
    guess = np.full((40, 40), np.float32(10))
    for known in (np.zeros_like(guess), np.full_like(guess, 20)):
        np.testing.assert_allclose(
            continued(guess, known, np.zeros_like(guess), 1.0, 20.0), guess, rtol=1e-5
        )
