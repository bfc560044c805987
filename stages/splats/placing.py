"""Gaussians of another program: whether they can be rendered, and where they lie."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.gaussians import Gaussians, read_gaussians_ply
from pipeline.artifacts.space.frames import BACKGROUND, TURNED
from pipeline.errors import RequestError
from stages.splats import compressed
from stages.splatting.frame import move_gaussians

#: Bytes of a `.ply` that its header fits into.
HEADER = 1 << 14
#: Logit of an opacity that is 1 in float32; its negative is that of one that no picture shows.
WHOLE = 20.0
#: Natural logarithm of a standard deviation above which its square is not far from overflowing.
LARGEST_LOG_SCALE = 40.0


def read_splats(path: Path) -> Gaussians:
    """Gaussians of a `.ply` as 3DGS or as PlayCanvas (compressed) writes it.

    Opacities of 0 and 1, whose logits are infinite, get finite ones that render the same.

    Raises:
        RequestError: it is neither, or damaged.
    """
    with path.open("rb") as file:
        if file.read(3) != b"ply":
            raise RequestError(
                f"{path} is no .ply. Of our own results give splats.ply or splats.compressed.ply; "
                "splat-transform makes a .ply of .sog, .spz, .splat and .ksplat."
            )
    packed = f" {compressed.MARK}".encode("ascii") in _head(path)
    fields = compressed.read_compressed_ply(path) if packed else read_gaussians_ply(path)
    fields["logit_opacities"] = np.clip(fields["logit_opacities"], -WHOLE, WHOLE)
    return Gaussians(**fields, light=None, background=said_background(path))


def unusable(gaussians: Gaussians) -> npt.NDArray[np.bool_]:
    """[N] True where a number is not finite, a rotation is none, or a size is beyond measure."""
    count = len(gaussians)
    numbers = (
        gaussians.means, gaussians.quats_wxyz, gaussians.log_scales,
        gaussians.logit_opacities[:, None], gaussians.sh.reshape(count, -1),
    )  # fmt: skip
    finite = np.all([np.isfinite(part).all(1) for part in numbers], axis=0)
    turned = np.linalg.norm(gaussians.quats_wxyz.astype(np.float64), axis=1) > 1e-12
    return ~(finite & turned & (gaussians.log_scales < LARGEST_LOG_SCALE).all(1))


def says_turned(path: Path) -> bool:
    """Is it one of our own files, or was made from one, that is turned for viewers?"""
    return f"comment {TURNED}".encode("ascii") in _head(path)


def said_background(path: Path) -> tuple[float, float, float]:
    """The colour behind the scene that a file of ours says; black where it says none."""
    said = _head(path).partition(f"comment {BACKGROUND}".encode("ascii"))[2].split(b"\n")[0]
    try:
        red, green, blue = (float(number) for number in said.split())
    except ValueError:
        return 0.0, 0.0, 0.0
    known = all(0 <= channel <= 1 for channel in (red, green, blue))
    return (red, green, blue) if known else (0.0, 0.0, 0.0)


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(HEADER).partition(b"end_header")[0]


def into_world(gaussians: Gaussians, frame_from_world: npt.NDArray[np.float64]) -> Gaussians:
    """Gaussians that were given in a frame, in our world, with rotations of length 1.

    Args:
        gaussians: N usable ones (`unusable`); their rotations may have any length, as 3DGS writes
            them.
        frame_from_world: [4, 4] similarity from our world to that frame.

    Raises:
        ValueError: it is no similarity.
    """
    quats = gaussians.quats_wxyz.astype(np.float64)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    unit = replace(gaussians, quats_wxyz=quats.astype(np.float32))
    world_from_frame = np.asarray(np.linalg.inv(frame_from_world), np.float64)
    return move_gaussians(unit, world_from_frame)


def share_in_view(gaussians: Gaussians, cameras: Sequence[Camera]) -> float:
    """Share of the Gaussians whose centres lie in the picture of at least one camera, 0..1."""
    seen = np.zeros(len(gaussians), bool)
    for camera in cameras:
        pixels, depth = camera.project(gaussians.means)
        seen |= camera.shows(pixels, depth)
    return float(seen.mean())
