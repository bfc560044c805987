"""Frames of a film are spread by how much they differ."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from pipeline.untrusted.files import FILM, opened
from stages.views.reading.video import Wanted, map_frames
from stages.views.sampling import uniform_indices
from stages.views.spread import STILL, distances, is_even, spread_indices

COUNT = 120


def film(path: Path, shifts: list[int], key_every: int) -> Path:
    """A wide picture that is seen through a window, at these columns."""
    small = np.random.default_rng(3).integers(0, 255, (3, 15, 3), np.uint8)
    wide = cv2.resize(small, None, fx=64, fy=64, interpolation=cv2.INTER_CUBIC)
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 256, 192, "yuv420p"
        coded = f"keyint={key_every}:min-keyint={key_every}:scenecut=0"
        stream.options = {"crf": "16", "threads": "1", "x264-params": coded}
        for left in shifts:
            pixels = np.ascontiguousarray(wide[:, left : left + 256])
            for packet in stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


def chosen(path: Path, wanted: Wanted) -> list[int]:
    with opened(path, FILM) as file:
        return map_frames(file, lambda frame: frame.index, wanted)


@pytest.mark.parametrize(("key_every", "name"), [(10, "x.mp4"), (250, "x.mp4"), (10, "x.ts")])
def test_a_hand_that_rests(tmp_path: Path, key_every: int, name: str) -> None:
    """Half a film at rest, then a pan of 480 pixels: at most four frames of twelve show rest."""
    shifts = [0] * 60 + [8 * k for k in range(60)]
    path = film(tmp_path / name, shifts, key_every)
    found = chosen(path, Wanted(12, by_difference=True))
    assert (found[0], found[-1], len(found)) == (0, 119, 12)
    assert sum(index < 60 for index in found) <= 4
    steps = np.diff([shifts[index] for index in found[1:]])
    assert steps.max() < 2.5 * 480 / 11
    assert chosen(path, Wanted(12)) == uniform_indices(COUNT, 12)


def test_a_film_that_is_damaged_within(tmp_path: Path) -> None:
    path = film(tmp_path / "x.mp4", [0] * 60 + [8 * k for k in range(60)], 10)
    data = bytearray(path.read_bytes())
    start, size = data.index(b"mdat") + 4, len(data)
    data[start + (size - start) // 2 : start + (size - start) // 2 + 3000] = bytes(3000)
    path.write_bytes(data)
    by_time = chosen(path, Wanted(4))
    found = chosen(path, Wanted(4, by_difference=True))
    assert len(found) == len(by_time) and (found[0], found[-1]) == (by_time[0], by_time[-1])


def test_frames_that_are_asked_for_are_among_them(tmp_path: Path) -> None:
    path = film(tmp_path / "x.mp4", [4 * k for k in range(COUNT)], 10)
    by_time = chosen(path, Wanted(5, also=frozenset({7, 118, 500})))
    assert by_time == sorted({*uniform_indices(COUNT, 5), 7, 118})
    by_difference = chosen(path, Wanted(5, by_difference=True, also=frozenset({7, 118, 500})))
    assert {7, 118} <= set(by_difference) and len(by_difference) == 7
    steady = [index for index in by_difference if index not in (7, 118)]
    np.testing.assert_allclose(steady, uniform_indices(COUNT, 5), atol=6)


def test_what_stands_still_is_spread_by_number(tmp_path: Path) -> None:
    path = film(tmp_path / "x.mp4", [9] * 40, 10)
    assert chosen(path, Wanted(7, by_difference=True)) == uniform_indices(40, 7)
    assert chosen(path, Wanted(40, by_difference=True)) == list(range(40))
    apart = np.full((8, 8), STILL / 2, np.float32)
    assert spread_indices(list(range(0, 40, 5)), apart, 40, 5) == uniform_indices(40, 5)


def test_frames_are_distinct_and_in_order_whatever_they_show() -> None:
    random = np.random.default_rng(0)
    for _ in range(300):
        count = int(random.integers(2, 90))
        glances = int(random.integers(2, count + 1))
        wanted = int(random.integers(2, glances + 1))
        inner = random.choice(np.arange(1, count - 1), glances - 2, replace=False)
        places = [0, *np.sort(inner).tolist(), count - 1]
        looks = random.normal(size=(glances, 3)).cumsum(0) ** random.integers(1, 4)
        apart = np.linalg.norm(looks[:, None] - looks[None], axis=-1).astype(np.float32)
        found = spread_indices(places, apart, count, wanted)
        assert len(found) == wanted
        assert (found[0], found[-1]) == (0, count - 1)
        assert np.all(np.diff(found) > 0)


def test_a_hand_that_shakes_at_rest_gets_nowhere() -> None:
    """The frames of a rest differ from each other, but never by more than .15."""
    random = np.random.default_rng(1)
    angle = np.concatenate([np.zeros(60), np.linspace(0, 3, 60)])
    shake = random.uniform(-0.07, 0.07, 120)
    apart = np.abs(np.subtract.outer(angle + shake, angle + shake)).astype(np.float32)
    found = spread_indices(list(range(120)), apart, 120, 12)
    assert sum(index < 60 for index in found) <= 3
    assert not is_even(apart)
    assert is_even(np.abs(np.subtract.outer(np.arange(9.0), np.arange(9.0))).astype(np.float32))


def test_the_way_to_the_mouth_and_cuts_are_no_views() -> None:
    """Twelve pictures at either end that have nothing in common with any other."""
    angle = np.linspace(0, 1.2, 96)
    apart = np.full((120, 120), 1.3, np.float32)
    np.fill_diagonal(apart, 0)
    apart[12:108, 12:108] = np.abs(np.subtract.outer(angle, angle))
    found = spread_indices(list(range(120)), apart, 120, 12)
    assert sum(12 <= index < 108 for index in found) >= 9


def test_distances() -> None:
    small = np.random.default_rng(1).integers(0, 255, (8, 20), np.uint8)
    wide = cv2.resize(small, (320, 128), interpolation=cv2.INTER_CUBIC)
    glances = [wide[:48, left : left + 64] for left in (0, 2, 8, 200)]
    apart = distances([*glances, (0.5 * glances[0].astype(float) + 40).astype(np.uint8)])
    np.testing.assert_allclose(np.diagonal(apart), 0, atol=1e-3)
    np.testing.assert_allclose(apart, apart.T, atol=1e-6)
    assert 0.05 < apart[0, 1] < apart[0, 2] < apart[0, 3]
    assert apart[0, 4] < 0.02  # darker, but the same
    odd = [glances[0], wide[:64, :48], np.full((48, 64), 9, np.uint8), wide[:4, :64]]
    assert np.isfinite(distances(odd)).all()
