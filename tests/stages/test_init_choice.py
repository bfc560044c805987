"""Features or teeth: which of them places the photographs, and what is said of that."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.dental.corrections import CORRECTIONS
from pipeline.artifacts.teeth import UNREAD, Dentition, Teeth
from pipeline.artifacts.views import Views
from pipeline.errors import ReconstructionError, RequestError
from pipeline.stage import LocalContext
from stages.dentition.corrections import LEFT_OUT
from stages.init.config import InitConfig
from stages.init.dental.choice import ByTeeth
from stages.init.dental.place import only_two
from stages.init.dental.read import labelled_teeth, turned_as_said
from stages.init.placement import Placement
from stages.init.sfm.options import ClassicalOptions
from stages.init.sfm.sounding import Sounding, sound
from stages.init.stage import InitStage
from tests.stages.init_teeth_case import SIZE, photographs, read_teeth
from tests.teeth_case import write

SAMPLES = Path(__file__).resolve().parents[2] / "data_samples" / "three_photos"


@pytest.fixture
def no_features(monkeypatch):
    """Photographs that share nothing."""

    def unplaced(*_, **__):
        raise ReconstructionError("0 of 3 photographs could be placed.")

    monkeypatch.setattr("stages.init.place.place_classical", unplaced)


def auto(tmp_path, count, read=None, sources=None, **config):
    inputs = {"views": photographs(count)} | ({"teeth": read} if read else {})
    context = LocalContext(InitConfig(**config), tmp_path, inputs, sources or {}, threads=1)
    InitStage().run(context)
    return context


def test_teeth_are_tried_where_features_fail_and_only_there(tmp_path, monkeypatch, no_features):
    tried = []
    monkeypatch.setattr(
        "stages.init.dental.place.from_teeth", lambda context, views: tried.append(1)
    )
    none = Teeth(tuple(Dentition(f"{k:03d}", SIZE[::-1], "none") for k in range(3)))
    refused = [
        ("unread", 3, None, {}),
        ("landscape", 3, none, {}),
        ("features", 3, read_teeth(), {"method": "colmap"}),
        ("one_of_two", 2, read_teeth(2, aside=(0,)), {}),
        ("aside", 3, read_teeth(aside=(0, 2)), {}),
    ]
    for name, count, read, settings in refused:
        with pytest.raises(ReconstructionError, match="could be placed"):
            auto(tmp_path / name, count, read, **settings)
    assert not tried
    auto(tmp_path / "teeth", 3, read_teeth())
    assert tried == [1]
    auto(tmp_path / "more", 4, read_teeth(4, aside=(3,)))
    auto(tmp_path / "pair", 2, read_teeth(2))
    auto(tmp_path / "one_aside", 3, read_teeth(aside=(0,)))
    assert tried == [1, 1, 1, 1]


def test_what_was_set_aside_is_named_and_taken_in_when_a_person_says_so(
    tmp_path, monkeypatch, no_features
):
    tried = []
    monkeypatch.setattr(
        "stages.init.dental.place.from_teeth", lambda context, views: tried.append(1)
    )
    read = read_teeth(aside=(0, 1))
    with pytest.raises(ReconstructionError, match=r"1 of 3 do \(p0.jpg, p1.jpg: .*check") as caught:
        auto(tmp_path / "a", 3, read)
    assert caught.value.artifacts == {"teeth": read}
    with pytest.raises(ReconstructionError, match=r"0 of 3 do \(p0.jpg, p1.jpg, p2.jpg: .*check"):
        auto(tmp_path / "none", 3, read_teeth(aside=(0, 1, 2)))
    with pytest.raises(
        ReconstructionError, match=r"1 of 8 do \(p0.jpg, p1.jpg, p2.jpg and 4 more: "
    ):
        auto(tmp_path / "film", 8, read_teeth(8, aside=range(7)))
    unread = Teeth((*read_teeth(8, aside=range(7)).views[:6], *(
        Dentition(f"{k:03d}", SIZE[::-1], UNREAD) for k in (6, 7)
    )))  # fmt: skip
    with pytest.raises(ReconstructionError, match=r"0 of 8 do .*jaw only; 2 were not read"):
        auto(tmp_path / "unread", 8, unread)
    said = write(tmp_path / CORRECTIONS, "photographs: {p0.jpg: {use: true}}")
    auto(tmp_path / "b", 3, read, {CORRECTIONS: said})
    assert tried == [1]


def test_both_diagnoses_are_told_and_pictures_and_teeth_kept(tmp_path, monkeypatch, no_features):
    picture = {"teeth": np.zeros((4, 4, 3), np.uint8)}
    read = {"teeth": read_teeth()}

    def doubtful(context, views):
        raise ReconstructionError("Photo 1 and 2 hardly agree.", picture, read)

    monkeypatch.setattr("stages.init.dental.place.from_teeth", doubtful)
    with pytest.raises(ReconstructionError, match=r"could be placed.*hardly agree") as caught:
        auto(tmp_path, 3, read_teeth())
    assert caught.value.pictures == picture
    assert caught.value.artifacts == read


def test_teeth_are_tried_where_features_place_hardly_any_of_the_mouth(tmp_path, monkeypatch):
    """Two frontal photographs look alike: features link these and leave the sides out."""
    tried, densified = [], []
    monkeypatch.setattr("stages.init.dental.choice.sound", lambda *_, **__: Sounding(4))

    def link(names):
        cameras = [Camera(name, 64, 48, 70.0, 70.0, 32.0, 24.0, np.eye(4)) for name in names]
        placement = Placement((), tuple(cameras), np.zeros((0, 3)), (), {})
        monkeypatch.setattr(Placement, "normalised", lambda self: self)
        monkeypatch.setattr("stages.init.place.place_classical", lambda *_, **__: placement)

    monkeypatch.setattr("stages.init.densify.densify", lambda *_: densified.append(1))
    monkeypatch.setattr(
        "stages.init.dental.place.from_teeth", lambda context, views: tried.append(1)
    )
    names = [view.name for view in photographs(4).views]
    read = read_teeth(4, aside=(2,))
    link([names[1], names[2]])
    auto(tmp_path / "few", 4, read)
    assert (tried, densified) == ([1], [])
    auto(tmp_path / "as_asked", 4, read, method="colmap")
    auto(tmp_path / "no_teeth", 4)
    assert (tried, densified) == ([1], [1, 1])
    link([names[0], names[1], names[3]])
    auto(tmp_path / "enough", 4, read)
    assert (tried, densified) == ([1], [1, 1, 1])

    def doubtful(context, views):
        raise ReconstructionError("Photo 1 and 2 hardly agree.")

    link([names[1], names[2]])
    monkeypatch.setattr("stages.init.dental.place.from_teeth", doubtful)
    context = auto(tmp_path / "doubtful", 4, read)
    assert densified == [1, 1, 1, 1]
    assert any("hardly agree" in text for text in context.warnings)


def test_teeth_come_first_where_features_have_no_chance_and_then_features(tmp_path, monkeypatch):
    """Of what small copies say: the attempt by features takes longer than all else."""
    order = []
    monkeypatch.setattr(Placement, "normalised", lambda self: self)
    monkeypatch.setattr("stages.init.densify.densify", lambda *_: order.append("dense"))

    def by_features(views, *_, **__):
        order.append("features")
        cameras = (Camera(v.name, 64, 48, 70.0, 70.0, 32.0, 24.0, np.eye(4)) for v in views)
        return Placement((), tuple(cameras), np.zeros((0, 3)), (), {})

    def by_teeth(context, views):
        order.append("teeth")
        if doubts:
            raise ReconstructionError("Photo 1 and 2 hardly agree.")

    monkeypatch.setattr("stages.init.place.place_classical", by_features)
    monkeypatch.setattr("stages.init.dental.place.from_teeth", by_teeth)
    for linked, doubts, expected in (
        (2, False, ["teeth"]),
        (2, True, ["teeth", "features", "dense"]),
        (3, False, ["features", "dense"]),
    ):
        monkeypatch.setattr(
            "stages.init.dental.choice.sound", lambda *_, n=linked, **__: Sounding(n)
        )
        order.clear()
        auto(tmp_path / f"{linked}_{doubts}", 3, read_teeth())
        assert order == expected
    for linked, first in ((1, "teeth"), (2, "features")):
        monkeypatch.setattr(
            "stages.init.dental.choice.sound", lambda *_, n=linked, **__: Sounding(n)
        )
        order.clear()
        auto(tmp_path / f"pair_{linked}", 2, read_teeth(2))
        assert order[0] == first
    order.clear()
    auto(tmp_path / "as_asked", 3, read_teeth(), method="colmap")
    assert order == ["features", "dense"]


def test_of_a_whole_folder_those_are_sounded_that_show_the_closed_bite(tmp_path, monkeypatch):
    sounded = []

    def few(grays, valid, focals, *_, **__):
        assert len(grays) == len(valid) == len(focals)
        sounded.append(len(grays))
        return Sounding(1, ["features"])

    monkeypatch.setattr("stages.init.dental.choice.sound", few)

    def first(read, ordered=False):
        views = replace(photographs(9), ordered=ordered)
        inputs = {"views": views, "teeth": read}
        context = LocalContext(InitConfig(), tmp_path, inputs, {}, threads=1)
        ways = ByTeeth(context, views)
        answer = ways.is_first(views.views, [None] * 9, ClassicalOptions())
        assert ways.features is None  # of all photographs or of none
        return answer

    folder = read_teeth(9, aside=(1, 3, 4, 6, 7, 8))
    assert first(folder) and sounded == [3]
    # many views around a mouth; frames of a film; those that nobody looked at may link the others
    assert not first(read_teeth(9)) and not first(folder, ordered=True)
    unread = (*folder.views[:8], Dentition("008", SIZE[::-1], UNREAD))
    assert not first(Teeth(unread)) and sounded == [3]


@pytest.mark.parametrize(
    ("ordered", "aside", "roll", "upright"),
    [
        (False, (), 0.0, True),
        (False, (), 0.3, False),
        (False, (0,), 0.0, False),  # nobody knows how that one stands
        (True, (0, 1, 2), 0.0, True),
        (True, (0, 1, 2, 3, 5), 0.0, False),
        (True, (0,), 0.3, False),
    ],
)
def test_upright_rows_of_teeth_say_that_no_photograph_is_rolled(
    tmp_path, ordered, aside, roll, upright
):
    views = replace(photographs(6), ordered=ordered)
    read = Teeth(
        tuple(replace(d, roll=roll if k == 4 else 0.0) for k, d in enumerate(
            read_teeth(6, aside=aside).views
        ))
    )  # fmt: skip
    inputs = {"views": views, "teeth": read}
    context = LocalContext(InitConfig(), tmp_path, inputs, {}, threads=1)
    assert ByTeeth(context, views).upright() == upright


@pytest.mark.parametrize(("placed", "said"), [((1, 1), 1), ((1, 0, 1), 1), ((1, 1, 1), 0)])
def test_a_scene_of_two_photographs_is_said_to_be_one(placed, said):
    names = [f"{k}.jpg" for k in range(len(placed))]
    fit = SimpleNamespace(views=tuple(object() if there else None for there in placed))
    told = only_two(names, SimpleNamespace(fit=fit))
    assert len(told) == said
    for name, there in zip(names, placed, strict=True):
        assert all((name in text) == bool(there) for text in told)


def test_a_sounding_tells_what_features_can_link(tmp_path):
    samples = [
        cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in sorted(SAMPLES.glob("*.jpg"))
    ]
    rng = np.random.default_rng(0)
    other = cv2.GaussianBlur(rng.integers(0, 255, samples[0].shape, np.uint8), (0, 0), 3)
    for grays, linked in ((samples, 3), ([*samples[:2], other], 2), ([samples[0], other], 1)):
        valid = [np.ones(gray.shape, bool) for gray in grays]
        sounding = sound(
            grays, valid, [None] * len(grays), False, ClassicalOptions(),
            seed=0, threads=1, scratch=tmp_path,
        )  # fmt: skip
        assert sounding.linked == linked
        assert sounding.features is not None  # the samples are no larger than what is asked
    larger = [cv2.resize(gray, None, fx=1.5, fy=1.5) for gray in samples]
    sounding = sound(
        larger, [np.ones(gray.shape, bool) for gray in larger], [None] * 3, False,
        ClassicalOptions(), seed=0, threads=1, scratch=tmp_path,
    )  # fmt: skip
    assert sounding.linked == 3 and sounding.features is None


def test_features_see_what_is_said_to_be_mirrored_turned_over(tmp_path, monkeypatch):
    seen = []

    def placed(views, *_, **__):
        seen.extend(views)
        raise ReconstructionError("0 of 3 photographs could be placed.")

    monkeypatch.setattr("stages.init.place.place_classical", placed)
    said = {CORRECTIONS: write(tmp_path / "teeth.yaml", "photographs: {p1.jpg: {mirrored: true}}")}
    with pytest.raises(ReconstructionError):
        auto(tmp_path / "w", 3, read_teeth(), said, method="colmap")
    for number, (view, given) in enumerate(zip(seen, photographs(3).views, strict=True)):
        expected = given.mirrored() if number == 1 else given
        np.testing.assert_array_equal(view.image, expected.image)


def test_features_do_not_see_what_a_person_leaves_out(tmp_path, monkeypatch):
    seen = []

    def placed(views, focals, given, ordered, least, *_, **__):
        seen.append(([view.name for view in views], len(focals), least))
        raise ReconstructionError("0 of 3 photographs could be placed.")

    monkeypatch.setattr("stages.init.place.place_classical", placed)
    one = write(tmp_path / "one.yaml", "photographs: {p1.jpg: {use: false}}")
    with pytest.raises(ReconstructionError):
        auto(tmp_path / "w", 4, read_teeth(4), {CORRECTIONS: one}, method="colmap")
    assert seen == [(["000", "002", "003"], 3, 3)]
    most = write(tmp_path / "most.yaml", "photographs: {p1: {use: false}, p2: {use: false}}")
    with pytest.raises(RequestError, match="leaves out 2 of 3 photographs"):
        auto(tmp_path / "v", 3, read_teeth(), {CORRECTIONS: most}, method="colmap")


def test_corrections_are_places_of_the_photograph_as_it_was_taken(tmp_path):
    text = "photographs: {p1.jpg: {mirrored: true, crowns: [{at: [35, 30], tooth: 22}]}}"
    sources = {CORRECTIONS: write(tmp_path / "teeth.yaml", text)}
    views = tuple(replace(v, source_size=(v.width, v.height)) for v in photographs(3).views)
    given = Views(views)
    inputs = {"views": given, "teeth": read_teeth()}
    context = LocalContext(InitConfig(), tmp_path / "w", inputs, sources, threads=1)
    turned = turned_as_said(context, given)
    assert [view.turned_over for view in turned.views] == [False, True, False]
    said = [
        [crown.doubt == 0 for crown in labelled_teeth(context, views).views[1].all_crowns]
        for views in (given, turned)
    ]
    assert sum(said[0]) == 1 and said[0] == said[1]


def test_corrections_hold_where_the_photograph_that_they_name_is_not_placed(tmp_path):
    text = "photographs: {p0.jpg: {crowns: [{at: [35, 30], tooth: 22}]}, p2.jpg: {use: false}}"
    sources = {CORRECTIONS: write(tmp_path / "teeth.yaml", text)}
    given = photographs(3)
    inputs = {"views": given, "teeth": read_teeth()}
    context = LocalContext(InitConfig(), tmp_path / "w", inputs, sources, threads=1)
    placed = labelled_teeth(context, replace(given, views=given.views[:2]))
    whole = labelled_teeth(context, given)
    assert [view.set_aside for view in placed.views] == ["", "", LEFT_OUT]
    assert [[crown.number for crown in view.all_crowns] for view in placed.views] == [
        [crown.number for crown in view.all_crowns] for view in whole.views
    ]
