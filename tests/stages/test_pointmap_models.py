"""Every adapter with a stand-in for its package: calls, pixels, cameras, and what is missing."""

from __future__ import annotations

import socket
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from pipeline.artifacts.views import View
from pipeline.errors import RequestError
from stages.pointmaps.loading import NoNetworkError, choose_device, import_module, offline
from stages.pointmaps.memory import check_memory, needed_gb
from stages.pointmaps.options import MODELS, PointmapOptions
from stages.pointmaps.predict import (
    adapter,
    available,
    cards,
    predict_pointmaps,
    source_files,
)
from stages.pointmaps.quick_start import quick_start
from tests.stages import pointmap_models as stand_in

ANGLES = (-20.0, -4.0, 12.0)


def photographs(sizes=((128, 96),) * 3, angles=ANGLES):
    cameras, images, depths, _ = stand_in.scene.scene(angles, sizes)
    views = [
        View(c.name, image, source_name=f"photo_{k}.jpg")
        for k, (c, image) in enumerate(zip(cameras, images, strict=True))
    ]
    return cameras, views, depths


def weights(tmp_path: Path) -> Path:
    path = tmp_path / "weights.pt"
    torch.save({"a": torch.zeros(1)}, path)
    return path


def camera_errors(found, truth) -> tuple[float, float]:
    """Largest rotation error in degrees after alignment, and of the focal length, relative."""
    matrix = Rotation.align_vectors(
        np.concatenate([c.rotation for c in truth]), np.concatenate([c.rotation for c in found])
    )[0].as_matrix()
    rotation = max(
        np.degrees(Rotation.from_matrix(f.rotation @ matrix.T @ t.rotation.T).magnitude())
        for f, t in zip(found, truth, strict=True)
    )
    return float(rotation), max(abs(f.fx / t.fx - 1) for f, t in zip(found, truth, strict=True))


@pytest.mark.parametrize("method", MODELS)
def test_exact_answers_give_the_exact_pointmaps_and_cameras(method, monkeypatch, tmp_path):
    cameras, views, depths = photographs()
    # 120 x 90 is cut to 112 x 80 by the dust3r family.
    long_side = 0 if method in ("vggt", "mapanything") else 120
    truth = stand_in.Truth(cameras, long_side=long_side)
    stand_in.FAKES[method](monkeypatch, truth)
    options = PointmapOptions(
        method, checkpoint=weights(tmp_path), device="cpu", long_side=120, graph="complete"
    )
    pairs = predict_pointmaps(views, True, options)
    assert len(pairs) == (6 if method in ("dust3r", "mast3r") else 3)
    for pair in pairs:
        i, j = int(pair.name_i), int(pair.name_j)
        known = pair.confidence_i > 1
        assert known.shape == (96, 128)
        assert known.mean() > 0.75
        exact = stand_in.local(cameras[i], depths[i], cameras[i])
        scale = np.median(pair.points_i[known] @ [0, 0, 1] / exact[known][:, 2])
        off = np.linalg.norm(pair.points_i - scale * exact, axis=-1)[known] / scale
        # Half a pixel where an odd number of pixels is cut off; the depth is about 4.
        assert np.median(off) < 0.004
        assert np.percentile(off, 95) < 0.012
        known = pair.confidence_j > 1
        other = stand_in.local(cameras[j], depths[j], cameras[i])
        off = np.linalg.norm(pair.points_j_in_i - scale * other, axis=-1)[known] / scale
        assert np.median(off) < 0.006
    start = quick_start(pairs, views)
    rotation, focal = camera_errors(start.cameras, cameras)
    assert rotation < 0.1
    assert focal < 0.005
    assert not start.unplaced
    assert len(start.points) > 20_000


@pytest.mark.parametrize("method", ["dust3r", "vggt"])
def test_spoiled_answers_of_mixed_sizes_still_place_the_cameras(method, monkeypatch, tmp_path):
    cameras, views, _ = photographs(((128, 96), (96, 128), (120, 96)))
    truth = stand_in.Truth(cameras, noise=0.01, outliers=0.05, hole=True)
    stand_in.FAKES[method](monkeypatch, truth)
    if method == "vggt":  # its stand-in knows only images that it sees whole
        cameras, views, _ = photographs()
        truth.cameras = cameras
    options = PointmapOptions(method, weights(tmp_path), device="cpu", long_side=128)
    pairs = predict_pointmaps(views, False, options)
    for pair in pairs:
        assert np.isfinite(pair.points_i).all() and np.isfinite(pair.confidence_j).all()
        assert pair.confidence_i.min() == 1  # the hole
    start = quick_start(pairs, views, seed=3, max_points=5000)
    rotation, focal = camera_errors(start.cameras, cameras)
    assert rotation < 0.5
    assert focal < 0.02
    assert len(start.points) == 5000
    known = quick_start(pairs, views, focals={"000": 200.0})
    assert known.cameras[0].fx == 200.0


def test_the_graph_and_the_mask_are_respected(monkeypatch, tmp_path):
    cameras, views, _ = photographs()
    mask = np.zeros((96, 128), bool)
    mask[:, 40:] = True
    views[1] = View("001", views[1].image, mask)
    truth = stand_in.Truth(cameras)
    stand_in.fake_dust3r(monkeypatch, truth)
    options = PointmapOptions(
        "dust3r", weights(tmp_path), device="cpu", long_side=128, graph="star", symmetric=False
    )
    said = []
    pairs = predict_pointmaps(views, True, options, lambda *step: said.append(step))
    assert [(p.name_i, p.name_j) for p in pairs] == [("001", "000"), ("001", "002")]
    assert (pairs[0].confidence_i[~mask] == 1).all()
    assert (pairs[0].confidence_i[mask] > 1).mean() > 0.95
    assert said[-1] == ("pointmaps", 2, 2)


@pytest.mark.parametrize("method", MODELS)
def test_a_missing_package_is_said_with_source_and_licences(method):
    card = adapter(method).card
    if method in available():
        pytest.skip(f"{card.title} is installed here")
    _, views, _ = photographs()
    with pytest.raises(RequestError) as caught:
        predict_pointmaps(views, True, PointmapOptions(method, device="cpu"))
    message = str(caught.value)
    for part in (card.title, card.repository, card.install, card.code_licence, card.weights):
        assert part in message
    assert caught.value.exit_status == 2


def test_missing_or_broken_weights_and_foreign_packages_are_said(monkeypatch, tmp_path):
    cameras, views, _ = photographs()
    stand_in.fake_must3r(monkeypatch, stand_in.Truth(cameras))
    with pytest.raises(RequestError, match="needs the path of its weights"):
        predict_pointmaps(views, True, PointmapOptions("must3r", device="cpu"))
    nothing = tmp_path / "no.pth"
    with pytest.raises(RequestError, match="no weights of MUSt3R at"):
        predict_pointmaps(views, True, PointmapOptions("must3r", nothing, device="cpu"))
    stand_in.fake_vggt(monkeypatch, stand_in.Truth(cameras))
    broken = tmp_path / "model.pt"
    broken.write_bytes(b"no weights")
    with pytest.raises(RequestError, match="could not be loaded"):
        predict_pointmaps(views, True, PointmapOptions("vggt", broken, device="cpu"))
    stand_in.module(monkeypatch, "dust3r")
    with pytest.raises(RequestError, match=r"importing dust3r\.model fails"):
        predict_pointmaps(views, True, PointmapOptions("dust3r", device="cpu"))
    with pytest.raises(RequestError, match="no folder"):
        import_module(adapter("vggt").card, "models", None, tmp_path / "nowhere")


def test_nothing_reaches_the_network_while_a_model_loads():
    card = adapter("vggt").card
    with pytest.raises(RequestError, match="never downloaded"), offline(card):
        socket.create_connection(("192.0.2.1", 80))
    with offline(card), pytest.raises(NoNetworkError):
        socket.getaddrinfo("example.org", 80)
    one, two = socket.socketpair()
    one.close()
    two.close()


def test_a_fork_under_another_name_and_a_checkout(monkeypatch, tmp_path):
    cameras, views, _ = photographs()
    truth = stand_in.Truth(cameras)
    stand_in.fake_must3r(monkeypatch, truth)
    for name in [n for n in sys.modules if n.split(".")[0] == "must3r"]:
        monkeypatch.setitem(sys.modules, "my" + name, sys.modules[name])
        monkeypatch.delitem(sys.modules, name)
    options = PointmapOptions("must3r", weights(tmp_path), package="mymust3r", device="cpu")
    assert len(predict_pointmaps(views, True, options)) == 3
    checkout = tmp_path / "checkout" / "vggtfork"
    checkout.mkdir(parents=True)
    (checkout / "__init__.py").write_text("")
    (checkout / "thing.py").write_text("answer = 42\n")
    monkeypatch.setattr(sys, "path", list(sys.path))
    found = import_module(adapter("vggt").card, "thing", "vggtfork", checkout.parent)
    assert found.answer == 42
    for name in ("vggtfork", "vggtfork.thing"):
        sys.modules.pop(name)


def test_an_answer_of_another_shape_is_refused(monkeypatch, tmp_path):
    cameras, views, _ = photographs()
    stand_in.fake_dust3r(monkeypatch, stand_in.Truth(cameras))
    good = sys.modules["dust3r.inference"].inference

    def inference(*arguments, **named):
        answer = good(*arguments, **named)
        answer["pred1"]["pts3d"] = answer["pred1"]["pts3d"][:, :-1]
        return answer

    sys.modules["dust3r.inference"].inference = inference
    options = PointmapOptions("dust3r", weights(tmp_path), device="cpu", long_side=128)
    with pytest.raises(RequestError, match="version"):
        predict_pointmaps(views, True, options)


def test_memory_is_asked_for_before_anything_is_loaded(monkeypatch, tmp_path):
    cameras, views, _ = photographs()
    truth = stand_in.Truth(cameras)
    stand_in.fake_vggt(monkeypatch, truth)
    options = PointmapOptions("vggt", weights(tmp_path), device="cpu", max_memory_gb=4.0)
    with pytest.raises(RequestError, match=r"needs about .* GB .* fewer views"):
        predict_pointmaps(views, True, options)
    assert not truth.calls
    card = adapter("dust3r").card
    assert needed_gb(card, [card.pixels] * 9, False) == needed_gb(card, [card.pixels] * 2, False)
    more = needed_gb(card, [card.pixels] * 9, True) - needed_gb(card, [card.pixels] * 2, True)
    assert more == pytest.approx(7 * card.gb_per_image)
    with pytest.raises(RequestError, match="symmetric"):
        check_memory(card, torch.device("cpu"), 3.0, 2.0, 4.0, False)
    check_memory(card, torch.device("cpu"), 3.0, 2.0, 6.0, False)


def test_unknown_names_and_devices_are_refused():
    _, views, _ = photographs()
    with pytest.raises(RequestError, match="Did you mean 'dust3r'"):
        predict_pointmaps(views, True, PointmapOptions("duster", device="cpu"))
    with pytest.raises(RequestError, match="at least two"):
        predict_pointmaps(views[:1], True, PointmapOptions("dust3r"))
    with pytest.raises(RequestError, match=r"^init\.pointmap\.device: there is no"):
        choose_device("gpu")
    assert choose_device("cpu").type == "cpu"
    assert {card.name for card in cards()} == set(MODELS)


def test_files_that_the_result_depends_on(tmp_path):
    assert source_files(PointmapOptions("vggt")) == {}
    path = weights(tmp_path)
    assert source_files(PointmapOptions("vggt", path)) == {"checkpoint": path}
    assert source_files(PointmapOptions("mapanything", tmp_path)) == {"weights.pt": path}
    assert source_files(PointmapOptions("files", files=tmp_path)) == {}
