"""Settings from outside: presets, suites, `--set`, `teeth.yaml`, and the paths that they name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

import pipeline
from pipeline import cli
from pipeline.artifacts.dental.corrections import corrections_file, read_corrections
from pipeline.config import load_config
from pipeline.errors import RequestError
from pipeline.geometry.models.known_cameras import model_files
from pipeline.studies.benchmark.suite import load_suite
from pipeline.studies.compare.models import model_folders
from pipeline.workspace import make_request

#: Nothing here may take as long as it likes: the bomb would, if it were unfolded.
pytestmark = pytest.mark.timeout(60)
SAMPLES = Path(__file__).resolve().parents[2] / "data_samples" / "three_photos"
BOMB = "\n".join(
    ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    + [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 12)]
)
#: What is wrong in any file of settings, and what is said of it.
TEXTS = [
    ("", ""),
    ("\0", "is not YAML"),
    ("a: \ud800".encode("utf-8", "surrogatepass").decode("latin-1"), "is not YAML"),
    ("2024-13-45", ""),
    ("views: 2024-02-30", "views"),
    ("views: {long_side: 2024-02-30}", "views.long_side='2024-02-30'"),
    ("views: {long_side: 0x_}", "views.long_side='0x_'"),
    ("views: {long_side: 0b}", "views.long_side='0b'"),
    ("views: {long_side: 1__0:61}", "views.long_side='1__0:61'"),
    ("views: {long_side: !!int x}", "tags"),
    ("views: {long_side: !!timestamp x}", "tags"),
    ("views: !!python/object/apply:os.system [true]", "tags"),
    ("views: {long_side: .inf}", "views.long_side=inf"),
    ("views: {long_side: .nan}", "views.long_side=nan"),
    ("views: {long_side: " + "9" * 5000 + "}", "views.long_side="),
    ("views: {long_side: " + "9" * 900 + "}", "views.long_side="),
    ("fit: {iterations: 1" + "0" * 300 + "}", "fit.iterations=1000"),
    ("fit: {iterations: 9223372036854775808}", "fit.iterations=9223372036854775808"),
    ("1: 2", "'1' is neither a stage"),
    ("{1.5: 2, ~: 3}", "is neither a stage"),
    ("? [a, b]\n: 1", "a key must be a word"),
    ("views: {long_side: 900}\nviews: {}", "'views' is said twice"),
    ("[" * 200_000, "nested deeper"),
    ("{a: " * 200_000, "nested deeper"),
    ("- " * 200_000 + "x", "nested deeper"),
    ("a: " * 200_000, "YAML"),
    ("views: " + "x" * 900_000, "views"),
    ("x" * 900_000 + ": 1", "can't be read"),
    ("\n".join(f"key{k}: 1" for k in range(20_000)), "is neither a stage"),
    ("views: {" + ", ".join(f"k{k}: 1" for k in range(20_000)) + "}", "'views.k0' is not a"),
    ("views: {" + "long" * 200 + ": 1}", "views"),
    ("- 1\n" * 100_000, "more entries"),
    (BOMB, "more entries"),
    ("a: &a [*a]", "stands for nothing"),
    ("a: *b", "stands for nothing"),
    ("#" * (1 << 20) + "\n", "more than a text of settings may have"),
    ("--- {}\n--- {}", "several documents"),
]


def refused(call: Callable[[], object]) -> str:
    """What is said, in one paragraph."""
    with pytest.raises(RequestError) as error:
        call()
    said = str(error.value)
    assert error.value.exit_status == 2 and len(said) < 3000 and "\n" not in said
    return said


@pytest.mark.parametrize(("text", "words"), TEXTS)
def test_a_preset_that_is_not_understood_is_refused(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(f"{text}\nstages: [views]\n" if text[:5] in ("views", "fit: ") else text)
    said = refused(lambda: load_config(path))
    assert words in said


@pytest.mark.parametrize(("text", "words"), TEXTS)
def test_a_suite_that_is_not_understood_is_refused(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    said = refused(lambda: load_suite(path))
    assert "mine.yaml" in said or words in said


@pytest.mark.parametrize(("text", "words"), TEXTS)
def test_labels_that_are_not_understood_are_refused(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "teeth.yaml"
    path.write_text(text)
    if not text:
        assert not read_corrections(path)
        return
    assert "teeth.yaml" in refused(lambda: read_corrections(path))


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", bytes(range(256)), b"a: \xc3("])
def test_what_is_no_text_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "mine.yaml"
    path.write_bytes(content)
    for call in (load_config, load_suite, read_corrections):
        said = refused(lambda call=call: call(path))  # type: ignore[misc]
        assert "mine.yaml" in said and "text in UTF-8" in said


def test_aliases_stand_for_what_they_name(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("extends: dentalsplat\nviews: &v {long_side: &s 640}\nfit: {iterations: *s}\n")
    sections = load_config(path).sections
    assert (sections["views"].long_side, sections["fit"].iterations) == (640, 640)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "as 'pipeline settings' has them"),
        ("=", "--set takes stage.key=value"),
        ("x" * 100_000, "--set takes stage.key=value"),
        ("views.long_side=0x_", "views.long_side='0x_'"),
        ("views.long_side=2024-02-30", "views.long_side='2024-02-30'"),
        ("views.long_side=!!int x", "tags"),
        ("views.long_side=&a [*a]", "anchors"),
        ("views.long_side=" + "[" * 100_000, "nested deeper"),
        ("views.long_side=" + "9" * 100_000, "views.long_side="),
        ("views.long_side=nan", "views.long_side="),
        ("views.long_side=1e999", "views.long_side="),
        ("views.long_side={1: 2}", "views.long_side="),
        ("views.long_side=[", "can't be read"),
        ("views.long_side=\0", "can't be read"),
        ("views.long_side=a\nb: c", "can't be read"),
        ("." * 100_000 + "=1", "no setting"),
        ("views." + "x." * 1000 + "y=1", "no setting"),
        ("init.dental.tooth_widths" + ".a" * 1000 + "=1", "no setting"),
        ("v" * 100_000 + "=1", "no setting"),
        ("views.=1", "views."),
        (".=1", "is neither a stage"),
        ("views=1", "'views' must hold"),
        ("stages=[1]", "stages"),
        ("stages=[" + "x" * 90_000 + "]", "Unknown stage"),
        ("threads=1e9", "threads="),
        ("seed=-1", "seed="),
        ("seed=true", "seed=true is not allowed: it is a number"),
        ("fit.iterations=true", "fit.iterations=true is not allowed: it is a number"),
        ("init.length.start=[true, 2]", "init.length.start=true is not allowed: it is a number"),
        ("init.squeezes=[1, 0]", "init.squeezes.1=0 is not allowed"),
        ("init.squeezes=[-1]", "init.squeezes.0=-1 is not allowed"),
        (
            "fit.light_widths=[30]",
            "fit.light_widths=[30] is not allowed: There are too few values.",
        ),
        ("fit.light_widths=[30, 20, 10]", "is not allowed: List should have at most 2 items"),
        ("fit.light_widths=3", "Input should be a list, as in [a, b]"),
        ("init.length.start=[1]", "init.length.start=[1] is not allowed: There are too few"),
        ("init.min_tri_angle=0", "init.min_tri_angle=0 is not allowed"),
        ("init.max_reprojection_error=0.01", "init.max_reprojection_error=0.01 is not allowed"),
        ("init.dense.window=4", "is not allowed: a window with a pixel in its middle is odd"),
        ("init.dense.polish_window=30", "is not allowed: a window with a pixel in its middle"),
        ("init.length.mm=8", "init.length: it needs init.length.photo, "),  # no {'mm': 8}
    ],
)
def test_a_setting_that_is_not_understood_is_refused(text: str, words: str) -> None:
    assert words in refused(lambda: load_config(None, [text]))


@pytest.mark.parametrize("tooth", [19, 20, 29, 50, 56, 80])
def test_numbers_that_no_tooth_has_are_refused(tooth: int) -> None:
    given = f"init.dental.labels=[{{photo: a.jpg, x: 1, y: 2, tooth: {tooth}}}]"
    said = refused(lambda: load_config(None, [given]))
    assert said.startswith(f"init.dental.labels.0.tooth={tooth} is not allowed: it is no tooth's")
    assert "FDI numbers are 11-18, " in said and "string" not in said
    load_config(None, [given.replace(f"tooth: {tooth}", "tooth: 55")])
    widths = refused(lambda: load_config(None, [f"init.dental.tooth_widths={{11: 8, {tooth}: 8}}"]))
    assert "tooth_widths" in widths and "it is no tooth's number; FDI numbers are" in widths


def test_names_may_be_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    asked = make_request(overrides=["views.masks=1.50", "views.held_out=[1, 02]"], workspace="w")
    views: Any = load_config(None, asked.overrides).sections["views"]
    assert (views.masks, views.held_out) == (tmp_path / "1.50", ("1", "02"))


def test_values_of_a_program_may_be_paths_and_numpy_s(tmp_path: Path) -> None:
    given = {"views.masks": tmp_path / "12", "fit.iterations": np.int64(50), "seed": np.uint8(3)}
    config = load_config(None, make_request(overrides=given, workspace="w").overrides)
    views, fit = (cast(Any, config.sections[name]) for name in ("views", "fit"))
    assert (views.masks, fit.iterations, config.run.seed) == (tmp_path / "12", 50, 3)


def test_presets_that_never_end_are_refused(tmp_path: Path) -> None:
    for number in range(300):
        (tmp_path / f"{number}.yaml").write_text(f"extends: {number + 1}.yaml\n")
    said = refused(lambda: load_config(tmp_path / "0.yaml"))
    assert "More than 20 presets extend each other" in said
    (tmp_path / "a.yaml").write_text("extends: [1, 2]\n")
    assert "There is no preset '[1, 2]'" in refused(lambda: load_config(tmp_path / "a.yaml"))
    (tmp_path / "a.yaml").write_text("extends: ~nosuchuser/b.yaml\n")
    assert "~nosuchuser" in refused(lambda: load_config(tmp_path / "a.yaml"))


PATHS = ["~nosuchuser/x", "a" * 300, "b/" * 3000, "nul\0byte", f"{__file__}/below"]


@pytest.mark.parametrize("path", PATHS)
def test_paths_that_no_file_system_has_are_refused(path: str, tmp_path: Path) -> None:
    settings = (
        "views.masks", "init.cameras", "init.pointmap.files", "init.pointmap.checkpoint",
        "init.pointmap.package_folder", "init.dental.labels", "swap.cameras", "splats.file",
        "evaluate.ground_truth", "evaluate.mesh", "evaluate.masks", "evaluate.lpips_weights",
    )  # fmt: skip
    for setting in settings:
        said = refused(lambda setting=setting: load_config(None, {setting: path}))  # type: ignore[misc]
        assert said.startswith(f"{setting}="), said
    calls: list[Callable[[], object]] = [
        lambda: load_config(path),
        lambda: load_config(f"{path}.yaml"),
        lambda: load_suite(path),
        lambda: load_suite(f"{path}.yaml"),
        lambda: model_files(Path(path), "init.cameras"),
        lambda: corrections_file(path, {}, "init.dental.labels"),
    ]
    for call in calls:
        assert len(refused(call)) > 30
    if "\0" in path or "~" in path:
        assert "--colmap" in refused(lambda: model_folders(Path(path)))


def test_the_command_line_says_so_in_one_paragraph(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    preset = tmp_path / "mine.yaml"
    preset.write_text(BOMB)
    for arguments, word in (
        (["-c", str(preset)], "more entries"),
        (["-c", "~nosuchuser/x.yaml"], "nosuchuser"),
        (["-c", "c" * 5000], "preset"),
        (["--set", "views.long_side=0x_"], "0x_"),
    ):
        command = ["pipeline", "run", str(SAMPLES), "-w", str(tmp_path / "w"), *arguments]
        monkeypatch.setattr("sys.argv", [*command, "--dry-run"])
        with pytest.raises(SystemExit) as stop:
            cli.main()
        said = capsys.readouterr().err
        assert stop.value.code == 2, (arguments, said)
        assert word in said.replace("\n", " ") and "Traceback" not in said
    assert pipeline.__name__


@pytest.mark.parametrize("more", [(), ("init.length.photo=front.jpg",)])
def test_a_length_that_begins_and_ends_nowhere_is_refused_at_once(more: tuple[str, ...]) -> None:
    with pytest.raises(RequestError, match=r"needs init\.length\.photo, init\.length\.start"):
        load_config(None, ("init.length.mm=8.6", *more))
