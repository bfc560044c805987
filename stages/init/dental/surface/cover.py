"""Lips and cheeks that stand before the teeth in one photograph, told by the other photographs.

The reader tells lips from gum by their looks (`Dentition.on_jaws`), and may take a lip that lies on
the gum for gum: it is as red, and in a photograph from the side it covers the teeth of the far
side. But where another photograph, that looks at a place from further in front, shows a tooth, gum
can't be: what is red there stands before it. That also shows what this patient's lip looks like in
this photograph; how far it reaches over the gum, where no tooth betrays it, is a cut between the
two colours (GrabCut: Rother, Kolmogorov and Blake 2004), if they are two.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.kernels.threads import in_threads
from stages.init.dental.surface.chart.jaws import (
    APART,
    FACING_SMOOTHING,
    HIDDEN,
    PAST_EDGE,
    WITHIN,
    Chart,
    facing,
    smooth_normals,
)
from stages.init.dental.surface.chart.raster import at_places, raster_chart, sees
from stages.init.dental.surface.options import SurfaceOptions
from stages.init.dental.surface.photos.photo import Photo
from stages.init.dental.surface.photos.tissue import disc, joined_to

Array32 = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

#: Half the width of the narrowest thing that covers (mm).
_NARROW = 0.5
#: Share of a sample's surroundings from which it is tooth, or tissue.
_HALF = 0.5
#: The cut is made at so many pixels per mm, in so many rounds; a lip's edge is no sharper.
_CUT_DENSITY, _CUT_ROUNDS = 4.0, 4
#: Gum this close to the crowns (mm) says which colour it has.
_GUM_RING = 1.5
#: A cut that takes more than this share of the gum beside the crowns is none: they look alike. So
#: in two of 36 photographs; in one of them a third of a child's gum would have gone.
_SEPARABLE = 0.1
#: Fewer pixels than this have no colour of their own.
_LEAST = 50


@dataclass(frozen=True)
class _Look:
    """What a photograph shows of a chart, [H, W] each: bool, but for `faces` (cosine).

    Attributes:
        faces: between normals and lines of sight; negative where it is not in sight.
        crown: well within a crown that it shows.
        bare: in sight, and no tooth is seen there or nearby.
        beyond: of these, those with what may be gum of this jaw.
    """

    faces: Array32
    crown: Mask
    bare: Mask
    beyond: Mask


def uncovered(
    charts: list[Chart], photos: list[Photo], nearest: list[Array32], options: SurfaceOptions,
    threads: int,
) -> list[Photo]:  # fmt: skip
    """The photographs with what stands before the teeth and the gum marked, and no longer gum.

    A crown is looked for only where another photograph shows it from further in front, and gum by
    its colour only where another one sees that place better.

    Args:
        charts: of the jaws, about where the surface is.
        photos: the photographs as they were prepared.
        nearest: per photograph the z-depth [h, w] of the nearest chart.
        options: settings.
        threads: number of threads; does not change the result.
    """
    covered = [np.zeros(photo.size, bool) for photo in photos]
    contested = [np.zeros(photo.size, bool) for photo in photos]
    for chart in charts:
        points = chart.points
        normals = smooth_normals(chart.radius, chart.grid, FACING_SMOOTHING)
        used = chart.used(PAST_EDGE, options.gum_height)
        look = partial(_look, chart, points, normals)
        looks = in_threads(look, zip(photos, nearest, strict=True), threads)
        for number, photo in enumerate(photos):
            better = np.any([look.faces > looks[number].faces for look in looks], axis=0)
            hidden = _hidden(chart, looks, number) & used
            depth, place = raster_chart(photo, points, used)
            near = (depth > 0) & (depth < nearest[number] + np.float32(HIDDEN))
            covered[number] |= near & at_places(hidden, place)
            contested[number] |= near & at_places(better, place)
    return in_threads(
        lambda item: _marked(*item), zip(photos, covered, contested, strict=True), threads
    )


def _look(chart: Chart, points: Array32, normals: Array32, shown: tuple[Photo, Array32]) -> _Look:
    """`shown`: a photograph and the depth [h, w] of what is nearest in it."""
    photo, front = shown
    jaw = chart.shape.jaw
    pixels, _ = photo.project(points)
    seen = sees(photo, front, points, HIDDEN)
    seen &= photo.sample(photo.valid.astype(np.float32), pixels) > _HALF
    gum = np.maximum(photo.upper_gum, photo.lower_gum)
    bare = seen & (photo.sample(photo.away_from_teeth(), pixels) > APART * photo.density)
    crown = (seen & (photo.sample(photo.tooth_of(jaw), pixels) > _HALF)).astype(np.uint8)
    own, any_jaws = photo.sample(photo.gum_of(jaw), pixels), photo.sample(gum, pixels)
    return _Look(
        faces=np.where(seen, facing(photo, points, normals), np.float32(-1)),
        crown=cv2.erode(crown, disc(round(WITHIN * chart.grid.density))) > 0,
        bare=bare,
        beyond=bare & ((own > _HALF) | (any_jaws < _HALF)),
    )


def _hidden(chart: Chart, looks: list[_Look], number: int) -> Mask:
    """[H, W] bool: crowns that others show, and what is beyond their gum line.

    What covers a crown comes from beyond its gum line: it covers the gum there as well.
    """
    own = looks[number]
    crown = np.any([look.crown & (look.faces > own.faces) for look in looks], axis=0)
    narrow = disc(round(_NARROW * chart.grid.density))
    hidden = cv2.morphologyEx((own.bare & crown).astype(np.uint8), cv2.MORPH_OPEN, narrow) > 0
    upwards = slice(None, None, -1 if chart.shape.gumwards > 0 else 1)  # rows run downwards
    gumwards = np.logical_or.accumulate((hidden & own.beyond)[upwards], axis=0)[upwards]
    return np.asarray(hidden | (gumwards & own.beyond))


def _marked(photo: Photo, covered: Mask, contested: Mask) -> Photo:
    """With what covers, and looks like that, marked; and what it cuts off from the teeth."""
    if not covered.any():
        return photo
    tooth = (photo.upper > 0) | (photo.lower > 0)
    gum = (photo.upper_gum > 0) | (photo.lower_gum > 0)
    wide = cv2.dilate(covered.astype(np.uint8), disc(round(APART * photo.density))) > 0
    covered = wide & ~tooth
    covered |= _of_its_colour(photo, covered & gum, gum & ~covered, tooth) & contested
    covered |= gum & ~joined_to(tooth | (gum & ~covered), tooth)
    free = (~covered).astype(np.float32)
    return replace(
        photo, upper_gum=photo.upper_gum * free, lower_gum=photo.lower_gum * free,
        covered=np.maximum(photo.covered, covered.astype(np.float32)),
    )  # fmt: skip


def _of_its_colour(photo: Photo, lip: Mask, gum: Mask, tooth: Mask) -> Mask:
    """[H, W] bool: what of the gum [H, W] looks like the lip [H, W], and hangs together with it."""
    near = cv2.distanceTransform((~tooth).astype(np.uint8), cv2.DIST_L2, 5)
    ring = gum & (near < _GUM_RING * photo.density)
    image = np.ascontiguousarray(np.rint(photo.image * 255).astype(np.uint8))
    lab = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2Lab))
    state = np.full(lip.shape, cv2.GC_BGD, np.uint8)
    state[gum] = cv2.GC_PR_BGD
    state[lip] = cv2.GC_FGD
    height, width = lip.shape
    factor = min(_CUT_DENSITY / photo.density, 1)
    size = max(round(width * factor), 1), max(round(height * factor), 1)
    small = cv2.resize(lab, size, interpolation=cv2.INTER_AREA)
    state = np.asarray(cv2.resize(state, size, interpolation=cv2.INTER_NEAREST))
    known = state == cv2.GC_FGD
    if min(int(ring.sum()), int(known.sum()), int((~known).sum())) < _LEAST:
        return np.zeros_like(lip)
    # Teeth and the rest count as gum: the cut is between two colours alone.
    small[state == cv2.GC_BGD] = np.median(lab[ring], axis=0).astype(np.uint8)
    cv2.setRNGSeed(0)  # this thread's: the same cut every time
    cv2.grabCut(
        small, state, (0, 0, 1, 1), np.zeros((1, 65)), np.zeros((1, 65)), _CUT_ROUNDS,
        cv2.GC_INIT_WITH_MASK,
    )  # fmt: skip
    like = ((state == cv2.GC_FGD) | (state == cv2.GC_PR_FGD)).astype(np.uint8)
    like = cv2.resize(like, (width, height), interpolation=cv2.INTER_NEAREST) > 0
    free = ring & ~lip
    if (like & free).sum() > _SEPARABLE * free.sum():
        return np.zeros_like(lip)
    return joined_to((like & gum) | lip, lip)
