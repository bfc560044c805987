"""The report of a run: what it says of good, partial and failed runs, and what a browser sees."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import pipeline
from pipeline.artifacts.cameras import Camera, Cameras
from pipeline.artifacts.metrics import Scores
from pipeline.artifacts.pictures import Pictures
from pipeline.artifacts.teeth import Dentition, Teeth
from pipeline.errors import ReconstructionError, RequestError
from pipeline.geometry.world import move_camera
from pipeline.pages.charts import (
    Bar,
    bar_chart,
    camera_plot,
    line_chart,
    match_matrix,
    series_chart,
)
from pipeline.pages.directions import movement, similarity_onto
from pipeline.pages.page import number, seconds
from pipeline.pages.pictures import picture, points_image, thirds
from pipeline.pages.tables import views_table
from pipeline.running.outcomes import RunSummary
from pipeline.studies.report import run_report
from pipeline.studies.report.reading import read_case
from stages.dentition.corrections import LEFT_OUT
from stages.evaluate.images.pictures import comparison
from stages.fit.report import course
from stages.flow.report import flow_colors
from tests.browser import browse, needs_chromium, run_in
from tests.studies import report_case as case
from tests.studies.report_page import assert_alone, look, text_of


def sections_of(page: str) -> list[str]:
    return re.findall(r"<summary>([\w -]+?) ?<", page)


def test_everything_that_is_there_is_shown(tmp_path: Path) -> None:
    workspace = case.write_case(tmp_path / "case")
    file = run_report(workspace)
    assert file == workspace / "report.html"
    page = file.read_text()
    text = text_of(page)
    assert sections_of(page) == [
        "Photographs", "Matches", "Cameras", "Points", "Flow", "Fit",
        "Renders beside the photographs", "Held-out photographs", "Figures", "Time and memory",
        "Stages and keys", "Settings", "run", *case.CHAIN, "Versions",
    ]  # fmt: skip
    for said in (
        "3 of 3 photographs placed", "25.00 dB PSNR of the input photographs (training views)",
        "21.00 dB PSNR of photographs held out (registered cameras)", "1,234 Gaussians",
        "1 photograph was held out", "21.00 dB (registered cameras), 22.00 dB (refined cameras)",
        "20 degrees beyond the outermost photographs, 25 % of what the scene shows was never",
        "within 0.40 pixels", "Lengths have no unit", "not how right it is from directions",
        "40 of 50 matches verified", "after sap: 300 points", "after align: 500 points",
        "rotation error, degrees, median 0.120", "Magenta: unseen.", "kept_back.jpg",
        "LPIPS is empty", "numpy 1.2.3", "fit.iterations=20",
    ):  # fmt: skip
        assert said in text, said
    assert "could not be drawn" not in text
    assert_alone(page)
    assert page.count("<svg xmlns") == 6, "matrix, two of the cameras, three of the fit"
    for image in re.findall(r"<img[^>]*>", page.partition("<dialog")[0]):
        assert re.search(r'alt="[^"]{5,}"', image), image[-200:]


def test_what_a_person_left_out_is_not_called_unplaced(tmp_path: Path) -> None:
    workspace = case.write_case(tmp_path / "w", ("views",))
    asked = json.loads((workspace / "request.json").read_text()) | {"stages": ["views", "init"]}
    (workspace / "request.json").write_text(json.dumps(asked))
    teeth = Teeth((Dentition("002", (case.WIDTH, case.HEIGHT), "right", set_aside=LEFT_OUT),))
    placed = Cameras(case.cameras().cameras[:2])
    case.write_result(workspace, "init", [placed, case.points(9), teeth])
    text = text_of(run_report(workspace).read_text())
    assert "2 of 2 photographs placed in space" in text
    assert "All 2 photographs were placed in space. Left out by hand: right.jpg." in text


def test_the_command_is_written_as_a_shell_takes_it(tmp_path: Path) -> None:
    workspace = case.write_case(tmp_path / "w", ("views",))
    asked = json.loads((workspace / "request.json").read_text())
    asked |= {"images": ["/of/my photos", "/of/-x"], "overrides": ["views.held_out=[a.jpg, b.jpg]"]}
    (workspace / "request.json").write_text(json.dumps(asked))
    text = text_of(run_report(workspace).read_text())
    said = "pipeline run 'my photos' ./-x --stages views --set 'views.held_out=[a.jpg, b.jpg]'"
    assert said in text


def test_names_and_warnings_are_text_and_not_markup(tmp_path: Path) -> None:
    workspace = case.write_case(tmp_path / "<i>case&", unplaced=True)
    page = run_report(workspace).read_text()
    assert "<b>x" not in page
    assert "<script>alert" not in page
    assert "<i>case" not in page
    text = text_of(page)
    assert case.HOSTILE in text
    assert "<i>case&" in text
    assert "<script>alert(1)</script>" in text
    assert "2 of 3 photographs placed in space" in text
    assert "1 of 3 photographs could not be placed and are not part of the scene: right.jpg" in text
    assert re.search(r"not placed 1 of 3 photographs could not be placed: right", text)


def test_dollars_in_names_are_no_formula() -> None:
    name = "scan_$1_$2.jpg"
    places = [replace(case.camera(name, 0.0), name=name), case.camera("b", 30.0)]
    nothing = np.zeros((0, 3))
    for chart in (
        match_matrix([name, "b"], {(0, 1): 5}),
        camera_plot([(name, places, None), ("b", places, None)], nothing, nothing, "top"),
        line_chart([0, 1], {name: [1, 2], "b": [2, 1]}, ("x", "y"), "lines"),
        series_chart({name: {1: 2, 2: 3}}, ("x", "y"), "series", dashed={"$_$": {1: 2}}),
        bar_chart([Bar(name, 1.0)], "x", "bars"),
    ):
        assert f">{name}<" in chart.svg, chart.alt


def test_names_in_any_letters_are_drawn_without_a_word(recwarn: pytest.WarningsRecorder) -> None:
    name = "患者"
    chart = match_matrix([name, "b"], {(0, 1): 5})
    assert f">{name}<" in chart.svg and not recwarn.list


def test_nothing_is_written_with_a_sign() -> None:
    assert (number(-0.04, 1), number(-0.06, 1), number(-1234.5)) == ("0.0", "-0.1", "-1,234.50")


@needs_chromium
def test_long_names_in_charts_can_be_read(tmp_path: Path) -> None:
    """No label lies on another or beyond the chart's edge."""
    long = "20240513_frontal_retracted_view_IMG"
    charts = [bar_chart([Bar(f"{long}_{k}", 1.0 + k) for k in range(3)], "x", "bars")]
    for count, start in ((3, "left_buccal"), (6, "IMG_12"), (3, long), (12, long)):
        pairs = {(i, j): i + j for i in range(count) for j in range(i)}
        charts.append(match_matrix([f"{start}_{k}" for k in range(count)], pairs))
    script = """
      const apart = (a, b) => a.right <= b.left + 1 || b.right <= a.left + 1
        || a.bottom <= b.top + 1 || b.bottom <= a.top + 1;
      tell({ charts: [...document.querySelectorAll("svg")].map((chart) => {
        const edge = chart.getBoundingClientRect();
        const names = [...chart.querySelectorAll("text")].filter((text) =>
          /[a-z]/i.test(text.textContent)).map((text) => text.getBoundingClientRect());
        return [names.length, names.filter((at) => at.left < edge.left - 1 || at.top < edge.top - 1
          || at.right > edge.right + 1 || at.bottom > edge.bottom + 1).length,
          names.filter((at, k) => names.slice(k + 1).some((other) => !apart(at, other))).length];
      }) });"""
    page = "<!doctype html><meta charset=utf-8><body style='font-family: system-ui'>"
    page += "".join(chart.svg for chart in charts) + "</body>"
    told, log = run_in(page, script, tmp_path, (1280, 900))
    assert log == []
    assert [wrong for _, *wrong in told["charts"]] == [[0, 0]] * 5
    assert [count for count, *_ in told["charts"][1:]] == [6, 12, 6, 24]


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (None, "–"), (0.44, "0.4 s"), (9.97, "10 s"), (12.4, "12 s"), (119.7, "2 min 0 s"),
        (179.7, "3 min 0 s"), (200, "3 min 20 s"), (3599.6, "60 min 0 s"),
    ],
)  # fmt: skip
def test_times_are_rounded_before_they_are_split(value: float | None, said: str) -> None:
    assert seconds(value) == said


def test_stages_that_did_not_run_leave_no_gap(tmp_path: Path) -> None:
    workspace = case.write_case(tmp_path / "case", ("views", "init", "sap", "fit"))
    page = run_report(workspace).read_text()
    assert sections_of(page)[:5] == ["Photographs", "Matches", "Cameras", "Points", "Fit"]
    assert "Figures" not in sections_of(page)
    text = text_of(page)
    assert "after align" not in text
    assert "PSNR of the input" not in text
    assert "could not be drawn" not in text


def test_a_damaged_picture_costs_only_its_part(tmp_path: Path) -> None:
    workspace = case.write_case(tmp_path / "case")
    (cloud,) = (workspace / "sap").glob("*/points/points.ply")
    cloud.write_bytes(cloud.read_bytes()[:100].ljust(cloud.stat().st_size, b"\0"))
    page = run_report(workspace).read_text()
    assert "The cached result sap/sap000000000 is damaged (points/points.ply" in text_of(page)
    assert {"Photographs", "Matches", "Flow", "Figures"} <= set(sections_of(page))


def test_no_workspace(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="not a workspace"):
        run_report(tmp_path)


# -- the building blocks ---------------------------------------------------------------------------


def test_cameras_of_two_stages_are_brought_together() -> None:
    before = case.cameras().cameras
    angle = np.radians(25)
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    after = [move_camera(camera, (1.7, turn, np.array([1.0, -2, 3]))) for camera in before]
    onto = similarity_onto(before, after)
    assert onto.scale == pytest.approx(1.7)
    np.testing.assert_allclose(onto.rotation, turn, atol=1e-12)
    for _, degrees, percent in movement(before, after):
        assert degrees == pytest.approx(0, abs=1e-5)
        assert percent == pytest.approx(0, abs=1e-9)
    twisted = case.cameras(2.0).cameras
    moved = {name: degrees for name, degrees, _ in movement(before, twisted)}
    assert moved["000"] == pytest.approx(2.0, abs=0.01), "the mean turn is taken out"
    assert moved["001"] == pytest.approx(0.0, abs=0.01)


def test_comparisons_are_taken_apart() -> None:
    photo, render = case.picture(1), case.picture(2)
    parts = thirds(comparison(render, photo, 0.25))
    assert parts is not None
    assert np.array_equal(parts[0], photo)
    assert np.array_equal(parts[1], render)
    assert thirds(photo) is None


def test_flow_colours_tell_direction_length_and_trust() -> None:
    flow = np.zeros((4, 6, 2), np.float32)
    flow[:, :3, 0], flow[:, 3:, 0] = 8, -8
    flow[0] = 0
    flow[3, 5] = np.nan
    trusted = np.ones((4, 6), bool)
    trusted[2] = False
    image, largest = flow_colors(flow, trusted)
    assert largest == pytest.approx(8)
    right, left = image[1, 0].astype(int), image[1, 5].astype(int)
    assert right[0] - right[2] > 200, "to the right is red"
    assert left[2] - left[0] > 200, "to the left is cyan"
    assert np.ptp(image[0, 0]) == 0, "no motion has no colour"
    assert (image[2] == 110).all()


def test_the_nearest_point_is_on_top() -> None:
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 40)] * 2), -1).reshape(-1, 2)
    near = np.column_stack([grid, np.full(len(grid), -1.0)])
    far = np.column_stack([grid, np.full(len(grid), 1.0)])
    colors = np.repeat([[1.0, 0, 0], [0, 0, 1.0]], len(grid), 0)
    image = points_image(np.vstack([near, far]), colors, np.eye(3), (60, 60))
    assert (image[30, 30] == (255, 0, 0)).all()
    image = points_image(np.vstack([near, far]), colors, np.diag([1.0, 1, -1]), (60, 60))
    assert (image[30, 30] == (0, 0, 255)).all()


def test_cameras_far_from_the_origin_of_their_world_are_drawn_as_large() -> None:
    nothing = np.zeros((0, 3), np.float32)

    def drawn(away: float) -> str:
        cameras = []
        for k in range(4):
            pose = np.eye(4)
            pose[:3, 3] = k + away, 0, 0
            cameras.append(Camera(f"{k:03d}", 64, 48, 60.0, 60.0, 32.0, 24.0, pose))
        return camera_plot([("truth", cameras, None)], nothing, nothing, "top").svg

    assert drawn(4096.0) == drawn(0.0)


def test_pictures_are_scaled_down_and_described() -> None:
    made = picture(np.zeros((300, 1200, 3), np.uint8), "nothing", long_side=400)
    assert (made.width, made.height) == (400, 100)
    assert made.uri.startswith("data:image/jpeg;base64,")


def test_columns_without_figures_are_left_out() -> None:
    block = Scores.of(case.scored(["000", "001"], 20.0))
    table = views_table(block, {"000": "first"})
    assert table.head == ["view", "PSNR dB", "SSIM", "covered %", "pixels scored %"]
    assert [cell.text for cell in table.rows[0]] == ["first", "20.00", "0.800", "97.0", "100.0"]
    assert table.sums[0][1].text == "20.50"


# -- in a browser ----------------------------------------------------------------------------------


@needs_chromium
def test_a_browser_draws_every_figure_of_a_real_run(sample_run: RunSummary, tmp_path: Path) -> None:
    page = sample_run.workspace / "report.html"
    assert sample_run.report == page
    text = text_of(page.read_text())
    assert "could not be drawn" not in text
    assert "could not be told" not in text
    assert page.stat().st_size < 4e6
    assert_alone(page.read_text())
    seen = look(page, tmp_path)
    assert seen["wide"]["images"] > 20
    assert len(seen["wide"]["charts"]) == 6
    assert seen["at"] == "20%"
    assert seen["focused"] is True and seen["zoomed"] is True, "the keyboard does it too"
    assert len(seen["sorted"]) >= 3
    shot = tmp_path / "shot.png"
    browse(page, tmp_path, (1200, 1600), f"--screenshot={shot}")
    drawn = cv2.imread(str(shot))
    assert drawn.shape == (1600, 1200, 3)
    assert drawn[400:].reshape(-1, 3).std(0).min() > 20, "pictures, not a blank page"


@needs_chromium
def test_a_browser_draws_whatever_is_there(tmp_path: Path) -> None:
    page = run_report(case.write_case(tmp_path / "a<b>&", unplaced=True))
    seen = look(page, tmp_path)
    assert len(seen["phone"]["charts"]) == 6
    assert seen["sorted"] == sorted(seen["sorted"], reverse=True) or len(seen["sorted"]) == 2
    by_name, by_figure = seen["sortings"]
    assert by_name == ["descending", *[None] * (len(by_name) - 1)]
    assert by_figure[:2] == [None, "descending"], "the column sorted by is told, and it alone"


# -- from a run ------------------------------------------------------------------------------------


def test_a_run_that_fails_is_reported_with_its_diagnosis(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    rng = np.random.default_rng(0)
    for name in ("<b>a&.jpg", "b.jpg"):
        blur = cv2.GaussianBlur(rng.normal(0.5, 0.6, (120, 160, 3)), (0, 0), 1.5)
        cv2.imwrite(str(photos / name), np.clip(blur * 255, 0, 255).astype(np.uint8))
    with pytest.raises(ReconstructionError):
        pipeline.run(photos, workspace=tmp_path / "w", overrides={"init.method": "colmap"})
    page = (tmp_path / "w" / "report.html").read_text()
    text = text_of(page)
    assert "init failed" in text
    failure = json.loads((tmp_path / "w" / "init" / "failure.json").read_text())["message"]
    assert failure.partition(" Pictures that")[0] in text
    assert "2 read" in text
    assert "<b>a" not in page


def test_previews_of_a_long_fit_stand_in_the_order_of_iterations(tmp_path: Path) -> None:
    previews = {f"fit_{n:05d}": case.picture(7) for n in (90_000, 100_000, 20)}
    workspace = case.write_case(tmp_path / "run", ["views", "init"])
    case.write_result(workspace, "fit", [case.cameras(), Pictures(previews)])
    (section,) = course(read_case(workspace))
    text = str(section)
    places = [text.index(f"after {n} iterations") for n in (20, 90_000, 100_000)]
    assert places == sorted(places)
