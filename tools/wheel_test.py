"""Build the wheel, install it elsewhere, and make a scene with it from a folder full of traps.

    python tools/wheel_test.py [FOLDER]        default: a temporary folder, deleted afterwards

The new environment borrows this one's libraries, so that nothing is downloaded.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import venv
import zipfile
from pathlib import Path

from pipeline.kernels.folder import SUFFIX

ROOT = Path(__file__).resolve().parents[1]
#: All that a wheel is made of. Whatever else it needed would be missing here.
SOURCES = (
    "LICENSE", "README.md", "configs", "dentalsplat", "pipeline", "pyproject.toml", "setup.cfg",
    "stages",
)  # fmt: skip
#: What a wheel must hold beside its modules.
DATA = (
    "dentalsplat/py.typed", "pipeline/py.typed", "stages/py.typed", "stages/teeth/reader.onnx",
    "stages/export/viewer/viewer.html", "stages/export/viewer/splat.vert.glsl",
    "stages/export/viewer/viewer.css", "stages/export/viewer/renderer.js",
    "pipeline/presets/dentalsplat.yaml", "pipeline/presets/suites/smoke.yaml",
)  # fmt: skip
SHORT = ("fit.iterations=60", "export.video_seconds=1", "export.mesh_faces=5000")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", help="a new one, which stays")
    folder = parser.parse_args().folder
    if folder is not None:
        folder.mkdir(parents=True)
        check(folder.resolve())
    else:
        with tempfile.TemporaryDirectory(prefix="dentalsplat_wheel_") as made:
            check(Path(made))


def check(folder: Path) -> None:
    wheel = build(folder)
    check_contents(wheel)
    bin_folder = install(wheel, folder / "env")
    place = traps(folder / "user")
    check_run(bin_folder, place)
    check_names_taken(bin_folder, place)
    print("The wheel works.")


def build(folder: Path) -> Path:
    """The wheel of a copy of the tree, so that nothing old in build/ gets into it."""
    source = folder / "source"
    source.mkdir()
    ignore = shutil.ignore_patterns("__pycache__", "*.egg-info")
    for name in SOURCES:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, source / name, ignore=ignore)
        else:
            shutil.copy(ROOT / name, source / name)
    call([sys.executable, "-m", "pip", "wheel", str(source), "--no-deps", "--no-build-isolation",
          "--quiet", "-w", str(folder)])  # fmt: skip
    (wheel,) = folder.glob("*.whl")
    return wheel


def check_contents(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    missing = [name for name in DATA if name not in names]
    modules = {
        path.relative_to(ROOT).as_posix()
        for package in ("dentalsplat", "pipeline", "stages")
        for path in (ROOT / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    missing += sorted(modules - names)
    assert not missing, f"the wheel lacks {', '.join(missing)}: see packages and package_data"
    tops = {name.split("/")[0] for name in names if ".dist-info/" not in name}
    assert tops == {"dentalsplat", "pipeline", "stages"}, f"the wheel holds {tops}"


def install(wheel: Path, env: Path) -> Path:
    """A new environment with the wheel and this one's libraries; returns its folder of commands."""
    venv.create(env, with_pip=False, symlinks=os.name != "nt")
    bin_folder = env / ("Scripts" if os.name == "nt" else "bin")
    python = bin_folder / "python"
    call([sys.executable, "-m", "pip", "--python", str(python), "install", "--no-deps", "--quiet",
          "--no-index", str(wheel)])  # fmt: skip
    own = subprocess.run(
        [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"],
        capture_output=True, text=True, check=True,
    ).stdout.strip()  # fmt: skip
    # A line of a .pth file comes last on the path, and the .pth files in it are not read: what is
    # installed as editable there is not seen from here.
    (Path(own) / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    borrow_kernels(Path(own))
    return bin_folder


def borrow_kernels(installed: Path) -> None:
    """Take along the kernels compiled of the same sources: that saves a minute or two.

    Their names say of which sources (`pipeline.kernels`): others are not asked for.
    """
    kernels = ROOT / "pipeline" / "kernels" / "__pycache__"
    borrowed = installed / "pipeline" / "kernels" / "__pycache__"
    borrowed.mkdir(exist_ok=True)
    for kernel in kernels.glob(f"*{SUFFIX}"):
        shutil.copy(kernel, borrowed)


def traps(place: Path) -> Path:
    """A folder of the user's with the photographs and things of the names of ours."""
    shutil.copytree(ROOT / "data_samples" / "three_photos", place / "three_photos")
    (place / "configs").mkdir()
    (place / "configs" / "dentalsplat.yaml").write_text("this is: [somebody else's\n")
    (place / "pipeline.py").write_text("raise SystemExit('the wrong pipeline')\n")
    (place / "stages").mkdir()
    (place / "stages" / "__init__.py").write_text("raise SystemExit('the wrong stages')\n")
    return place


def check_run(bin_folder: Path, place: Path) -> None:
    """The command does the whole job there; both names of it are the same."""
    settings = [part for setting in SHORT for part in ("--set", setting)]
    run = [bin_folder / "pipeline", "run", "three_photos", "-w", "case", *settings, "--json"]
    done = call(run, cwd=place)
    results = place / json.loads(done.stdout)["results"]
    for name in ("viewer.html", "splats.ply", "mesh.ply", "teeth.json", "orbit.mp4"):
        assert (results / name).stat().st_size > 0, name
    assert (place / "case" / "report.html").is_file()
    done = call([bin_folder / "dentalsplat", "status", "-w", "case", "--json"], cwd=place)
    states = {stage["name"]: stage["state"] for stage in json.loads(done.stdout)}
    assert set(states.values()) == {"cached"}, states


def check_names_taken(bin_folder: Path, place: Path) -> None:
    """Where the user's files come first, the message names the one in the way."""
    told = call(
        [bin_folder / "pipeline", "stages"], cwd=place, status=2,
        env={**os.environ, "PYTHONPATH": str(place)},
    )  # fmt: skip
    paragraph = told.stderr.strip()
    assert f"{place / 'pipeline.py'} is in the way" in paragraph, paragraph
    assert "\n" not in paragraph and "Traceback" not in paragraph, paragraph
    told = call([bin_folder / "python", "-m", "dentalsplat", "stages"], cwd=place, status=2)
    assert f"{place / 'pipeline.py'} is in the way" in told.stderr, told.stderr
    script = "import dentalsplat; print(dentalsplat.__version__); dentalsplat.stages()"
    told = call([bin_folder / "python", "-c", script], cwd=place, status=1)
    assert "pipeline.py is in the way" in told.stderr.strip().splitlines()[-1], told.stderr


def call(
    command: list, *, cwd: Path | None = None, status: int = 0, env: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run a command that has to end with a status."""
    done = subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True)
    if done.returncode != status:
        sys.exit(
            f"{' '.join(map(str, command))}\nended with status {done.returncode} instead of "
            f"{status}:\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
        )
    return done


if __name__ == "__main__":
    main()
