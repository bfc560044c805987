"""Loss, Adam, tile lists and pictures against plain numpy and torch."""

from __future__ import annotations

import kornia
import numpy as np
import pytest
import torch

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.gaussians import Gaussians
from stages.splatting.adam import Adam
from stages.splatting.kernels.tiles import TILE, fill_tiles, order_by_depth
from stages.splatting.loss import ColourLoss
from stages.splatting.rasterizer import Viewpoint, pack, rasterize, unpack, use_threads
from stages.splatting.rendering import render

WIDTH, HEIGHT = 70, 45


def camera(width: int = WIDTH, height: int = HEIGHT) -> Camera:
    return Camera("000", width, height, 60.0, 60.0, width / 2, height / 2, np.eye(4))


def gaussians(count: int, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    means = np.concatenate([rng.uniform(-1, 1, (count, 2)), rng.uniform(1, 3, (count, 1))], 1)
    quats = rng.normal(size=(count, 4))
    return Gaussians(
        means.astype(np.float32),
        (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        np.log(rng.uniform(0.01, 0.1, (count, 3))).astype(np.float32),
        rng.normal(size=count).astype(np.float32),
        (0.3 * rng.normal(size=(count, 16, 3))).astype(np.float32),
    )


def reference_loss(image, target, mask, share):
    """The definition, with kornia's SSIM on a black surround; differentiable."""
    x, y = (torch.nn.functional.pad((p * mask)[None], (10,) * 4) for p in (image, target))
    ssim = kornia.metrics.ssim(x, y, 11)[0, :, 10:-10, 10:-10]
    count = 3 * mask.sum()
    mean_ssim = (ssim * mask).sum() / count
    l1 = ((image - target).abs() * mask).sum() / count
    return (1 - share) * l1 + share * (1 - mean_ssim), mean_ssim


@pytest.mark.parametrize("masked", [False, True])
def test_colour_loss_and_gradient_agree_with_the_definition(masked: bool) -> None:
    rng = np.random.default_rng(0)
    target = rng.random((3, HEIGHT, WIDTH)).astype(np.float32)
    image = np.clip(target + 0.1 * rng.normal(size=target.shape), 0, 1).astype(np.float32)
    mask = np.ones((HEIGHT, WIDTH), np.float32)
    if masked:
        mask[10:30, :25] = 0
    loss = ColourLoss(target, mask)
    result, again = loss(image, 0.3), loss(image, 0.3)  # the second uses the cached moments
    assert again.loss == result.loss and np.array_equal(again.gradient, result.gradient)
    x = torch.tensor(image, dtype=torch.float64, requires_grad=True)
    truth, ssim = reference_loss(
        x, torch.tensor(target, dtype=torch.float64), torch.tensor(mask, dtype=torch.float64), 0.3
    )
    truth.backward()
    assert result.loss == pytest.approx(float(truth.detach()), abs=1e-6)
    assert result.ssim == pytest.approx(float(ssim), abs=1e-5)
    error = ((image - target) ** 2 * mask).sum() / (3 * mask.sum())
    assert result.psnr == pytest.approx(-10 * np.log10(error), abs=1e-3)
    expected = x.grad.numpy()
    assert np.linalg.norm(result.gradient - expected) < 1e-4 * np.linalg.norm(expected)
    assert (result.gradient[:, mask == 0] == 0).all()


def test_what_lies_outside_the_mask_changes_nothing() -> None:
    rng = np.random.default_rng(1)
    target, image = rng.random((2, 3, HEIGHT, WIDTH)).astype(np.float32)
    mask = (rng.random((HEIGHT, WIDTH)) < 0.7).astype(np.float32)
    first = ColourLoss(target, mask)(image, 0.2)
    image[:, mask == 0] = 5
    target[:, mask == 0] = -3
    second = ColourLoss(target, mask)(image, 0.2)
    assert first.loss == second.loss
    assert np.array_equal(first.gradient, second.gradient)


def test_adam_agrees_with_torch() -> None:
    rng = np.random.default_rng(2)
    start = rng.normal(size=(700, 5)).astype(np.float32)
    ours, truth = start.copy(), torch.tensor(start.astype(np.float64), requires_grad=True)
    adam = Adam(ours.shape)
    peer = torch.optim.Adam([truth], lr=1e-2, eps=1e-15)
    for _ in range(5):
        gradient = rng.normal(size=start.shape).astype(np.float32)
        adam.step(ours, gradient, np.full(5, 1e-2, np.float32))
        truth.grad = torch.tensor(gradient.astype(np.float64))
        peer.step()
    assert np.abs(ours - truth.detach().numpy()).max() < 1e-5


def test_order_by_depth_sorts_stably() -> None:
    rng = np.random.default_rng(3)
    depth = rng.choice(np.geomspace(1e-3, 1e6, 300), 1000).astype(np.float32)
    count = rng.integers(0, 3, 1000).astype(np.int32)
    visible = np.flatnonzero(count)
    expected = visible[np.argsort(depth[visible], kind="stable")]
    assert np.array_equal(order_by_depth(depth.view(np.uint32), count), expected)


def test_every_tile_that_an_ellipse_reaches_lists_it_and_no_other() -> None:
    scene = gaussians(300)
    packed = pack(scene.means, scene.quats_wxyz, scene.log_scales, scene.logit_opacities, scene.sh)
    result = rasterize(packed, Viewpoint.of(camera()), degree=0, near=0.1)
    forward = result._forward
    listed = np.zeros((300, forward.tiles_x * forward.tiles_y), bool)
    for tile in range(listed.shape[1]):
        members = forward.members[forward.offsets[tile] : forward.offsets[tile + 1]]
        assert (np.diff(result.screen[members, 8]) >= 0).all()
        listed[members, tile] = True
    superfluous = 0
    v, u = np.mgrid[: forward.tiles_y * TILE, : forward.tiles_x * TILE] + 0.5
    for i in np.flatnonzero(result.visible):
        x, y, a, b, c, opacity = result.screen[i, :6].astype(np.float64)
        power = 0.5 * (a * (u - x) ** 2 + c * (v - y) ** 2) + b * (u - x) * (v - y)
        alpha = opacity * np.exp(-power)
        blocks = alpha.reshape(forward.tiles_y, TILE, forward.tiles_x, TILE).max((1, 3)).ravel()
        needed = blocks > 1.001 / 255
        assert listed[i][needed].all()
        superfluous += int((listed[i] & ~needed).sum())
    # the ellipse may pass between the pixels of a tile
    assert superfluous < 0.1 * listed.sum()


def test_the_result_does_not_depend_on_the_number_of_threads() -> None:
    scene = gaussians(2000, 5)
    packed = pack(scene.means, scene.quats_wxyz, scene.log_scales, scene.logit_opacities, scene.sh)
    rng = np.random.default_rng(5)
    given = rng.normal(size=(2000, 7)).astype(np.float32)
    mask = rng.random((HEIGHT, WIDTH)) < 0.9
    d_planes = rng.normal(size=(11, HEIGHT, WIDTH)).astype(np.float32)
    d_left = rng.normal(size=(HEIGHT, WIDTH)).astype(np.float32)
    results = []
    for threads in (1, 2):
        use_threads(threads)
        rendering = rasterize(
            packed, Viewpoint.of(camera()), degree=3, near=0.1, depth=True, features=given,
            antialiased=True, mask=mask,
        )  # fmt: skip
        gradients = rendering.backward(d_planes, d_left)
        results.append(
            (rendering.planes, gradients.packed, gradients.pose, gradients.focal,
             gradients.absolute, gradients.features, gradients.opacities)
        )  # fmt: skip
    for one, two in zip(*results, strict=True):
        assert one.tobytes() == two.tobytes()


def test_absolute_gradients_bound_the_signed_ones() -> None:
    packed = pack(*(getattr(gaussians(200, 6), n) for n in (
        "means", "quats_wxyz", "log_scales", "logit_opacities", "sh")))  # fmt: skip
    rendering = rasterize(packed, Viewpoint.of(camera()), degree=0, near=0.1)
    rng = np.random.default_rng(6)
    gradients = rendering.backward(
        rng.normal(size=rendering.planes.shape).astype(np.float32),
        np.zeros((HEIGHT, WIDTH), np.float32),
    )
    assert (np.abs(gradients.centres) <= gradients.absolute * 1.0001 + 1e-6).all()
    assert np.abs(gradients.centres).sum() < 0.9 * gradients.absolute.sum()


def test_render_blends_with_the_background() -> None:
    scene = gaussians(100, 7)
    black = render(scene, camera(), threads=1)
    white = render(scene, camera(), background=(1, 1, 1), threads=1)
    assert black.image.shape == (HEIGHT, WIDTH, 3) and black.image.dtype == np.float32
    assert np.allclose(white.image, black.image + 1 - black.alpha[..., None], atol=1e-6)
    assert (black.depth[black.alpha > 0.1] > 1).all() and (black.depth < 3.01).all()


def test_render_of_nothing_visible_is_the_background() -> None:
    scene = gaussians(10, 8)
    turned = np.diag([-1.0, 1.0, -1.0, 1.0])
    behind = Camera("000", 40, 30, 40.0, 40.0, 20.0, 15.0, turned)
    result = render(scene, behind, background=(0.2, 0.4, 0.6), threads=1)
    assert np.allclose(result.image, (0.2, 0.4, 0.6)) and not result.alpha.any()


def test_pack_and_unpack_are_inverse() -> None:
    scene = gaussians(20, 9)
    back = unpack(
        pack(scene.means, scene.quats_wxyz, scene.log_scales, scene.logit_opacities, scene.sh)
    )
    for name in ("means", "quats_wxyz", "log_scales", "logit_opacities", "sh"):
        assert np.allclose(getattr(back, name), getattr(scene, name), atol=1e-6)


def test_rasterize_refuses_a_matrix_of_the_wrong_kind() -> None:
    view = Viewpoint.of(camera())
    with pytest.raises(ValueError, match="float32"):
        rasterize(np.zeros((3, 23)), view, degree=1, near=0.1)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="degree 2"):
        rasterize(np.zeros((3, 23), np.float32), view, degree=2, near=0.1)


def test_no_gaussian_at_all_and_not_a_number_are_survived() -> None:
    view = Viewpoint.of(camera())
    empty = rasterize(np.zeros((0, 14), np.float32), view, degree=0, near=0.1)
    assert not empty.planes.any() and (empty.transmittance == 1).all()
    broken = np.full((5, 14), np.nan, np.float32)
    assert not rasterize(broken, view, degree=0, near=0.1).visible.any()
    assert fill_tiles.nopython_signatures  # the kernels did run compiled
