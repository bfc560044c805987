"""Photographs within a picture: several on one sheet, as clinics send them, or one with a border.

A sheet is cut where a band of one colour crosses it from side to side, then its parts likewise:
the recursive X-Y cut of Nagy and Seth, "Hierarchical representation of optically scanned documents"
(1984). What tells a photograph on a sheet from a thing before a plain wall is its rim: there the
picture begins on a straight line, all along.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from stages.views.working import Box

Bytes = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float32]

#: levels within which pixels are of one colour: what JPEG leaves beside an edge
LEVELS = 16
#: share of a line that has its colour where it belongs to a band between photographs or a border
PLAIN = 0.97
#: lines of a band between photographs, at least: a single one is a hair or a scratch
BAND = 2
#: Least share of a photograph's rim that differs from the bands beside it, all sides together:
#: those of twelve triads on 360 sheets have more (`benchmarks/sheets.py`) but where the photograph
#: itself ends in plain black or white. Of 810 photographs of teeth and houses none has two parts
#: above .23.
RIM = 0.6
#: The same of each side for a border around one photograph, and the share of the border that may be
#: of another colour. Of 698 that were found in the web 17 have a border, 15 of them with .93 or
#: more, 10 of these of one colour; others have .77 at most, and .72 where the sky ends.
BORDER, OTHER = 0.9, 0.1
#: Where the rim is looked at, as a share of the photograph's short side: scaled and compressed
#: pictures begin softly.
INSIDE = 0.004
#: Least share of a line across which the picture jumps where two photographs touch. The twelve
#: triads in rows and columns have .65 to .99, edges within the 810 photographs .45 or less.
SEAM = 0.5
#: lines from a seam to where the picture shows how it usually goes on: a narrow band lies between
BESIDE = 8
#: Short sides of photographs, in pixels: less is nothing to place teeth by.
LEAST = 64
#: Short sides of photographs on one sheet, as a share of the largest: less is a logo or a line of
#: text.
SMALLEST = 1 / 3
#: pixels of a line that are looked at, first to see whether it is worth it, then in full
FEW, MANY = 24, 600
DEEPEST = 8


def photographs_in(rgb: Bytes) -> list[Box]:
    """Where the photographs of a picture [H, W, 3] are, in reading order; the whole where it is
    one."""
    whole = Box(0, 0, *rgb.shape[:2])
    parts = _parts(rgb, whole)
    if len(parts) == 1:
        return parts if _has_border(rgb, parts[0]) else [whole]
    if sum(np.mean(_rim(rgb, part)) >= RIM for part in parts) < 2:
        return [whole]
    largest = max(part.short_side for part in parts)
    return [part for part in parts if part.short_side >= SMALLEST * largest]


def _parts(rgb: Bytes, box: Box, depth: int = 0, axes: tuple[int, ...] = (0, 1)) -> list[Box]:
    """What the bands and seams of a part of the picture, across these axes, leave of it."""
    if box.short_side < LEAST:
        return []
    for axis in axes:
        lines = box.of(rgb) if axis == 0 else box.of(rgb).swapaxes(0, 1)
        pieces, by_seams = _between_bands(lines), False
        if pieces == [(0, len(lines))]:
            pieces, by_seams = _between_seams(lines), True
        if pieces == [(0, len(lines))] or depth == DEEPEST:
            continue
        found: list[tuple[Box, list[Box]]] = []
        for start, end in pieces:
            piece = _piece(box, axis, start, end)
            parts = _parts(rgb, piece, depth + 1)
            if found and found[-1][1] and parts and not by_seams:
                before, earlier = found[-1]
                rims = [_side(rgb, part, axis, 1) or 0 for part in earlier]
                rims += [_side(rgb, part, axis, 0) or 0 for part in parts]
                if max(rims) < RIM:  # a plain stretch of one photograph
                    found.pop()
                    piece = Box(before.top, before.left, piece.bottom, piece.right)
                    parts = _parts(rgb, piece, depth + 1, axes[axis + 1 :])
            found.append((piece, parts))
        return [part for _, parts in found for part in parts]
    return [box]


def _piece(box: Box, axis: int, start: int, end: int) -> Box:
    if axis == 0:
        return box._replace(top=box.top + start, bottom=box.top + end)
    return box._replace(left=box.left + start, right=box.left + end)


def _between_bands(pixels: Bytes) -> list[tuple[int, int]]:
    """(start, end) of the lines [N, M, 3] between bands of one colour; none where all is plain."""
    plain = _plain_lines(pixels)
    edges = np.flatnonzero(np.diff(np.concatenate([[True], plain, [True]]).astype(np.int8)))
    pieces: list[tuple[int, int]] = []
    for start, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        if pieces and start - pieces[-1][1] < BAND:
            pieces[-1] = pieces[-1][0], end
        else:
            pieces.append((start, end))
    return pieces


def _plain_lines(pixels: Bytes) -> npt.NDArray[np.bool_]:
    """[N] which of the lines of [N, M, 3] are of one colour."""
    plain = _plainness(pixels, FEW) >= 0.9
    plain[plain] = _plainness(pixels[plain], MANY) >= PLAIN
    return plain


def _plainness(pixels: Bytes, samples: int) -> Floats:
    """[N] share of each line [N, M, 3] that has its colour, by so many of its pixels.

    The colour may change evenly along the line, as on the slides of a presentation.
    """
    step = max(1, pixels.shape[1] // samples)
    some = pixels[:, step // 2 :: step].astype(np.float32)
    half = some.shape[1] // 2
    start, end = (np.median(part, axis=1)[:, None] for part in (some[:, :half], some[:, half:]))
    along = (np.arange(some.shape[1], dtype=np.float32) + 0.5)[:, None] / some.shape[1]
    colours = np.median(some, axis=1)[:, None], start + (end - start) * (2 * along - 0.5)
    near = [np.abs(some - colour).max(-1) <= LEVELS for colour in colours]
    return np.max([each.mean(1, dtype=np.float32) for each in near], axis=0)


def _between_seams(pixels: Bytes) -> list[tuple[int, int]]:
    """(start, end) of the lines between places where the picture jumps on nearly a whole line."""
    places = np.arange(len(pixels) - 1)
    places = places[_jumps(pixels, places, FEW) >= SEAM / 2]
    places = places[_jumps(pixels, places, MANY) >= SEAM]
    pieces = [(0, len(pixels))]
    for place in places.tolist():
        start, end = pieces[-1]
        if len(pieces) > 1 and place + 1 - start <= BESIDE:  # the other edge of a narrow band
            pieces[-1] = place + 1, end
        elif min(place + 1 - start, end - place - 1) >= LEAST:
            pieces[-1:] = [(start, place + 1), (place + 1, end)]
    return pieces


def _jumps(pixels: Bytes, places: npt.NDArray[np.intp], samples: int) -> Floats:
    """[K] shares of lines of [N, M, 3] from which the picture jumps to the next line, more than it
    does nearby; by so many of their pixels."""
    some = pixels[:, :: max(1, pixels.shape[1] // samples)]

    def jump(lines: npt.NDArray[np.intp]) -> Floats:
        there = (lines >= 0) & (lines < len(some) - 1)
        first = np.where(there, lines, 0)
        one, two = (some[line].mean(-1, dtype=np.float32) for line in (first, first + there))
        return np.asarray(np.abs(two - one))

    beside = (-BESIDE - 1, -BESIDE, BESIDE, BESIDE + 1)
    usual = np.max([jump(places + aside) for aside in beside], axis=0)
    return np.asarray((jump(places) > 2 * usual + 4).mean(1), np.float32)


def _has_border(rgb: Bytes, box: Box) -> bool:
    """Is all around the box of one colour, and its rim straight? A sky is neither."""
    around = (rgb[: box.top], rgb[box.bottom :], rgb[:, : box.left], rgb[:, box.right :])
    for strip in around:
        some = strip[:: max(1, len(strip) // MANY), :: max(1, strip.shape[1] // MANY)]
        if some.size and _differing(some.reshape(-1, 3), some.reshape(-1, 3)) > OTHER:
            return False
    return min(_rim(rgb, box)) >= BORDER


def _rim(rgb: Bytes, box: Box) -> list[float]:
    """`_side` of each side of the box that the picture does not have; 1 where it has all."""
    sides = [_side(rgb, box, axis, end) for axis in (0, 1) for end in (0, 1)]
    return [share for share in sides if share is not None] or [1.0]


def _side(rgb: Bytes, box: Box, axis: int, end: int) -> float | None:
    """Share of the first (0) or last (1) line of the box across an axis that differs from the line
    outside; None where the picture ends."""
    across = slice(box.left, box.right) if axis == 0 else slice(box.top, box.bottom)
    lines = rgb[:, across] if axis == 0 else rgb[across].swapaxes(0, 1)
    inside = max(2, round(INSIDE * box.short_side))
    if end == 0:
        outside = box[axis] - 1
        line = box[axis] + inside
    else:
        outside = box[axis + 2]
        line = box[axis + 2] - 1 - inside
    if not 0 <= outside < len(lines):
        return None
    return _differing(lines[line], lines[outside])


def _differing(line: Bytes, outside: Bytes) -> float:
    colour = np.median(outside, axis=0)
    return float((np.abs(line - colour).max(-1) > LEVELS).mean())
