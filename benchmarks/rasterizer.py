"""Speed and memory of the rasterizer.

    python benchmarks/rasterizer.py [--gaussians 10000 30000 100000 300000] [--threads 1 2]

Random Gaussians (sigma about 3 px) before a 512x384 camera. Shortest of the repetitions, in ms, of
wall and CPU time: compare figures of one run only, on an otherwise idle machine. Memory is the peak
of a process that renders, differentiates and steps 300,000 Gaussians at 1024x768.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from pipeline.artifacts.cameras import Camera
from stages.splatting.adam import Adam
from stages.splatting.loss import ColourLoss
from stages.splatting.rasterizer import Rendering, Viewpoint, rasterize, use_threads

WIDTH, HEIGHT, FOCAL = 512, 384, 600.0


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
        adam = Adam(packed.shape)
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


def peak_memory() -> float:
    """GiB that this process has held at most (getrusage would count what it was started from)."""
    status = Path("/proc/self/status").read_text()
    return int(re.findall(r"VmHWM:\s+(\d+) kB", status)[0]) / 2**20


def memory(count: int) -> None:
    """Peak memory of this process after an iteration at 1024x768, and before it."""
    before = peak_memory()
    packed = scene(count, sigma_px=1.5)
    rendering: Rendering | None = None
    adam = Adam(packed.shape)
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gaussians", type=int, nargs="+", default=[10000, 30000, 100000, 300000])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repetitions", type=int, default=12)
    parser.add_argument("--memory", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.memory:
        memory(options.memory)
    else:
        table(options.gaussians, options.threads, options.repetitions)
        subprocess.run([sys.executable, __file__, "--memory", "300000"], check=True)


if __name__ == "__main__":
    main()
