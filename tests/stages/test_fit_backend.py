"""A fit on a graphics card: the same code with another device, and what happens where it fails."""

from __future__ import annotations

import sys
from functools import partial
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from pipeline.errors import RequestError
from stages.fit import backend, trial
from stages.fit.stage import FitStage
from stages.splatting.card import rasterize_on_card
from stages.splatting.rasterizer import Viewpoint, rasterize
from tests.stages.lit_fit_case import case, context

#: what runs on a card, with torch on the processor and our kernels in gsplat's place
STAND_IN = partial(rasterize_on_card, device="cpu", backend="cpu")


@pytest.mark.parametrize(("degree", "depth", "flow"), [(0, False, False), (2, True, True)])
def test_the_card_is_handed_the_same_scene(degree: int, depth: bool, flow: bool) -> None:
    random = np.random.default_rng(0)
    count, terms = 200, (degree + 1) ** 2
    packed = np.concatenate(
        [random.uniform(-1, 1, (count, 2)), random.uniform(1, 3, (count, 1)),
         random.normal(size=(count, 4)), np.log(random.uniform(0.02, 0.2, (count, 3))),
         random.normal(size=(count, 1 + 3 * terms))], 1,
    ).astype(np.float32)  # fmt: skip
    intrinsics = np.float32([60, 58, 31, 25])
    here, there = np.eye(4, dtype=np.float32)[:3].copy(), np.eye(4, dtype=np.float32)[:3].copy()
    there[0, 3] = 0.05
    view, following = (Viewpoint(pose, intrinsics, 64, 48) for pose in (here, there))
    options = {
        "degree": degree,
        "near": 0.2,
        "depth": depth,
        "flow_to": following if flow else None,
    }
    ours = rasterize(packed, view, **options)
    theirs = STAND_IN(packed, view, **options)
    assert np.abs(ours.planes[: len(theirs.planes)] - theirs.planes).max() < 1e-4
    assert np.abs(ours.transmittance - theirs.transmittance).max() < 1e-5
    assert (ours.visible == theirs.visible).all()
    by_image = random.normal(size=theirs.planes.shape).astype(np.float32)
    by_transmittance = random.normal(size=ours.transmittance.shape).astype(np.float32)
    wanted = ours.backward(by_image, by_transmittance)
    found = theirs.backward(by_image, by_transmittance)
    for name in ("packed", "pose", "next_pose", "centres", "absolute"):
        expected, got = getattr(wanted, name), getattr(found, name)
        assert np.abs(expected - got).max() <= 1e-4 * np.abs(expected).max(), name


@pytest.fixture(autouse=True)
def fresh_trial(tmp_path, monkeypatch: pytest.MonkeyPatch):
    """Each test's card is tried anew, and noted in a place of its own."""
    notes = tmp_path / "notes"
    notes.mkdir()
    places = SimpleNamespace(writable=lambda: notes, readable=lambda: [notes])
    monkeypatch.setattr(trial, "folder", places)
    monkeypatch.setattr(trial, "_libraries", lambda: "gsplat 1.0, torch 1.0")
    monkeypatch.setattr(backend, "WORTHWHILE", 0)
    trial._file.cache_clear()
    trial.card_trouble.cache_clear()
    yield notes
    trial._file.cache_clear()
    trial.card_trouble.cache_clear()


def give_card(monkeypatch: pytest.MonkeyPatch, card) -> None:
    """Have this machine look as if it had a card that draws like this; None: it has none."""
    trial.card_trouble.cache_clear()
    monkeypatch.setattr(trial, "looks_like_a_card", lambda: card is not None)
    monkeypatch.setattr(trial, "has_card", lambda: card is not None)
    monkeypatch.setattr(trial, "rasterizer_of_card", lambda: card)
    monkeypatch.setattr("torch.cuda.get_device_name", lambda: "Card 9")


def fitted(tmp_path, **config):
    views, cameras, points, _ = case(lit=True)
    here = context(tmp_path, views, cameras, points, light="camera", iterations=30, **config)
    FitStage().run(here)
    return here


def test_a_card_that_agrees_is_used(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    # all that is seen is split: which gradients are above a threshold hangs on the last digit, and
    # all lots that are drawn afterwards hang on that
    grows = {
        "densify": True, "densify_from_iter": 10, "densify_until_iter": 30,
        "densification_interval": 10, "densify_abs_grad_threshold": 1e-12,
    }  # fmt: skip
    plain = fitted(tmp_path / "cpu", backend="cpu", **grows)
    assert plain.figures["backend"] == "cpu"
    assert plain.figures["gaussians"] > 2000  # of 1500
    give_card(monkeypatch, STAND_IN)
    card = fitted(tmp_path / "card", **grows)
    assert card.figures["backend"] == "gsplat"
    assert card.figures["train_psnr"] == pytest.approx(plain.figures["train_psnr"], abs=0.1)
    assert card.figures["gaussians"] == pytest.approx(plain.figures["gaussians"], rel=0.02)


def test_short_fits_are_left_to_the_processor(tmp_path, monkeypatch) -> None:
    give_card(monkeypatch, STAND_IN)
    monkeypatch.setattr(backend, "WORTHWHILE", 1e8)
    short = fitted(tmp_path / "auto")
    assert short.figures["backend"] == "cpu" and not short.warnings
    assert fitted(tmp_path / "asked", backend="gsplat").figures["backend"] == "gsplat"


def wrong_way_round(*arguments, **options):
    rendering = STAND_IN(*arguments, **options)
    rendering.planes[:] = rendering.planes[:, ::-1].copy()
    return rendering


def out_of_order(*arguments, **options):
    raise RuntimeError("no kernel image is available")


@pytest.mark.parametrize(
    ("card", "word"), [(wrong_way_round, "images differ"), (out_of_order, "no kernel image")]
)
def test_a_card_that_does_not_is_not(tmp_path, monkeypatch, card, word: str) -> None:
    give_card(monkeypatch, card)
    automatic = fitted(tmp_path / "auto")
    assert automatic.figures["backend"] == "cpu"
    assert any(word in warning for warning in automatic.warnings)
    with pytest.raises(RequestError, match=word):
        fitted(tmp_path / "asked", backend="gsplat")


def test_what_a_compiler_says_at_length_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_compiler():
        raise RuntimeError("Error building extension\n" + "g++: a line of flags\n" * 200)

    monkeypatch.setattr(trial, "rasterizer_of_card", no_compiler)
    why = trial.card_trouble()
    assert why is not None and "building extension" in why
    assert "\n" not in why and len(why) < 400


def test_gsplat_without_kernels_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("gsplat", "gsplat.cuda", "gsplat.cuda._backend"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setattr(sys.modules["gsplat.cuda._backend"], "_C", None, raising=False)
    why = trial.card_trouble()
    assert why is not None and "nvcc" in why


def test_a_card_that_is_not_there_is_explained(tmp_path, monkeypatch) -> None:
    give_card(monkeypatch, None)
    with pytest.raises(RequestError, match="no gsplat"):
        fitted(tmp_path, backend="gsplat")
    give_card(monkeypatch, STAND_IN)
    with pytest.raises(RequestError, match="focal"):
        fitted(tmp_path, backend="gsplat", optimize_focal=True)


def test_the_key_says_what_a_fit_runs_on(monkeypatch: pytest.MonkeyPatch) -> None:
    stage = FitStage()
    give_card(monkeypatch, None)
    assert stage.backend(stage.Config()) == "cpu"
    give_card(monkeypatch, out_of_order)
    assert stage.backend(stage.Config()) == "cpu"
    assert stage.backend(stage.Config(backend="gsplat")) == "Card 9, gsplat 1.0, torch 1.0"
    give_card(monkeypatch, STAND_IN)
    assert stage.backend(stage.Config()) == "Card 9, gsplat 1.0, torch 1.0"
    assert stage.backend(stage.Config(backend="cpu")) == "cpu"
    assert stage.backend(stage.Config(optimize_focal=True)) == "cpu"


def test_what_passed_need_not_be_started_to_be_known(tmp_path, monkeypatch) -> None:
    stage = FitStage()
    give_card(monkeypatch, STAND_IN)
    name = stage.backend(stage.Config())
    monkeypatch.setattr(trial, "has_card", lambda: pytest.fail("the card was started"))
    assert stage.backend(stage.Config()) == name
    # it breaks: what the processor makes is not given out as the card's, and the next run knows
    give_card(monkeypatch, out_of_order)
    with pytest.raises(RequestError, match="no longer does"):
        fitted(tmp_path / "first")
    assert stage.backend(stage.Config()) == "cpu"
    assert fitted(tmp_path / "second").figures["backend"] == "cpu"


def test_other_libraries_are_tried_anew(monkeypatch: pytest.MonkeyPatch, fresh_trial) -> None:
    give_card(monkeypatch, STAND_IN)
    trial.card_in_order()
    trial._file.cache_clear()
    monkeypatch.setattr(trial, "_libraries", lambda: "gsplat 2.0, torch 1.0")
    assert trial.card_in_order() == "Card 9, gsplat 2.0, torch 1.0"
    assert len(list(fresh_trial.iterdir())) == 2
