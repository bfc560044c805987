"""Photographs that a run took smaller are read anew where their files are as they were."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from pipeline.artifacts.views import View
from pipeline.studies.register.pictures.originals import LARGEST, larger_photographs
from stages.views.load import Loaded, load_photos, load_video
from stages.views.reading.video import Wanted

SMALL = 200


def view_of(item: Loaded, name: str) -> View:
    """As the stage `views` notes it."""
    picture = item.picture
    return View(
        name, picture.rgb.astype(np.float32) / 255,
        working_from_source=picture.working_from_source, source_size=picture.source_size,
        source_name=item.source_name, source_sha256=item.source_sha256,
    )  # fmt: skip


def scene(seed: int, width: int, height: int) -> np.ndarray:
    small = np.random.default_rng(seed).integers(0, 255, (9, 12, 3), np.uint8)
    return np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC))


@pytest.fixture
def case(tmp_path: Path) -> Any:
    for seed in (1, 2):
        cv2.imwrite(str(tmp_path / f"p{seed}.png"), scene(seed, 1600, 1200))
    return SimpleNamespace(request={"images": [str(tmp_path)]}, settings={})


def views_of(folder: Path) -> list[View]:
    files = {f"p{seed}.png": folder / f"p{seed}.png" for seed in (1, 2)}
    return [view_of(item, f"00{k}") for k, item in enumerate(load_photos(files, {}, SMALL, 64))]


def agrees(large: np.ndarray, view: View) -> bool:
    """A larger picture shows what the view shows, at the same place."""
    small = cv2.resize(large, (view.width, view.height), interpolation=cv2.INTER_AREA)
    return float(np.abs(small - view.gray() / np.float32(255)).max()) < 0.02


def test_photographs_are_read_with_more_pixels(case: Any, tmp_path: Path) -> None:
    views = views_of(tmp_path)
    views[1] = views[1].mirrored()
    found, lost = larger_photographs(case, views)
    assert not lost
    assert sorted(found) == ["000", "001"]
    assert all(found[view.name].shape == (LARGEST * 3 // 4, LARGEST) for view in views)
    assert all(agrees(found[view.name], view) for view in views)


def test_what_has_changed_or_is_gone_is_left_out(case: Any, tmp_path: Path) -> None:
    views = views_of(tmp_path)
    cv2.imwrite(str(tmp_path / "p1.png"), scene(3, 1600, 1200))
    found, lost = larger_photographs(case, views)
    assert (list(found), lost) == (["001"], ("p1.png",))
    (tmp_path / "p2.png").unlink()
    assert larger_photographs(case, views) == ({}, ("p1.png", "p2.png"))
    case.request["images"] = [str(tmp_path / "nowhere")]
    assert larger_photographs(case, views) == ({}, ("p1.png", "p2.png"))


def test_what_has_no_more_pixels_is_not_read(case: Any, tmp_path: Path) -> None:
    case.request["images"] = [str(tmp_path / "nowhere")]
    assert larger_photographs(case, [View("000", np.zeros((60, 80, 3), np.float32))]) == ({}, ())


def test_frames_of_a_film_are_read_with_more_pixels(tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 25, (640, 480))
    for seed in range(8):
        writer.write(scene(seed, 640, 480))
    writer.release()
    items = load_video("film.mp4", path, None, Wanted(3), SMALL, 64)
    views = [view_of(item, f"00{k}") for k, item in enumerate(items)]
    case: Any = SimpleNamespace(request={"images": [str(path)]}, settings={})
    found, lost = larger_photographs(case, views[1:])
    assert not lost
    assert sorted(found) == ["001", "002"]
    assert all(found[v.name].shape == (480, 640) and agrees(found[v.name], v) for v in views[1:])
