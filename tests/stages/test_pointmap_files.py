"""Pointmaps made elsewhere: names, sizes, transforms, bad values, and what is said of bad files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.artifacts.pointmaps import PointmapPair, write_pair
from pipeline.artifacts.views import View
from pipeline.errors import RequestError
from stages.pointmaps.options import PointmapOptions
from stages.pointmaps.predict import predict_pointmaps, source_files

SIZE = (12, 16)


def views(*names: str) -> list[View]:
    image = np.full((*SIZE, 3), 0.5, np.float32)
    return [View(f"{k:03d}", image, source_name=name) for k, name in enumerate(names)]


def arrays(size=SIZE, **changes) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    maps = {
        "points_i": rng.normal(size=(*size, 3)) + 5,
        "points_j_in_i": rng.normal(size=(*size, 3)) + 5,
        "confidence_i": np.full(size, 4.0),
        "confidence_j": np.full(size, 3.0),
    }
    return maps | changes


def options(folder: Path, names: str = "auto") -> PointmapOptions:
    return PointmapOptions("files", files=folder, file_names=names)


def read(folder: Path, photographs, names: str = "auto"):
    return predict_pointmaps(photographs, False, options(folder, names))


def test_our_own_files_come_back_as_they_are(tmp_path):
    values = {key: value.astype(np.float32) for key, value in arrays().items()}
    write_pair(tmp_path / "000_001.npz", PointmapPair("000", "001", *values.values()))
    (pair,) = read(tmp_path, views("a.jpg", "b.jpg"))
    assert (pair.name_i, pair.name_j) == ("000", "001")
    for key, value in values.items():
        np.testing.assert_array_equal(getattr(pair, key), value)
    assert source_files(options(tmp_path)) == {"000_001.npz": tmp_path / "000_001.npz"}


def test_photographs_are_found_by_file_name_stem_or_path(tmp_path):
    photographs = views("left_buccal.jpg", "front.jpg", "right_buccal.jpg")
    np.savez(tmp_path / "left_buccal_front.npz", **arrays())
    np.savez(tmp_path / "2.npz", **arrays(), names=["right_buccal.jpg", "left_buccal.jpg"])
    np.savez(tmp_path / "3.npz", **arrays(), names=["/elsewhere/front.jpg", "right_buccal.jpg"])
    found = [(pair.name_i, pair.name_j) for pair in read(tmp_path, photographs)]
    assert found == [("000", "001"), ("001", "002"), ("002", "000")]


def test_names_that_mean_two_things_are_asked_about(tmp_path):
    photographs = views("001.jpg", "002.jpg", "000.jpg")
    np.savez(tmp_path / "001_002.npz", **arrays())
    with pytest.raises(RequestError, match=r"init\.pointmap\.file_names=source"):
        read(tmp_path, photographs)
    assert read(tmp_path, photographs, "source")[0].name_i == "000"
    assert read(tmp_path, photographs, "neutral")[0].name_i == "001"


def test_scaled_maps_and_transforms(tmp_path):
    size = (2 * SIZE[0], 2 * SIZE[1])
    flat = np.ones((*size, 3))
    flat[..., 0] = np.arange(size[1]) + 0.5
    flat[..., 2] = 100
    cut = flat[4:, 6:]
    np.savez(
        tmp_path / "a_b.npz", **arrays(size, points_i=flat, points_j_in_i=cut,
        confidence_j=np.full(cut.shape[:2], 3.0)),
        transform_j=np.array([[2.0, 0, -6], [0, 2, -4], [0, 0, 1]]),
    )  # fmt: skip
    (pair,) = read(tmp_path, views("a.jpg", "b.jpg"))
    expected = 2 * (np.arange(SIZE[1]) + 0.5)
    np.testing.assert_allclose(pair.points_i[5, 1:-1, 0], expected[1:-1])
    np.testing.assert_allclose(pair.points_j_in_i[5, 4:-1, 0], expected[4:-1])
    assert (pair.confidence_j[:, :3] == 1).all() and (pair.confidence_j[2:, 3:] == 3).all()


def test_transforms_from_pixels_of_the_original(tmp_path):
    image = np.full((*SIZE, 3), 0.5, np.float32)
    scaled = np.diag([0.25, 0.25, 1.0])
    photographs = [
        View(f"{k:03d}", image, working_from_source=scaled, source_name=name)
        for k, name in enumerate(("a.jpg", "b.jpg"))
    ]
    np.savez(
        tmp_path / "a_b.npz", **arrays(), transform_i=scaled, transform_j=scaled,
        transform_from="source",
    )  # fmt: skip
    (pair,) = read(tmp_path, photographs)
    np.testing.assert_allclose(pair.points_i, arrays()["points_i"], rtol=1e-6)


def test_bad_values_and_masked_pixels_are_unknown(tmp_path):
    changed = arrays()
    changed["points_i"][2, 3] = np.nan
    changed["confidence_i"][4, 5] = np.inf
    changed["confidence_j"][6, 7] = -2
    np.savez(tmp_path / "a_b.npz", **changed)
    photographs = views("a.jpg", "b.jpg")
    mask = np.ones(SIZE, bool)
    mask[:, :4] = False
    photographs[1] = View("001", photographs[1].image, mask, source_name="b.jpg")
    (pair,) = read(tmp_path, photographs)
    assert pair.confidence_i[2, 3] == pair.confidence_i[4, 5] == pair.confidence_j[6, 7] == 1
    assert np.isfinite(pair.points_i).all()
    assert (pair.confidence_j[:, :4] == 1).all()
    assert (pair.confidence_i > 1).sum() == pair.confidence_i.size - 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"points_i": np.ones((5, 5, 3))}, "shape"),
        ({"points_i": np.ones((*SIZE, 4))}, "shape"),
        ({"confidence_j": np.full(SIZE, 0.7)}, "add 1"),
        ({"names": ["a.jpg"]}, "1 names instead of 2"),
        ({"names": ["a.jpg", "c.jpg"]}, "no two of the photographs in use .* or set aside"),
        ({"transform_i": np.eye(4)}, "3x3"),
        ({"transform_from": "original"}, "working or source"),
        ({"points_i": np.array([{}], object)}, "can't be read|lacks"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(tmp_path, changes, message):
    np.savez(tmp_path / "a_b.npz", **(arrays() | changes))
    with pytest.raises(RequestError, match=message) as caught:
        read(tmp_path, views("a.jpg", "b.jpg"))
    assert "a_b.npz" in str(caught.value)


def test_a_name_that_is_there_is_not_taken_for_a_mistake(tmp_path):
    np.savez(tmp_path / "1.npz", **arrays(), names=["front.jpg", "lefft.jpg"])
    with pytest.raises(RequestError, match=r"Did you mean 'left\.jpg'"):
        read(tmp_path, views("front.jpg", "left.jpg"))


def test_missing_arrays_broken_files_and_wrong_shapes(tmp_path):
    photographs = views("a.jpg", "b.jpg")
    with pytest.raises(RequestError, match="no folder"):
        read(tmp_path / "nothing", photographs)
    with pytest.raises(RequestError, match=r"--set init\.pointmap\.files=FOLDER"):
        predict_pointmaps(photographs, False, PointmapOptions("files"))
    with pytest.raises(RequestError, match=r"no \.npz"):
        read(tmp_path, photographs)
    path = tmp_path / "a_b.npz"
    path.write_bytes(b"PK no archive")
    with pytest.raises(RequestError, match="write it again"):
        read(tmp_path, photographs)
    np.savez(path, points_i=np.ones((*SIZE, 3)))
    with pytest.raises(RequestError, match="lacks points_j_in_i"):
        read(tmp_path, photographs)
    np.savez(path, **arrays((24, 24)))
    with pytest.raises(RequestError, match=r"24x24.*16x12"):
        read(tmp_path, photographs)
    np.savez(path, **arrays())
    np.savez(tmp_path / "second.npz", **arrays(), names=["a.jpg", "b.jpg"])
    with pytest.raises(RequestError, match="same pair"):
        read(tmp_path, photographs)
    with pytest.raises(RequestError, match="choose auto"):
        read(tmp_path, photographs, "both")
