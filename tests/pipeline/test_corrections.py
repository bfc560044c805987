"""`teeth.yaml`: what it may say, how it is found, and what the engine makes of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import toy
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import pipeline
from pipeline.artifacts.dental.corrections import (
    Corrections,
    CrownCorrection,
    PhotoCorrection,
    corrections_file,
    read_corrections,
)
from pipeline.errors import ReconstructionError, RequestError
from pipeline.store import Store
from stages.dentition.corrections import (
    apply_corrections,
)
from tests import teeth_case as case

GOOD = """
photographs:
  0_right.jpg:
    use: true
    kind: right
    mirrored: true
    crowns:
      - {at: [412, 300.5], tooth: 16}
      - {at: [1, 2], remove: true}
      - {at: [3, 4], split: [[1, 2], [3, 4.5]]}
    sha256: 5f8e0c1b7a29d364
  "001": {use: false, mirrored: false}
  1.jpg:
"""


def test_what_the_page_writes_is_read(tmp_path: Path) -> None:
    found = read_corrections(case.write(tmp_path / "teeth.yaml", GOOD))
    crowns = (
        CrownCorrection((412, 300.5), tooth=16),
        CrownCorrection((1, 2), remove=True),
        CrownCorrection((3, 4), split=((1, 2), (3, 4.5))),
    )
    assert found.photographs == {
        "0_right.jpg": PhotoCorrection(True, "right", True, crowns),
        "001": PhotoCorrection(use=False, mirrored=False),
        "1.jpg": PhotoCorrection(),
    }
    assert found
    assert [photo.sha256 for photo in found.photographs.values()] == ["5f8e0c1b7a29d364", "", ""]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "# nothing\n",
        "photographs:\n",
        "photographs: {a.jpg: {}}",
        "photographs: {a.jpg: {mirrored: }}",
    ],
)
def test_an_empty_file_changes_nothing(tmp_path: Path, text: str) -> None:
    found = read_corrections(case.write(tmp_path / "teeth.yaml", text))
    assert not found
    teeth = case.teeth()
    assert apply_corrections(teeth, case.views(), found) is teeth


def one(entry: str) -> str:
    return "photographs: {a.jpg: {crowns: [" + entry + "]}}"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("photos: {}", r"'photos' is not known here.*Did you mean 'photographs'"),
        ("[1, 2]", "must hold photographs"),
        ("photographs: [a.jpg]", "must hold a photograph's name"),
        ("photographs: {a.jpg: {used: true}}", r"photograph 'a.jpg': 'used' .*Did you mean 'use'"),
        ("photographs: {a.jpg: {use: 1}}", "use must be true or false, not 1"),
        ("photographs: {a.jpg: {use: yes}}", "use must be true or false, not 'yes'"),
        ("photographs: {a.jpg: {mirrored: 1}}", "mirrored must be true or false, not 1"),
        ("photographs: {a.jpg: {mirrored: yes}}", "mirrored must be true or false, not 'yes'"),
        ("photographs: {a.jpg: {mirrored: [true]}}", "mirrored must be true or false"),
        ("photographs: {a.jpg: {mirored: true}}", "'mirored' .*Did you mean 'mirrored'"),
        ("photographs: {a.jpg: {sha256: 12345678}}", "sha256 must be .* in quotes, not 12345678"),
        ("photographs: {a.jpg: {sha256: xyz}}", "sha256 must be up to 64 digits 0-9 and a-f"),
        ("photographs: {a.jpg: {kind: rigth}}", "kind must be.*Did you mean 'right'"),
        ("photographs: {a.jpg: {crowns: {at: 1}}}", "crowns must be a list"),
        (one("{tooth: 11}"), r"crowns\[0\] must say where the crown is"),
        (one("{at: [1, 2]}"), "one of tooth, remove and split; it says at"),
        (one("{at: [1, 2], tooth: 11, remove: true}"), "one of tooth, remove and split"),
        (one("{at: [1, 2], tooth: 19}"), r"crowns\[0\].tooth: 19 is no tooth's number"),
        (one("{at: [1, 2], tooth: true}"), "True is no tooth's number"),
        (one("{at: [1, 2], tooth: 16.0}"), "16.0 is no tooth's number"),
        (one("{at: [1, 2], tooth: 016}"), "'016' is no tooth's number"),
        (one("{at: [1, 2], tooth: '16'}"), "'16' is no tooth's number"),
        (one("{at: [1, 2], remove: false}"), "remove can only be true"),
        (one("{at: [1, true], tooth: 11}"), r"crowns\[0\].at must be two numbers"),
        (one("{at: [1, .nan], tooth: 11}"), "must be two numbers"),
        (one("{at: [1, 1.0e99], tooth: 11}"), "must be two numbers"),
        (one("{at: [1, 2, 3], tooth: 11}"), "must be two numbers"),
        (one("{at: 5, tooth: 11}"), "must be two numbers"),
        (one("{at: [1, 2], split: [[1, 2]]}"), "split must be two places"),
        (one("{at: [1, 2], split: [[1, 2], [3]]}"), r"split\[1\] must be two numbers"),
        (one("{at: [1, 2], split: [[1, 2], [1, 2]]}"), "the same place"),
        ("photographs: {a: {use: true}, a: {use: false}}", "line 1: 'a' is said twice"),
        ("photographs: {[1]: {}}", "a key must be a word"),
        ("a: &x 1\nb: *x", "anchors and aliases"),
        ("photographs: !!python/object:os.system {}", "tags"),
        ("--- 1\n--- 2", "several documents"),
        ("photographs: {", "is not YAML"),
        ("a: \x00", "is not YAML"),
        ("photographs:\n  a.jpg:\n\t\tuse: false", "line 3 is not YAML: it is indented by a tab"),
        ("[" * 100_000, "nested deeper"),
        ("- 1\n" * 100_000, "more entries"),
        ("#" * 2**20 + "\n", "more than a text of settings may have"),
        ("a: " + "9" * 10_000, "'a' is not known"),
    ],
)  # fmt: skip
def test_what_is_not_understood_is_refused(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(RequestError, match=said) as caught:
        read_corrections(case.write(tmp_path / "teeth.yaml", text))
    assert str(tmp_path / "teeth.yaml") in str(caught.value)
    assert len(str(caught.value)) < 400


def test_a_folder_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "teeth.yaml"
    path.mkdir()
    with pytest.raises(RequestError, match="is a folder, not a file"):
        read_corrections(path)


PIECES = [
    "photographs", "a.jpg", ":", " ", "\n", "\n  ", "{", "}", "[", "]", ",", "at", "tooth", "16",
    "- ", "use", "true", "&x", "*x", "!!", "---", "'", '"', "#", "~", "|", ">", "1e9",
]  # fmt: skip


@settings(max_examples=150, suppress_health_check=list(HealthCheck))
@given(st.one_of(st.text(max_size=60), st.lists(st.sampled_from(PIECES)).map("".join)))
def test_any_text_is_read_or_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "teeth.yaml"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    try:
        assert isinstance(read_corrections(path), Corrections)
    except RequestError as error:
        assert str(path) in str(error)


def test_where_the_file_is(tmp_path: Path) -> None:
    request = {"images": [], "workspace": tmp_path}
    assert corrections_file((), {}) is None
    assert corrections_file((), request) is None
    own = case.write(tmp_path / "teeth.yaml", "")
    assert corrections_file((), request) == corrections_file(None, request) == own
    other = case.write(tmp_path / "mine.yaml", "")
    assert corrections_file(str(other), request) == other
    with pytest.raises(RequestError, match=r"init.dental.labels: there is no file .*none.yaml"):
        corrections_file(str(tmp_path / "none.yaml"), request, "init.dental.labels")


# -- the engine ------------------------------------------------------------------------------------


def test_stages_know_the_workspace_but_their_keys_do_not(
    toys: Path, run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def sources(self: Any, config: Any, request: Any) -> dict[str, Path]:
        path = corrections_file((), request)
        return {"teeth.yaml": path} if path else {}

    monkeypatch.setattr(toy.ScaleStage, "sources", sources)
    run()
    key = Store(toys / "w").current("scale").key  # type: ignore[union-attr]
    pipeline.run(toys / "images", workspace=toys / "elsewhere", preset=toys / "toy.yaml")
    assert Store(toys / "elsewhere").current("scale").key == key  # type: ignore[union-attr]
    case.write(toys / "w" / "teeth.yaml", "photographs:\n")
    assert pipeline.status(workspace=toys / "w")[1].reasons == ["input file added: teeth.yaml"]
    assert run()["scale"] == "ran"
    assert run()["scale"] == "cached"


def test_what_a_failed_stage_made_is_kept_until_one_succeeds(
    toys: Path, run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = {"teeth": case.teeth()}

    def doubtful(self: Any, how: str) -> None:
        if how:
            picture = {"pair": np.zeros((4, 6, 3), np.uint8)}
            raise ReconstructionError("Doubtful.", picture if how == "drawn" else {}, made)

    monkeypatch.setattr(toy.CountStage, "_maybe_fail", doubtful)
    monkeypatch.setattr("pipeline.studies.report.check._views_of", lambda found: case.views())
    with pytest.raises(ReconstructionError, match=r" To put it right, open .*check.* Pictures "):
        run("count.fail=drawn")
    folder = toys / "w" / "count" / "failure"
    assert sorted(path.name for path in folder.iterdir()) == ["pair.png", "teeth"]
    assert len(Store(toys / "w").failures.evidence("count", "teeth").views) == 3
    with pytest.raises(ReconstructionError, match=r"^Doubtful. To put it right, open"):
        run("count.fail=plain")
    assert [path.name for path in folder.iterdir()] == ["teeth"]
    assert "check.html" not in (Store(toys / "w").failures.of("count") or {})["message"]
    assert (toys / "w" / "check.html").is_file()
    made.clear()
    with pytest.raises(ReconstructionError, match=r"^Doubtful.$"):
        run("count.fail=again")
    assert not folder.exists() and not (toys / "w" / "check.html").exists()
    run()


def test_a_wrong_file_is_refused_before_the_stages_that_come_first_run(
    toys: Path, run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def sources(self: Any, config: Any, request: Any) -> dict[str, Path]:
        path = corrections_file(str(toys / "none.yaml"), request, "scale.labels")
        return {"teeth.yaml": path} if path else {}

    monkeypatch.setattr(toy.ScaleStage, "sources", sources)
    with pytest.raises(RequestError, match=r"scale\.labels: there is no file"):
        run()
    assert not (toys / "w" / "read").exists()
