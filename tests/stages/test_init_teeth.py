"""From the dental path's result to the stage's outputs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.artifacts.dental.fdi import is_upper
from pipeline.artifacts.space.scale import Scale
from pipeline.artifacts.teeth import UNREAD, Dentition, Teeth
from pipeline.artifacts.views import Views
from pipeline.errors import ReconstructionError, RequestError
from pipeline.stage import LocalContext
from stages.init.config import DentalConfig, InitConfig
from stages.init.dental import place
from stages.init.dental.read import labelled_teeth
from stages.init.dental.reconstruct import as_sentence, seen_from_elsewhere, with_numbers
from stages.init.dental.scale import crown_width, scale_from_widths, width_doubts
from stages.init.stage import InitStage
from tests.stages.init_teeth_case import (
    LOWER,
    SIZE,
    UPPER,
    found_teeth,
    photographs,
    read_teeth,
    side_pose,
)
from tests.teeth_case import write


def run(
    tmp_path, monkeypatch, found, read=None, asked=None, said=None, length=None, over=(),
    wanted=(), kinds=None, **dental,
):  # fmt: skip
    """The stage with the reconstruction as given (an exception is raised); what it was asked.

    Args:
        said: text of `teeth.yaml`.
        over: photographs that the reconstruction turns over.
        wanted: photographs that it must not leave out.
        kinds: from where photographs show the teeth, as a person says.
    """

    def reconstruct(views, names, dentitions, *args, kept, **kwargs):
        if asked is not None:
            asked.extend(dentitions)
        assert list(kept) == list(wanted)
        assert kwargs["said"] == (kinds or {})
        if isinstance(found, Exception):
            raise found
        shown = [view.mirrored() if k in over else view for k, view in enumerate(views)]
        return replace(found, views=shown, mirrored=tuple(over))

    monkeypatch.setattr(place, "reconstruct_teeth", reconstruct)
    config = InitConfig(method="dental", dental=dental, length=length or {})
    inputs = {"views": photographs(), "teeth": read or read_teeth()}
    tmp_path.mkdir(exist_ok=True)
    sources = {"teeth.yaml": write(tmp_path / "teeth.yaml", said)} if said else {}
    context = LocalContext(config, tmp_path, inputs=inputs, sources=sources, threads=1)
    InitStage().run(context)
    return context


def test_outputs_agree_with_each_other_and_lead_back_to_millimetres(tmp_path, monkeypatch):
    context = run(tmp_path, monkeypatch, found_teeth())
    cameras = context.result("cameras")
    assert cameras.scale == Scale("mm", "textbook_teeth", 10.0) and not cameras.provisional
    for camera, yaw in zip(cameras.cameras, (-40, 0, 40), strict=True):
        mm_from_cam = cameras.input_from_world @ np.linalg.inv(camera.cam_from_world)
        np.testing.assert_allclose(
            mm_from_cam[:3, 3], np.linalg.inv(side_pose(yaw))[:3, 3], atol=1e-9
        )
    to_mm = cameras.input_from_world
    positions = context.result("points").positions @ to_mm[:3, :3].T + to_mm[:3, 3]
    np.testing.assert_allclose(np.linalg.norm(positions, axis=1), 20, atol=1e-3)
    normals = context.result("points").normals @ to_mm[:3, :3].T
    cosine = (normals * positions).sum(1) / np.linalg.norm(normals, axis=1) / 20
    np.testing.assert_allclose(cosine, 1, atol=1e-4)
    assert len(context.result("pointmaps")) == 0  # the surface is one already
    assert sorted(context.result("pictures").images) == ["surface_turned"]
    assert sorted(context.result("teeth").pictures) == ["000", "001", "002"]
    assert any("textbook teeth" in warning for warning in context.warnings)


def test_what_is_not_teeth_is_masked(tmp_path, monkeypatch):
    found = found_teeth()
    context = run(tmp_path, monkeypatch, found)
    for view, shown in zip(context.result("views").views, found.surface.views, strict=True):
        np.testing.assert_array_equal(view.valid(), shown.depth > 0)
    context = run(tmp_path / "all", monkeypatch, found, mask_rest=False)
    assert not (tmp_path / "all" / "views").exists()


def test_known_tooth_width_gives_the_scale(tmp_path, monkeypatch):
    found = found_teeth()
    assert crown_width(found.fit, 11) == pytest.approx(8.5)
    assert crown_width(found.fit, 16) is None
    assert scale_from_widths(found.fit, {11: 10.2})[0] == pytest.approx(1.2)
    assert scale_from_widths(found.fit, {51: 6.8})[0] == pytest.approx(0.8)
    assert scale_from_widths(found.fit, {})[0] == 1
    with pytest.raises(RequestError, match="none was seen with both its neighbours"):
        scale_from_widths(found.fit, {16: 10.0})
    # primary and permanent at once: as many widths, one far off
    assert scale_from_widths(found.fit, {11: 8.5, 51: 8.5}) == pytest.approx((1, 0.06 / 2**0.5))
    factor, deviation = scale_from_widths(found.fit, {11: 8.5, 51: 6.8})
    assert factor == pytest.approx(0.9) and deviation == pytest.approx(np.log(1.25) / 2)
    assert width_doubts(found.fit, {11: 8.5}) == width_doubts(found.fit, {11: 8.5, 51: 8.0}) == []
    (said,) = width_doubts(found.fit, {11: 8.5, 51: 6.0})
    assert "by 11 the mouth is 42% larger than by 51" in said
    assert "16 tells nothing of the scale" in width_doubts(found.fit, {11: 8.5, 16: 10.0})[0]
    context = run(tmp_path, monkeypatch, found, tooth_widths={11: 10.2})
    cameras = context.result("cameras")
    assert cameras.scale == Scale("mm", "tooth_widths", 6.0)
    scale = np.cbrt(np.linalg.det(cameras.input_from_world[:3, :3]))
    distance = scale * np.linalg.norm(cameras.cameras[0].centre - cameras.cameras[2].centre)
    truth = np.linalg.norm(
        np.linalg.inv(side_pose(-40))[:3, 3] - np.linalg.inv(side_pose(40))[:3, 3]
    )
    assert distance == pytest.approx(1.2 * truth)
    assert not any("textbook" in warning for warning in context.warnings)


def test_the_numbers_of_all_photographs_together_are_handed_on(tmp_path, monkeypatch):
    context = run(tmp_path, monkeypatch, found_teeth())
    for view in context.result("teeth").views:
        assert tuple(crown.number for crown in view.upper) == UPPER
        assert tuple(crown.number for crown in view.lower) == LOWER
        assert [crown.doubt for crown in view.upper] == [0.1, 0.0, 0.0]


def test_primary_teeth_get_their_own_numbers_and_what_a_person_said_is_not_doubted():
    """Not even where it is a tooth that the arch does not have."""
    found = found_teeth()
    object.__setattr__(found.fit, "primary", frozenset({11, 41}))
    said = replace(read_teeth().views[0].upper[0], number=18, doubt=0.0)
    before = replace(read_teeth().views[0], upper=(said, *read_teeth().views[0].upper[1:]))
    after = with_numbers(before, found.fit.views[0], found.fit)
    assert [crown.number for crown in after.upper] == [18, 51, 21]
    assert [crown.number for crown in after.lower] == [81, 0, 31]
    assert [crown.doubt for crown in after.upper] == [0, 0, 0]
    assert with_numbers(before, None, found.fit) is before


@pytest.mark.parametrize(
    ("names", "wrong", "mirrors"),
    [
        (["wright_1.jpg", "wright_2.jpg", "wright_3.jpg"], 0, False),
        (["right.jpg", "front.jpg", "left.jpg"], 0, False),
        (["right.jpg", "front.jpg", "right2.jpg"], 1, False),
        (["left.jpg", "front.jpg", "right.jpg"], 2, True),
        (["left.jpg", "a.jpg", "b.jpg"], 1, True),
    ],
)
def test_names_that_say_the_other_side_are_said_once(names, wrong, mirrors):
    """Where all do, all photographs may be mirror images."""
    said = place.misnamed(names, found_teeth())
    assert len(said) == wrong
    assert ("all photographs are mirror images" in " ".join(said)) == mirrors


def test_photographs_set_aside_take_no_part_unless_their_order_is_given(tmp_path, monkeypatch):
    asked = []
    read = read_teeth(aside=(1,))
    run(tmp_path / "a", monkeypatch, found_teeth(), read, asked)
    assert [d and d.name for d in asked] == ["000", None, "002"]
    asked.clear()
    run(tmp_path / "b", monkeypatch, found_teeth(), read, asked, order="right,frontal,left")
    assert [(d.name, d.set_aside) for d in asked] == [("000", ""), ("001", ""), ("002", "")]
    asked.clear()
    left_out = "photographs: {p2.jpg: {use: false}}"
    run(
        tmp_path / "c", monkeypatch, found_teeth(), read, asked, left_out,
        order="right,frontal,left",
    )  # fmt: skip
    assert [d and d.name for d in asked] == ["000", "001", None]


def test_teeth_that_were_not_read_are_asked_for(tmp_path):
    context = LocalContext(InitConfig(method="dental"), tmp_path, inputs={"views": photographs()})
    with pytest.raises(RequestError, match="--stages teeth,init"):
        InitStage().run(context)


def test_photographs_that_were_not_read_are_not_said_to_show_no_teeth(tmp_path, monkeypatch):
    unread = Teeth(tuple(Dentition(f"{k:03d}", SIZE[::-1], UNREAD) for k in range(3)))
    with pytest.raises(ReconstructionError, match="None of these photographs was read"):
        run(tmp_path, monkeypatch, found_teeth(), unread)


def test_a_refusal_brings_the_teeth_of_all_photographs_with_it(tmp_path, monkeypatch):
    one = with_numbers(read_teeth().views[0], found_teeth().fit.views[0], found_teeth().fit)
    refused = ReconstructionError("The teeth are odd.", {}, {"teeth": Teeth((one,))})
    with pytest.raises(ReconstructionError) as caught:
        run(tmp_path, monkeypatch, refused, read_teeth(numbers=(13, 12, 11)))
    views = caught.value.artifacts["teeth"].views
    assert [view.name for view in views] == ["000", "001", "002"]
    assert [crown.number for crown in views[0].upper] == list(UPPER)
    assert [crown.number for crown in views[1].upper] == [13, 12, 11]


def test_labels_given_as_settings_are_of_the_photograph_as_it_was_taken(tmp_path, monkeypatch):
    views = photographs()
    first = views.views[0]
    scale = np.diag([first.width / 1280, first.height / 960, 1])
    large = replace(first, working_from_source=scale, source_size=(1280, 960))
    views = Views((large, *views.views[1:]))

    def said(**hint):
        labels = [{"photo": "p0", "x": 600, "y": 300, "tooth": 14, **hint}]
        config = InitConfig(method="dental", dental={"labels": labels})
        inputs = {"views": views, "teeth": read_teeth()}
        context = LocalContext(config, tmp_path, inputs=inputs, threads=1)
        return labelled_teeth(context, views)

    (crown,) = [c for c in said().views[0].all_crowns if c.doubt == 0]
    assert (crown.number, crown.jaw) == (14, "upper")
    assert crown.centre == pytest.approx([59.5, 34])
    assert all(is_upper(c.number) == (c.jaw == "upper") for c in said(tooth=44).views[0].upper)
    with pytest.raises(RequestError, match="no crown at 5, 5"):
        said(x=5, y=5)
    with pytest.raises(RequestError, match="no photograph 'q0'"):
        said(photo="q0")


def test_why_photographs_are_set_aside_is_said_where_too_few_are_left(tmp_path, monkeypatch):
    few = ReconstructionError("Two are needed.")
    with pytest.raises(ReconstructionError, match=r"needed. p0.jpg, p2.jpg: it shows.*check.html"):
        run(tmp_path / "w", monkeypatch, few, read_teeth(aside=(0, 2)))
    sides = ReconstructionError("One must be from the front.")
    with pytest.raises(ReconstructionError, match=r"front. p1.jpg: it shows.*check.html"):
        run(tmp_path / "f", monkeypatch, sides, read_teeth(aside=(1,)))
    with pytest.raises(ReconstructionError, match=r"front\.$"):
        run(tmp_path / "o", monkeypatch, sides, read_teeth(aside=(1,)), order="right,frontal,left")


def test_a_photograph_said_to_be_mirrored_is_turned_over_with_its_teeth(tmp_path, monkeypatch):
    asked = []
    said = """
        photographs:
          p1.jpg: {mirrored: true, crowns: [{at: [35, 30], tooth: 22}]}
          p2.jpg: {mirrored: false}
    """
    read = read_teeth(numbers=(12, 11, 13))
    context = run(tmp_path, monkeypatch, found_teeth(), read, asked, said)
    assert [dentition.mirrored for dentition in asked] == [None, True, False]
    assert [crown.number for crown in asked[0].upper] == [12, 11, 13]
    assert [crown.number for crown in asked[1].upper] == [23, 21, 22]
    left = [crown.outline[:, 0].min() for crown in asked[1].upper]
    assert left == [SIZE[1] - 89, SIZE[1] - 69, SIZE[1] - 49]
    for k, view in enumerate(context.result("views").views):
        before = photographs().views[k].image
        np.testing.assert_allclose(
            view.image, before[:, ::-1] if k == 1 else before, atol=0.5 / 255
        )
        assert (np.linalg.det(view.working_from_source) < 0) == (k == 1)
    assert not any("turned over" in warning for warning in context.warnings)
    assert "undistorted" not in context.figures


def test_a_photograph_that_was_turned_over_is_named(tmp_path, monkeypatch):
    context = run(tmp_path, monkeypatch, found_teeth(), over=(2,))
    (warning,) = [text for text in context.warnings if "turned over" in text]
    assert warning.startswith("p2.jpg is a mirror image")
    before = photographs().views[2].image
    image = context.result("views").views[2].image
    np.testing.assert_allclose(image, before[:, ::-1], atol=0.5 / 255)


def test_a_photograph_without_which_the_others_agree_is_named_and_set_aside(tmp_path, monkeypatch):
    found = found_teeth()
    two = (*found.fit.views[:2], None)
    found = replace(
        found, dentitions=[*found.dentitions[:2], None], fit=replace(found.fit, views=two),
        surface=replace(found.surface, views=(*found.surface.views[:2], None)),
        left_out=(2,), reasons=("p2.jpg may show another patient", "another numbering is as good"),
    )  # fmt: skip
    context = run(tmp_path, monkeypatch, found)
    assert len(context.result("cameras").cameras) == 2
    assert [bool(seen.set_aside) for seen in context.result("teeth").views] == [False, False, True]
    assert context.result("teeth").views[2].all_crowns
    (warning,) = [text for text in context.warnings if "left out" in text]
    assert warning.startswith(
        "p2.jpg does not fit the others, which agree without it: left out. With it: p2.jpg may "
        "show another patient. Another numbering is as good. If it is to be used"
    )


def test_a_photograph_that_a_person_wants_is_not_left_out(tmp_path, monkeypatch):
    said = "photographs: {p1.jpg: {use: true}, p2.jpg: {kind: left}}"
    run(tmp_path, monkeypatch, found_teeth(), said=said, wanted=(1,), kinds={2: "left"})


def test_a_photograph_that_shows_another_side_than_a_person_says_is_doubtful():
    fit = found_teeth().fit  # right, front, left
    names = ["a.jpg", "b.jpg", "c.jpg"]
    assert seen_from_elsewhere(fit, names, {}) == []
    assert seen_from_elsewhere(fit, names, {0: "right", 1: "front", 2: "left"}) == []
    (doubt,) = seen_from_elsewhere(fit, names, {0: "left", 2: "left"})
    assert doubt.startswith(
        "a.jpg is said to show the teeth from the left, but by its teeth it shows them from the "
        "right: one of the two is wrong"
    )
    unplaced = replace(fit, views=(None, *fit.views[1:]))
    assert seen_from_elsewhere(unplaced, names, {0: "left"}) == []


def test_a_known_length_is_of_the_photograph_as_it_was_taken(tmp_path, monkeypatch):
    """Where one end is nearer than the other it matters which side is which."""
    length = {"mm": 5.0, "photo": "p1", "start": [20.5, 40], "end": [60.5, 40]}
    ramp = np.broadcast_to(np.linspace(90, 150, SIZE[1], dtype=np.float32), SIZE)

    def millimetres(name, depth, **more):
        found = found_teeth()
        views = list(found.surface.views)
        views[1] = replace(views[1], depth=depth)
        found = replace(found, surface=replace(found.surface, views=tuple(views)))
        context = run(tmp_path / name, monkeypatch, found, length=length, **more)
        return context.figures["mm_per_unit"]

    taken = millimetres("taken", ramp)
    said = "photographs: {p1.jpg: {mirrored: true}}"
    assert millimetres("over", ramp[:, ::-1], over=(1,)) == pytest.approx(taken)
    assert millimetres("said", ramp[:, ::-1], said=said) == pytest.approx(taken)
    assert millimetres("other", ramp[:, ::-1]) != pytest.approx(taken, rel=0.05)


def options_of(views, dentitions, part=None, **dental):
    config = InitConfig(method="dental", dental=dental)
    context = LocalContext(config, Path(), inputs={"views": views}, threads=1)
    return place.arch_options(context, part or views, dentitions)


def test_photographs_that_take_no_part_do_not_speak_of_several_days():
    times = (0.0, 30.0, 86400.0 * 12)
    taken = zip(photographs().views, times, strict=True)
    views = Views(tuple(replace(view, taken_after=after) for view, after in taken))
    read = list(read_teeth().views)

    def sitting(dentitions):
        return options_of(views, dentitions).one_sitting

    assert (sitting(read), sitting([*read[:2], None])) == (False, True)


def test_settings_reach_the_fit():
    views = photographs()
    dentitions = list(read_teeth().views)
    options = options_of(views, dentitions, order="right, frontal,left")
    assert options.order == ("right", "frontal", "left")
    placed = Views((views.views[0], views.views[2]))
    some = options_of(views, dentitions[:2], placed, order="right,frontal,left")
    assert some.order == ("right", "left")
    with pytest.raises(RequestError, match="names 2 photographs"):
        options_of(views, dentitions, order="right,left")
    assert place.surface_options(DentalConfig(gum_height=2)).gum_height == 2


def test_a_photograph_keeps_its_name_where_a_sentence_begins_with_it():
    names = ["left.jpg", "right.jpg"]
    assert as_sentence("right.jpg is odd.", names) == "right.jpg is odd."
    assert (
        as_sentence("crowns of left.jpg fit no tooth", names) == "Crowns of left.jpg fit no tooth."
    )
