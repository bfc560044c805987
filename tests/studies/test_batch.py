"""Batches of toy cases: what runs, what is not run again, and what is said."""

from __future__ import annotations

import csv
import io
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from pipeline.artifacts import KINDS
from pipeline.errors import RequestError
from pipeline.stage import get_stage
from pipeline.studies.batch.progress import Lines
from pipeline.studies.batch.summary import COLUMNS
from tests.studies import toy_batch
from tests.studies.toy_batch_case import PRESET, add_case, computed

pytest.importorskip("distributed")


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Callable[..., Any]]:
    """Run a batch of toys on ``cases`` and return its records by name."""
    from pipeline.studies.batch import task
    from pipeline.studies.batch.running import batch

    monkeypatch.setitem(KINDS, "numbers", "toy:Numbers")
    monkeypatch.setattr("pipeline.stage._entry_points", lambda: toy_batch.STAGES)
    monkeypatch.setattr(task, "COMMAND", (*toy_batch.COMMAND, "child"))
    monkeypatch.setenv("TOY_LOG", str(tmp_path / "log.txt"))
    get_stage.cache_clear()
    (tmp_path / "toy.yaml").write_text(PRESET)

    def call(cases: str = "cases", **options: Any) -> dict[str, Any]:
        (tmp_path / "log.txt").write_text("")
        given = {"preset": tmp_path / "toy.yaml", "jobs": 2, "out": tmp_path / "out", **options}
        found = batch(tmp_path / cases, **given)
        return {record["name"]: record for record in found["cases"]}

    yield call
    get_stage.cache_clear()


@pytest.fixture
def here(run: Callable[..., Any]) -> Callable[..., Any]:
    """As `run`, where cases need no process of their own: each takes a second to start."""
    from pipeline.studies.batch import child, task

    one = threading.Lock()  # at a time: a run has the whole process

    def in_this_process(job: dict[str, Any], case: Any) -> tuple[int, str]:
        with one:
            child.run_case(job)
        return 0, ""

    def call(*cases: str, **options: Any) -> dict[str, Any]:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(task, "_process", in_this_process)
            return run(*cases, **options)

    return call


def listed(folder: Path, **settings: str) -> None:
    """A list of cases, each with two photographs of its own and these settings."""
    lines = ["name,photographs,settings"]
    for number, (name, setting) in enumerate(settings.items()):
        add_case(folder, name, 10 * number, 10 * number + 1)
        lines.append(f"{name},cases/{name},{setting}")
    (folder / "cases.csv").write_text("\n".join(lines) + "\n")


def test_cases_are_run_once_and_seen_again(here: Any, tmp_path: Path) -> None:
    add_case(tmp_path, "a", 1, 2)
    add_case(tmp_path, "clinic/b", 3, 4, 5)
    add_case(tmp_path, "clinic/like a", 1, 2)
    add_case(tmp_path, "empty")
    found = here()
    states = {name: record["state"] for name, record in found.items()}
    assert states == {
        "a": "done", "clinic/b": "done", "clinic/like a": "duplicate", "empty": "wrong",
    }  # fmt: skip
    assert computed(tmp_path) == {"views": 2, "fit": 2, "export": 2}
    one = found["clinic/b"]
    assert (one["teeth"], one["placed"], one["photographs"], one["psnr"]) == (3, 3, 3, 33.0)
    assert one["seconds"] > 0 and one["peak_memory_mb"] > 10
    assert found["clinic/like a"]["like"] == "a"
    assert (tmp_path / "out" / "summary.csv").read_bytes().startswith(b"\xef\xbb\xbfname,state,")
    with (tmp_path / "out" / "summary.csv").open(encoding="utf-8-sig") as stream:
        rows = {row["name"]: row for row in csv.DictReader(stream)}
    assert rows["clinic/b"]["viewer"] == "cases/clinic__b/results/viewer.html"
    assert (tmp_path / "out" / rows["clinic/b"]["viewer"]).is_file()
    assert "empty" in rows["empty"]["reason"]
    assert one["measured"] == {"overjet": {"value": -1.25, "uncertainty": 0.5, "estimated": False}}
    measured = {name: rows["clinic/b"][name] for name in COLUMNS if name.endswith("_mm")}
    assert measured.pop("overjet_mm") == "-1.25"
    assert measured.pop("overjet_uncertainty_mm") == "0.5"
    assert set(measured.values()) == {""}
    again = here()
    assert computed(tmp_path) == {}
    assert again == found
    # A changed photograph and a changed setting are noticed; a file that was only touched is not.
    (tmp_path / "cases" / "a" / "1.jpg").write_text("7")
    os.utime(tmp_path / "cases" / "clinic" / "b" / "3.jpg", ns=(1, 1))
    assert here()["clinic/like a"]["state"] == "done"  # not like `a` any more
    assert computed(tmp_path) == {"views": 2, "fit": 2, "export": 2}
    here(overrides=["fit.megabytes=1"])
    assert computed(tmp_path) == {"fit": 3}  # what it exports has the same bytes
    # Pages and tables call a photograph by its name.
    (tmp_path / "cases" / "a" / "1.jpg").rename(tmp_path / "cases" / "a" / "9.jpg")
    here(overrides=["fit.megabytes=1"])
    assert computed(tmp_path)["views"] == 1


def test_what_was_moved_away_is_not_linked_to(here: Any, tmp_path: Path) -> None:
    add_case(tmp_path, "anna", 1, 2)
    add_case(tmp_path, "ben o", 1, 3)
    before = here()
    place = tmp_path / "out" / "cases" / "ben_o"
    place.rename(tmp_path / "elsewhere")
    told = here()
    assert computed(tmp_path) == {}, "it is done all the same"
    assert told["anna"] == before["anna"]
    assert (told["ben o"]["state"], told["ben o"]["links"]) == ("done", {})
    assert "results, viewer (cases/ben_o in the folder" in told["ben o"]["reason"]
    assert "--retry 'ben o' makes it anew" in told["ben o"]["reason"]
    assert 'href="cases/ben_o/' not in (tmp_path / "out" / "summary.html").read_text()
    (tmp_path / "elsewhere").rename(place)
    assert here() == before
    shutil.rmtree(place)
    assert here(retry=["ben o"])["ben o"]["links"] == before["ben o"]["links"]


def test_every_end_has_its_state_and_others_go_on(run: Any, tmp_path: Path) -> None:
    listed(
        tmp_path, good="", none="fit.fail=refused", bug="fit.fail=fault", dies="fit.fail=killed",
        odd="fit.fial=1", big="fit.megabytes=500; fit.wait=20",
    )  # fmt: skip
    found = run("cases.csv", memory=0.4)
    states = {name: record["state"] for name, record in found.items()}
    assert states == {
        "good": "done", "none": "refused", "bug": "fault", "dies": "killed", "odd": "wrong",
        "big": "killed",
    }  # fmt: skip
    assert "share nothing" in found["none"]["reason"]
    assert "ZeroDivisionError" in found["bug"]["reason"]
    assert "fit.fail" in found["odd"]["reason"]  # the setting that was meant
    assert "more memory" in found["big"]["reason"] and "--memory" in found["big"]["reason"]
    assert found["dies"]["attempts"] == 3 and "3 times" in found["dies"]["reason"]
    assert computed(tmp_path)["views"] == 5  # the store had it for the second try
    again = run("cases.csv", memory=0.4, progress=Lines(said := io.StringIO()))
    assert computed(tmp_path) == {} and again == found
    assert "4 of 6 cases went wrong before and are not run again; --retry" in said.getvalue()
    run("cases.csv", memory=0.4, retry=["bug"])
    assert computed(tmp_path) == {"fit": 1}
    with pytest.raises(
        RequestError, match=r"--retry gud: there is no such case.*Did you mean 'good"
    ):
        run("cases.csv", retry=["gud"])


def test_the_summary_keeps_up_with_cases_that_end_quickly(
    run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a cluster one ends every moment, and there is never a quiet one."""
    from pipeline.studies.batch import running
    from pipeline.studies.batch.records import Case, new_record

    def quick(job: dict[str, Any]) -> dict[str, Any]:
        time.sleep(0.1)
        return new_record(Case.from_dict(job["case"]), "done")

    told = []
    monkeypatch.setattr(running, "run_case", quick)
    monkeypatch.setattr(running, "SUMMARY", 0.3)
    monkeypatch.setattr(running, "write_summary", lambda *given: told.append(given[-1]))
    listed(tmp_path, **{f"c{number}": "" for number in range(20)})
    run("cases.csv", jobs=1)
    assert len({text.partition(" done")[0] for text in told}) > 3
    assert told[-1].startswith("20 done;")


def test_all_that_failed_is_tried_again_where_a_case_is_called_so(
    here: Any, tmp_path: Path
) -> None:
    listed(tmp_path, failed="", none="fit.fail=refused")
    here("cases.csv")
    here("cases.csv", retry=["failed"])
    assert computed(tmp_path) == {"fit": 1}, "the store has what came of the good one"


def test_a_case_may_take_so_much_time_and_is_tried_again_when_asked(
    run: Any, tmp_path: Path
) -> None:
    listed(tmp_path, slow="fit.wait=60")
    found = run("cases.csv", minutes=0.01)
    assert found["slow"]["state"] == "killed" and "more time" in found["slow"]["reason"]
    text = (tmp_path / "cases.csv").read_text().replace("=60", "=0")  # no result depends on it
    (tmp_path / "cases.csv").write_text(text)
    assert run("cases.csv") == found and computed(tmp_path) == {}
    assert run("cases.csv", retry=["failed"])["slow"]["state"] == "done"


def test_a_file_that_a_setting_names_is_read_again_when_it_is_another(
    here: Any, tmp_path: Path
) -> None:
    one, two = tmp_path / "one.txt", tmp_path / "two.txt"
    one.write_text("1")
    two.write_text("2")
    listed(tmp_path, a="", like="", other=f"fit.file={one}", other_like=f"fit.file={two}")
    text = (tmp_path / "cases.csv").read_text()
    for name in ("like", "other", "other_like"):
        text = text.replace(f"cases/{name},", "cases/a,")
    (tmp_path / "cases.csv").write_text(text)
    states = {name: record["state"] for name, record in here("cases.csv").items()}
    assert states == {"a": "done", "like": "duplicate", "other": "done", "other_like": "done"}
    before = here("cases.csv")
    assert computed(tmp_path) == {}
    two.write_text("1")
    assert here("cases.csv")["other_like"]["state"] == "duplicate"
    one.write_text("3")
    assert here("cases.csv")["other"]["files"] != before["other"]["files"]
    assert computed(tmp_path) == {"fit": 2}
    one.rename(tmp_path / "moved.txt")
    (tmp_path / "cases.csv").write_text(text.replace("one.txt", "moved.txt"))
    here("cases.csv")
    assert computed(tmp_path) == {}, "what it says is the same"
    found = here("cases.csv", overrides=[f"fit.file={two}"])
    assert found["a"]["state"] == "done" and computed(tmp_path)["fit"] == 1
    found = here("cases.csv", overrides=[f"fit.file={tmp_path / 'nowhere.txt'}"])
    assert found["a"]["state"] == "wrong" and found["other"]["state"] == "done"


def test_what_a_person_put_right_is_taken_by_the_same_command(here: Any, tmp_path: Path) -> None:
    add_case(tmp_path, "a", 1, 2)
    add_case(tmp_path, "b", 1, 2)
    add_case(tmp_path, "c", 3, 4)
    first = here()
    said = tmp_path / "out" / "cases" / "a" / "teeth.yaml"
    for text in ("photographs: {}\n", "photographs:\n  1.jpg: {mirrored: true}\n"):
        said.write_text(text)
        found = here()
        assert computed(tmp_path)["fit"] == 1 and computed(tmp_path)["views"] == 0
        assert found["b"]["state"] == "duplicate" and found["c"] == first["c"]
        assert here() == found and computed(tmp_path) == {}
    said.unlink()
    assert here()["a"]["key"] == first["a"]["key"] != found["a"]["key"]
    assert computed(tmp_path) == {}, "the store had it"


def test_a_case_that_is_refused_now_shows_no_earlier_scene(
    run: Any, here: Any, tmp_path: Path
) -> None:
    case = add_case(tmp_path, "a", 1, 2)
    picture = tmp_path / "out" / "thumbnails" / "a.jpg"
    assert {"viewer", "results"} <= set(here()["a"]["links"]) and picture.is_file()
    (tmp_path / "out" / "cases" / "a" / "report.html").write_text("of this run or an earlier one")
    (case / "1.jpg").write_text("7")
    assert here(overrides=["fit.fail=refused"])["a"]["links"] == {"report": "report.html"}
    assert not picture.exists()
    assert "results" not in (tmp_path / "out" / "summary.csv").read_text()
    assert "viewer" in here()["a"]["links"] and picture.is_file()
    assert here(overrides=["fit.file=nowhere"])["a"]["links"] == {}, "no page is written then"
    assert run(overrides=["fit.fail=killed"])["a"]["links"] == {} and not picture.exists()


def test_a_process_that_dies_before_it_says_anything_is_given_up(
    run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from pipeline.studies.batch import task

    case, command = add_case(tmp_path, "a", 1, 2), task.COMMAND

    def dying(how: str) -> tuple[str, int, dict[str, str]]:
        monkeypatch.setattr(task, "COMMAND", (sys.executable, "-c", f"import os; {how}"))
        found = run(retry=["failed"])["a"]
        return found["state"], found["attempts"], found["links"]

    assert dying("os.kill(os.getpid(), 4)") == ("killed", 3, {})
    monkeypatch.setattr(task, "COMMAND", command)
    assert run(retry=["failed"])["a"]["state"] == "done"
    (case / "1.jpg").write_text("7")
    assert dying("x") == ("fault", 1, {})
    assert dying("os.kill(os.getpid(), 9)") == ("killed", 3, {})


def test_without_a_limit_it_takes_the_memory_it_needs(
    run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from pipeline.studies.batch import task

    monkeypatch.setattr(task, "_memory", lambda: 1)  # what the worker was given
    listed(tmp_path, a="fit.wait=0.3")
    assert run("cases.csv", memory=0)["a"]["state"] == "done"


def test_each_folder_of_cases_has_a_folder_of_results(
    here: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for number, place in enumerate(("29.11.2025", "29.11.2026", "north/2024", "south/2024")):
        add_case(tmp_path, f"{place}/a", 10 * number, 10 * number + 1)
    for place in ("29.11.2025", "29.11.2026", "north/2024"):
        here(f"cases/{place}", out=None)
    made = {path.name for path in (tmp_path / "runs").iterdir()}
    assert made == {"batch_29.11.2025", "batch_29.11.2026", "batch_2024"}
    with pytest.raises(RequestError, match=r"other cases, those of .*north/2024.*-o"):
        here("cases/south/2024", out=None)
    assert here("cases/north/2024", out=None)["a"]["state"] == "done" and computed(tmp_path) == {}
    (tmp_path / "cases" / "north").rename(tmp_path / "cases" / "moved")
    assert here("cases/moved/2024", out=None)["a"]["state"] == "done"
    assert computed(tmp_path) == {}, "it was known by what the photographs hold"


def test_only_results_are_kept(here: Any, tmp_path: Path) -> None:
    add_case(tmp_path, "a", 1, 2)
    place = tmp_path / "out" / "cases" / "a"
    record = here()["a"]
    assert (place / "results" / "splats.ply").is_file() and record["bytes"] > 9_000_000
    kept, gone = (
        f'<li><a href="results/{name}">{name}</a></li>' for name in ("viewer.html", "splats.ply")
    )
    (place / "report.html").write_text(f"<ul>{kept}{gone}</ul>")
    record = here(keep="results")["a"]  # what was made before is trimmed, not made again
    assert computed(tmp_path) == {}
    assert record["kept"] == "results" and record["bytes"] < 12_000_000
    assert set(record["left_out"]) == {"splats.ply", "colmap"}
    assert (place / "results" / "viewer.html").read_text() == "<p>a scene"
    assert (place / "report.html").read_text() == f"<ul>{kept}</ul>", "no link leads nowhere"
    said = (place / "results" / "README.txt").read_text()
    assert said.endswith("Left out by 'pipeline batch --keep results': colmap, splats.ply.\n")
    assert not (place / "fit").exists()
    assert here(keep="results")["a"] == record and computed(tmp_path) == {}
    assert here(keep="results", overrides=["fit.fail=refused"])["a"]["state"] == "refused"
    assert (place / "results" / "viewer.html").read_text() == "<p>a scene", "nothing replaces it"
    (place / "results").rename(place / ".results.before")  # killed while it was run anew
    here(retry=["a"])  # asked for anew, with all of it
    assert (place / "results" / "splats.ply").is_file() and computed(tmp_path)["fit"] == 1
    assert not (place / ".results.before").exists()


def test_a_full_disk_ends_the_batch_and_it_goes_on(run: Any, tmp_path: Path) -> None:
    listed(tmp_path, a="", b="fit.fail=full")
    with pytest.raises(RequestError, match=r"is full.*run the same command again"):
        run("cases.csv", jobs=1)
    with pytest.raises(RequestError, match="1 at least; this is 0"):
        run("cases.csv", jobs=0)
    text = (tmp_path / "cases.csv").read_text().replace("fit.fail=full", "")
    (tmp_path / "cases.csv").write_text(text)
    states = [record["state"] for record in run("cases.csv").values()]
    assert states == ["done", "done"]
    assert computed(tmp_path) == {"fit": 1, "export": 1}


def test_wrong_requests_are_refused_before_anything_is_written(run: Any, tmp_path: Path) -> None:
    from filelock import FileLock

    case = add_case(tmp_path, "a", 1, 2)
    add_case(tmp_path, "a b", 1, 2)
    for change, text in (
        ({"cases": "case"}, "Did you mean 'cases'"),
        ({"cases": "cases/a"}, r"is one case.*pipeline run /\S*/cases/a$"),
        ({"cases": "cases/a b"}, r"pipeline run '/\S*/cases/a b'$"),
        ({"overrides": ["fit.fial=1"]}, r"fit\.fail"),
        ({"scheduler": "nowhere.json"}, "neither an address"),
        ({"scheduler": str(case / "1.jpg")}, "names no address"),
    ):
        with pytest.raises(RequestError, match=text):
            run(**change)
    with pytest.raises(RequestError, match="among the cases"):
        from pipeline.studies.batch.running import batch

        batch(tmp_path / "cases", out=case / "out", preset=tmp_path / "toy.yaml")
    (tmp_path / "out").mkdir(exist_ok=True)
    with FileLock(tmp_path / "out" / ".lock"), pytest.raises(RequestError, match="Another batch"):
        run()
