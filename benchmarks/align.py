"""Accuracy and time of global alignment on stand-in pointmaps with known cameras.

    python benchmarks/align.py [--views 3 6 12] [--graph complete] [--noise 0.01]
                               [--outliers 0.05] [--bent 0.02]

The frames of data_samples/twelve_frames have exact cameras and depth. Each pair gets both pointmaps
in the frame of its first view, in a random scale, with noise (in all directions, relative to the
distance), holes and outliers of which half look confident. With `--bent` the depth of each map is
also wrong by a smooth factor, as a model's is. Prints, per number of views: the rotation errors in
degrees (after alignment), the camera centres in percent of their extent and the focal length in
percent: at the start (spanning tree), after the optimisation, and after bundle adjustment of
matches (where that changes anything); and the seconds. CPU seconds say what it costs on a machine
that does something else as well.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.pointmaps import PointmapPair
from pipeline.artifacts.views import View
from pipeline.geometry.depths import view_depths
from pipeline.geometry.start import start_from_tree
from stages.align.bundle import BundleOptions, refine_with_matches
from stages.align.fusion import FusionOptions, fuse
from stages.align.optimise import AlignOptions, optimise
from stages.pointmaps.graph import scene_pairs

CUBIC = cv2.INTER_CUBIC
SAMPLES = Path(__file__).resolve().parents[1] / "data_samples" / "twelve_frames"


def read_case(count: int) -> tuple[list[Camera], list[np.ndarray], list[np.ndarray]]:
    """Cameras and depths [H, W] of `count` frames, evenly chosen, and their photographs."""
    about = json.loads((SAMPLES / "transforms.json").read_text())
    width, height = about["depth_w"], about["depth_h"]
    cameras, depths, images = [], [], []
    frames = about["frames"]
    for k in np.linspace(0, len(frames) - 1, count).astype(int):
        frame = frames[k]
        whole = Camera(
            f"{len(cameras):03d}", about["w"], about["h"], about["fl_x"], about["fl_y"],
            about["cx"], about["cy"], np.array(frame["w2c_opencv"]),
        )  # fmt: skip
        cameras.append(whole.resized(width, height))
        depth = cv2.imread(str(SAMPLES / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED)
        depths.append(depth.astype(np.float64) / about["depth_per_mm"])
        image = cv2.imread(str(SAMPLES / frame["file_path"]))[..., ::-1]
        images.append(image.astype(np.float32) / 255)
    return cameras, depths, images


def stand_in_pairs(
    cameras: list[Camera],
    depths: list[np.ndarray],
    graph: list[tuple[int, int]],
    noise: float,
    outliers: float,
    along_rays: bool = False,
    bent: float = 0.0,
    seed: int = 0,
) -> list[PointmapPair]:
    """What a model would say of the pairs."""
    rng = np.random.default_rng(seed)
    pairs = []
    for i, j in graph:
        scale = rng.uniform(0.2, 5)
        maps, trust = [], []
        for v in (i, j):
            shape = depths[v].shape
            size = (cameras[v].width, cameras[v].height)
            factor = 1 + bent * cv2.resize(rng.normal(size=(4, 5)), size, interpolation=CUBIC)
            points = cameras[v].unproject(depths[v] * factor)
            points = points @ cameras[i].rotation.T + cameras[i].translation
            rays = points - (cameras[i].rotation @ cameras[v].centre + cameras[i].translation)
            if along_rays:
                points = points + noise * rng.normal(size=(*shape, 1)) * rays
            else:
                far = np.linalg.norm(rays, axis=-1, keepdims=True)
                points = points + noise * far * rng.normal(size=points.shape)
            wild = rng.random(shape) < outliers
            points[wild] += rng.normal(size=(wild.sum(), 3)) * 0.2 * depths[v].max()
            confidence = rng.uniform(2, 12, shape)
            confidence[wild & (rng.random(shape) < 0.5)] = 1.5
            y, x = rng.integers(0, shape[0] // 2), rng.integers(0, shape[1] // 2)
            confidence[y : y + shape[0] // 8, x : x + shape[1] // 8] = 1
            confidence[depths[v] == 0] = 1
            maps.append((scale * points).astype(np.float32))
            trust.append(confidence.astype(np.float32))
        pairs.append(PointmapPair(cameras[i].name, cameras[j].name, *maps, *trust))
    return pairs


def errors(found: dict[str, Camera], truth: list[Camera]) -> tuple[float, float, float, float]:
    """Median and largest rotation error (degrees), largest centre and focal error (percent)."""
    cameras = [found[camera.name] for camera in truth]
    turn = Rotation.align_vectors(
        np.concatenate([c.rotation for c in truth]), np.concatenate([c.rotation for c in cameras])
    )[0].as_matrix()
    rotation = [
        np.degrees(Rotation.from_matrix(f.rotation @ turn.T @ t.rotation.T).magnitude())
        for f, t in zip(cameras, truth, strict=True)
    ]
    a = np.array([turn @ c.centre for c in cameras])
    b = np.array([c.centre for c in truth])
    a, b = a - a.mean(0), b - b.mean(0)
    scale = (a * b).sum() / (a * a).sum()
    extent = max(np.linalg.norm(b[:, None] - b[None], axis=-1).max(), 1e-12)
    centre = np.linalg.norm(scale * a - b, axis=1).max() / extent
    focal = max(abs(f.fx / t.fx - 1) for f, t in zip(cameras, truth, strict=True))
    return float(np.median(rotation)), max(rotation), 100 * float(centre), 100 * float(focal)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--views", type=int, nargs="+", default=[3, 6, 12])
    parser.add_argument("--graph", default="complete", choices=["complete", "window", "star"])
    parser.add_argument("--noise", type=float, default=0.01)
    parser.add_argument("--outliers", type=float, default=0.05)
    parser.add_argument("--bent", type=float, default=0.0, help="smooth relative depth error")
    parser.add_argument("--size", type=float, default=2, help="maps are so many times 256x192")
    parser.add_argument("--samples", type=int, default=AlignOptions().samples)
    parser.add_argument("--iterations", type=int, default=AlignOptions().iterations)
    parser.add_argument(
        "--along-rays", action="store_true", help="noise of the depth alone, not of all directions"
    )
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    print("views pairs | stage    | rotation med/max, deg | centre % | focal % | CPU s | wall s")
    for count in arguments.views:
        cameras, depths, images = read_case(count)
        height, width = (round(s * arguments.size) for s in depths[0].shape)
        cameras = [c.resized(width, height) for c in cameras]
        depths = [cv2.resize(z, (width, height), interpolation=cv2.INTER_NEAREST) for z in depths]
        images = [cv2.resize(i, (width, height), interpolation=cv2.INTER_AREA) for i in images]
        graph = scene_pairs(arguments.graph, count, 3, None, True)
        pairs = stand_in_pairs(
            cameras,
            depths,
            graph,
            arguments.noise,
            arguments.outliers,
            arguments.along_rays,
            arguments.bent,
            arguments.seed,
        )
        row = f"{count:5d} {len(pairs):5d}"
        options = AlignOptions(iterations=arguments.iterations, samples=arguments.samples)
        seconds = np.zeros(2)
        for stage, found, spent in stages(pairs, images, options):
            figures = ""
            if found is not None:
                median, worst, centre, focal = errors(found, cameras)
                figures = f"{median:9.3f} {worst:8.3f}    | {centre:8.3f} | {focal:7.3f}"
            print(f"{row} | {stage:8s} | {figures:43s} | {spent[0]:5.1f} | {spent[1]:6.1f}")
            seconds += spent
        print(f"{row} | {'all':8s} | {'':43s} | {seconds[0]:5.1f} | {seconds[1]:6.1f}")


def stages(
    pairs: list[PointmapPair], images: list[np.ndarray], options: AlignOptions
) -> Iterator[tuple[str, dict[str, Camera] | None, np.ndarray]]:
    """Name of each step, cameras after it, CPU and wall seconds."""

    def clock() -> np.ndarray:
        return np.array([time.process_time(), time.perf_counter()])

    before = clock()
    start = start_from_tree(pairs)
    yield "start", start.cameras, clock() - before
    before = clock()
    best, _ = optimise(pairs, start, options)
    yield "optimise", best.cameras, clock() - before
    before = clock()
    grays = {f"{k:03d}": View("", image).gray() for k, image in enumerate(images)}
    masks = {name: np.ones(gray.shape, bool) for name, gray in grays.items()}
    bundle = refine_with_matches(
        grays, masks, best.cameras, view_depths(pairs, best), BundleOptions()
    )
    yield "matches", bundle.cameras, clock() - before
    before = clock()
    merged = view_depths(pairs, best)
    names = sorted(merged)
    fuse(
        [merged[n].depth for n in names], [merged[n].confidence for n in names],
        [images[int(n)] for n in names], [best.cameras[n] for n in names], FusionOptions(), 2,
    )  # fmt: skip
    yield "fuse", None, clock() - before


if __name__ == "__main__":
    main()
