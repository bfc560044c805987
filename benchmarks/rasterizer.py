"""Speed and memory of the rasterizer, and how far it is from C++ written by hand.

    python benchmarks/rasterizer.py [--gaussians 10000 30000 100000 300000] [--threads 1 2]
                                    [--assembly]

Random Gaussians (sigma about 3 px) before a 512x384 camera. Shortest of the repetitions, in ms, of
wall and CPU time: compare figures of one run only, on an otherwise idle machine.
The same tiles are composited by `rasterizer.cpp` (AVX-512 intrinsics, OpenMP), compiled on the spot
with g++; left out where there is none or the processor lacks AVX-512. Memory is the peak of a
process that renders, differentiates and steps 300,000 Gaussians at 1024x768.
`--assembly` prints how many instructions the rows of the kernels take, by kind of register,
instead: a loop that is not vectorised shows as a lack of zmm (AVX-512) or ymm (AVX2).
"""

from __future__ import annotations

import argparse
import ctypes
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.artifacts.cameras import Camera
from stages.splatting.adam import Adam
from stages.splatting.kernels import compositing as raster
from stages.splatting.loss import ColourLoss
from stages.splatting.rasterizer import ALPHA_CUT, Rendering, Viewpoint, rasterize, use_threads
from stages.splatting.threads import workers

WIDTH, HEIGHT, FOCAL = 512, 384, 600.0
SOURCE = Path(__file__).with_suffix(".cpp")
SLOT_COLUMNS = 16


def scene(count: int, sigma_px: float = 3.0) -> np.ndarray:
    """[N, 23] random Gaussians of degree 1 that fill the view."""
    random = np.random.default_rng(0)
    depth = random.uniform(2, 4, count)
    packed = np.zeros((count, 23), np.float32)
    packed[:, 0] = random.uniform(-0.5, 0.5, count) * WIDTH / FOCAL * depth
    packed[:, 1] = random.uniform(-0.5, 0.5, count) * HEIGHT / FOCAL * depth
    packed[:, 2] = depth
    packed[:, 3:7] = random.normal(size=(count, 4))
    spread = random.uniform(0.5, 1.5, (count, 3)) * sigma_px / FOCAL
    packed[:, 7:10] = np.log(spread * depth[:, None])
    packed[:, 10] = random.normal(size=count)
    packed[:, 11:] = 0.3 * random.normal(size=(count, 12))
    return packed


def view(scale: int = 1) -> Viewpoint:
    """The camera of `scene`, for an image `scale` times as large."""
    w, h, f = scale * WIDTH, scale * HEIGHT, scale * FOCAL
    return Viewpoint.of(Camera("000", w, h, f, f, w / 2, h / 2, np.eye(4)))


def measure(works: Sequence[Callable[[], object]], repetitions: int) -> list[tuple[float, float]]:
    """Shortest wall and CPU milliseconds of each; they take turns, to share what disturbs them."""
    times = np.full((len(works), 2), np.inf)
    for work in works:
        work()
    for _ in range(repetitions):
        for k, work in enumerate(works):
            wall, cpu = time.perf_counter(), time.process_time()
            work()
            now = time.perf_counter() - wall, time.process_time() - cpu
            times[k] = np.minimum(times[k], now)
    return [(1e3 * float(wall), 1e3 * float(cpu)) for wall, cpu in times]


def table(counts: list[int], threads: list[int], repetitions: int) -> None:
    viewpoint = view()
    target = np.random.default_rng(1).random((3, HEIGHT, WIDTH)).astype(np.float32)
    loss = ColourLoss(target, np.ones((HEIGHT, WIDTH), np.float32))
    nothing = np.zeros((HEIGHT, WIDTH), np.float32)
    print("Whole passes at 512x384; ms wall (ms CPU)")
    heads = ("gaussians", "threads", "tile pairs", "forward", "backward", "loss", "adam")
    print("".join(f"{head:>16}" for head in heads))
    for count in counts:
        packed = scene(count)
        adam = Adam(packed.shape, 0.9, 0.999, 1e-15)
        still = np.zeros(packed.shape[1], np.float32)
        for number in threads:
            use_threads(number)
            rendering = rasterize(packed, viewpoint, degree=1, near=0.1)
            gradient = loss(rendering.planes, 0.2).gradient
            by_scene = rendering.backward(gradient, nothing).packed
            works: list[Callable[[], object]] = [
                lambda packed=packed: rasterize(packed, viewpoint, degree=1, near=0.1),
                lambda r=rendering, g=gradient: r.backward(g, nothing),
                lambda r=rendering: loss(r.planes, 0.2),
                lambda p=packed, g=by_scene, a=adam, s=still: a.step(p, g, s),
            ]
            parts = measure(works, repetitions)
            cells = [f"{count:>16,}{number:>16}{rendering.intersections:>16,}"]
            print("".join([*cells, *(f"{f'{w:.1f} ({c:.1f})':>16}" for w, c in parts)]), flush=True)


def address(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def compile_peer(folder: Path) -> ctypes.CDLL | str:
    """The C++ kernels, or why there are none."""
    compiler = shutil.which("g++")
    if compiler is None:
        return "there is no g++"
    if "avx512f" not in Path("/proc/cpuinfo").read_text():
        return "the processor has no AVX-512"
    library = folder / "peer.so"
    flags = ["-O3", "-march=native", "-fopenmp", "-shared", "-fPIC"]
    done = subprocess.run([compiler, *flags, "-o", library, SOURCE], capture_output=True, text=True)
    if done.returncode:
        return f"g++ failed: {done.stderr.strip()[:300]}"
    return ctypes.CDLL(str(library))


def compare(counts: list[int], threads: list[int], repetitions: int) -> None:
    """The compositing kernels alone, against C++ on the same tiles."""
    print("\nCompositing kernels alone against C++ by hand, same tiles; ms wall")
    with tempfile.TemporaryDirectory() as folder:
        peer = compile_peer(Path(folder))
        if isinstance(peer, str):
            print(f"left out: {peer}")
            return
        heads = ("gaussians", "threads", "forward", "C++", "ratio", "backward", "C++", "ratio")
        print("".join(f"{head:>12}" for head in heads))
        for count in counts:
            for number in threads:
                use_threads(number)
                peer.set_threads(number)
                cells = compare_one(peer, scene(count), repetitions)
                print("".join(f"{cell:>12}" for cell in (f"{count:,}", number, *cells)), flush=True)


def compare_one(peer: ctypes.CDLL, packed: np.ndarray, repetitions: int) -> list[str]:
    viewpoint = view()
    rendering = rasterize(packed, viewpoint, degree=1, near=0.1)
    f, screen = rendering._forward, rendering.screen
    threads, cut = workers(), np.float32(ALPHA_CUT)
    random = np.random.default_rng(2)
    d_image = random.normal(size=rendering.planes.shape).astype(np.float32)
    d_left = random.normal(size=(1, HEIGHT, WIDTH)).astype(np.float32)
    state = ("image", "transmittance", "stop", "blocks")
    everything = np.empty((0, 0), np.bool_)

    def outputs() -> dict[str, Any]:
        arrays = (rendering.planes, rendering.transmittance[None], f.stop, f.blocks)
        made = {name: np.zeros_like(array) for name, array in zip(state, arrays, strict=True)}
        return made | {"slots": raster.aligned_empty(len(f.members), SLOT_COLUMNS)}

    ours, theirs = outputs(), outputs()
    lists = (f.tiles_x, f.tiles_y, WIDTH, HEIGHT, *map(address, (f.offsets, f.members)))
    given = (*lists, address(screen), address(f.features), ctypes.c_float(cut))

    def forward() -> None:
        raster.composite_forward(
            threads, f.tiles_x, f.offsets, f.members, screen, f.features, cut, everything,
            *(ours[name] for name in state),
        )  # fmt: skip

    def backward() -> None:
        raster.composite_backward(
            threads, f.tiles_x, f.offsets, f.members, f.slots, screen, f.features, cut,
            *(ours[name] for name in state[1:]), d_image, d_left, ours["slots"],
        )  # fmt: skip

    def peer_forward() -> None:
        peer.composite_forward(*given, *(address(theirs[name]) for name in state))

    def peer_backward() -> None:
        peer.composite_backward(
            *given, address(f.slots), *(address(theirs[name]) for name in state[1:]),
            address(d_image), address(d_left), address(theirs["slots"]),
        )  # fmt: skip

    times = measure([forward, peer_forward, backward, peer_backward], repetitions)
    error = np.abs(ours["image"] - theirs["image"]).max()
    slot_error = np.abs(ours["slots"] - theirs["slots"]).max() / np.abs(ours["slots"]).max()
    if not (error < 1e-4 and slot_error < 1e-4):
        raise SystemExit(f"C++ and numba disagree: image by {error}, gradients by {slot_error}")
    # another core's CPU time is booked late: over a few ms only wall time is right
    a, b, c, d = (wall for wall, _ in times)
    return [f"{a:.1f}", f"{b:.1f}", f"{a / b:.2f}", f"{c:.1f}", f"{d:.1f}", f"{c / d:.2f}"]


def peak_memory() -> float:
    """GiB that this process has held at most (getrusage would count what it was started from)."""
    status = Path("/proc/self/status").read_text()
    return int(re.findall(r"VmHWM:\s+(\d+) kB", status)[0]) / 2**20


def memory(count: int) -> None:
    """Peak memory of this process after an iteration at 1024x768, and before it."""
    before = peak_memory()
    packed = scene(count, sigma_px=1.5)
    rendering: Rendering | None = None
    adam = Adam(packed.shape, 0.9, 0.999, 1e-15)
    target = np.zeros((3, 2 * HEIGHT, 2 * WIDTH), np.float32)
    loss = ColourLoss(target, np.ones((2 * HEIGHT, 2 * WIDTH), np.float32))
    for _ in range(2):
        rendering = rasterize(packed, view(2), degree=1, near=0.1)
        gradient = loss(rendering.planes, 0.2).gradient
        gradients = rendering.backward(gradient, np.zeros_like(rendering.transmittance))
        adam.step(packed, gradients.packed, np.zeros(packed.shape[1], np.float32))
    assert rendering is not None
    print(
        f"\n{count:,} Gaussians at 1024x768, {rendering.intersections:,} tile pairs: peak "
        f"{peak_memory():.2f} GiB, of which {before:.2f} GiB are Python and its libraries"
    )


def assembly() -> None:
    rendering = rasterize(scene(1000), view(), degree=1, near=0.1)
    rendering.backward(np.zeros_like(rendering.planes), np.zeros((HEIGHT, WIDTH), np.float32))
    for kernel in (raster.composite_forward, raster.composite_backward):
        text = "\n".join(kernel.inspect_asm(signature) for signature in kernel.signatures)
        # a row is what comes around its one conversion to integers (exp2)
        lines = [line.strip() for line in text.splitlines()]
        middle = next(k for k, line in enumerate(lines) if line.startswith("vcvttps2dq"))
        rows = lines[middle - 40 : middle + 60]
        found = {n: sum(bool(re.search(rf"%{n}\d", x)) for x in rows) for n in ("zmm", "ymm")}
        print(f"{kernel.py_func.__name__:20} in the 100 lines around exp2:", found)


def anew(*arguments: str, **environment: str) -> None:
    """This script in a process of its own."""
    command = [sys.executable, str(Path(__file__)), *arguments]
    subprocess.run(command, env={**os.environ, **environment}, check=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gaussians", type=int, nargs="+", default=[10000, 30000, 100000, 300000])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repetitions", type=int, default=12)
    parser.add_argument("--assembly", action="store_true")
    parser.add_argument("--memory", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.memory:
        memory(options.memory)
    elif options.assembly and "NUMBA_CACHE_DIR" not in os.environ:
        # there is no assembly to look at in cached code: compile anew
        with tempfile.TemporaryDirectory() as folder:
            anew("--assembly", NUMBA_CACHE_DIR=folder)
    elif options.assembly:
        assembly()
    else:
        table(options.gaussians, options.threads, options.repetitions)
        # short, and disturbed by whatever else runs: the shortest of many
        compare(options.gaussians[:2], options.threads, 8 * options.repetitions)
        sys.stdout.flush()
        anew("--memory", "300000")


if __name__ == "__main__":
    main()
