"""Presets, overrides, and the paragraphs that refuse wrong ones."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config import load_config, parse_override, presets, result_fields, yaml_value
from pipeline.errors import RequestError
from pipeline.front.options import path
from pipeline.process.privacy import share_for
from pipeline.workspace import make_request

ROOT = Path(__file__).resolve().parents[2]


def test_override_reaches_the_stage(toys: Path) -> None:
    config = load_config(toys / "toy.yaml", ["scale.factor=3.5", "seed=7"])
    assert config.sections["scale"].factor == 3.5  # type: ignore[attr-defined]
    assert config.run.seed == 7


@pytest.mark.parametrize(
    ("override", "text"),
    [
        ("scale.factr=3", r"'scale.factr' is not a setting. Did you mean scale.factor"),
        ("scal.factor=3", r"'scal' is neither a stage nor a setting.*Did you mean 'scale'\?"),
        ("scale.factor=70", r"scale.factor=70 is not allowed: .*less than 10.*multiply with"),
        ("scale.factor=many", r"scale.factor='many' is not allowed: .*number"),
        ("scale=3", "'scale' must hold key: value pairs"),
        ("stages=[read, nothing]", "Unknown stage 'nothing'"),
        ("scale.factor", "--set takes stage.key=value"),
        ("scale.factor=[1", "can't be read"),
    ],
)
def test_wrong_override_is_explained(toys: Path, override: str, text: str) -> None:
    with pytest.raises(RequestError, match=text):
        load_config(toys / "toy.yaml", [override])


def test_presets_extend_each_other(toys: Path) -> None:
    (toys / "a.yaml").write_text("extends: toy.yaml\nscale: {factor: 4}\ncount: {steps: 3}\n")
    (toys / "b.yaml").write_text("extends: a.yaml\nscale: {factor: 5}\n")
    config = load_config(toys / "b.yaml")
    assert config.sections["scale"].factor == 5  # type: ignore[attr-defined]
    assert config.sections["count"].steps == 3  # type: ignore[attr-defined]
    (toys / "a.yaml").write_text("extends: b.yaml\n")
    with pytest.raises(RequestError, match="in a circle"):
        load_config(toys / "b.yaml")


@pytest.mark.parametrize("section", ["scale:", "scale: {}", "scale: {round: true}"])
def test_what_a_preset_does_not_say_is_as_in_the_one_that_it_extends(
    toys: Path, section: str
) -> None:
    (toys / "a.yaml").write_text("extends: toy.yaml\nscale: {factor: 4}\n")
    (toys / "b.yaml").write_text(f"extends: a.yaml\n{section}\n")
    assert load_config(toys / "b.yaml").sections["scale"].factor == 4  # type: ignore[attr-defined]


def test_a_section_that_is_set_changes_what_it_names() -> None:
    one_by_one = load_config("no_flow", ["fit.near=0.1", "init.dense.planes=50"])
    assert load_config("no_flow", ["fit={near: 0.1}", "init={dense: {planes: 50}}"]) == one_by_one
    assert load_config("no_flow", {"fit.near": 0.1, "init.dense": {"planes": 50}}) == one_by_one
    widths = [f"init.dental.tooth_widths={given}" for given in ("{11: 8.6}", "{21: 8.5}")]
    assert load_config(None, widths) == load_config(None, widths[1:]), "that is one setting"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("scale: {factor: 3}", "names no stages. Let it begin with 'extends"),
        ("extends: toy.yaml\nscale.factor: 3", "has a section for each stage"),
        ("extends: toy.yaml\nrun: {seed: 3}", "settings of a run stand by themselves"),
        ("extends: toy.yaml\nthreads: null", "threads=null is not allowed"),
    ],
)
def test_a_preset_of_another_shape_is_told_which(toys: Path, text: str, told: str) -> None:
    (toys / "mine.yaml").write_text(text)
    with pytest.raises(RequestError, match=told):
        load_config(toys / "mine.yaml")


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ("init.method=dentl", "or 'files'. Did you mean 'dental'"),
        ("init.dental.order=rihgt,frontal,left", "Did you mean 'right'"),
        ("views.long_side=auot", "or a whole number. Did you mean 'auto'"),
        ("views.long_side=ten", "or a whole number. It means"),
    ],
)
def test_a_misspelled_choice_names_the_nearest(given: str, told: str) -> None:
    with pytest.raises(RequestError, match=told):
        load_config("dentalsplat", [given])


def test_an_order_of_no_photographs_is_refused_before_anything_runs() -> None:
    with pytest.raises(RequestError, match=r"init\.dental\.order=\[\] is not allowed"):
        load_config("dentalsplat", ["init.dental.order=[]"])


def test_unknown_preset_names_the_nearest() -> None:
    with pytest.raises(RequestError, match="Did you mean 'dentalsplat'"):
        load_config("dentalsplot")


def test_unreadable_preset_is_refused(toys: Path) -> None:
    (toys / "broken.yaml").write_text("a: [1")
    with pytest.raises(RequestError, match="can't be read"):
        load_config(toys / "broken.yaml")


@pytest.mark.parametrize("name", sorted(presets()))
def test_every_preset_is_valid(name: str) -> None:
    assert load_config(name).run.stages


def test_real_quantile_out_of_range_is_refused() -> None:
    with pytest.raises(RequestError, match=r"sap.quantile=7 is not allowed"):
        load_config(None, ["sap.quantile=7"])


@pytest.mark.parametrize(
    ("override", "told"),
    [
        ("views.held_out=003.jpg", "should be a list, as in [a, b]. It means"),
        ("fit.iterations=many", "should be 'auto', or a whole number. It means"),
        ("fit.background=1", "should be 'auto', or a list, as in [a, b]. It means"),
        ("init.length=null", "should be a section, as in {name: value}. It means"),
        ("init.dental.tooth_widths=8.6", "should be entries, as in {a: b}. It means"),
        ("views.masks=[1]", "should be a path. It means"),
        ("export.video=maybe", "should be true or false. It means"),
        ("export.mesh_faces=5.5", "should be a whole number. It means"),
    ],
)
def test_a_value_of_another_kind_is_refused_in_no_words_of_python(override: str, told: str) -> None:
    with pytest.raises(RequestError) as caught:
        load_config(None, [override])
    assert told in str(caught.value)


def test_runtime_fields_stay_out_of_the_result(toys: Path) -> None:
    section = load_config(toys / "toy.yaml").sections["scale"]
    assert result_fields(section) == {"factor": 2.0, "note": False, "round": False}


@given(st.one_of(st.integers(), st.floats(allow_nan=False), st.booleans(), st.text(), st.none()))
def test_values_survive_the_command_line(value: object) -> None:
    key, parsed = parse_override(f"a.b={yaml_value(value)}")
    assert key == "a.b"
    assert parsed == value


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("a.b=off", "off"),
        ("a.b=on", "on"),
        ("a.b=no", "no"),
        ("a.b=true", True),
        ("a.b=False", False),
    ],
)
def test_on_and_off_are_words(text: str, value: object) -> None:
    assert parse_override(text) == ("a.b", value)


def test_settings_load_nothing_that_takes_long() -> None:
    """A run that finds everything in the store should not wait for libraries that it never asks."""
    program = (
        "import sys; from pipeline.config import load_config; load_config(); "
        "heavy = 'numba', 'scipy', 'torch', 'pycolmap', 'open3d', 'pymeshlab', 'onnxruntime'; "
        "print(*(name for name in heavy if name in sys.modules))"
    )
    found = subprocess.run(
        [sys.executable, "-c", program], check=True, capture_output=True, text=True, cwd=ROOT
    )
    assert found.stdout.split() == []


def test_paths_hold_in_every_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A workspace goes on with the settings of its last run, from wherever that is asked for."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").touch()
    stay = (
        "fit.iterations=4", "evaluate.mesh=~/teeth.ply", "init.cameras=/there", "swap.cameras=null",
        "evaluate.masks", "nothing.masks=m", "evaluate.test_poses=both", "report=false",
        "init.dental.labels=[]",
    )  # fmt: skip
    given = (
        "evaluate.ground_truth=a/b.json", "init.pointmap.files='in: here'", "views.masks=m",
        "init.dental.labels=teeth.yaml",
    )  # fmt: skip
    request = make_request("photos", "w", "mine.yaml", [*given, *stay])
    assert request.preset == f"{tmp_path}/mine.yaml"
    assert request.overrides == (
        f"evaluate.ground_truth={tmp_path}/a/b.json",
        f"init.pointmap.files='{tmp_path}/in: here'", f"views.masks={tmp_path}/m",
        f"init.dental.labels={tmp_path}/teeth.yaml", *stay,
    )  # fmt: skip
    assert make_request("photos", "w", "paper", {"views.masks": "m"}).overrides == (
        f"views.masks={tmp_path}/m",
    )
    assert make_request("photos", "w", None, {"views": {"masks": "m", "frames": 3}}).overrides == (
        f"views={{frames: 3, masks: {tmp_path}/m}}",
    )


def test_the_place_of_a_file_is_not_in_the_key() -> None:
    here, there, none = (
        result_fields(load_config(None, given).sections["init"])
        for given in (["init.dental.labels=a.yaml"], ["init.dental.labels=/b/a.yaml"], [])
    )
    assert here == there != none


def test_settings_that_do_not_go_together_are_refused_in_our_words() -> None:
    with pytest.raises(RequestError, match=r"^fit: isotropic works with"):
        load_config(overrides=["fit.isotropic=true"])


def test_paths_of_a_preset_begin_at_its_folder(tmp_path: Path) -> None:
    (tmp_path / "base").mkdir()
    (tmp_path / "base" / "a.yaml").write_text("extends: dentalsplat\nviews: {masks: m}\n")
    (tmp_path / "b.yaml").write_text(
        "extends: base/a.yaml\ninit: {cameras: ~/c, pointmap: {files: p}}\nfit: {iterations: 5}\n"
    )
    sections: Any = load_config(tmp_path / "b.yaml").sections
    assert sections["views"].masks == tmp_path / "base" / "m"
    assert sections["init"].pointmap.files == str(tmp_path / "p")
    assert (sections["init"].cameras, sections["fit"].iterations) == ("~/c", 5)


def test_what_a_last_run_had_is_said_as_a_shell_takes_it(tmp_path: Path) -> None:
    make_request("photos", tmp_path, "paper", ["views.masks=/of me/m", "fit.iterations=5"]).save()
    request = make_request(workspace=tmp_path, as_before=True)
    assert request.typed_before == "-c paper --set 'views.masks=/of me/m' --set fit.iterations=5"


def test_one_stage_or_setting_may_be_given_as_it_is(tmp_path: Path) -> None:
    """Strings are sequences of strings, too: stages='views' was the stages v, i, e, w and s."""
    request = make_request((), tmp_path, None, "fit.iterations=5", "views, init")
    assert request.stages == ("views", "init") and request.overrides == ("fit.iterations=5",)
    assert make_request((), tmp_path, stages="").stages is None
    with pytest.raises(RequestError, match="share is nobody or group; this is 'all'"):
        share_for(tmp_path, "all")  # type: ignore[arg-type]


def test_a_tilde_that_no_shell_has_replaced(toys: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(toys))
    request = make_request(["~/images/*", "~nosuch/a"], "~/w")
    assert request.images == (str(toys / "images" / "*"), str(Path.cwd() / "~nosuch" / "a"))
    assert request.workspace == toys / "w"
    assert path("~/w") == toys / "w"
