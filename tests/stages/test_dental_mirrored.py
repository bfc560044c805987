"""Mirror images among photographs of generated mouths, which are no more symmetric than others."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from pipeline.artifacts.dental.fdi import JAWS, permanent_of
from pipeline.artifacts.teeth import Dentition, Teeth
from pipeline.artifacts.views import View, Views
from pipeline.stage import LocalContext
from stages.dentition.corrections import split_polygon
from stages.dentition.crowns import mirrored_dentition, outline_of, with_outlines
from stages.dentition.tooth_rows import NO_TOOTH, Labels
from stages.init.config import InitConfig
from stages.init.dental.cameras.held import HeldCameras, held_cameras
from stages.init.dental.numbering.arch import fit_arch
from stages.init.dental.numbering.arch_options import ArchOptions
from stages.init.dental.numbering.labellings.scorer import (
    Labelling,
    Scorer,
    ViewLabels,
)
from stages.init.dental.numbering.mirrored import MIRRORED, mirror_evidence, mirrored_labels
from stages.init.dental.numbering.sightings import seen_rows
from stages.init.dental.surface.options import SurfaceOptions
from stages.init.dental.template import position_of
from stages.init.stage import InitStage
from tests.stages.mouth_case import (
    WIDTH,
    Case,
    mouth_case,
    relative_errors,
    true_numbers,
    wrong_numbers,
)

ARCH = {"arch_power": 2.5, "arch_width": 1.04, "size": 1.0}
#: The numbers of these mouths are easily found: a short search is enough.
QUICK = ArchOptions(dense_rounds=0, rows_tried=3, candidates_per_view=2, beam=2)
#: The shape of the crowns as it is.
ROUGH = SurfaceOptions(rounds=(), chart_density=3.0)


@cache
def case() -> Case:
    return mouth_case(10, **ARCH)


def true_labels(photographed: Case) -> list[ViewLabels]:
    labels = []
    for photo, seen in zip(photographed.photos, photographed.dentitions(), strict=True):
        truth = true_numbers(photo, seen)
        rows: list[Labels] = [
            tuple(position_of(permanent_of(n)) if n else NO_TOOTH for n in truth[jaw])
            for jaw in JAWS
        ]
        labels.append((rows[0], rows[1]))
    return labels


def evidence(
    dentitions: list[Dentition], labels: list[ViewLabels],
    roles: tuple[str, ...] = ("right", "frontal", "left"), held: HeldCameras | None = None,
) -> dict[int, float]:  # fmt: skip
    count = len(dentitions)
    scorer = Scorer(
        [seen_rows(dentition) for dentition in dentitions], np.full(count, 1.9 * WIDTH),
        np.full(count, 0.12), QUICK, 1, held,
    )  # fmt: skip
    best = scorer.solve(Labelling(tuple(range(count)), roles, tuple(labels)))
    return mirror_evidence(scorer, best, dentitions)


def test_labels_in_the_picture_turned_over() -> None:
    labels = (2, 3, NO_TOOTH, 5, 7), (6,)
    assert mirrored_labels(labels) == ((6, 8, NO_TOOTH, 10, 11), (7,))
    assert mirrored_labels(mirrored_labels(labels)) == labels
    assert mirrored_labels(((), (0, 13))) == ((), (0, 13))


def test_evidence_is_for_the_mirror_image_where_it_is_one() -> None:
    dentitions, labels = case().dentitions(), true_labels(case())
    straight = evidence(dentitions, labels)
    assert list(straight) == [1]
    assert straight[1] < -2 * MIRRORED
    dentitions[1], labels[1] = mirrored_dentition(dentitions[1]), mirrored_labels(labels[1])
    # The same two readings are compared, the other way around.
    assert evidence(dentitions, labels)[1] == pytest.approx(-straight[1], abs=0.5)


def test_evidence_where_a_person_has_numbered_one_part_of_a_crown() -> None:
    """The other part looks like the same tooth; turned over, like that of the other side."""
    dentitions, labels = case().dentitions(), true_labels(case())
    front, place = dentitions[1], labels[1][0].index(position_of(13))
    outlines = [outline_of(crown) for crown in front.all_crowns]
    polygon = outlines[place].polygon
    x, y = polygon.mean(axis=0)
    one, other = split_polygon(polygon, np.array([x, y]), np.array([x, y + 1]))
    if one[:, 0].mean() > x:
        one, other = other, one
    part = replace(outlines[place], polygon=one, number=13, doubt=0.0)
    outlines[place : place + 1] = [part, replace(part, polygon=other, number=0, doubt=1.0)]
    dentitions[1] = with_outlines(front, outlines)
    upper = labels[1][0]
    labels[1] = ((*upper[: place + 1], *upper[place:]), labels[1][1])
    assert evidence(dentitions, labels)[1] < -MIRRORED


def test_evidence_is_about_each_photograph_from_the_front_beside_others() -> None:
    dentitions, labels = case().dentitions(), true_labels(case())
    right, front, left = dentitions
    over, over_labels = mirrored_dentition(front), mirrored_labels(labels[1])
    both = evidence(
        [front, right, over, left], [labels[1], labels[0], over_labels, labels[2]],
        ("frontal", "right", "frontal", "left"),
    )  # fmt: skip
    assert list(both) == [0, 2]
    assert both[0] < -MIRRORED and both[2] > MIRRORED
    assert evidence([front, front], [labels[1], labels[1]], ("frontal", "frontal")) == {}
    assert evidence([right, left], [labels[0], labels[2]], ("right", "left")) == {}


def test_cameras_that_are_known_leave_no_question() -> None:
    dentitions = case().dentitions()
    held = held_cameras([photo.cam_from_world for photo in case().photos],
                        [dentition.roll for dentition in dentitions])  # fmt: skip
    assert evidence(dentitions, true_labels(case()), held=held) == {}


def test_a_mirrored_front_is_doubted_and_named() -> None:
    """A photograph that takes no part comes first: the others keep their places."""
    right, front, left = case().dentitions()
    given = [None, right, mirrored_dentition(front), left]
    views = case().views.views
    shown = [views[0], views[0], views[1].mirrored(), views[2]]
    fit = fit_arch(
        list(given), [view.image for view in shown], [view.valid() for view in shown], [None] * 4,
        QUICK, 1, lambda *_: None, ["out.jpg", "right.jpg", "front.jpg", "left.jpg"],
    )  # fmt: skip
    assert fit.mirrored == (2,)
    assert fit.figures["mirrored_1"] > MIRRORED
    assert fit.confidence < 0.5
    assert any("front.jpg seems to be a mirror image" in doubt for doubt in fit.doubts)


def test_init_turns_a_mirrored_front_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stages.init.dental.place.arch_options", lambda *_: QUICK)
    monkeypatch.setattr("stages.init.dental.place.surface_options", lambda *_: ROUGH)
    photographed = case()
    taken: list[View] = [
        replace(view, source_name=f"{photo.view}.jpg")
        for view, photo in zip(photographed.views.views, photographed.photos, strict=True)
    ]
    truth = photographed.dentitions()
    mirrored = replace(mirrored_dentition(truth[1]), mirrored=None)
    views = Views((taken[0], taken[1].mirrored(), taken[2]))
    inputs = {"views": views, "teeth": Teeth((truth[0], mirrored, truth[2]))}
    context = LocalContext(InitConfig(method="dental"), tmp_path, inputs=inputs, threads=1)
    InitStage().run(context)

    assert [text for text in context.warnings if "mirror" in text] == [
        "front.jpg is a mirror image: the patient's right is on its left where the other "
        "photographs have it on theirs. It was turned over."
    ]
    assert not any("seems" in text for text in context.warnings)
    saved = context.result("views").views
    for before, after in zip(taken, saved, strict=True):
        np.testing.assert_allclose(after.image, before.image, atol=0.5 / 255)
        np.testing.assert_allclose(after.working_from_source, before.working_from_source)
    found = context.result("teeth").views
    assert [view.mirrored for view in found] == [None, True, None]
    wrong, share = wrong_numbers(photographed, list(found))
    assert wrong == []
    assert share > 0.95
    rotations = [camera.rotation for camera in context.result("cameras").cameras]
    assert max(relative_errors(rotations, photographed.rotations)) < 8.0
    assert "undistorted" not in context.figures
