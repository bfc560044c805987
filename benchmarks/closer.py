"""How a scene looks from nearer: drawn larger than it was fitted, against the larger photographs.

    python benchmarks/closer.py WORKSPACE ... --photographs FOLDER [--times 2] [--pictures DIR]

FOLDER holds the photographs of one workspace, or a folder of them named like each. Photographs with
fewer pixels than that are enlarged, and tell less. Away from the borders of the masks; cracks are
how much darker thin dark lines are than what is beside them, beyond those of the photograph itself
(mean over the pixels, in thousandths).
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.store import Store
from stages.splatting import render
from stages.splatting.rasterizer import use_threads

Floats = npt.NDArray[np.float32]

#: Pixels of the fitted size that are left out along masks; and the width of what counts as thin.
BORDER, THIN = 4, 5


def enlarged(camera: Camera, times: float) -> Camera:
    """The same camera with so many times the pixels a side."""
    return replace(
        camera, width=round(camera.width * times), height=round(camera.height * times),
        fx=camera.fx * times, fy=camera.fy * times, cx=camera.cx * times, cy=camera.cy * times,
    )  # fmt: skip


def photograph(folder: Path, name: str, camera: Camera) -> Floats:
    """[H, W, 3] of a camera's size, 0..1."""
    found = cv2.imread(str(folder / name), cv2.IMREAD_COLOR_RGB)
    if found is None:
        raise SystemExit(f"{folder} has no photograph {name} that can be read.")
    smaller = found.shape[1] > camera.width
    how = cv2.INTER_AREA if smaller else cv2.INTER_CUBIC
    return cv2.resize(found, (camera.width, camera.height), interpolation=how) / np.float32(255)


def thin_lines(image: Floats) -> Floats:
    """[H, W] how much darker than its closing an image is."""
    grey = image.mean(2)
    return np.asarray(cv2.morphologyEx(grey, cv2.MORPH_CLOSE, np.ones((THIN, THIN)))) - grey


def psnr(image: Floats, wanted: Floats, compared: npt.NDArray[np.bool_]) -> float:
    return float(-10 * np.log10(((image - wanted)[compared].astype(np.float64) ** 2).mean()))


def compare(workspace: Path, photographs: Path, times: float) -> tuple[list[Any], list[Floats]]:
    """Per photograph PSNR as fitted, PSNR and cracks enlarged; and what is compared."""
    store = Store(workspace)

    def loaded(stage: str, kind: str) -> Any:
        result = store.in_use(stage)
        if result is None:
            raise SystemExit(f"{workspace} has no result of {stage}: run it up to fit first.")
        return store.load(result, kind)

    gaussians = loaded("fit", "gaussians")
    placed = store.in_use("init")  # which masks them where it finds the teeth in them
    masked = placed is not None and (placed.folder / "views").is_dir()
    views = {view.name: view for view in loaded("init" if masked else "views", "views").views}
    scores, pictures = [], []
    for camera in loaded("fit", "cameras").cameras:
        view, larger = views[camera.name], enlarged(camera, times)
        kernel = np.ones((2 * BORDER + 1, 2 * BORDER + 1))
        inside = cv2.erode(view.valid().astype(np.uint8), kernel)
        size = (larger.width, larger.height)
        inside_larger = cv2.resize(inside, size, interpolation=cv2.INTER_NEAREST) > 0
        wanted = photograph(photographs, view.source_name, larger)
        own = np.clip(render(gaussians, camera).image, 0, 1)
        drawn = np.clip(render(gaussians, larger).image, 0, 1)
        cracks = (thin_lines(drawn) - thin_lines(wanted))[inside_larger].mean()
        scores.append(
            (psnr(own, view.image, inside > 0), psnr(drawn, wanted, inside_larger), 1e3 * cracks)
        )
        pictures.append(np.concatenate([drawn, wanted], 1))
    return scores, pictures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("workspaces", nargs="*", type=Path)
    parser.add_argument("--photographs", type=Path, default=Path("data_samples/three_photos"))
    parser.add_argument("--times", type=float, default=2.0)
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    if not args.workspaces:
        print("benchmarks/closer.py: nothing to do without a WORKSPACE")
        return
    use_threads(args.threads)
    rows = []
    for workspace in args.workspaces:
        own = args.photographs / workspace.name
        scores, pictures = compare(workspace, own if own.is_dir() else args.photographs, args.times)
        rows.append(np.mean(scores, axis=0))
        fitted, larger, cracks = rows[-1]
        print(f"{workspace.name}: {fitted:.2f} dB, enlarged {larger:.2f} dB, cracks {cracks:.2f}")
        if args.pictures:
            args.pictures.mkdir(parents=True, exist_ok=True)
            for number, picture in enumerate(pictures):
                path = args.pictures / f"{workspace.name}_{number}.png"
                cv2.imwrite(str(path), np.round(255 * picture[..., ::-1]).astype(np.uint8))
    fitted, larger, cracks = np.mean(rows, axis=0)
    print(f"mean {fitted:.2f} dB, enlarged {larger:.2f} dB, cracks {cracks:.2f}, {len(rows)} cases")


if __name__ == "__main__":
    main()
