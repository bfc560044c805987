"""How ragged the rim of a scene is, from its photographs and from midway between them.

    python benchmarks/rims.py WORKSPACE ... [--pictures DIR]

Ragged is by how many per cent the outline of what is drawn (opaque by half) is longer than one that
is even over some pixels: 0 is as smooth as can be. Outlines of holes count, those of specks don't.
Pictures show the outline from midway.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import workspaces
from scipy.spatial.transform import Rotation, Slerp

from pipeline.artifacts.cameras import Camera
from stages.splatting.rasterizer import use_threads
from stages.splatting.rendering import render

Floats = npt.NDArray[np.float64]

#: An outline is even that has been drawn by a Gaussian this wide, in pixels of a picture 1024 wide.
EVEN = 8.0
#: Outlines shorter than this share of the picture's width are specks.
SPECK = 0.1


def midway(a: Camera, b: Camera) -> Camera:
    """A camera of the first one's size between two."""
    turns = Slerp([0, 1], Rotation.from_matrix([a.rotation, b.rotation]))(0.5).as_matrix()
    pose = np.eye(4)
    pose[:3, :3] = turns
    pose[:3, 3] = -turns @ (a.centre + b.centre) / 2
    return replace(a, cam_from_world=pose)


def length(outline: Floats) -> float:
    return float(np.linalg.norm(np.roll(outline, -1, axis=0) - outline, axis=1).sum())


def even(outline: Floats, width: float) -> Floats:
    """An outline [N, 2] in steps of about a pixel, smoothed along itself."""
    size = 2 * round(3 * width) + 1
    around = np.pad(outline, ((size // 2, size // 2), (0, 0)), mode="wrap")
    kernel = cv2.getGaussianKernel(size, width)[:, 0]
    return np.stack([np.convolve(column, kernel, "valid") for column in around.T], axis=1)


def raggedness(alpha: npt.NDArray[np.float32]) -> tuple[float, npt.NDArray[np.uint8]]:
    """Per cent by which the outlines of [H, W] are longer than even ones; and their picture."""
    scale = alpha.shape[1] / 1024
    shape = (alpha > 0.5).astype(np.uint8)
    found, _ = cv2.findContours(shape, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    total, smooth = 0.0, 0.0
    for contour in found:
        # a step of one pixel each way is as even as pixels are
        outline = even(contour[:, 0].astype(np.float64), 1.0)
        if length(outline) >= SPECK * alpha.shape[1]:
            total += length(outline)
            smooth += length(even(outline, EVEN * scale))
    return 100 * (total / max(smooth, 1e-9) - 1), 255 * shape


def measure(workspace: Path, pictures: Path | None) -> tuple[float, float]:
    """Mean over the photographs, and over the places midway between neighbours."""
    gaussians = workspaces.load(workspace, "fit", "gaussians")
    cameras: Sequence[Camera] = workspaces.load(workspace, "fit", "cameras").cameras
    between = [midway(a, b) for a, b in pairwise(cameras)]
    seen = [raggedness(render(gaussians, camera).alpha)[0] for camera in cameras]
    new = [raggedness(render(gaussians, camera).alpha) for camera in between]
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        for number, (_, picture) in enumerate(new):
            cv2.imwrite(str(pictures / f"{workspace.name}_{number}.png"), picture)
    return float(np.mean(seen)), float(np.mean([found for found, _ in new]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("workspaces", nargs="*", type=Path)
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    if not args.workspaces:
        print("benchmarks/rims.py: nothing to do without a WORKSPACE")
        return
    use_threads(args.threads)
    rows = []
    for workspace in args.workspaces:
        rows.append(measure(workspace, args.pictures))
        seen, new = rows[-1]
        print(f"{workspace.name}: {seen:.1f} % from the photographs, {new:.1f} % midway")
    seen, new = np.mean(rows, axis=0)
    print(f"mean {seen:.1f} % from the photographs, {new:.1f} % midway, {len(rows)} cases")


if __name__ == "__main__":
    main()
