"""The evaluate stage with a renderer of known output."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.artifacts.cameras import Camera, Cameras
from pipeline.artifacts.gaussians import Gaussians
from pipeline.artifacts.views import View, Views, read_png, to_uint8
from pipeline.errors import RequestError
from pipeline.stage import LocalContext
from stages.evaluate.config import EvaluateConfig
from stages.evaluate.evaluation import evaluate
from stages.evaluate.images.metrics import psnr, ssim
from stages.evaluate.stage import EvaluateStage


@dataclass
class Rendered:
    image: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray


def view(name: str, height: int, width: int, seed: int) -> View:
    rng = np.random.default_rng(seed)
    eight_bit = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    return View(name, eight_bit.astype(np.float32) / np.float32(255))


def camera(name: str, height: int, width: int) -> Camera:
    return Camera(name, width, height, 50.0, 50.0, width / 2, height / 2, np.eye(4))


GAUSSIANS = Gaussians(
    np.zeros((2, 3), np.float32), np.ones((2, 4), np.float32), np.zeros((2, 3), np.float32),
    np.zeros(2, np.float32), np.zeros((2, 16, 3), np.float32),
)  # fmt: skip


class Darker:
    """Renders each photograph a little darker, covered on the left half only."""

    def __init__(self, views: Views, by: float = 0.1) -> None:
        self.views, self.by, self.calls = views.by_name(), by, list[dict[str, Any]]()

    def __call__(
        self, gaussians: Gaussians, background: Any, threads: Any
    ) -> Callable[[Camera], Rendered]:
        self.background = background
        return self.draw

    def draw(self, camera: Camera) -> Rendered:
        self.calls.append({"name": camera.name, "background": self.background})
        image = self.views[camera.name].image
        assert image.shape[:2] == (camera.height, camera.width)
        alpha = np.zeros(image.shape[:2], np.float32)
        alpha[:, : camera.width // 2] = 1
        return Rendered(image - np.float32(self.by), alpha, 2 * alpha)


def context(folder: Path, views: Views, names: list[str], **config: Any) -> LocalContext:
    sizes = {v.name: (v.height, v.width) for v in views.views}
    cameras = Cameras(tuple(camera(name, *sizes.get(name, (20, 30))) for name in names))
    inputs = {"views": views, "cameras": cameras, "gaussians": GAUSSIANS}
    return LocalContext(EvaluateConfig(**config), folder, inputs, threads=1)


def test_figures_of_views_of_different_sizes(tmp_path: Path) -> None:
    views = Views((view("000", 20, 30, 0), view("001", 40, 24, 1), view("002", 20, 30, 2)))
    run = context(tmp_path, views, ["000", "001"], background=(1, 1, 1))
    darker = Darker(views)
    evaluate(run, darker)
    figures = run.result("metrics").figures
    assert sorted(figures["views"]) == ["000", "001"]
    assert figures["views_unplaced"] == ["002"]
    assert figures["coverage"] == pytest.approx(0.5)
    assert "training views" in figures["protocol"]
    for name in ("000", "001"):
        photo = to_uint8(views.by_name()[name].image)
        dark = to_uint8(views.by_name()[name].image - np.float32(0.1))
        assert figures["views"][name]["psnr"] == psnr(dark, photo)
        assert figures["views"][name]["ssim"] == ssim(dark, photo)
    mean = np.mean([figures["views"][name]["psnr"] for name in ("000", "001")])
    assert figures["mean"]["psnr"] == pytest.approx(mean)
    assert run.figures["views"] == "2/3"
    assert run.figures["psnr"] == pytest.approx(mean, abs=0.005)
    assert [call["background"] for call in darker.calls] == [(1, 1, 1)] * 2


def test_only_valid_pixels_count(tmp_path: Path) -> None:
    whole = view("000", 40, 60, 0)
    mask = np.zeros((40, 60), bool)
    mask[:, :30] = True
    spoiled = whole.image.copy()
    spoiled[:, 30:] = 0.0
    results = []
    for index, image in enumerate((whole.image, spoiled)):
        views = Views((replace(whole, image=image, mask=mask),))
        run = context(tmp_path / str(index), views, ["000"])
        evaluate(run, Darker(Views((whole,))))
        results.append(run.result("metrics").figures)
    assert results[0]["views"] == results[1]["views"]
    assert results[0]["views"]["000"]["pixels"] == 0.5
    assert results[0]["coverage"] == 1.0  # the covered half is the valid half


def test_pictures_are_written_as_configured(tmp_path: Path) -> None:
    views = Views(tuple(view(f"{k:03d}", 20, 30, k) for k in range(5)))
    names = [v.name for v in views.views]
    run = context(tmp_path / "a", views, names, max_comparisons=2, save_renders=True)
    evaluate(run, Darker(views))
    folder = tmp_path / "a" / "metrics"
    assert sorted(path.name for path in folder.glob("comparison_*")) == [
        "comparison_000.png", "comparison_004.png",
    ]  # fmt: skip
    assert len(list(folder.glob("render_*.png"))) == 5
    picture = read_png(folder / "comparison_000.png")
    np.testing.assert_array_equal(picture[:, :30], to_uint8(views.views[0].image))

    run = context(tmp_path / "b", views, names, comparisons=False)
    evaluate(run, Darker(views))
    assert [path.name for path in (tmp_path / "b" / "metrics").iterdir()] == ["metrics.json"]


def test_the_same_bytes_twice(tmp_path: Path) -> None:
    views = Views((view("000", 20, 30, 0), view("001", 20, 30, 1)))
    written = []
    for folder in (tmp_path / "a", tmp_path / "b"):
        evaluate(context(folder, views, ["000", "001"]), Darker(views))
        files = sorted((folder / "metrics").iterdir())
        written.append({path.name: path.read_bytes() for path in files})
    assert written[0] == written[1]
    assert len(written[0]) == 3


def test_an_exact_render_gives_valid_json(tmp_path: Path) -> None:
    views = Views((view("000", 20, 30, 0),))
    evaluate(context(tmp_path, views, ["000"]), Darker(views, by=0))
    figures = json.loads((tmp_path / "metrics" / "metrics.json").read_text())
    assert figures["mean"]["psnr"] == 100
    assert figures["mean"]["ssim"] == pytest.approx(1)


def test_cameras_of_other_views_are_explained(tmp_path: Path) -> None:
    views = Views((view("000", 20, 30, 0),))
    with pytest.raises(RequestError, match=r"views are 000, the cameras IMG_7"):
        evaluate(context(tmp_path, views, ["IMG_7"]), Darker(views))


def test_empty_masks_are_left_out_or_explained(tmp_path: Path) -> None:
    empty = replace(view("001", 20, 30, 1), mask=np.zeros((20, 30), bool))
    views = Views((view("000", 20, 30, 0), empty))
    run = context(tmp_path / "a", views, ["000", "001"])
    evaluate(run, Darker(views))
    assert sorted(run.result("metrics").figures["views"]) == ["000"]
    assert len(run.warnings) == 1
    assert "001" in run.warnings[0]
    with pytest.raises(RequestError, match="masks"):
        evaluate(context(tmp_path / "b", Views((empty,)), ["001"]), Darker(views))


def test_with_the_real_renderer(tmp_path: Path) -> None:
    """One broad opaque Gaussian before a small camera: its colour in the middle of the picture."""
    sh = np.zeros((1, 16, 3), np.float32)
    sh[0, 0] = (np.array([0.8, 0.4, 0.2]) - 0.5) / 0.28209479177387814
    gaussians = Gaussians(
        np.array([[0, 0, 4]], np.float32), np.array([[1, 0, 0, 0]], np.float32),
        np.full((1, 3), np.log(2.0), np.float32), np.full(1, 12, np.float32), sh,
    )  # fmt: skip
    photo = np.broadcast_to(np.array([0.8, 0.4, 0.2], np.float32), (32, 48, 3)).copy()
    mask = np.zeros((32, 48), bool)
    mask[14:18, 22:26] = True  # where the Gaussian is opaque
    views = Views((View("000", photo, mask),))
    run = context(tmp_path, views, ["000"])
    run.inputs = {**run.inputs, "gaussians": gaussians}
    EvaluateStage().run(run)
    figures = run.result("metrics").figures
    assert figures["views"]["000"]["psnr"] > 38
    assert figures["coverage"] == 1
