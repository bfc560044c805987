"""Radial distortion: pixels both ways, images, and its estimate in bundle adjustment."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from stages.init.sfm import refine
from stages.init.sfm.matching.two_view import Correspondences, coherent_matches
from stages.init.sfm.options import ClassicalOptions, RefinementOptions
from stages.init.sfm.refine import bundle_adjust, refine_solution, robust_cost
from stages.init.sfm.solver import Solver, known_focal, unknown_focal
from stages.init.sfm.undistort import distort_pixels, undistort_image, undistort_pixels
from tests.stages.init_scene import FOCAL, HEIGHT, WIDTH, make_scene, worst_rotation

SIZE = (WIDTH, HEIGHT)


def grid():
    u, v = np.meshgrid(np.linspace(0.5, 511.5, 17), np.linspace(0.5, 383.5, 13))
    return np.stack([u, v], -1)


@pytest.mark.parametrize("k1", [-0.3, -0.1, 0.0, 0.2])
def test_pixels_go_there_and_back(k1):
    there = distort_pixels(grid(), FOCAL, k1, SIZE)
    np.testing.assert_allclose(undistort_pixels(there, FOCAL, k1, SIZE), grid(), atol=1e-8)


def test_the_model_is_colmaps():
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT,
        params=[FOCAL, WIDTH / 2, HEIGHT / 2, -0.15],
    )  # fmt: skip
    pixels = grid().reshape(-1, 2)
    rays = camera.cam_from_img(pixels)
    expected = rays[:, :2] * FOCAL + (WIDTH / 2, HEIGHT / 2)
    np.testing.assert_allclose(undistort_pixels(pixels, FOCAL, -0.15, SIZE), expected, atol=1e-6)


def test_beyond_the_fold_of_a_barrel_pixels_stay_finite():
    far = undistort_pixels(np.array([[5000.0, 192.0]]), FOCAL, -0.5, SIZE)
    assert np.isfinite(far).all()
    assert far[0, 0] == pytest.approx(WIDTH / 2 + FOCAL / np.sqrt(1.5))


@pytest.mark.parametrize("k1", [-0.2, 0.2])
def test_a_bent_image_becomes_straight(k1):
    def pattern(pixels):
        return (0.5 + 0.4 * np.sin(pixels[..., 0] / 9) * np.cos(pixels[..., 1] / 7)).astype("f4")

    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    pixels = np.stack([u, v], -1)
    bent = pattern(undistort_pixels(pixels, FOCAL, k1, SIZE))
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[100:120, 200:260] = False
    image, usable = undistort_image(np.where(valid, bent, 0).astype("f4"), valid, FOCAL, k1)
    assert usable.mean() > 0.85
    assert not usable[110, 230]
    inner = np.zeros_like(usable)
    inner[2:-2, 2:-2] = usable[2:-2, 2:-2]
    far_from_hole = inner & ~((np.abs(v - 110) < 20) & (np.abs(u - 230) < 45))
    np.testing.assert_allclose(image[far_from_hole], pattern(pixels)[far_from_hole], atol=0.01)
    if k1 > 0:  # the photograph does not show the corners of the straight image
        assert not usable[0, 0]


def test_no_distortion_changes_nothing():
    image, valid = np.random.default_rng(0).random((8, 9, 3)).astype("f4"), np.ones((8, 9), bool)
    same, usable = undistort_image(image, valid, FOCAL, 0.0)
    assert same is image
    assert usable is valid


def through_a_bent_lens(given, k1):
    """The same scene, photographed by a lens with radial distortion."""
    pixels = [distort_pixels(place, FOCAL, k1, SIZE) for place in given.positions]
    pairs = {}
    for (i, j), old in given.correspondences.items():
        places = pixels[i][old.features[:, 0]], pixels[j][old.features[:, 1]]
        pairs[i, j] = Correspondences(old.features, *places, coherent_matches(*places, 40.0))
    return replace(given, positions=pixels, correspondences=pairs)


def solved(given, tmp_path, **options):
    solver = Solver(given, ClassicalOptions(), 1.0, 0, 1, tmp_path)
    best, _ = unknown_focal(solver, True, lambda *_: None)
    return best, refine_solution(solver, best, True, RefinementOptions(**options))


def test_distortion_is_found_and_taken_out(tmp_path):
    straight, poses = make_scene([-22, 0, 20], count=600)
    given = through_a_bent_lens(straight, -0.25)
    before, found = solved(given, tmp_path)
    assert found.distortions[0] == pytest.approx(-0.25, abs=0.03)
    assert found.focals[0] == pytest.approx(FOCAL, rel=0.02)
    assert worst_rotation(found, poses) < 0.2
    assert worst_rotation(before, poses) > 2 * worst_rotation(found, poses)
    assert robust_cost(found, 0.5) < 0.9 * robust_cost(before, 0.5)
    # Its pixels are those of the pinhole: the true ones, which no lens had bent.
    mine = found.observed_view == 1
    nearest = np.linalg.norm(
        found.observed_pixel[mine][:, None] - straight.positions[1][None], axis=2
    ).min(1)
    assert np.median(nearest) < 0.5


@pytest.mark.parametrize("factor", [0.45, 2.2])
def test_exif_that_the_photographs_refute_does_not_hide_distortion(tmp_path, factor):
    straight, poses = make_scene([-22, -7, 7, 20], count=600)
    lens = replace(straight.lenses[0], focal=factor * FOCAL)
    given = through_a_bent_lens(replace(straight, lenses=[lens]), -0.25)
    solver = Solver(given, ClassicalOptions(), 1.0, 0, 1, tmp_path)
    best = known_focal(solver, True, lambda *_: None)
    found = refine_solution(solver, best, True, RefinementOptions())
    assert found.distortions[0] == pytest.approx(-0.25, abs=0.03)
    assert found.focals[0] == pytest.approx(FOCAL, rel=0.02)
    assert worst_rotation(found, poses) < 0.2


def test_errors_are_those_of_the_photograph(tmp_path):
    """Straightened, the rim of a barrel is enlarged: errors there hid that the lens fits better."""
    given = through_a_bent_lens(make_scene([-8, 0, 8], count=600, noise=0.4, seed=3)[0], -0.25)
    solver = Solver(given, ClassicalOptions(), 1.0, 0, 1, tmp_path)
    best = solver.solve([FOCAL], False)
    plain, bent = (
        bundle_adjust(
            best, given, [FOCAL], refine_focal=False, distortions=distortions, loss_scale=0.5
        )
        for distortions in (None, [0.0])
    )
    assert robust_cost(bent, 0.5) < 0.99 * robust_cost(plain, 0.5)
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT,
        params=[bent.focals[1], WIDTH / 2, HEIGHT / 2, bent.distortions[1]],
    )  # fmt: skip
    mine = bent.observed_view == 1
    pose, places = bent.poses[1], bent.points[bent.observed_point[mine]]
    shown = camera.img_from_cam(places @ pose[:3, :3].T + pose[:3, 3])
    photographed = distort_pixels(
        bent.observed_pixel[mine], bent.focals[1], bent.distortions[1], SIZE
    )  # fmt: skip
    missed = np.linalg.norm(shown - photographed, axis=1)
    np.testing.assert_allclose(bent.residuals[mine], missed, atol=1e-6)


@pytest.mark.parametrize("seed", [1, 3])
def test_distortion_is_found_beside_a_focal_length_that_exif_decides(tmp_path, seed):
    straight, poses = make_scene([-8, 0, 8], count=600, noise=0.4, seed=seed)
    lens = replace(straight.lenses[0], focal=FOCAL)
    given = through_a_bent_lens(replace(straight, lenses=[lens]), -0.25)
    solver = Solver(given, ClassicalOptions(), 1.0, 0, 1, tmp_path)
    best = known_focal(solver, True, lambda *_: None)
    found = refine_solution(solver, best, True, RefinementOptions())
    assert found.focals[0] == pytest.approx(FOCAL, rel=0.02)
    assert found.distortions[0] == pytest.approx(-0.25, abs=0.03)
    assert worst_rotation(found, poses) < 0.5 * worst_rotation(best, poses)


def test_a_straight_lens_keeps_its_pinhole(tmp_path):
    given, poses = make_scene([-22, 0, 20], count=600)
    before, found = solved(given, tmp_path)
    assert set(found.distortions.values()) == {0.0}
    assert robust_cost(found, 0.5) <= robust_cost(before, 0.5) + 1e-6
    assert worst_rotation(found, poses) < 0.2


def test_distortion_can_be_switched_off(tmp_path):
    given = through_a_bent_lens(make_scene([-22, 0, 20], count=250)[0], -0.25)
    _, found = solved(given, tmp_path, refine_distortion="never")
    assert set(found.distortions.values()) == {0.0}


def test_a_lens_that_saw_little_keeps_its_pinhole(tmp_path, monkeypatch):
    monkeypatch.setattr(refine, "DISTORTION_OBSERVATIONS", 1_000_000)
    given = through_a_bent_lens(make_scene([-22, 0, 20], count=250)[0], -0.25)
    _, found = solved(given, tmp_path)
    assert set(found.distortions.values()) == {0.0}
