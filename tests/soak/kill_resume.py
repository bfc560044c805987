"""Kill real commands at random moments, fill the disk, start two at once: nothing may be lost.

    python tests/soak/kill_resume.py --seed 0 --count 20

Not part of the test suite: it takes many minutes (`make soak SEED=1 KILLS=50`). `pipeline run`,
`compare` and `benchmark` get SIGKILL, SIGTERM and SIGINT; after each, no process may be left, and
the exit status must be right. In the end the same command must have made the same bytes as one that
nobody disturbed, with no half-written files, no lock held, and nothing that others can read. Prints
what it does; exit status 1 if anything was wrong.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from filelock import FileLock, Timeout

from pipeline.files import content_hash, folder_listing, read_json

ROOT = Path(__file__).resolve().parents[2]
SAMPLES = ROOT / "data_samples" / "three_photos"
SHORT = {
    "fit.iterations": 60, "views.long_side": 256, "export.video_seconds": 1,
    "export.mesh_faces": 2000,
}  # fmt: skip
SETTINGS = [part for name, value in SHORT.items() for part in ("--set", f"{name}={value}")]
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
#: Seconds after which the program follows its rule for signals, on any machine.
STARTED = 1.5
MARK = "DENTALSPLAT_SOAK"
SUITE = """\
title: Soak
data: {data}
scenes:
  - {{name: three_photos, images: three_photos}}
methods:
  - {{name: dentalsplat, title: Ours}}
  - {{name: 3dgs, preset: 3dgs, title: 3DGS}}
tables:
  - {{name: photos, form: photos, title: Photographs, scenes: [three_photos]}}
"""


@dataclass
class Case:
    """A command that is disturbed.

    Attributes:
        arguments: of the program; ``{}`` stands for the folder that it writes into.
        prepare: what has to be in that folder before.
    """

    name: str
    arguments: list[str]
    prepare: Callable[[Path], None] = lambda folder: None
    seconds: float = 0.0
    whole: dict[str, str] = field(default_factory=dict)

    def command(self, folder: Path) -> list[str]:
        told = [part.replace("{}", str(folder)) for part in self.arguments]
        return [sys.executable, "-m", "dentalsplat", *told]


class Soak:
    def __init__(self, root: Path, seed: int) -> None:
        self.root = root
        self.moments = random.Random(seed)
        self.problems: list[str] = []
        self.mark = f"{os.getpid()}"

    def wrong(self, text: str) -> None:
        print(f"  WRONG: {text}", flush=True)
        self.problems.append(text)

    def start(self, command: list[str]) -> subprocess.Popen[str]:
        environment = {**os.environ, MARK: self.mark, "PYTHONPATH": str(ROOT)}
        return subprocess.Popen(
            command, cwd=ROOT, env=environment, text=True, umask=0o022,
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        )  # fmt: skip

    def complete(self, case: Case, folder: Path) -> None:
        """Run to the end, and look at everything."""
        process = self.start(case.command(folder))
        _, told = process.communicate()
        if process.returncode != 0:
            self.wrong(f"{case.name} ended with {process.returncode}: {told.strip()[-500:]}")
            return
        self.check_end(case, folder)

    def check_end(self, case: Case, folder: Path) -> None:
        found = contents(folder)
        if case.whole and found != case.whole:
            differing = {
                name
                for name in found.keys() | case.whole.keys()
                if found.get(name) != case.whole.get(name)
            }
            self.wrong(f"{case.name}: other bytes than undisturbed in {sorted(differing)}")
        for text in left_over(folder):
            self.wrong(f"{case.name}: {text}")
        self.nobody_left(case.name)

    def nobody_left(self, name: str) -> None:
        for _ in range(50):
            left = processes(self.mark)
            if not left:
                return
            time.sleep(0.1)
        self.wrong(f"{name}: processes are left: {left}")
        for number in left:
            os.kill(number, signal.SIGKILL)

    def undisturbed(self, case: Case) -> None:
        folder = self.root / f"{case.name}_whole"
        case.prepare(folder)
        begin = time.monotonic()
        self.complete(case, folder)
        case.seconds = time.monotonic() - begin
        case.whole = contents(folder)
        told = f"{case.seconds:.1f} s undisturbed, {len(case.whole)} artifacts"
        print(f"{case.name}: {told}", flush=True)

    def kills(self, case: Case, count: int) -> None:
        """So many kills; whenever the command comes to its end, it begins anew."""
        folder = self.root / f"{case.name}_killed"
        case.prepare(folder)
        killed = 0
        while killed < count:
            number = SIGNALS[killed % len(SIGNALS)]
            moment = self.moments.uniform(0.1, max(case.seconds, 2.0))
            process = self.start(case.command(folder))
            try:
                _, told = process.communicate(timeout=moment)
                print(f"  {case.name}: done before {moment:.1f} s", flush=True)
                if process.returncode != 0:
                    self.wrong(f"{case.name} ended with {process.returncode}: {told[-500:]}")
                    return
                self.check_end(case, folder)
                shutil.rmtree(folder)
                case.prepare(folder)
            except subprocess.TimeoutExpired:
                process.send_signal(number)
                begin = time.monotonic()
                _, told = process.communicate()
                killed += 1
                where = sorted(str(p.parent.relative_to(folder)) for p in folder.rglob("*.partial"))
                print(
                    f"  {case.name}: {number.name} after {moment:.1f} s, in {where}: status "
                    f"{process.returncode} {time.monotonic() - begin:.1f} s later", flush=True,
                )  # fmt: skip
                self.check_kill(case, number, moment, process.returncode, told)
        self.complete(case, folder)
        shutil.rmtree(folder, ignore_errors=True)

    def check_kill(
        self, case: Case, number: signal.Signals, moment: float, status: int, told: str
    ) -> None:
        expected = {-number} if number == signal.SIGKILL else {130, 0}
        if moment < STARTED:
            expected.add(-number)
        elif "Traceback" in told or "Exception ignored" in told:
            self.wrong(f"{case.name}, {number.name} after {moment:.2f} s: {told[-800:]}")
        if status not in expected:
            self.wrong(f"{case.name}: {number.name} gave {status}: {told[-500:]}")
        self.nobody_left(case.name)

    def full_disk(self, case: Case, times: int) -> None:
        """Disks too small by any amount; then there is room."""
        disk = self.root / "disk"
        disk.mkdir(exist_ok=True)
        used = size_of(self.root / f"{case.name}_whole")
        for _ in range(times):
            size = int(self.moments.uniform(0.01, 1.0) * used)
            mount = ["mount", "-t", "tmpfs", "-o", f"size={size},mode=700", "tmpfs", str(disk)]
            if subprocess.run(mount, capture_output=True).returncode != 0:
                print("  no full disk: mounting one needs root")
                return
            try:
                folder = disk / "w"
                process = self.start(case.command(folder))
                _, told = process.communicate()
                print(
                    f"  {case.name}: {size / 1e6:.2f} MB: status {process.returncode}", flush=True
                )
                if process.returncode not in (0, 2) or "Traceback" in told:
                    self.wrong(f"full disk gave {process.returncode}: {told[-500:]}")
                elif process.returncode == 2 and "full" not in told:
                    self.wrong(f"full disk was called: {told[-500:]}")
                larger = ["mount", "-o", f"remount,size={4 * used + 2**26}", str(disk)]
                subprocess.run(larger, check=True)
                self.complete(case, folder)
            finally:
                subprocess.run(["umount", str(disk)], check=True)

    def two_at_once(self, case: Case) -> None:
        folder = self.root / f"{case.name}_two"
        case.prepare(folder)
        first = self.start(case.command(folder))
        time.sleep(self.moments.uniform(0.0, 2.0))
        second = self.start(case.command(folder))
        for process in (first, second):
            _, told = process.communicate()
            if process.returncode != 0:
                self.wrong(f"two {case.name} at once: {process.returncode}: {told[-500:]}")
        self.check_end(case, folder)
        print(f"  two {case.name} at once: done", flush=True)
        shutil.rmtree(folder, ignore_errors=True)


def contents(folder: Path) -> dict[str, str]:
    """(where, kind) -> hash of the names and bytes of every artifact below a folder."""
    found = {}
    for manifest in folder.rglob("manifest.json"):
        if "." in manifest.parent.name:
            continue
        for kind, output in (read_json(manifest) or {"outputs": {}})["outputs"].items():
            name = f"{manifest.parent.relative_to(folder)}/{kind}"
            bytes_hash = content_hash(folder_listing(manifest.parent / kind))
            found[name] = bytes_hash if bytes_hash == output["content"] else "damaged"
    for model in folder.rglob("compare/colmap_*/sparse"):
        found[str(model.relative_to(folder))] = content_hash(folder_listing(model))
    return found


def left_over(folder: Path) -> list[str]:
    """What should not be there when a command has ended well."""
    found = []
    for path in folder.rglob("*"):
        name = str(path.relative_to(folder))
        if path.name.endswith((".tmp", ".partial", ".replaced", ".new", ".owner.json")):
            found.append(f"{name} is left over")
        if ".quarantined" in path.name:
            found.append(f"{name} was found damaged")
        mode = path.lstat().st_mode
        if not stat.S_ISLNK(mode) and mode & 0o077:
            found.append(f"{name} can be read by others ({stat.S_IMODE(mode):o})")
        if path.name == ".lock":
            try:
                FileLock(path, mode=0o600).acquire(timeout=0).lock.release()
            except Timeout:
                found.append(f"{name} is still held")
    return found


def processes(mark: str) -> list[int]:
    """Those of ours that still run, whoever started them."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        try:
            environment = (place / "environ").read_bytes()
            state = (place / "stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            continue
        if f"{MARK}={mark}\0".encode() in environment and state != "Z":
            found.append(int(place.name))
    return found


def size_of(folder: Path) -> int:
    return sum(path.lstat().st_size for path in folder.rglob("*") if path.is_file())


def cases(root: Path) -> list[Case]:
    run = Case("run", ["run", str(SAMPLES), "-w", "{}", *SETTINGS])
    suite = root / "soak.yaml"
    suite.write_text(SUITE.format(data=SAMPLES.parent))

    def finished(folder: Path) -> None:
        shutil.copytree(root / "run_whole", folder, symlinks=True)

    return [
        run,
        Case("compare", ["compare", "-w", "{}", "--run-colmap"], finished),
        Case("benchmark", ["benchmark", str(suite), "-o", "{}", *SETTINGS]),
    ]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=20, help="kills, of all commands together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", help="one of run, compare, benchmark")
    arguments = parser.parse_args()
    for number in (signal.SIGINT, signal.SIGTERM):  # what is ignored here, children would ignore
        signal.signal(number, signal.default_int_handler)
    with tempfile.TemporaryDirectory() as folder:
        soak = Soak(Path(folder), arguments.seed)
        every = cases(Path(folder))
        for index, case in enumerate(every):
            if index and arguments.only not in (None, case.name):
                continue
            soak.undisturbed(case)
            if arguments.only in (None, case.name):
                soak.kills(case, -(-arguments.count // (1 if arguments.only else len(every))))
                if case.name == "run":
                    soak.two_at_once(case)
                    soak.full_disk(case, max(1, arguments.count // 10))
    print(f"{len(soak.problems)} problems")
    return 1 if soak.problems else 0


if __name__ == "__main__":
    sys.exit(main())
