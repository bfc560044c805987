"""Time of one training iteration, part by part.

    python benchmarks/rasterizer.py [--gaussians 20000 30000] [--threads 1 2] [--assembly]

Random Gaussians (sigma about 3 px) before a 512x384 camera; median of the repetitions, in ms of
wall time: compare figures of one run only, on an otherwise idle machine. `--assembly` counts the
vector registers in the compositing kernels instead: a loop that LLVM no longer vectorises shows as
a fall in zmm (AVX-512) or ymm (AVX2).
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable

import numpy as np

from pipeline.artifacts.cameras import Camera
from stages.splatting import raster
from stages.splatting.adam import Adam
from stages.splatting.loss import ColourLoss
from stages.splatting.rasterizer import Viewpoint, rasterize, use_threads

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


def measure(work: Callable[[], object], repetitions: int) -> float:
    """Median milliseconds."""
    work()
    times = []
    for _ in range(repetitions):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times))


def time_parts(
    packed: np.ndarray, viewpoint: Viewpoint, loss: ColourLoss, adam: Adam, repetitions: int
) -> list[float]:
    """Milliseconds of forward, backward, loss and Adam."""
    rendering = rasterize(packed, viewpoint, degree=1, near=0.1)
    gradient = loss(rendering.planes, 0.2).gradient
    nothing = np.zeros((HEIGHT, WIDTH), np.float32)
    by_scene = rendering.backward(gradient, nothing).packed
    still = np.zeros(packed.shape[1], np.float32)
    return [
        measure(lambda: rasterize(packed, viewpoint, degree=1, near=0.1), repetitions),
        measure(lambda: rendering.backward(gradient, nothing), repetitions),
        measure(lambda: loss(rendering.planes, 0.2), repetitions),
        measure(lambda: adam.step(packed, by_scene, still), repetitions),
    ]


def table(counts: list[int], threads: list[int], repetitions: int) -> None:
    camera = Camera("000", WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, np.eye(4))
    viewpoint = Viewpoint.of(camera)
    target = np.random.default_rng(1).random((3, HEIGHT, WIDTH)).astype(np.float32)
    loss = ColourLoss(target, np.ones((HEIGHT, WIDTH), np.float32))
    heads = ("gaussians", "threads", "tile pairs", "forward", "backward", "loss", "adam", "all")
    print("".join(f"{head:>12}" for head in heads))
    for count in counts:
        packed = scene(count)
        adam = Adam(packed.shape, 0.9, 0.999, 1e-15)
        for number in threads:
            use_threads(number)
            parts = time_parts(packed, viewpoint, loss, adam, repetitions)
            rendering = rasterize(packed, viewpoint, degree=1, near=0.1)
            cells = [f"{count:>12}{number:>12}{rendering.intersections:>12}"]
            print("".join([*cells, *(f"{part:>12.2f}" for part in (*parts, sum(parts)))]))


def assembly() -> None:
    camera = Camera("000", 64, 48, 60.0, 60.0, 32.0, 24.0, np.eye(4))
    rendering = rasterize(scene(100), Viewpoint.of(camera), degree=1, near=0.1)
    rendering.backward(np.zeros_like(rendering.planes), np.zeros((48, 64), np.float32))
    for kernel in (raster.composite_forward, raster.composite_backward):
        text = "\n".join(kernel.inspect_asm(signature) for signature in kernel.signatures)
        found = {name: len(re.findall(rf"%{name}\d", text)) for name in ("zmm", "ymm", "xmm")}
        print(f"{kernel.py_func.__name__:24}", *(f"{name} {n:6}" for name, n in found.items()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gaussians", type=int, nargs="+", default=[20000, 30000])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repetitions", type=int, default=20)
    parser.add_argument("--assembly", action="store_true")
    options = parser.parse_args()
    if options.assembly:
        if "NUMBA_CACHE_DIR" not in os.environ:
            # there is no assembly to look at in cached code: compile anew, in a process of its own
            with tempfile.TemporaryDirectory() as folder:
                environment = {**os.environ, "NUMBA_CACHE_DIR": folder}
                subprocess.run([sys.executable, *sys.argv], env=environment, check=True)
            return
        assembly()
    else:
        table(options.gaussians, options.threads, options.repetitions)


if __name__ == "__main__":
    main()
