"""Time of a fit of three 512x384 views, and where the CPU time of an iteration goes.

    python benchmarks/fit.py [--presets dentalsplat paper] [--threads 2] [--iterations N]

The photographs of `data_samples/three_photos` with their true cameras, and the points that their
true depth gives: nothing but the fit is timed. Wall time is of an idle machine only; CPU time
stands more. The first fit of a process is short and warms up (kernels that are not cached yet are
compiled). A preset is `configs/NAME.yaml`; one that is not there is left out, with a word. With
`+held` the Gaussians are held to their surface, as they are for three photographs 45° apart (those
here are closer).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.points import Points
from pipeline.artifacts.views import View
from pipeline.config import load_config, presets
from stages.fit import trainer
from stages.fit.config import PARTS as FIT_PARTS
from stages.fit.config import FitConfig, FitSettings, resolve
from stages.fit.fitting import fit
from stages.splatting.adam import Adam
from stages.splatting.loss import ColourLoss
from stages.splatting.rasterizer import Rendering

ROOT = Path(__file__).parents[1]
SAMPLE = ROOT / "data_samples" / "three_photos"
PARTS = ("rasterize", "loss", "optimiser", "density", "other")


class Clock:
    """CPU time by part; what a part calls of another part counts there alone."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(PARTS, 0.0)
        self.running = ["other"]
        self.since = time.process_time()

    def switch(self) -> None:
        now = time.process_time()
        self.seconds[self.running[-1]] += now - self.since
        self.since = now

    def watch(self, owner: Any, name: str, part: str) -> None:
        """Count the time of `owner.name` to a part from now on."""
        work: Callable[..., Any] = getattr(owner, name)

        def watched(*arguments: Any, **options: Any) -> Any:
            self.switch()
            self.running.append(part)
            try:
                return work(*arguments, **options)
            finally:
                self.switch()
                self.running.pop()

        setattr(owner, name, watched)


def watch_the_trainer() -> Clock:
    clock = Clock()
    clock.watch(trainer, "rasterize", "rasterize")
    clock.watch(Rendering, "backward", "rasterize")
    # the losses with what it takes to put them together
    clock.watch(trainer.Trainer, "_compare", "loss")
    clock.watch(ColourLoss, "__call__", "loss")
    clock.watch(Adam, "step", "optimiser")
    hooks = {"guide": "optimiser", "follow": "optimiser", "populate": "density"}
    for kind in FIT_PARTS:
        for hook in hooks.keys() & vars(kind).keys():
            clock.watch(kind, hook, hooks[hook])
    return clock


def sample() -> tuple[list[View], list[Camera], Points]:
    """The photographs, their true cameras, and points from their true depth."""
    facts = json.loads((SAMPLE / "transforms.json").read_text())
    views, cameras, positions, colors, normals = [], [], [], [], []
    for number, frame in enumerate(facts["frames"]):
        image = cv2.imread(str(SAMPLE / frame["file_path"]))[..., ::-1].astype(np.float32) / 255
        # camera to world in OpenGL axes -> world to camera in OpenCV axes
        world_from_cam = np.array(frame["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
        name = f"{number:03d}"
        size = [facts[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")]
        camera = Camera(name, *size, np.linalg.inv(world_from_cam))
        stored = cv2.imread(str(SAMPLE / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED)
        depth = stored / facts["depth_per_mm"]
        height, width = depth.shape
        points = camera.resized(width, height).unproject(depth)
        normal = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
        seen = (depth > 0) & (cv2.erode((depth > 0).astype(np.uint8), np.ones((3, 3))) > 0)
        small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        views.append(View(name, np.ascontiguousarray(image)))
        cameras.append(camera)
        positions.append(points[seen])
        colors.append(small[seen])
        towards = np.sign(((camera.centre - points[seen]) * normal[seen]).sum(1, keepdims=True))
        normals.append(normal[seen] * towards)
    cloud = [np.concatenate(x).astype(np.float32) for x in (positions, colors, normals)]
    ones = np.ones(len(cloud[0]), np.float32)
    return views, cameras, Points(*cloud, 2 * ones, 0 * ones)


def settings_of(preset: str, held: bool, iterations: int | None, views: int) -> FitSettings | None:
    if preset not in presets():
        return None
    overrides = {} if iterations is None else {"fit.iterations": iterations}
    config = load_config(preset, overrides).sections["fit"]
    assert isinstance(config, FitConfig)
    return resolve(config, views, seed=0, held=held)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--presets", nargs="+", default=["dentalsplat", "dentalsplat+held", "paper"]
    )
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--iterations", type=int)
    options = parser.parse_args()
    views, cameras, points = sample()

    def run(settings: FitSettings) -> Any:
        return fit(
            views, cameras, points, None, settings, threads=options.threads, checkpoint=None,
            report=lambda *_: None,
        )  # fmt: skip

    clock = watch_the_trainer()
    for name in options.presets:
        preset, _, held = name.partition("+")
        settings = settings_of(preset, held == "held", options.iterations, len(views))
        if settings is None:
            print(f"{preset}: left out, there is no configs/{preset}.yaml")
            continue
        short = settings_of(preset, held == "held", 8, len(views))
        assert short is not None
        run(short)
        clock.switch()
        clock.seconds = dict.fromkeys(PARTS, 0.0)
        wall, cpu = time.perf_counter(), time.process_time()
        result = run(settings)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        clock.switch()
        print(
            f"{name}: {settings.iterations:,} iterations, {len(result.gaussians):,} Gaussians, "
            f"{wall:.1f} s wall, {cpu:.1f} s CPU ({options.threads} threads), "
            f"training PSNR {result.figures['train_psnr']:.2f} dB"
        )
        # before and after the iterations (trials, preparing, pruning) is in there as well
        split = ", ".join(
            f"{part} {1e3 * clock.seconds[part] / settings.iterations:.1f}" for part in PARTS
        )
        print(f"    CPU ms of the whole fit per iteration: {split}", flush=True)


if __name__ == "__main__":
    main()
