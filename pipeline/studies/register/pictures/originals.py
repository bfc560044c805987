"""The photographs that a run was made of, larger than it used them.

A run takes many photographs smaller than they are, for speed; marks of the enamel are too small
for that (see `marks`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.artifacts.views import View
from pipeline.errors import RequestError
from pipeline.measure import usable_cores
from pipeline.pages.case import Case

Floats = npt.NDArray[np.float32]

#: Pixels of the long side at most.
LARGEST = 1024


def larger_photographs(
    case: Case, views: Sequence[View]
) -> tuple[dict[str, Floats], tuple[str, ...]]:
    """Read the photographs of views that have more pixels than these.

    Args:
        case: a finished run.
        views: of it.

    Returns:
        View name -> [H, W] float32 grey in 0..1; the names of the files that are not what the run
        read, or not where it read them.
    """
    wanted = {view.source_name: view for view in views if _has_more(view)}
    found = {}
    for item in _loaded(case, list(wanted)) if wanted else ():
        view = wanted.get(item.source_name)
        if view is None or item.source_sha256 != view.source_sha256:
            continue
        grey = cv2.cvtColor(item.picture.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
        height, width = grey.shape
        alike = abs(width * view.height - height * view.width) <= 2 * max(width, height)
        if alike and width > view.width:
            found[view.name] = np.ascontiguousarray(grey[:, ::-1]) if view.turned_over else grey
    return found, tuple(name for name, view in wanted.items() if view.name not in found)


def _has_more(view: View) -> bool:
    """A view whose photograph has more pixels, and no lens that was taken out of it."""
    linear = np.linalg.svd(view.working_from_source[:2, :2], compute_uv=False)
    smaller = float(linear.max()) < 0.99 and max(view.width, view.height) < LARGEST
    return smaller and not view.lens_taken_out


def _loaded(case: Case, names: Sequence[str]) -> Sequence[Any]:
    """The pictures of a run, read anew: `stages.views.load.Loaded`."""
    from stages.views.find import find_images, is_video
    from stages.views.load import load_photos, load_video
    from stages.views.reading.video import Wanted

    settings = case.settings.get("views")
    cut, least = getattr(settings, "cut_sheets", True), getattr(settings, "min_side", 1)
    try:
        files = find_images(case.request["images"])
        first = next(iter(files))
        if is_video(files[first]):
            frames = tuple(sorted(int(name.rpartition("#")[2]) for name in names))
            wanted = Wanted(len(frames), indices=frames)
            return load_video(
                first, files[first], None, wanted, LARGEST, least, cut, usable_cores()
            )
        # All of them, as the run did: how a picture is cut hangs on whether it is the only one.
        return load_photos(files, {}, LARGEST, least, cut, usable_cores())
    except (RequestError, OSError):
        return []
