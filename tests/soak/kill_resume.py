"""Kill a real run at random moments, each time start it again, and compare every byte at the end.

    python tests/soak/kill_resume.py data_samples/three_photos --kills 30

Not part of the test suite: it takes minutes. Prints the moments and the verdict; exit status 1 if a
byte differs.
"""

from __future__ import annotations

import argparse
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path


def artifact_bytes(workspace: Path) -> dict[str, bytes]:
    """Relative name -> bytes of every artifact file; manifests hold timings and are left out."""
    files = (p for p in sorted(workspace.rglob("*")) if p.is_file() and not p.is_symlink())
    named = {p.relative_to(workspace): p for p in files}
    return {
        str(name): path.read_bytes()
        for name, path in named.items()
        if len(name.parts) > 3 and name.parts[0] != "results"
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("images")
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("options", nargs="*", help="more options for 'pipeline run', after --")
    arguments = parser.parse_args()
    moments = random.Random(arguments.seed)

    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)

        def command(workspace: Path) -> list[str]:
            python = [sys.executable, "-m", "pipeline.cli", "run", arguments.images]
            return [*python, "-w", str(workspace), *arguments.options]

        start = time.monotonic()
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        subprocess.run(command(root / "whole"), check=True, **quiet)
        seconds = time.monotonic() - start
        print(f"uninterrupted: {seconds:.1f} s")
        killed = finished = 0
        while killed < arguments.kills:
            process = subprocess.Popen(command(root / "killed"), **quiet)
            moment = moments.uniform(0.3, seconds)
            try:
                process.wait(timeout=moment)
                finished += 1  # it was done before the moment came: begin anew
                if not same(root):
                    return 1
                subprocess.run(["rm", "-rf", str(root / "killed")], check=True)
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGKILL)
                process.wait()
                killed += 1
                partial = sorted(p.parent.name for p in (root / "killed").glob("*/*.partial"))
                print(f"kill {killed:2d} after {moment:6.2f} s, in the middle of {partial}")
        subprocess.run(command(root / "killed"), check=True, **quiet)
        if not same(root):
            return 1
        print(f"{killed} kills, {finished + 1} finished runs: every artifact has the same bytes")
        return 0


def same(root: Path) -> bool:
    whole, resumed = artifact_bytes(root / "whole"), artifact_bytes(root / "killed")
    differing = [n for n in whole.keys() | resumed.keys() if whole.get(n) != resumed.get(n)]
    for name in sorted(differing):
        print(f"DIFFERS: {name}")
    return not differing


if __name__ == "__main__":
    sys.exit(main())
