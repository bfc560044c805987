"""How a scene looks from nearer: drawn larger than it was fitted, against the larger photographs.

    python benchmarks/closer.py WORKSPACE ... --photographs FOLDER [--times 2] [--pictures DIR]

FOLDER holds the photographs of one workspace, or a folder of them named like each. Photographs with
fewer pixels than that are enlarged, and tell less. Away from the borders of the masks; cracks are
how much darker thin dark lines are than what is beside them, beyond those of the photograph itself
(mean over the pixels, in thousandths).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import workspaces

from pipeline.artifacts.cameras import Camera
from stages.evaluate.images.metrics import psnr
from stages.splatting.rasterizer import use_threads
from stages.splatting.rendering import render

Floats = npt.NDArray[np.floating]
Image = npt.NDArray[np.uint8]

#: Pixels of the fitted size that are left out along masks; and the width of what counts as thin.
BORDER, THIN = 4, 5


def photograph(folder: Path, name: str, camera: Camera) -> Image:
    """[H, W, 3] of a camera's size."""
    found = cv2.imread(str(folder / name), cv2.IMREAD_COLOR_RGB)
    if found is None:
        raise SystemExit(f"{folder} has no photograph {name} that can be read.")
    how = cv2.INTER_AREA if found.shape[1] > camera.width else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(found, (camera.width, camera.height), interpolation=how), np.uint8)


def as_bytes(image: Floats) -> Image:
    return np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)


def thin_lines(image: Image) -> Floats:
    """[H, W] how much darker than its closing an image is, of 0..1."""
    grey = image.mean(2) / 255
    return np.asarray(cv2.morphologyEx(grey, cv2.MORPH_CLOSE, np.ones((THIN, THIN)))) - grey


def compare(workspace: Path, photographs: Path, times: float) -> tuple[list[Any], list[Image]]:
    """Per photograph PSNR as fitted, PSNR and cracks enlarged; and what is compared."""
    gaussians = workspaces.load(workspace, "fit", "gaussians")
    views = workspaces.views(workspace)
    scores, pictures = [], []
    for camera in workspaces.load(workspace, "fit", "cameras").cameras:
        view = views[camera.name]
        larger = camera.resized(round(camera.width * times), round(camera.height * times))
        around = np.ones((2 * BORDER + 1, 2 * BORDER + 1))
        inside = cv2.erode(view.valid().astype(np.uint8), around)
        size = (larger.width, larger.height)
        inside_larger = cv2.resize(inside, size, interpolation=cv2.INTER_NEAREST) > 0
        wanted = photograph(photographs, view.source_name, larger)
        own, drawn = (as_bytes(render(gaussians, seen).image) for seen in (camera, larger))
        cracks = (thin_lines(drawn) - thin_lines(wanted))[inside_larger].mean()
        fitted = psnr(own, as_bytes(view.image), inside > 0)
        scores.append((fitted, psnr(drawn, wanted, inside_larger), 1e3 * cracks))
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
                cv2.imwrite(str(path), picture[..., ::-1])
    fitted, larger, cracks = np.mean(rows, axis=0)
    print(f"mean {fitted:.2f} dB, enlarged {larger:.2f} dB, cracks {cracks:.2f}, {len(rows)} cases")


if __name__ == "__main__":
    main()
