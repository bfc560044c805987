"""Two photographs that are one picture turned over are told from photographs of both sides."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.artifacts.teeth import Crown, Dentition
from pipeline.artifacts.views import View
from pipeline.errors import ReconstructionError
from stages.init.dental import reconstruct
from stages.init.dental.numbering.arch_options import ArchOptions
from stages.init.dental.solution import ArchFit, PlacedView
from stages.photographs.copies import turned_copies

SAMPLES = Path(__file__).parents[2] / "data_samples" / "three_photos"
NAMES = ("right_buccal", "frontal", "left_buccal")


def sample(name: str) -> np.ndarray:
    return np.float32(cv2.imread(str(SAMPLES / f"{name}.jpg"))[..., ::-1] / 255)


def sent(image: np.ndarray) -> np.ndarray:
    """A photograph cut, made small and compressed."""
    height, width = image.shape[:2]
    cut = image[height // 20 :, width // 10 :]
    small = cv2.resize(cut, None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)
    levels = np.rint(255 * small[..., ::-1]).astype(np.uint8)
    coded = cv2.imencode(".jpg", levels, [cv2.IMWRITE_JPEG_QUALITY, 50])[1]
    return np.float32(cv2.imdecode(coded, cv2.IMREAD_COLOR)[..., ::-1] / 255)


def over(image: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(image[:, ::-1])


def test_three_photographs_are_three_pictures() -> None:
    assert turned_copies({k: sample(name) for k, name in enumerate(NAMES)}) == []


@pytest.mark.parametrize("name", NAMES)
def test_a_picture_turned_over_is_known_again(name: str) -> None:
    image = sample(name)
    assert turned_copies({2: image, 5: over(image)}) == [(2, 5)]
    assert turned_copies({2: sent(over(image)), 5: image, 7: sample("frontal")})[0] == (2, 5)
    upside_down = cv2.rotate(over(image), cv2.ROTATE_180)
    assert turned_copies({0: image, 1: upside_down}) == [(0, 1)]


def test_the_same_picture_twice_is_not_turned_over() -> None:
    image = sample("right_buccal")
    assert turned_copies({0: image, 1: sent(image)}) == []


def test_a_picture_without_detail_is_nobodys_copy() -> None:
    blank = np.full((300, 400, 3), 0.5, np.float32)
    assert turned_copies({0: blank, 1: blank}) == []


def test_a_side_that_was_made_of_the_other_one_makes_no_scene(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    corners = np.array([[50.0, 50], [90, 50], [90, 120], [50, 120]])
    crown = Crown("upper", corners[0], corners[2], None, None, None, None, 40, 70, outline=corners)

    def fit(dentitions: list[Dentition | None], *_: object) -> ArchFit:
        placed = PlacedView(np.eye(4), 500.0, "frontal", (11,), (), 1.0, (0.0,))
        return ArchFit(tuple(d and placed for d in dentitions), {}, {}, 50.0, confidence=0.9)

    monkeypatch.setattr(reconstruct, "fit_arch", fit)

    def place(left: np.ndarray) -> reconstruct.PlacedTeeth:
        images = [sample("right_buccal"), sample("frontal"), left]
        views = [View(f"{k:03d}", image) for k, image in enumerate(images)]
        seen = [Dentition(v.name, (v.width, v.height), "front", (crown,)) for v in views]
        return reconstruct.place_teeth(
            views, ["r.jpg", "f.jpg", "l.jpg"], [*seen], [None] * 3, ArchOptions(),
            accept_doubtful=False, threads=1, progress=lambda *_: None,
        )  # fmt: skip

    assert not place(sample("left_buccal")).fit.doubts
    with pytest.raises(ReconstructionError, match=r"r\.jpg and l\.jpg are one picture, one of"):
        place(over(sample("right_buccal")))
