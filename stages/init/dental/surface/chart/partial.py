"""Crowns that a photograph shows in part only: a lip, a cheek or its border cuts them off.

What it shows of such a crown lies in the shade of what covers the rest, and ends in a line across
the crown. Both stay on it when the view turns. Where another photograph shows the crown whole, the
first need not say anything of it: what one photograph shows then ends between two crowns.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.kernels.threads import in_threads
from stages.init.dental.surface.chart.crown_shape import tooth_of_columns, within_crowns
from stages.init.dental.surface.chart.jaws import (
    APART,
    FACING_SMOOTHING,
    HIDDEN,
    PAST_EDGE,
    ROW_SMOOTHING,
    WITHIN,
    Chart,
    facing,
    smooth_normals,
)
from stages.init.dental.surface.chart.raster import sees
from stages.init.dental.surface.options import SurfaceOptions
from stages.init.dental.surface.photos.photo import Photo
from stages.init.dental.surface.photos.tissue import disc

Array32 = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

#: A crown is cut off if so much of it is lacking. Of 532 crowns of eleven patients, each against a
#: photograph that faces it better, two in three lack .03 at most, one in four .2 and more.
_LACKING = 0.1
#: A photograph shows a crown whole if it shows so much of what the other one could see. Between the
#: gum line from zenith to zenith and the edges papillae count as crown: .75 to .95 is all there is.
_WHOLE = 0.6
#: One that shows it whole may face it so much worse (share of the cosine), if the other does not.
_NEARLY = 0.9
#: A crown of which less is in sight (square mm) is not looked at.
_LEAST = 1.0


@dataclass(frozen=True)
class _Sight:
    """What a photograph has of a chart, [H, W] each.

    Attributes:
        could: bool: not too aslant and nothing of the jaws before it, within its borders or not.
        tooth, tissue: bool: of these it shows a tooth of this jaw; or gum.
        bare: bool: of these it shows no tooth, nor one nearby.
        faces, row: float32 cosine between the lines of sight and the surface's normals; the row's.
    """

    could: Mask
    tooth: Mask
    tissue: Mask
    bare: Mask
    faces: Array32
    row: Array32


def partial_crowns(
    chart: Chart,
    photos: list[Photo],
    nearest: list[Array32],
    options: SurfaceOptions,
    threads: int,
) -> list[Mask]:
    """Per photograph [H, W] bool: crowns that it shows in part, with the gum beyond them.

    Only where a photograph that shows them whole faces their surface better: a flank that is turned
    towards the one that shows them in part is its own to show.

    Args:
        chart: of a jaw, about where the surface is; photos: the photographs.
        nearest: per photograph the z-depth [h, w] of the nearest chart.
        options: settings.
        threads: number of threads; does not change the result.
    """
    close = smooth_normals(chart.radius, chart.grid, FACING_SMOOTHING)
    row = smooth_normals(chart.radius, chart.grid, ROW_SMOOTHING)
    look = partial(_sight, chart, options, close, row)
    sights = in_threads(look, zip(photos, nearest, strict=True), threads)
    columns = tooth_of_columns(chart.grid, chart.shape)
    crowns = within_crowns(chart.grid, chart.shape)
    used = chart.used(PAST_EDGE, options.gum_height)
    inset = disc(round(WITHIN * chart.grid.density))
    found = [np.zeros(chart.grid.shape, bool) for _ in photos]
    for tooth in chart.shape.teeth:
        own = (columns == tooth)[None]
        cut = _cut_off(sights, crowns & own, inset, _LEAST * chart.grid.density**2)
        whole = [sight for sight, is_cut in zip(sights, cut, strict=True) if not is_cut]
        best = np.max([np.where(each.tissue, each.faces, 0) for each in whole], axis=0, initial=0)
        for mask, sight, is_cut in zip(found, sights, cut, strict=True):
            mask |= used & own & is_cut & (best > np.maximum(sight.faces, 0))
    return found


def _sight(
    chart: Chart,
    options: SurfaceOptions,
    close: Array32,
    row: Array32,
    shown: tuple[Photo, Array32],
) -> _Sight:
    """`close`, `row`: [H, W, 3] normals of the surface and of the row; `shown`: as for `cover`."""
    photo, front = shown
    points, jaw = chart.points, chart.shape.jaw
    pixels, _ = photo.project(points)
    height, width = photo.size
    inside = (pixels > 0).all(-1) & (pixels < (width, height)).all(-1)
    clear = sees(photo, front, points, 2 * HIDDEN)
    faces = facing(photo, points, close)
    could = (faces > options.least_facing) & (clear | ~inside)
    tooth = could & (photo.sample(photo.tooth_of(jaw), pixels) > 0.5)
    gum = could & (photo.sample(photo.gum_of(jaw), pixels) > 0.5)
    far = photo.sample(photo.away_from_teeth(), pixels) > APART * photo.density
    bare = could & (far | ~inside)
    return _Sight(could, tooth, tooth | gum, bare, faces, facing(photo, points, row))


def _cut_off(
    sights: list[_Sight], crown: Mask, inset: npt.NDArray[np.uint8], least: float
) -> list[bool]:
    """Per photograph: whether it shows a part of a crown [H, W] that another one shows whole.

    Args:
        inset: element by which what another one shows is eroded; least: in samples, of the crown.
    """
    count = len(sights)
    lacking, faces = np.zeros((2, count, count))
    for a, mine in enumerate(sights):
        could = crown & mine.could
        if could.sum() < least:
            continue
        for b, other in enumerate(sights):
            faces[a, b] = other.row[could].mean()
            sure = could & (cv2.erode((crown & other.tooth).astype(np.uint8), inset) > 0)
            if sure.sum() >= least and (could & other.tooth).sum() > _WHOLE * could.sum():
                lacking[a, b] = (sure & mine.bare).sum() / sure.sum()
    cut = lacking > _LACKING
    own = np.diag(faces)[:, None]
    better = (faces > own) | ((faces > _NEARLY * own) & ~cut.T)
    return [bool(row.any()) for row in cut & better]
