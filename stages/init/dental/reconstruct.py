"""The dental path from end to end: photographs of teeth in, cameras and one surface out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.views import View
from pipeline.errors import ReconstructionError
from stages.init.dental.numbering.arch import fit_arch
from stages.init.dental.numbering.arch_options import ArchOptions
from stages.init.dental.observation import Dentition
from stages.init.dental.photo import PhotoOptions, read_dentitions
from stages.init.dental.pictures.overlay import labelled_overlay, sheet
from stages.init.dental.pictures.turned import turned_sheet
from stages.init.dental.solution import ArchFit
from stages.init.dental.surface.dense import ArchSurface, dense_surface
from stages.init.dental.surface.options import SurfaceOptions

Array = npt.NDArray[np.float64]
Picture = npt.NDArray[np.uint8]
Progress = Callable[[str, int, int], None]

HOW_TO_SHOOT_TEETH = (
    "Take one photograph from the front and one from each side, 30 to 45 degrees apart, with the "
    "lips drawn back so that the gum line of all teeth shows, all sharp and at the same zoom; or a "
    "short film or more photographs, no more than 20 degrees apart."
)


@dataclass(frozen=True)
class Teeth:
    """What `reconstruct_teeth` found.

    Attributes:
        dentitions: the teeth in each photograph; None where none were found.
        fit: cameras and named landmarks.
        surface: dense depth of each placed view, and one cloud.
        pictures: for people to check: the labelled photographs, the cloud turned.
    """

    dentitions: list[Dentition | None]
    fit: ArchFit
    surface: ArchSurface
    pictures: Mapping[str, Picture] = field(default_factory=dict)


def reconstruct_teeth(
    views: list[View], names: list[str], focals: list[float | None], photo: PhotoOptions,
    arch: ArchOptions, surface: SurfaceOptions, *, accept_doubtful: bool, seed: int, threads: int,
    progress: Progress, cameras: list[Array] | None = None,
) -> Teeth:  # fmt: skip
    """Find the teeth, say which is which, place the cameras, and make the surface.

    Args:
        views: three or more photographs of one patient's teeth, in any order.
        names: how the user knows them.
        focals: focal lengths in pixels where known.
        accept_doubtful: go on although `ArchFit.doubts` says not to, if two views are placed.
        cameras: [4, 4] cam_from_world of each where the cameras are known (`fit_arch`).

    Raises:
        ReconstructionError: no teeth, or the result is doubtful; pictures with the labels come
            with it, so that the user sees what was taken for what.
    """
    images = [view.image for view in views]
    valid = [view.valid() for view in views]
    progress("find teeth", 0, len(views))
    dentitions = read_dentitions(images, valid, photo, threads)
    progress("find teeth", len(views), len(views))
    found = sum(dentition is not None for dentition in dentitions)
    if found < 2:
        raise ReconstructionError(
            f"Teeth could be made out in {found} of {len(views)} photographs; three are needed. "
            f"{HOW_TO_SHOOT_TEETH}"
        )
    fit = fit_arch(dentitions, images, valid, focals, arch, seed, threads, progress, names, cameras)
    pictures = labelled(views, dentitions, fit)
    placed = sum(view is not None for view in fit.views)
    if placed < 2 or (fit.doubts and not accept_doubtful):
        shown = [f"{doubt[0].upper()}{doubt[1:].rstrip('.')}." for doubt in fit.doubts]
        raise ReconstructionError(
            f"The teeth were found, but the result would not be safe to look at. {' '.join(shown)} "
            "Check the labelled photographs; a wrong or missing number can be put right with "
            "--set init.dental.labels and the order of the photographs with --set "
            f"init.dental.order. {HOW_TO_SHOOT_TEETH}",
            pictures,
        )
    dense = dense_surface(images, valid, dentitions, fit, surface, threads, progress)
    return Teeth(dentitions, fit, dense, {**pictures, "turned": turned_sheet(dense)})


def labelled(
    views: list[View], dentitions: list[Dentition | None], fit: ArchFit
) -> dict[str, Picture]:
    """Name -> picture: each photograph with the numbers of its teeth, and all beside each other."""
    pictures = {}
    for view, dentition, placed in zip(views, dentitions, fit.views, strict=True):
        if dentition is not None:
            upper = placed.upper if placed else (0,) * len(dentition.upper)
            lower = placed.lower if placed else (0,) * len(dentition.lower)
            pictures[f"teeth_{view.name}"] = labelled_overlay(view.image, dentition, upper, lower)
    return {"teeth": sheet(list(pictures.values())), **pictures}
