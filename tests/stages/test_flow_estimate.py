"""Flow of images that were moved in a known way, and the tests that decide what is trusted."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from stages.flow.estimate import (
    Method,
    centred_start,
    consistency_mask,
    estimate_flow,
    highlights,
    inside,
    lands_on,
    local_contrast,
    sample,
    textured,
)
from stages.flow.geometry import pixel_grid

METHODS: tuple[Method, Method] = ("dis", "farneback")


def texture(height: int = 120, width: int = 160, seed: int = 0) -> np.ndarray:
    """Smooth random grey levels, [height, width] uint8."""
    noise = np.random.default_rng(seed).normal(size=(height, width)).astype(np.float32)
    image = cv2.GaussianBlur(noise, (0, 0), 1.5) + 2 * cv2.GaussianBlur(noise, (0, 0), 5)
    return np.clip(128 + 60 * image / image.std(), 0, 255).astype(np.uint8)


def moved(image: np.ndarray, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The image whose pixel matrix @ x shows what `image` shows at x, and the true flow."""
    height, width = image.shape
    warped = cv2.warpAffine(image, matrix, (width, height), flags=cv2.INTER_CUBIC)
    grid = pixel_grid(height, width)
    return warped, grid @ matrix[:, :2].T.astype(np.float32) + matrix[:, 2].astype(
        np.float32
    ) - grid


MOTIONS = {
    "shift": np.array([[1, 0, 3.4], [0, 1, -2.3]]),
    "rotation": cv2.getRotationMatrix2D((80, 60), 4, 1.0),
    "zoom": cv2.getRotationMatrix2D((80, 60), 0, 1.05),
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("motion", MOTIONS)
def test_known_motion(method: Method, motion: str) -> None:
    image = texture()
    other, truth = moved(image, MOTIONS[motion])
    flow, residual = estimate_flow(image, other, np.zeros_like(truth), method)
    error = np.linalg.norm(flow - truth, axis=-1)[15:-15, 15:-15]
    assert np.median(error) < 0.25
    assert (error < 1).mean() > 0.97
    np.testing.assert_array_equal(flow, residual)  # nothing was predicted


@pytest.mark.parametrize("method", METHODS)
def test_large_motion_is_found_from_a_rough_guess_only(method: Method) -> None:
    image = texture()
    other, truth = moved(image, np.array([[1, 0, 48.0], [0, 1, 7.0]]))
    guess = truth + np.float32(2)
    flow, residual = estimate_flow(image, other, guess, method)
    error = np.linalg.norm(flow - truth, axis=-1)[15:-15, 15:-70]
    assert (error < 1).mean() > 0.97
    assert np.median(residual[15:-15, 15:-70]) == pytest.approx(-2, abs=0.1)


@pytest.mark.parametrize("sizes", [((120, 160), (180, 240)), ((180, 240), (120, 160))])
def test_views_of_different_sizes(sizes: tuple[tuple[int, int], tuple[int, int]]) -> None:
    large = texture(360, 480)
    (height_i, width_i), (height_j, width_j) = sizes
    image_i, image_j = (
        cv2.resize(large, (width, height), interpolation=cv2.INTER_AREA) for height, width in sizes
    )
    start = centred_start((width_i, height_i), (width_j, height_j))
    flow, _ = estimate_flow(image_i, image_j, start)
    truth = (pixel_grid(height_i, width_i) + 0.5) * (width_j / width_i) - 0.5
    error = np.linalg.norm(pixel_grid(height_i, width_i) + flow - truth, axis=-1)
    assert (error < 0.5).mean() > 0.99
    assert inside(flow, image_j.shape).mean() > 0.97


def test_start_of_equal_sizes_is_zero_and_of_turned_ones_centred() -> None:
    assert not centred_start((160, 120), (160, 120)).any()
    start = centred_start((160, 120), (120, 160))
    np.testing.assert_allclose(start, np.broadcast_to([-20, 20], start.shape), atol=1e-4)


@pytest.mark.parametrize("size", [(1, 40), (8, 8), (20, 30), (40, 3)])
@pytest.mark.parametrize("method", METHODS)
def test_tiny_images(method: Method, size: tuple[int, int]) -> None:
    image = texture(*size)
    flow, _ = estimate_flow(image, image, np.zeros((*size, 2), np.float32), method)
    assert flow.shape == (*size, 2)
    assert np.isfinite(flow).all()
    assert np.median(np.abs(flow)) < 0.5


def test_flow_does_not_follow_a_light_that_moves() -> None:
    image = texture() // 4 + 60
    columns = np.arange(160)
    lit = [40 * np.exp(-(((columns - centre) / 40) ** 2)) for centre in (40, 120)]
    lit_i, lit_j = ((image + light).astype(np.uint8) for light in lit)
    start = np.zeros((120, 160, 2), np.float32)
    plain, _ = estimate_flow(lit_i, lit_j, start)
    even, _ = estimate_flow(local_contrast(lit_i, 4), local_contrast(lit_j, 4), start)
    assert np.linalg.norm(even, axis=-1).mean() < 0.5 * np.linalg.norm(plain, axis=-1).mean()
    np.testing.assert_array_equal(local_contrast(lit_i, 0), lit_i)


def test_sample_is_bilinear() -> None:
    field = np.array([[0, 1], [2, 3]], np.float32)
    positions = np.array([[[0.5, 0.5], [1, 0], [9, 9]]], np.float32)
    np.testing.assert_allclose(sample(field, positions), [[1.5, 1, 3]])
    np.testing.assert_allclose(sample(field, positions, outside=-1), [[1.5, 1, -1]])


def test_consistency() -> None:
    shape = (20, 30, 2)
    forward, backward = np.full(shape, 2, np.float32), np.full(shape, -2, np.float32)
    still = np.zeros(shape, np.float32)
    backward[10:, :15] = (-2, -2.9)  # wrong by 0.9 px: 0.81 > 0.5
    mask = consistency_mask(forward, backward, still, still, 0.0, 0.5)
    expected = np.ones(shape[:2], bool)
    expected[8:, :13] = False  # what lands there
    expected[18:] = False  # leaves the image
    expected[:, 28:] = False
    np.testing.assert_array_equal(mask, expected)
    # In proportion to the motion: 0.01 * (8 + 12.41) + 0.65 > 0.81, and 0.05 less is not.
    tolerant = consistency_mask(forward, backward, forward, backward, 0.01, 0.65)
    assert tolerant[9, 3]
    assert not consistency_mask(forward, backward, forward, backward, 0.01, 0.60)[9, 3]


def test_landing_on_a_mask() -> None:
    allowed = np.ones((10, 10), bool)
    allowed[:, 5] = False
    flow = np.zeros((10, 10, 2), np.float32)
    flow[..., 0] = 2.5
    landing = lands_on(flow, allowed)
    # 2 -> 4.5 and 3 -> 5.5 touch column 5; 7 -> 9.5 leaves the image.
    assert landing[0].tolist() == [True, True, False, False, True, True, True, False, False, False]


def test_texture_test() -> None:
    image = np.full((40, 80), 100, np.uint8)
    image[:, 40:] = texture(40, 40)
    mask = textured(image, 5.0)
    assert not mask[:, :35].any()
    assert mask[:, 45:].mean() > 0.95


def test_highlight_test() -> None:
    image = np.full((30, 30, 3), 0.4, np.float32)
    image[10:13, 10:13] = (0.95, 0.9, 0.85)
    image[20, 20] = (1, 1, 0.2)  # yellow, no glare
    mask = highlights(image, 0.8)
    assert mask[8:15, 8:15].all()
    assert mask.sum() == 49
