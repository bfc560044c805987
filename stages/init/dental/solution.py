"""Cameras and named teeth, found from the crowns in the photographs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.artifacts.dental.fdi import Jaw, primary_of
from stages.init.dental.landmarks import Landmark

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class PlacedView:
    """One photograph, placed.

    Attributes:
        cam_from_world: [4, 4] float64; the world is the arch frame in millimetres: x to the
            patient's left, y up, z towards a camera in front; the origin between the upper central
            incisors' biting edges.
        focal: pixels of the working image; the principal point is its centre.
        role: `right`, `frontal`, `left` (buccal), or `between`.
        upper, lower: FDI number of each crown of the `Dentition`, in its order, that of the
            permanent tooth in its place; 0 where a crown is taken for no tooth (a bracket, a glove,
            a split outline).
        upper_doubts, lower_doubts: 0..1 of each, that the number is another one.
        error: median reprojection error of the landmarks in pixels.
    """

    cam_from_world: Array
    focal: float
    role: str
    upper: tuple[int, ...]
    lower: tuple[int, ...]
    error: float
    upper_doubts: tuple[float, ...] = ()
    lower_doubts: tuple[float, ...] = ()

    def camera(self, name: str, width: int, height: int) -> Camera:
        """Its camera, for the working image of that many pixels."""
        return Camera(
            name, width, height, self.focal, self.focal, width / 2, height / 2, self.cam_from_world
        )

    def teeth(self, jaw: Jaw) -> tuple[int, ...]:
        """FDI numbers of the crowns of one jaw."""
        return self.upper if jaw == "upper" else self.lower

    def with_whole_crowns(self) -> PlacedView:
        """The same with one crown for neighbours that have the same number."""
        upper, upper_doubts = _whole(self.upper, self.upper_doubts)
        lower, lower_doubts = _whole(self.lower, self.lower_doubts)
        return replace(
            self, upper=upper, lower=lower, upper_doubts=upper_doubts, lower_doubts=lower_doubts
        )


def _whole(
    row: tuple[int, ...], doubts: tuple[float, ...]
) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Numbers and doubts of a row, equal neighbours once and as sure as the surer one."""
    kept: list[tuple[int, float]] = []
    for tooth, doubt in zip(row, doubts, strict=True):
        if kept and tooth == kept[-1][0] != 0:
            doubt = min(doubt, kept.pop()[1])
        kept.append((tooth, doubt))
    return tuple(tooth for tooth, _ in kept), tuple(doubt for _, doubt in kept)


@dataclass(frozen=True)
class ArchFit:
    """The outcome of `fit_arch`.

    Attributes:
        views: one per photograph, in the order given; None where it could not be placed.
        landmarks: seen landmarks -> [3] position in mm (arch frame).
        shape: every landmark of the arch model, seen or not -> [3] position in mm, after fitting.
        margin: by how much the labelling chosen is better than the next one that matches the
            photographs to each other otherwise (twice the log evidence).
        doubts: sentences for the user why the result should not be trusted; empty: trust it.
        figures: what the doubts rest on.
        confidence: 0..1, how far the numbers and the cameras can be trusted; doubts say why not
            where it is below .5.
        primary: permanent numbers in whose place primary teeth stand.
        mirrored: photographs from the front that are mirror images if those of the sides are none.
    """

    views: tuple[PlacedView | None, ...]
    landmarks: dict[Landmark, Array]
    shape: dict[Landmark, Array]
    margin: float
    doubts: tuple[str, ...] = ()
    figures: dict[str, float] = field(default_factory=dict)
    primary: frozenset[int] = frozenset()
    confidence: float = 0.0
    mirrored: tuple[int, ...] = ()

    def number_of(self, tooth: int) -> int:
        """FDI number of the tooth that stands in the place of a permanent one; 0 for 0."""
        return primary_of(tooth) if tooth in self.primary else tooth

    def doubted(self, doubts: Iterable[str]) -> ArchFit:
        """The same with more doubts about it."""
        return replace(self, doubts=(*self.doubts, *doubts))

    def enlarged(self, factors: Sequence[float]) -> ArchFit:
        """The same for photographs so many times as large."""
        views = (
            view and replace(view, focal=view.focal * factor, error=view.error * factor)
            for view, factor in zip(self.views, factors, strict=True)
        )
        return replace(self, views=tuple(views))
