"""A small workspace written by hand: every kind of result that a report shows, in no time."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.artifacts import Artifact
from pipeline.artifacts.cameras import Camera, Cameras
from pipeline.artifacts.flow import Flow, FlowPair
from pipeline.artifacts.metrics import Metrics
from pipeline.artifacts.pictures import Pictures
from pipeline.artifacts.points import Points
from pipeline.artifacts.space.scale import NO_SCALE, Scale
from pipeline.artifacts.views import HeldOut, View, Views, write_png
from pipeline.store import Store
from stages.evaluate.images.pictures import comparison

WIDTH, HEIGHT = 64, 48
HOSTILE = "<b>x&.jpg"
NAMES = (HOSTILE, "left.jpg", "right.jpg")
CHAIN = ("views", "init", "align", "sap", "flow", "fit", "evaluate")


def camera(name: str, degrees: float, focal: float = 60.0) -> Camera:
    """Looks at the origin from 4 away."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    pose = np.eye(4)
    pose[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    pose[2, 3] = 4
    return Camera(name, WIDTH, HEIGHT, focal, focal, WIDTH / 2, HEIGHT / 2, pose)


def cameras(turn: float = 0.0, scale: Scale = NO_SCALE) -> Cameras:
    return Cameras(
        tuple(camera(f"{k:03d}", 30.0 * (k - 1) + turn * k) for k in range(3)), scale=scale
    )


def picture(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)


def views(names: Sequence[str] = NAMES) -> Views:
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[:10] = False
    return Views(
        tuple(
            View(f"{k:03d}", picture(k).astype(np.float32) / 255, mask if k == 1 else None,
                 source_name=name, source_size=(WIDTH, HEIGHT))
            for k, name in enumerate(names)
        )
    )  # fmt: skip


def points(count: int) -> Points:
    rng = np.random.default_rng(count)
    positions = rng.normal(0, 0.5, (count, 3)).astype(np.float32)
    ones = np.ones(count, np.float32)
    return Points(positions, rng.random((count, 3)).astype(np.float32), 0 * positions, ones, ones)


def write_result(
    workspace: Path, stage: str, artifacts: Sequence[Artifact],
    extra: dict[str, bytes] | None = None, sources: Sequence[Sequence[str]] = (), **manifest: Any,
) -> None:  # fmt: skip
    """Commit artifacts as a stage's result in use, made from files of these names and hashes."""
    store = Store(workspace)
    key = f"{stage:0<64}"
    folder = store.begin(stage, key)
    for artifact in artifacts:
        (folder / artifact.kind).mkdir()
        artifact.save(folder / artifact.kind)
    for name, content in (extra or {}).items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content)
    kinds = sorted(path.name for path in folder.iterdir() if path.name != "scratch")
    material: dict[str, Any] = {
        "stage": stage, "version": 1, "config": {}, "seed": 0, "inputs": {},
        "sources": [*map(list, sources)], "libraries": {"numpy": "1.2.3"},
    }  # fmt: skip
    entry = {
        "key_material": material, "config": {"setting": 1}, "seed": 0, "inputs": {}, "reasons": [],
        "threads": 1, "summary": {}, "warnings": [], "wall_seconds": 1.5, "cpu_seconds": 2.5,
        "peak_memory_mb": 100.0,
    }  # fmt: skip
    store.use(store.commit(stage, key, entry | manifest, kinds))


def scored(names: Sequence[str], psnr: float) -> dict[str, Any]:
    figures = {"psnr": psnr, "ssim": 0.8, "lpips": None, "coverage": 0.97, "pixels": 1.0}
    return {
        "protocol": "as tested",
        "views": {name: {**figures, "psnr": psnr + k} for k, name in enumerate(names)},
        "mean": {**figures, "psnr": psnr + (len(names) - 1) / 2},
        "worst": {"psnr": {"view": names[0], "value": psnr}},
    }


def write_case(workspace: Path, chain: Sequence[str] = CHAIN, unplaced: bool = False) -> Path:
    """Write a workspace with results of these stages.

    Args:
        unplaced: leave the last view without a camera.
    """
    workspace.mkdir(parents=True)
    request = {
        "images": [f"/photos/{name}" for name in NAMES], "preset": None,
        "overrides": ["fit.iterations=20"], "stages": list(chain), "from": None,
    }  # fmt: skip
    (workspace / "request.json").write_text(json.dumps(request))
    first, second = cameras(), cameras(1.0)
    if unplaced:
        first, second = Cameras(first.cameras[:2]), Cameras(second.cameras[:2])
    held = HeldOut(
        (View("h000", picture(9).astype(np.float32) / 255, source_name="kept_back.jpg"),)
    )
    table = {
        "views": ["000", "001", "002"],
        "pairs": [
            {"views": ["000", "001"], "matches": 50, "verified": 40, "evidence": 40, "used": True},
            {"views": ["001", "002"], "matches": 30, "verified": 3, "evidence": 1, "used": False},
        ],
    }  # fmt: skip
    zero = np.ones((HEIGHT, WIDTH), bool)
    flow = np.full((HEIGHT, WIDTH, 2), 3, np.float32)
    curve = "iteration,loss,psnr,gaussians\n1,0.5,10,100\n10,0.1,20,120\n20,0.02,25,130\n"
    warning = f"1 of 3 photographs could not be placed: {NAMES[2]} <script>alert(1)</script>"
    made: dict[str, Any] = {
        "views": ([views(), held], {}, {"summary": {"views": 3}}),
        "init": (
            [first, points(900),
             Pictures({"matches_000_001": picture(5), "teeth_000": picture(6)})],
            {"pictures/matches.json": json.dumps(table).encode()},
            {"warnings": [warning] if unplaced else [],
             "summary": {"reprojection_error_px": 0.4, "views_registered": 3}},
        ),
        "align": ([second, points(500)], {}, {}),
        "sap": ([points(300)], {}, {"summary": {"points_before": 500}}),
        "flow": ([Flow((FlowPair("000", "001", flow, -flow, zero, zero),))], {}, {}),
        "fit": (
            [second, Pictures({"fit_00020": picture(7)})], {"pictures/curve.csv": curve.encode()},
            {"summary": {"gaussians": 1234}},
        ),
        "evaluate": ([Metrics(metrics())], comparisons(workspace), {}),
    }  # fmt: skip
    for stage in chain:
        artifacts, extra, manifest = made[stage]
        write_result(workspace, stage, artifacts, extra, **manifest)
    return workspace


def metrics() -> dict[str, Any]:
    return {
        **scored(["000", "001", "002"], 24.0),
        "coverage": 0.97,
        "held_out": {
            "registered": scored(["h000"], 21.0), "refined": scored(["h000"], 22.0),
            "pictures": "refined", "sources": {"h000": "kept_back.jpg"},
        },
        "poses": {"rotation_deg": {"median": 0.12}, "auc_5": 0.9, "alignment": "similarity"},
        "geometry": {"fscore": {"0.5": 0.77}, "unit": "mm"},
        "novel": {"degrees_beyond": 20.0, "views": {"first": {"unsupported": 0.25}}},
        "support_legend": "magenta: unseen",
    }  # fmt: skip


def comparisons(folder: Path) -> dict[str, bytes]:
    """The pictures of the evaluation as PNG bytes."""
    found = {}
    for name in ("comparison_000", "comparison_001", "heldout_comparison_h000"):
        write_png(folder / "picture.png", comparison(picture(1), picture(2), 0.25))
        found[f"metrics/{name}.png"] = (folder / "picture.png").read_bytes()
    write_png(folder / "picture.png", picture(3))
    found["metrics/support_novel_first.png"] = (folder / "picture.png").read_bytes()
    (folder / "picture.png").unlink()
    return found
