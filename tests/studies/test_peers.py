"""`benchmarks/peers.py`: another program's cost, and its scene beside ours in one table."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.peers import scored
from pipeline.running.outcomes import RunSummary
from pipeline.workspace import read_request

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "peers.py"
#: "Trains" for a tenth of a second or more with 64 MB, and gives our own scene for its own.
FAKE = """
import shutil, sys, time
held = b"x" * (64 << 20)
while time.process_time() < 0.3:
    pass
shutil.copy(sys.argv[1], sys.argv[2])
"""


def peers(folder: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, SCRIPT, *arguments]
    return subprocess.run(
        [str(word) for word in command], capture_output=True, text=True, cwd=folder, timeout=240
    )


@pytest.fixture
def workspace(sample_run: RunSummary, tmp_path: Path) -> Path:
    """A copy of the finished run."""
    return shutil.copytree(sample_run.workspace, tmp_path / "w", symlinks=True)


@pytest.mark.slow
def test_a_peer_that_gives_our_scene_has_our_figures(workspace: Path, tmp_path: Path) -> None:
    (tmp_path / "fake.py").write_text(FAKE)
    before = read_request(workspace)
    done = peers(
        tmp_path, "-w", workspace, "--name", "fake", "--iterations", 10, "--threads", 1,
        "--ply", "*.ply", "--", sys.executable, "fake.py", "{results}/splats.ply",
        "{folder}/{iterations}.ply",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    table = (tmp_path / "runs" / "peers" / "fake" / "table.md").read_text()
    assert table in done.stdout
    heads, _, ours, fake = ([c.strip() for c in r.split("|")[1:-1]] for r in table.splitlines())
    assert ours[:2] == ["ours (fit)", fake[1]]
    figures = dict(zip(heads, fake, strict=True))
    assert 0.3 <= float(figures["CPU s"]) < 10
    assert float(figures["CPU s an iteration"]) == pytest.approx(float(fake[2]) / 10, abs=0.01)
    assert 64 < float(figures["peak MB"]) < 120
    assert float(figures["PSNR / SSIM, input views"].split(" / ")[0]) > 15
    assert (tmp_path / "runs" / "peers" / "fake" / "output" / "10.ply").is_file()
    assert read_request(workspace) == before, "the workspace is left as it was"
    evaluated = json.loads((workspace / "evaluate" / "current.json").read_text())
    scored = workspace / "evaluate" / evaluated["key"][:12] / "metrics" / "metrics.json"
    figure = json.loads(scored.read_text())["mean"]["psnr"]
    assert ours[6].startswith(f"{figure:.2f} / ")


def test_a_colour_behind_the_scene_is_the_files_own_unless_one_is_given(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[list[str]] = []
    monkeypatch.setattr("dentalsplat.run", lambda **given: asked.append(given["overrides"]))
    request = {"preset": None, "overrides": ["fit.light=none"]}
    scored(Path("w"), request, Path("peer.ply"))
    scored(Path("w"), request, Path("peer.ply"), [0.0, 0.5, 1.0])
    assert asked[0] == ["fit.light=none", 'splats.file="peer.ply"']
    assert asked[1] == [*asked[0], "splats.background=[0.0, 0.5, 1.0]"]


def test_what_can_not_be_measured_is_said(tmp_path: Path) -> None:
    (tmp_path / "w" / "results" / "colmap" / "sparse" / "0").mkdir(parents=True)
    assert "nothing to do without" in peers(tmp_path).stdout
    for name, command, told in (
        ("a", ["no-such-program"], r"no-such-program can't be run: No such file"),
        (
            "b",
            [sys.executable, "-c", "raise SystemExit(3)"],
            r"ended with status 3; see .*log\.txt",
        ),
        ("c", [sys.executable, "-c", "print('{ply}')"], r"has written no splats\.ply"),
        ("c", [sys.executable, "-c", ""], r"is there already"),
        ("d", [sys.executable, "-c", "open('{ply}', 'w')"], r"w is not a workspace"),
    ):
        done = peers(tmp_path, "-w", "w", "--name", name, "--", *command)
        assert done.returncode == 1
        assert re.search(told, done.stderr), done.stderr
        assert "Traceback" not in done.stderr
    said = (tmp_path / "runs" / "peers" / "c" / "log.txt").read_text().strip()
    assert said.endswith("runs/peers/c/output/splats.ply")
    assert "no COLMAP model" in peers(tmp_path, "-w", "x", "--", "y").stderr
