"""Teeth of photographs that features, cameras or a model have placed: numbered together."""

import numpy as np

from pipeline.artifacts.cameras import Cameras
from pipeline.artifacts.dental.corrections import CORRECTIONS
from pipeline.artifacts.points import Points
from pipeline.artifacts.teeth import Teeth
from pipeline.artifacts.views import Views
from pipeline.stage import LocalContext
from stages.init.config import InitConfig
from stages.init.write import save_all
from tests.stages import arch_wall_case as wall
from tests.teeth_case import write


def saved(folder, read, sources=None, placed=5, **dental):
    cameras, views, _ = wall.case()
    everything = Views(tuple(views))
    context = LocalContext(
        InitConfig(dental=dental),
        folder,
        {"views": everything, "teeth": Teeth(tuple(read))},
        sources or {},
    )
    depths = [wall.depth_of(camera) for camera in cameras[:placed]]
    none = np.zeros((0, 3), np.float32)
    points = Points(none, none, none, none[:, 0], none[:, 0])
    save_all(
        context, everything, tuple(views[:placed]), Cameras(tuple(cameras[:placed])), depths,
        points, [],
    )  # fmt: skip
    return context


def numbers_of(dentition):
    return [crown.number for crown in dentition.all_crowns]


def test_the_numbers_agreed_on_are_written_and_drawn(tmp_path):
    cameras, _, read = wall.case()
    read[2] = wall.photographed(cameras[2], {11: wall.looks_like(12, 0.7)})
    assert 11 not in numbers_of(read[2])
    context = saved(tmp_path, read)
    teeth = context.result("teeth")
    for camera, dentition in zip(cameras, teeth.views, strict=True):
        assert numbers_of(dentition) == wall.truth_of(camera)
    assert sorted(teeth.pictures) == [camera.name for camera in cameras]
    assert context.figures["teeth"] == 28
    mouth = context.result("cameras").mouth_from_world
    assert mouth is not None, "the way to the left is known"
    np.testing.assert_allclose(mouth[0, :3] / np.linalg.norm(mouth[0, :3]), [1, 0, 0], atol=0.05)


def test_what_a_person_said_in_one_photograph_is_followed_in_the_others(tmp_path):
    """Here nobody but the person knows that the last premolar on the right is a primary molar."""
    cameras, _, read = wall.case()
    crown = next(crown for crown in read[1].upper if crown.number == 15)
    x, y = crown.centre
    said = f"photographs:\n  '{cameras[1].name}':\n    crowns: [{{at: [{x}, {y}], tooth: 55}}]\n"
    sources = {CORRECTIONS: write(tmp_path / "teeth.yaml", said)}
    teeth = saved(tmp_path, read, sources).result("teeth")
    assert 55 in numbers_of(teeth.views[0])
    assert 15 not in numbers_of(teeth.views[0])


def test_a_known_width_that_is_not_used_is_said(tmp_path):
    _, _, read = wall.case()
    context = saved(tmp_path, read, tooth_widths={11: 8.6})
    assert context.result("cameras").scale.source == "textbook_teeth"
    assert ["tooth_widths is not used" in said for said in context.warnings] == [True]
    assert saved(tmp_path / "none", read).warnings == []


def test_without_teeth_nothing_is_written(tmp_path):
    _, _, read = wall.case()
    empty = [type(d)(d.name, d.size, "none") for d in read]
    context = saved(tmp_path, empty)
    assert not (tmp_path / "teeth").exists()
    assert "teeth" not in context.figures
