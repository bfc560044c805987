"""`pipeline register`: what it writes and says, and its page of both visits in a browser."""

from __future__ import annotations

import csv
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result
from typer.testing import CliRunner

from pipeline.artifacts.space.scale import Scale
from pipeline.cli import app
from pipeline.errors import ReconstructionError, RequestError
from pipeline.store import Store
from pipeline.studies.register import comparing, run_register, solving
from pipeline.studies.register.page.writing import tinted
from pipeline.studies.register.visit import Visit, names_of, read_visit, warning_of
from pipeline.workspace import StageStatus
from tests.browser import needs_chromium, run_in
from tests.studies.register_case import MOVED, toy_motions, toy_visit, write_visit
from tests.studies.report_case import write_result


@pytest.fixture(scope="module")
def workspaces(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    home = tmp_path_factory.mktemp("visits")
    return (
        write_visit(home / "may", toy_visit("first")),
        write_visit(home / "june", toy_visit("second", toy_motions(), turn=3.0)),
    )


@pytest.fixture(scope="module")
def compared() -> list[comparing.Comparison]:
    """What the command of `written` compared."""
    return []


@pytest.fixture(scope="module")
def written(
    workspaces: tuple[Path, Path], compared: list[comparing.Comparison],
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Path, Result]:  # fmt: skip
    """The folder that the command writes, and how it ended."""
    out = tmp_path_factory.mktemp("written") / "out"
    compare = comparing.compare_visits

    def kept(first: Visit, second: Visit) -> comparing.Comparison:
        compared[:] = [compare(first, second)]
        return compared[0]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(comparing, "compare_visits", kept)
        return out, CliRunner().invoke(app, ["register", *map(str, workspaces), "-o", str(out)])


def test_a_page_without_live_scenes_is_small_and_has_the_pictures(
    workspaces: tuple[Path, Path], written: tuple[Path, Result],
    compared: list[comparing.Comparison], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    assert written[1].exit_code == 0, written[1].output
    monkeypatch.setattr(comparing, "compare_visits", lambda first, second: compared[0])
    result = CliRunner().invoke(
        app, ["register", *map(str, workspaces), "-o", str(tmp_path), "--no-live"]
    )
    assert result.exit_code == 0, result.output
    page, whole = (tmp_path / "register.html"), (written[0] / "register.html")
    assert page.read_text().count("data:image/jpeg") == whole.read_text().count("data:image/jpeg")
    assert "splats-0" not in page.read_text() and "Drag to turn" not in page.read_text()
    assert page.stat().st_size < whole.stat().st_size / 2


def test_the_command_writes_table_page_and_mesh(written: tuple[Path, Result]) -> None:
    out, result = written
    assert result.exit_code == 0, result.output
    assert "12: " in result.output
    size = (out / "register.html").stat().st_size
    assert f"register.html ({size / 1e6:.1f} MB)" in result.stdout
    assert "register: starts" in result.stderr and "register: done in" in result.stderr
    assert "peak memory" not in result.stderr
    said = json.loads((out / "register.json").read_text())
    assert {t["fdi"] for t in said["teeth"] if t["moved"]} == set(MOVED)
    with (out / "movements.csv").open() as stream:
        rows = {int(row["fdi"]): row for row in csv.DictReader(stream)}
    assert rows[12]["moved"] == "yes"
    at = next(np.array(t["at"]) for t in said["teeth"] if t["fdi"] == 12)
    true = np.linalg.norm(solving.displacement(toy_motions()[12], at)[:3])
    assert float(rows[12]["distance_mm"]) == pytest.approx(true, abs=0.15)
    assert said["scale_deviation_percent"] is None and said["first_scaled_by"] == 1
    page = (out / "register.html").read_text()
    assert "how far these may be off is not known" in page and ">unknown<" in page
    assert not re.search(r"-0\.0+ ±", page) and "0.00 ±" in page
    assert page.count("data:image/jpeg") == 9
    for text in ("photograph 000 · right 000.jpg; arrows", "from the same place (000 · right 0"):
        assert text in page, text
    assert "http" not in page.replace("http-equiv", "")
    assert (out / "movements.ply").read_bytes().startswith(b"ply\nformat binary_little_endian")


def test_arrows_are_told_of_where_there_are_some(
    written: tuple[Path, Result], compared: list[comparing.Comparison]
) -> None:
    found = compared[0]
    assert any("arrows" in (shown.caption or "") for shown in tinted(found))
    still = replace(found, teeth=tuple(replace(tooth, certain=False) for tooth in found.teeth))
    assert not any("arrows" in (shown.caption or "") for shown in tinted(still))


@pytest.mark.parametrize("how", ["-q", "-v"])
def test_the_command_says_nothing_or_each_step(
    workspaces: tuple[Path, Path], written: tuple[Path, Result],
    compared: list[comparing.Comparison], tmp_path: Path, how: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    assert written[1].exit_code == 0
    monkeypatch.setattr(comparing, "compare_visits", lambda first, second: compared[0])
    monkeypatch.setattr("pipeline.front.progress.time.monotonic", iter(range(10_000)).__next__)
    out = str(tmp_path / "out")
    result = CliRunner().invoke(app, ["register", *map(str, workspaces), "-o", out, how])
    assert result.exit_code == 0, result.output
    if how == "-q":
        assert result.output == ""
    else:
        for text in (f"read {workspaces[1]} 1/4", "compare the teeth 2/4", "peak memory mb"):
            assert text in result.stderr, text
    assert (Path(out) / "register.html").exists()


def test_no_workspace_is_said(workspaces: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="not a workspace"):
        run_register(workspaces[0], tmp_path)


def test_a_run_that_was_begun_anew_is_refused(tmp_path: Path) -> None:
    """Its photographs or teeth are not those any more that its scene was made from."""
    workspace = write_visit(tmp_path / "w 1", toy_visit("first"))
    store = Store(workspace)
    fitted = store.current("fit")
    assert fitted is not None
    scene = store.load(fitted, "gaussians")
    shutil.rmtree(workspace / "fit")
    before = {"views": {"stage": "views", "content": "of other photographs"}}
    write_result(workspace, "fit", [scene], inputs=before)
    with pytest.raises(RequestError, match=r"another result of 'views'.*pipeline run -w '"):
        read_visit(workspace)


def test_photographs_that_both_visits_hold_are_named(
    workspaces: tuple[Path, Path], written: tuple[Path, Result],
    compared: list[comparing.Comparison], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    assert written[1].exit_code == 0, written[1].output
    monkeypatch.setattr(
        comparing, "compare_visits", lambda a, b: replace(compared[0], first=a, second=b)
    )
    visit = toy_visit("third", turn=2.0)
    mixed = replace(visit, looks=(toy_visit("first").looks[0], *visit.looks[1:]))
    for other, named in ((workspaces[0], "000, 001, 002, 003"), (tmp_path / "mixed", "000")):
        if other != workspaces[0]:
            write_visit(other, mixed)
        page, said = run_register(workspaces[0], other, tmp_path / "out")
        assert f"of {named}, byte for byte" in said
        assert f"of {named}, byte for byte" in page.read_text()
        warning = json.loads((tmp_path / "out" / "register.json").read_text())["warning"]
        assert warning == said.splitlines()[0]


def test_photographs_that_can_not_be_read_again_are_named() -> None:
    visit = replace(toy_visit("first"), lost=("a.jpg", "b.jpg"))
    said = warning_of(visit, toy_visit("second"))
    assert said.startswith("a.jpg, b.jpg of 'first' can't be read where the run read them")


def test_teeth_that_were_put_right_since_the_run_are_said_not_to_count(
    workspaces: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A refusal sends people to check.html; without another run what they say there counts for
    nothing, and the old numbers were compared without a word."""
    from pipeline.studies.report import reading

    def changed(**_: Any) -> list[StageStatus]:
        why = ["input file added: teeth.yaml", "library numpy 1 → 2"]
        states = {"init": ("stale", why), "fit": ("pending", ["depends on init"])}
        return [
            StageStatus(name, *states.get(name, ("cached", [])))
            for name in ("views", "teeth", "init", "fit")
        ]

    monkeypatch.setattr(reading, "status", changed)
    visit = read_visit(workspaces[0])
    assert visit.changed == ("input file added: teeth.yaml",)
    said = warning_of(toy_visit("second"), replace(visit, name="may"))
    assert said == (
        "'may' was run before this: input file added: teeth.yaml. It is not in the figures. Run "
        "the pipeline there again first."
    )


def test_a_folder_that_cannot_be_written_is_said_before_the_work(
    workspaces: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(first: Visit, second: Visit) -> comparing.Comparison:
        raise ReconstructionError("not one patient")

    monkeypatch.setattr(comparing, "compare_visits", refused)
    (tmp_path / "file").write_text("")
    with pytest.raises(RequestError, match=r"written to \(a part of its path is no folder\)"):
        run_register(*workspaces, tmp_path / "file" / "out")
    with pytest.raises(RequestError, match=r"\(there is something else of that name\)\. Name an"):
        run_register(*workspaces, tmp_path / "file")
    with pytest.raises(ReconstructionError):
        run_register(*workspaces, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_visits_whose_folders_are_called_alike_are_told_apart(tmp_path: Path) -> None:
    may, june = (tmp_path / month / "anna" for month in ("may", "june"))
    assert names_of([may, june]) == ["may/anna", "june/anna"]
    assert names_of([may, june.parent]) == ["anna", "june"]
    assert names_of([may, may]) == ["anna", "anna"]


def test_a_run_without_a_scale_is_as_large_as_textbook_teeth(tmp_path: Path) -> None:
    write_visit(tmp_path / "w", toy_visit("first"), Scale())
    visit = read_visit(tmp_path / "w")
    assert (visit.scale_percent, visit.scale_source) == (10.0, "textbook teeth")


def test_an_unfinished_run_is_said(workspaces: tuple[Path, Path], tmp_path: Path) -> None:
    half = tmp_path / "half of it"
    half.mkdir()
    (half / "request.json").write_text((workspaces[0] / "request.json").read_text())
    with pytest.raises(RequestError, match=rf"run first \(pipeline run -w '{half}'\)"):
        run_register(half, workspaces[1])


PROBE = """
const found = () => {
  const { pair } = visits;
  const by = (id) => document.getElementById(id);
  const sum = () => pair.pixels().reduce((total, value) => total + value, 0);
  const halves = () => {
    const bytes = pair.pixels();
    const { width, height } = pair.canvas;
    const total = [0, 0];
    for (let y = 0; y < height; y++) {
      for (let x = 0; x < width; x++) {
        total[x < (width / 2 | 0) ? 0 : 1] += bytes[4 * (y * width + x)];
      }
    }
    return total;
  };
  const drag = (target, from, to) => {
    target.setPointerCapture = () => {};
    target.hasPointerCapture = () => true;
    const fire = (type, x) => target.dispatchEvent(new PointerEvent(type,
      { pointerId: 3, clientX: x, clientY: 40, buttons: 1, bubbles: true, cancelable: true }));
    fire("pointerdown", from);
    for (let k = 1; k <= 5; k++) fire("pointermove", from + (to - from) * k / 5);
    fire("pointerup", to);
  };
  const press = (key, more) => pair.canvas.dispatchEvent(
    new KeyboardEvent("keydown", { key, bubbles: true, cancelable: true, ...more }));
  const box = pair.canvas.getBoundingClientRect();
  const told = { state: document.documentElement.dataset.scenes };
  told.stills = getComputedStyle(document.querySelector(".stills")).display;
  told.says = document.body.innerText.includes("Drag to turn");
  const slide = (value) => {
    by("between").value = value;
    by("between").dispatchEvent(new Event("input"));
  };
  slide(100);
  told.first = halves();
  slide(0);
  told.second = halves();
  slide(50);
  told.wiped = halves();
  told.text = by("between").getAttribute("aria-valuetext");
  by("fade").click();
  told.faded = sum();
  told.edge = by("edge").hidden;
  by("wipe").click();
  drag(by("edge"), box.left + box.width / 2, box.left + box.width * 0.8);
  told.edgeAt = by("between").value;
  press("ü", { code: "BracketLeft" });
  told.keyed = by("between").value;
  by("swap").click();
  told.swapped = by("between").value;
  const before = sum();
  drag(pair.canvas, box.left + 40, box.left + 140);
  told.turned = sum() !== before;
  told.pressed = by("places").querySelectorAll("[aria-pressed=true]").length;
  press("r");
  pair.motion && (pair.motion.start -= 1000);
  told.back = sum() === before;
  told.wide = [...document.querySelectorAll(".scroll")].map((e) => e.scrollWidth - e.clientWidth);
  told.page = document.documentElement.scrollWidth - innerWidth;
  told.named = [...by("live").querySelectorAll("button, input, canvas")].filter((e) => !e.hidden
    && !(e.ariaLabel || e.textContent.trim() || e.labels?.length)).length;
  told.width = innerWidth;
  return told;
};
(async () => {
  await visits.ready;
  const wide = found();
  await resized(390, 780);
  tell({ wide, narrow: found() });
})().catch((error) => tell({ failed: String(error) }));
"""


@pytest.fixture(scope="module")
def page(written: tuple[Path, Result]) -> str:
    return (written[0] / "register.html").read_text()


@needs_chromium
def test_both_scenes_are_live_under_one_slider(page: str, tmp_path: Path) -> None:
    """On a desk, and then in a window as narrow as a telephone."""
    found, log = run_in(page, PROBE, tmp_path, (1280, 560), coarse=True, framed=True)
    assert "failed" not in found, found
    assert log == []
    assert (found["wide"]["width"], found["narrow"]["width"]) == (1280, 390)
    for told in found.values():
        check_slider(told)


def check_slider(told: dict[str, Any]) -> None:
    assert told["state"] == "live"
    assert told["stills"] == "none"
    assert told["says"] is True
    assert min(told["first"] + told["second"]) > 0
    assert told["first"] != told["second"], "a tooth has moved"
    assert told["wiped"] == pytest.approx([told["first"][0], told["second"][1]], rel=0.01)
    assert told["text"] == "first visit on the left 50 %, second visit on the right 50 %"
    assert told["faded"] > 0
    assert told["edge"] is True
    assert told["edgeAt"] == "80"
    assert told["keyed"] == "75"
    assert told["swapped"] == "0"
    assert told["turned"] is True
    assert told["pressed"] == 0
    assert told["back"] is True
    assert told["wide"] == [0], "the table is cut off"
    assert told["page"] <= 0
    assert told["named"] == 0


@needs_chromium
def test_without_webgl_the_pictures_stay(page: str, tmp_path: Path) -> None:
    blind = page.replace(
        "<head>",
        "<head><script>HTMLCanvasElement.prototype.getContext = () => null;</script>",
        1,
    )
    script = """visits.ready.then(() => tell({
      state: document.documentElement.dataset.scenes, live: document.getElementById("live").hidden,
      stills: getComputedStyle(document.querySelector(".stills")).display,
      says: document.body.innerText.includes("Drag to turn"),
      why: document.documentElement.dataset.problem }));"""
    told, log = run_in(blind, script, tmp_path, (1280, 900))
    assert log == []
    assert told["state"] == "pictures"
    assert told["live"] is True
    assert told["stills"] == "grid"
    assert told["says"] is False, "pictures can't be turned"
    assert "WebGL2" in told["why"]


@needs_chromium
def test_a_graphics_context_that_stays_away_leaves_the_pictures(page: str, tmp_path: Path) -> None:
    script = """(async () => {
      await visits.ready;
      const wait = (ms) => new Promise((done) => setTimeout(done, ms));
      const sum = () => visits.pair.pixels().reduce((total, value) => total + value, 0);
      const state = () => [document.documentElement.dataset.scenes,
        document.getElementById("live").hidden];
      const before = sum();
      const card = document.getElementById("both").getContext("webgl2")
        .getExtension("WEBGL_lose_context");
      card.loseContext();
      await wait(5000);
      const lost = state();
      card.restoreContext();
      await wait(500);
      tell({ lost, back: state(), same: sum() === before });
    })();"""
    told, log = run_in(page, script, tmp_path, (1280, 900), coarse=True)
    assert all("CONTEXT_LOST_WEBGL" in line for line in log)
    assert told == {"lost": ["pictures", True], "back": ["live", False], "same": True}
