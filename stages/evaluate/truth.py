"""What the user knows of a scene to test with: true cameras, and masks to score in."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePath

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.views import View
from pipeline.errors import RequestError
from pipeline.geometry.models.known_cameras import matching_cameras, pinhole_camera, read_cameras
from pipeline.untrusted.files import PHOTOGRAPH, UnusableFile, read
from pipeline.untrusted.pictures import gray, same_shape
from stages.evaluate.held_out import without_lens

Mask = npt.NDArray[np.bool_]

SETTING = "evaluate.ground_truth"
#: Masks are 255 where they count; what is less (gum may be 128) does not.
_COUNTS = 250
#: Masks cut a little otherwise than the photograph will do: logarithm of width over height.
_ASPECT = 0.02


@dataclass(frozen=True)
class Truth:
    """Attributes:
    cameras: name of a view -> its true camera, for the view's image, without lens distortion.
    units: of their world, ``"mm"`` or ``"arbitrary"``.
    """

    cameras: Mapping[str, Camera]
    units: str


def read_truth(files: Iterable[Path], inputs: Sequence[View], held: Sequence[View]) -> Truth:
    """True cameras of input views and of photographs held out, by the names of their files.

    Raises:
        RequestError: the files are damaged, or have no camera of at least two of them.
    """
    known, scale = read_cameras(files, SETTING)
    matched = matching_cameras(known, inputs, SETTING, held)
    views = [*inputs, *held]
    cameras = {
        view.name: pinhole_camera(view, matched[view.name], SETTING)
        for view in views
        if view.name in matched
    }
    return Truth(cameras, scale.units)


def scoring_mask(files: Mapping[str, Path], view: View) -> Mask | None:
    """[H, W] where a view is scored by itself, or None where no file is named as its photograph.

    Args:
        files: file name -> mask of the photograph: upright, or else as it is stored, at any size.
        view: its lens is taken out of the mask as it was of the image.

    Raises:
        RequestError: the mask can't be read, or has another shape than the photograph.
    """
    source = PurePath(view.source_name).name or view.name
    names = {PurePath(name).stem: path for name, path in sorted(files.items())}
    path = names.get(source) or names.get(PurePath(source).stem)
    if path is None:
        return None
    try:
        stored = gray(read(path, PHOTOGRAPH))
    except UnusableFile as error:
        raise RequestError(
            f"evaluate.masks: the mask {path} {error}. Mend it, or leave it out."
        ) from error
    height, width = stored.shape
    mask_from_working = _mask_from_working((width, height), view)
    if mask_from_working is None:
        raise RequestError(
            f"evaluate.masks: {path.name} has {width} x {height} pixels, but the photograph "
            f"{source} {view.source_size[0]} x {view.source_size[1]}. Give masks of its size."
        )
    v, u = np.mgrid[: view.height, : view.width] + 0.5
    position = np.stack([u, v, np.ones_like(u)], -1) @ mask_from_working.T
    column = np.clip(np.floor(position[..., 0]), 0, width - 1).astype(np.int64)
    row = np.clip(np.floor(position[..., 1]), 0, height - 1).astype(np.int64)
    mask = np.asarray(stored[row, column] >= _COUNTS)
    if view.lens_taken_out:
        straight = without_lens(replace(view, mask=mask), view.lens_taken_out)
        mask = straight.valid()
    return mask


def _mask_from_working(size: tuple[int, int], view: View) -> npt.NDArray[np.float64] | None:
    """[3, 3] from the view's pixels to those of a mask of its photograph; None: of another shape.

    As the stage `views` takes masks: upright where they have the upright shape.
    """
    upright, stored = view.upright_size, view.source_size
    whole, from_whole = upright, view.working_from_upright
    if not same_shape(size, upright):
        if min(stored) > 0 and same_shape(size, stored):
            whole, from_whole = stored, view.working_from_source
        elif abs(np.log(size[0] * upright[1] / (size[1] * upright[0]))) >= _ASPECT:
            return None
    scale = np.diag([size[0] / whole[0], size[1] / whole[1], 1.0])
    return np.asarray(scale @ np.linalg.inv(from_whole))
