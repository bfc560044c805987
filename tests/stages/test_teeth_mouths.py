"""The dental path on generated mouths, which share no constant with the estimator's template."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

import pipeline
from pipeline.artifacts.dental.fdi import JAWS, is_primary, permanent_of
from pipeline.artifacts.teeth import Dentition, Teeth
from pipeline.stage import LocalContext
from pipeline.store import Store
from stages.init.config import InitConfig
from stages.init.dental.numbering.arch import ArchOptions, fit_arch
from stages.init.dental.reconstruct import with_numbers
from stages.init.dental.solution import ArchFit
from stages.init.stage import InitStage
from stages.teeth.read import Reading
from stages.teeth.reader import PhotographReader
from tests.stages.mouth_case import (
    Case,
    mouth_case,
    relative_errors,
    true_numbers,
    wrong_numbers,
)

#: An arch as wide in front as the textbook's; with a narrower one the angles come out too small.
ARCH = {"arch_power": 2.5, "arch_width": 1.04, "size": 1.0}
#: Degrees by which the rotation from one photograph to another may be off, by landmarks alone: the
#: patient's arch is not known.
LANDMARKS_ALONE = 8.0

MOUTHS = {
    "normal": (10, ARCH),
    "missing premolar": (2, {**ARCH, "missing": (14, 18, 28, 38, 48)}),
    "primary": (3, {"dentition": "primary", "missing": ()}),
    "deep bite": (4, {**ARCH, "bite": "deep", "overbite": 5.5, "overjet": 3.5}),
}


@cache
def case(name: str) -> Case:
    """A mouth whose photographs are looked at where it is the normal one."""
    seed, options = MOUTHS[name]
    return mouth_case(seed, dark=name != "normal", **options)


def fitted(photographed: Case, dentitions: list[Dentition], rows_tried: int = 8) -> ArchFit:
    """The fit by landmarks alone; where looks are told, the same comes of 8 rivals as of 40."""
    views = photographed.views.views
    return fit_arch(
        list(dentitions), [view.image for view in views], [view.valid() for view in views],
        [None] * len(views), ArchOptions(dense_rounds=0, rows_tried=rows_tried), 1, lambda *_: None,
    )  # fmt: skip


def named(dentitions: list[Dentition], fit: ArchFit) -> list[Dentition]:
    return [with_numbers(d, view, fit) for d, view in zip(dentitions, fit.views, strict=True)]


@pytest.mark.parametrize("name", MOUTHS)
def test_numbers_and_cameras_from_exact_outlines(name: str) -> None:
    photographed = case(name)
    dentitions = photographed.dentitions()
    fit = fitted(photographed, dentitions)
    assert [view.role for view in fit.views if view] == ["right", "frontal", "left"]
    wrong, share = wrong_numbers(photographed, named(dentitions, fit))
    assert wrong == []
    assert share > 0.94  # the missing premolar: three of 58, all marked
    found = [view.cam_from_world[:3, :3] for view in fit.views if view]
    neighbours = np.array(relative_errors(found, photographed.rotations))[[0, 2]]
    assert neighbours.max() < LANDMARKS_ALONE
    for view, photo in zip(fit.views, photographed.photos, strict=True):
        assert view is not None
        # Three photographs hardly tell the lens: what is expected may lie a third off.
        assert view.focal == pytest.approx(photo.fx, rel=0.3)


def test_without_looks_the_arch_alone_names_the_teeth() -> None:
    photographed = case("missing premolar")
    dentitions = photographed.dentitions(tell=False)
    fit = fitted(photographed, dentitions, rows_tried=40)
    wrong, share = wrong_numbers(photographed, named(dentitions, fit))
    assert wrong == []
    assert share > 0.9


@cache
def changing(seed: int) -> tuple[Case, tuple[Dentition, ...], ArchFit]:
    photographed = mouth_case(seed, dark=True, dentition="mixed", missing=())
    dentitions = photographed.dentitions()
    return photographed, tuple(dentitions), fitted(photographed, dentitions)


@pytest.mark.parametrize(
    ("seed", "known"), [(5, set()), (15, {("right", 63, 22), ("left", 12, 53)})]
)
def test_places_of_changing_teeth(seed: int, known: set[tuple[str, int, int]]) -> None:
    """All but a strip at the end of a row, and across the midline what is taken for a part of 12;
    however doubtful they are."""
    photographed, dentitions, fit = changing(seed)
    wrong = set()
    for photo, dentition in zip(photographed.photos, named(list(dentitions), fit), strict=True):
        truth = true_numbers(photo, dentition)
        for jaw in JAWS:
            for crown, true in zip(dentition.crowns(jaw), truth[jaw], strict=True):
                if crown.number and permanent_of(crown.number) != permanent_of(true):
                    wrong.add((photo.view, crown.number, true))
    assert wrong <= known


@pytest.mark.parametrize(
    "seed", [15, 5, 7], ids=["in order", "34 and 44 before 33 and 43", "82 before 72"]
)
def test_primary_teeth_among_permanent_ones_are_told(seed: int) -> None:
    """The second primary molar stands beside the first permanent one for six years."""
    photographed, dentitions, fit = changing(seed)
    primary = set()
    for photo, dentition in zip(photographed.photos, dentitions, strict=True):
        for row in true_numbers(photo, dentition).values():
            primary |= {permanent_of(tooth) for tooth in row if is_primary(tooth)}
    assert fit.primary == primary


@pytest.fixture(scope="module")
def upright() -> list[Reading]:
    return PhotographReader(case("normal").views.views, 1).read(lambda *_: None)


@pytest.mark.parametrize("quarters", [(2, 2, 2), (0, 1, 3), (0, 2, 0)])
def test_photographs_are_read_whichever_way_up_they_are(
    upright: list[Reading], quarters: tuple[int, ...]
) -> None:
    """All from behind the patient's head, or some; two that lost on which side they were taken."""
    turned = [
        replace(view, image=np.ascontiguousarray(np.rot90(view.image, k)))
        for view, k in zip(case("normal").views.views, quarters, strict=True)
    ]
    found = PhotographReader(turned, 1).read(lambda *_: None)
    for one, other, k in zip(upright, found, quarters, strict=True):
        more = (other.dentition.roll - one.dentition.roll + k * np.pi / 2) / (2 * np.pi)
        assert abs(more - round(more)) < 0.02
        for jaw in JAWS:
            numbers = [crown.number for crown in one.dentition.crowns(jaw)]
            assert len(numbers) > 6
            assert [crown.number for crown in other.dentition.crowns(jaw)] == numbers


@pytest.mark.slow
def test_init_makes_a_scene_of_exact_outlines(tmp_path: Path) -> None:
    photographed = case("normal")
    read = Teeth(tuple(photographed.dentitions()))
    inputs = {"views": photographed.views, "teeth": read}
    config = InitConfig(method="dental", dental={"accept_doubtful": True, "chart_density": 5})
    context = LocalContext(config, tmp_path, inputs=inputs, threads=1)
    InitStage().run(context)
    check_scene(photographed, context.result("teeth"), context.result("cameras"))
    points = context.result("points")
    assert len(points) > 10_000
    assert context.figures["upper_teeth"] >= 12


@pytest.mark.slow
def test_photographs_become_a_scene(tmp_path: Path) -> None:
    """The whole way: files, the learned reader, numbers, cameras."""
    photographed = case("normal")
    photos = tmp_path / "photos"
    photos.mkdir()
    for photo in photographed.photos:
        cv2.imwrite(
            str(photos / f"{photo.view}.jpg"), photo.image[..., ::-1],
            [cv2.IMWRITE_JPEG_QUALITY, 96],
        )  # fmt: skip
    done = pipeline.run(
        photos, workspace=tmp_path / "w", stages=["views", "teeth", "init"],
        overrides=["init.method=dental", "init.dental.accept_doubtful=true", "report=false"],
    )  # fmt: skip
    assert [stage.name for stage in done.stages] == ["views", "teeth", "init"]
    store = Store(done.workspace)

    def load(stage: str, kind: str):  # type: ignore[no-untyped-def]
        outcome = next(entry for entry in done.stages if entry.name == stage)
        result = store.find(stage, outcome.key or "")
        assert result is not None
        return store.load(result, kind)

    sources = {view.name: Path(view.source_name).stem for view in load("views", "views").views}
    by_role = {photo.view: photo for photo in photographed.photos}
    ordered = Case(tuple(by_role[role] for role in sources.values()))
    read = load("teeth", "teeth")
    assert [view.name for view in read.chosen] == list(sources)
    check_scene(ordered, load("init", "teeth"), load("init", "cameras"))


def check_scene(photographed: Case, teeth: Teeth, cameras) -> None:  # type: ignore[no-untyped-def]
    """Numbers as the label maps have them, cameras turned to each other as they truly were."""
    numbered = [teeth.by_name()[f"{k:03d}"] for k in range(len(photographed.photos))]
    wrong, share = wrong_numbers(photographed, numbered)
    assert wrong == []
    assert share > 0.9
    assert all(crown.number for view in numbered for crown in view.upper[1:-1])
    found = [cameras.by_name()[view.name].rotation for view in numbered]
    assert max(relative_errors(found, photographed.rotations)) < 2 * LANDMARKS_ALONE
    assert cameras.units == "mm"
