"""Which crowns of placed photographs are the same tooth, by the surface that they show.

The pixels of a crown are carried into the other photographs by their depth. Where most of two
crowns fall onto each other, they are probably one tooth; where both photographs show both places
and they do not, they are two. What all pairs say together is settled by correlation clustering
(Bansal, Blum and Chawla 2004), contracting the strongest edge first (Keuper et al., ICCV 2015:
greedy additive edge contraction).
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.teeth import Dentition
from pipeline.artifacts.views import View
from stages.dentition.working import labels_in_view

Array = npt.NDArray[np.float64]
Map = npt.NDArray[np.float32]

#: Samples along the longer side of a photograph: a lower incisor from the front is four wide.
SAMPLES = 160
#: Two depths are of one place if they differ by less than this share: .02 of 12 cm are 2.4 mm,
#: less than half a tooth, more than dense stereo is off by on wet enamel.
SAME_DEPTH = 0.02
#: A photograph says nothing of a crown of which it shows fewer samples than this, or less than this
#: share of those that there are.
LEAST_SAMPLES, LEAST_SHOWN = 6, 0.3
#: Crowns that cover each other by more than this (geometric mean of both shares) are rather one
#: tooth. Neighbours share some pixels at their border, halves of a crown and the whole have .7.
SAME_OVERLAP = 0.45
#: What it counts, as such a share, that crowns surely look like the same place in the row; half of
#: it speaks against one tooth where they surely do not. Depth may be off by a tooth; so may looks.
LOOKS = 0.8
#: Crowns of one photograph are two teeth, or parts of one: this speaks against one.
APART = -2.0


@dataclass(frozen=True)
class Sighting:
    """One crown in one placed photograph.

    Attributes:
        view: index of the photograph among the placed ones.
        index: of the crown among `Dentition.all_crowns`.
        centre: [3] median of its surface, in the world.
    """

    view: int
    index: int
    centre: Array


@dataclass(frozen=True)
class Overlaps:
    """How crowns cover each other in the photographs.

    Attributes:
        sightings: the crowns whose depth is known.
        shown: [N, V] share of a crown's samples that another photograph shows.
        onto: {(i, j): share}, of the samples of crown i that the photograph of crown j shows, those
            that lie in crown j.
    """

    sightings: list[Sighting]
    shown: Array
    onto: dict[tuple[int, int], float]

    def place(self, sighting: int) -> tuple[int, int]:
        """Index of the photograph, and of the crown in it."""
        return self.sightings[sighting].view, self.sightings[sighting].index


def crown_overlaps(
    views: Sequence[View], dentitions: Sequence[Dentition | None], cameras: Sequence[Camera],
    depths: Sequence[Map],
) -> Overlaps:  # fmt: skip
    """Carry the crowns of each photograph into every other one.

    Args:
        views: the placed photographs.
        dentitions: of each; None where it takes no part.
        cameras, depths: of each, with z-depth [H, W], 0 where unknown.
    """
    maps = [
        np.zeros(depth.shape, np.int32)
        if dentition is None
        else labels_in_view(dentition, view, range(1, len(dentition.all_crowns) + 1))
        for view, dentition, depth in zip(views, dentitions, depths, strict=True)
    ]
    sightings: list[Sighting] = []
    surfaces: list[Array] = []
    for v, (camera, depth, crowns) in enumerate(zip(cameras, depths, maps, strict=True)):
        for index, surface in _surfaces(camera, depth, crowns):
            sightings.append(Sighting(v, index, np.median(surface, axis=0)))
            surfaces.append(surface)
    count = len(sightings)
    sizes = np.array([len(surface) for surface in surfaces], np.int64)
    owner = np.repeat(np.arange(count), sizes)
    points = np.concatenate(surfaces) if surfaces else np.zeros((0, 3))
    shown = np.zeros((count, len(views)))
    onto: dict[tuple[int, int], float] = {}
    for w, (camera, depth, crowns) in enumerate(zip(cameras, depths, maps, strict=True)):
        seen, label = _carried(points, camera, depth, crowns)
        samples = np.bincount(owner[seen], minlength=count)
        enough = (samples >= LEAST_SAMPLES) & (samples >= LEAST_SHOWN * sizes)
        shown[:, w] = np.where(enough, samples / np.maximum(sizes, 1), 0.0)
        for j, sighting in enumerate(sightings):
            if sighting.view == w:
                shown[j, w] = 0.0
                hits = np.bincount(owner[seen & (label == sighting.index + 1)], minlength=count)
                for i in np.flatnonzero(hits):
                    if sightings[i].view != w:
                        onto[int(i), j] = float(hits[i] / samples[i])
    return Overlaps(sightings, shown, onto)


def _surfaces(
    camera: Camera, depth: Map, crowns: npt.NDArray[np.int32]
) -> Iterator[tuple[int, Array]]:
    """Index of each crown in one photograph, with [N, 3] samples of its surface in the world."""
    step = max(1, max(depth.shape) // SAMPLES)
    rows, columns = (a * step + step // 2 for a in np.indices([n // step for n in depth.shape]))
    label, z = crowns[rows, columns], np.asarray(depth, np.float64)[rows, columns]
    used = (label > 0) & (z > 0)
    label, z = label[used], z[used]
    x = (columns[used] + 0.5 - camera.cx) / camera.fx
    y = (rows[used] + 0.5 - camera.cy) / camera.fy
    local = np.column_stack([x, y, np.ones(len(z))]) * z[:, None]
    world = (local - camera.translation) @ camera.rotation
    for crown in np.unique(label):
        surface = world[label == crown]
        if len(surface) >= LEAST_SAMPLES:
            yield int(crown) - 1, surface


def _carried(
    points: Array, camera: Camera, depth: Map, crowns: npt.NDArray[np.int32]
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.int32]]:
    """[N] which points a photograph shows, and 1 + the index of the crown there, 0: none."""
    pixels, z = camera.project(points)
    column, row = np.floor(pixels).astype(int).T
    height, width = depth.shape
    inside = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    there = np.where(inside, depth[row * inside, column * inside], 0.0)
    seen = inside & (np.abs(there - z) < SAME_DEPTH * z)
    return seen, crowns[row * seen, column * seen]


def same_teeth(overlaps: Overlaps, rows: Sequence[int], looks: Sequence[Array]) -> list[list[int]]:
    """Sightings of the same tooth together, largest group first.

    Args:
        overlaps: of the crowns.
        rows: of each sighting, its jaw: those of two jaws are never one tooth.
        looks: of each, [14] probabilities of the places in its row by its looks.
    """
    alike = looking_alike(looks)
    sightings, count = overlaps.sightings, len(overlaps.sightings)
    edges: list[dict[int, float]] = [{} for _ in range(count)]
    for i in range(count):
        for j in range(i + 1, count):
            if rows[i] != rows[j]:
                continue
            if sightings[i].view == sightings[j].view:
                weight = APART
            else:
                there, back = (
                    overlaps.shown[i, sightings[j].view],
                    overlaps.shown[j, sightings[i].view],
                )
                if min(there, back) <= 0:
                    continue
                share = overlaps.onto.get((i, j), 0.0) * overlaps.onto.get((j, i), 0.0)
                weight = (np.sqrt(share) - SAME_OVERLAP + alike[i, j]) * min(there, back)
            edges[i][j] = edges[j][i] = float(weight)
    return _contracted(edges)


def looking_alike(looks: Sequence[Array]) -> Array:
    """[N, N] what looks say for crowns being one tooth, against it below 0, as shares of overlap.

    Args:
        looks: as of `same_teeth`.
    """
    places = np.array(looks).reshape(len(looks), -1)
    return np.asarray(LOOKS * (np.sqrt(places @ places.T) - 0.5))


def _contracted(edges: list[dict[int, float]]) -> list[list[int]]:
    """Groups of nodes: again and again, the edge that speaks most for one tooth is contracted."""
    groups = {k: [k] for k in range(len(edges))}
    queue = [(-w, i, j) for i, mine in enumerate(edges) for j, w in mine.items() if i < j and w > 0]
    heapq.heapify(queue)
    while queue:
        weight, i, j = heapq.heappop(queue)
        if i not in groups or j not in groups or edges[i].get(j) != -weight:
            continue  # of before one of its ends grew
        if len(edges[i]) < len(edges[j]):
            i, j = j, i
        groups[i] += groups.pop(j)
        del edges[i][j]
        for k, w in edges[j].items():
            if k == i:
                continue
            del edges[k][j]
            edges[i][k] = edges[k][i] = edges[i].get(k, 0.0) + w
            if edges[i][k] > 0:
                heapq.heappush(queue, (-edges[i][k], min(i, k), max(i, k)))
        edges[j] = {}
    return sorted((sorted(group) for group in groups.values()), key=lambda g: (-len(g), g))
