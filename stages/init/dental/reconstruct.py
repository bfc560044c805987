"""The dental path from end to end: photographs of teeth in, cameras and one surface out."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.dental.corrections import Kind
from pipeline.artifacts.dental.fdi import JAWS, Jaw
from pipeline.artifacts.teeth import Crown, Dentition, Teeth
from pipeline.artifacts.views import View
from pipeline.errors import ReconstructionError
from stages.dentition.crowns import mirrored_dentition
from stages.dentition.overlay import labelled_overlay, sheet
from stages.dentition.parts import joined_parts
from stages.dentition.tooth_rows import number_is_said
from stages.dentition.working import resized_dentition, working_scale, working_view
from stages.init.dental.mirror_images import Turned, fit_turned
from stages.init.dental.numbering.arch import fit_arch
from stages.init.dental.numbering.arch_options import ArchOptions
from stages.init.dental.odd_ones import SeveralMouthsError, without_odd_ones
from stages.init.dental.solution import ArchFit, PlacedView
from stages.init.dental.surface.beyond import without_guesses_beyond
from stages.init.dental.surface.dense import ArchSurface, dense_surface
from stages.init.dental.surface.options import SurfaceOptions
from stages.init.dental.surface.photos.photo import FullSize
from stages.init.dental.turned_sheet import turned_sheet
from stages.photographs.copies import turned_copies

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Picture = npt.NDArray[np.uint8]
Progress = Callable[[str, int, int], None]

HOW_TO_SHOOT_TEETH = (
    "Take one photograph from the front and one from each side, 30 to 45 degrees apart, with the "
    "lips drawn back so that the gum line of all teeth shows, all sharp and at the same zoom; or a "
    "short film or more photographs, no more than 20 degrees apart."
)


#: Role of a photograph -> what a person calls it.
FROM: Mapping[str, Kind] = {"right": "right", "frontal": "front", "left": "left"}
NOTHING_SAID: Mapping[int, Kind] = {}


@dataclass(frozen=True)
class Reconstruction:
    """What `reconstruct_teeth` found.

    Attributes:
        views: the photographs, mirror images among them turned back.
        dentitions: the teeth in each with their numbers; None where none are used.
        fit: cameras and named landmarks, in pixels of `views`.
        surface: dense depth of each placed view, and one cloud.
        turned: the surface from three sides, in colour and as it is shaped.
        mirrored, left_out, reasons: as of `Turned`.
    """

    views: list[View]
    dentitions: list[Dentition | None]
    fit: ArchFit
    surface: ArchSurface
    turned: Picture
    mirrored: tuple[int, ...] = ()
    left_out: tuple[int, ...] = ()
    reasons: tuple[str, ...] = ()

    @property
    def labelled(self) -> dict[str, Picture]:
        """View name -> the photograph with the numbers of its teeth, drawn when asked for."""
        return overlays(self.views, self.dentitions)


@dataclass(frozen=True)
class PlacedTeeth:
    """Numbered teeth before their cameras.

    Attributes:
        views, dentitions, fit: as of `Reconstruction`.
        small: all that at the size that was worked at.
        full: the photographs as they are, for depths and colours.
    """

    views: list[View]
    dentitions: list[Dentition | None]
    fit: ArchFit
    small: Turned
    full: list[FullSize | None]

    @property
    def labelled(self) -> dict[str, Picture]:
        """View name -> the photograph with the numbers of its teeth, drawn when asked for."""
        return overlays(self.views, self.dentitions)


def reconstruct_teeth(
    views: list[View], names: list[str], dentitions: list[Dentition | None],
    focals: list[float | None], arch: ArchOptions, surface: SurfaceOptions, *,
    accept_doubtful: bool, threads: int, progress: Progress, kept: Collection[int] = (),
    said: Mapping[int, Kind] = NOTHING_SAID,
) -> Reconstruction:  # fmt: skip
    """Say which tooth is which, place the cameras, and make the surface.

    All of this sees the photographs at one size, so that theirs decides nothing; depths and colours
    are those of the photographs as they are.

    Args:
        views: photographs of one patient's teeth, in any order.
        names: how the user knows them.
        dentitions: the crowns of each; None: it takes no part.
        focals: focal lengths in pixels where known.
        accept_doubtful: go on although `ArchFit.doubts` says not to, if two views are placed.
        kept: photographs that are not left out, whatever they show.
        said: from where some show the teeth, as a person says.

    Raises:
        ReconstructionError: no teeth, or the result is doubtful; pictures with the labels come
            with it, and the teeth with their numbers, so that the user can put them right.
    """
    teeth = place_teeth(
        views, names, dentitions, focals, arch, accept_doubtful=accept_doubtful, threads=threads,
        progress=progress, kept=kept, said=said,
    )  # fmt: skip
    return with_surface(teeth, surface, threads, progress)


def place_teeth(
    views: list[View], names: list[str], dentitions: list[Dentition | None],
    focals: list[float | None], arch: ArchOptions, *, accept_doubtful: bool, threads: int,
    progress: Progress, cameras: list[Array] | None = None, scales: list[float] | None = None,
    kept: Collection[int] = (), said: Mapping[int, Kind] = NOTHING_SAID,
) -> PlacedTeeth:  # fmt: skip
    """Say which tooth is which, and place the cameras; arguments as for `reconstruct_teeth`.

    Args:
        cameras: [4, 4] cam_from_world of each where the cameras are known (`fit_arch`).
        scales: by how much each is reduced; None: `working_scale`.

    Raises:
        ReconstructionError: no teeth, or the result is doubtful.
    """
    found = sum(dentition is not None for dentition in dentitions)
    if found < 2:
        raise ReconstructionError(
            f"Rows of closed teeth, seen from the front or a side, were made out in {found} of "
            f"{len(views)} photographs; two are needed, better three. {HOW_TO_SHOOT_TEETH}",
            evidence(overlays(views, dentitions)),
            {"teeth": Teeth(tuple(d for d in dentitions if d is not None))} if found else {},
        )

    scales = scales or [working_scale(view.width, view.height) for view in views]
    small = [working_view(view, scale) for view, scale in zip(views, scales, strict=True)]
    read = [_resized(d, view) for d, view in zip(dentitions, small, strict=True)]
    shrunk = [focal and focal * s for focal, s in zip(focals, scales, strict=True)]

    copies = turned_copies({k: small[k].image for k, d in enumerate(read) if d is not None})

    def placed_by(views: list[View], dentitions: list[Dentition | None]) -> ArchFit:
        images, valid = [view.image for view in views], [view.valid() for view in views]
        fit = fit_arch(dentitions, images, valid, shrunk, arch, threads, progress, names, cameras)
        both = [pair for pair in copies if all(dentitions[k] is not None for k in pair)]
        return fit.doubted(
            [
                *(
                    f"{names[a]} and {names[b]} are one picture, one of them turned over: leave "
                    "out the one that shows the patient's right and left the wrong way round"
                    for a, b in both
                ),
                *seen_from_elsewhere(fit, names, said),
            ]
        )

    if cameras is None:
        turned = fit_turned(small, read, names, placed_by)
        if turned.fit.doubts and arch.order is None and not accept_doubtful:
            turned = without_odd_ones(turned, placed_by, kept)
    else:
        turned = Turned(small, read, placed_by(small, read))
    views = [v.mirrored() if k in turned.mirrored else v for k, v in enumerate(views)]
    dentitions = [
        mirrored_dentition(d) if d and k in turned.mirrored else d for k, d in enumerate(dentitions)
    ]
    dentitions = [None if k in turned.left_out else d for k, d in enumerate(dentitions)]
    turned, dentitions = with_whole_crowns(turned, dentitions)
    fit = turned.fit.enlarged([1 / scale for scale in scales])
    numbered = [
        None if dentition is None else with_numbers(dentition, placed, fit)
        for dentition, placed in zip(dentitions, fit.views, strict=True)
    ]
    placed = sum(view is not None for view in fit.views)
    if placed < 2 or (fit.doubts and not accept_doubtful):
        pictures = evidence(overlays(views, numbered))
        read_so_far = {"teeth": Teeth(tuple(d for d in numbered if d is not None))}
        if turned.mouths:
            raise SeveralMouthsError(several_mouths(turned.mouths, names), pictures, read_so_far)
        raise ReconstructionError(doubtful(fit, names, found), pictures, read_so_far)
    full = [
        FullSize(view.image, view.valid(), d.mask, d.above) if d else None
        for view, d in zip(views, numbered, strict=True)
    ]
    return PlacedTeeth(views, numbered, fit, turned, full)


def doubtful(fit: ArchFit, names: Sequence[str], found: int) -> str:
    """Why a fit of so many photographs is not gone on with, and what to do."""
    shown = " ".join(as_sentence(doubt, names) for doubt in fit.doubts)
    enough = " The front and one side are enough if the third does not belong." * (found == 3)
    return (
        f"The teeth were found, but the result would not be safe to look at. {shown} Check the "
        "numbers in the labelled photographs; a wrong one can be put right, and a photograph left "
        f"out, on the page check.html.{enough} {HOW_TO_SHOOT_TEETH} If you know better, go on all "
        "the same: --set init.dental.accept_doubtful=true."
    )


def several_mouths(mouths: Sequence[Sequence[int]], names: Sequence[str]) -> str:
    """What to say of photographs that are of two mouths, of which one at least was made out."""
    one, *other = (", ".join(names[k] for k in mouth) for mouth in mouths)
    if other:
        told = (
            f"These photographs are of two patients, or of two visits: {one} fit each other, and "
            f"so do {other[0]}, but not the ones the others."
        )
    else:
        told = (
            f"Of these photographs half fit each other, {one}, and none of the others fits them: "
            "these may be of another patient or visit."
        )
    return (
        f"{told} Give each mouth a folder of its own, or leave out those that do not belong on the "
        "page check.html."
    )


def seen_from_elsewhere(fit: ArchFit, names: Sequence[str], said: Mapping[int, Kind]) -> list[str]:
    """A doubt for each photograph whose teeth are seen from another side than a person says."""
    doubts = []
    for k, kind in said.items():
        placed = fit.views[k]
        shown = FROM.get(placed.role) if placed else None
        if shown is not None and shown != kind:
            doubts.append(
                f"{names[k]} is said to show the teeth from the {kind}, but by its teeth it shows "
                f"them from the {shown}: one of the two is wrong, or it is a mirror image"
            )
    return doubts


def as_sentence(doubt: str, names: Sequence[str]) -> str:
    """A doubt as a sentence; the name of a photograph that it begins with stays as it is."""
    begin = doubt[0] if doubt.startswith(tuple(names)) else doubt[0].upper()
    return f"{begin}{doubt[1:].rstrip('.')}."


def with_whole_crowns(
    turned: Turned, dentitions: list[Dentition | None]
) -> tuple[Turned, list[Dentition | None]]:
    """Crowns of which the fit says that they are parts of one, as one.

    Args:
        turned: the fit, its photographs at the size that was worked at.
        dentitions: of the photographs as they are.
    """

    def joined(read: list[Dentition | None]) -> list[Dentition | None]:
        return [
            joined_parts(d, (placed.upper, placed.lower)) if d and placed else d
            for d, placed in zip(read, turned.fit.views, strict=True)
        ]

    fit = replace(turned.fit, views=tuple(v and v.with_whole_crowns() for v in turned.fit.views))
    return replace(turned, dentitions=joined(turned.dentitions), fit=fit), joined(dentitions)


def with_surface(
    teeth: PlacedTeeth, surface: SurfaceOptions, threads: int, progress: Progress,
    jaws: Sequence[Mask | None] | None = None,
) -> Reconstruction:  # fmt: skip
    """The teeth with their dense surface.

    Args:
        jaws: where each photograph [H, W] shows tooth or gum, if its dentition is without that;
            what is only guessed beyond is left out.
    """
    small = teeth.small
    dense = dense_surface(
        [view.image for view in small.views], [view.valid() for view in small.views],
        small.dentitions, small.fit, surface, threads, progress, teeth.full,
    )  # fmt: skip
    if jaws is not None:
        dense = without_guesses_beyond(dense, teeth.fit, jaws)
    return Reconstruction(
        teeth.views, teeth.dentitions, teeth.fit, dense, turned_sheet(dense), small.mirrored,
        small.left_out, small.reasons,
    )  # fmt: skip


def _resized(dentition: Dentition | None, view: View) -> Dentition | None:
    """The dentition in pixels of the photograph at another size."""
    return dentition and resized_dentition(dentition, (view.width, view.height))


def with_numbers(dentition: Dentition, placed: PlacedView | None, fit: ArchFit) -> Dentition:
    """The dentition with the numbers that all photographs together give its crowns, but for those
    that a person has said."""
    if placed is None:
        return dentition
    rows: dict[Jaw, tuple[Crown, ...]] = {}
    for jaw, doubts in zip(JAWS, (placed.upper_doubts, placed.lower_doubts), strict=True):
        rows[jaw] = tuple(
            crown if number_is_said(crown)
            else replace(crown, number=fit.number_of(tooth), doubt=doubt)
            for crown, tooth, doubt in zip(
                dentition.crowns(jaw), placed.teeth(jaw), doubts, strict=True
            )
        )  # fmt: skip
    return replace(dentition, upper=rows["upper"], lower=rows["lower"])


def overlays(views: list[View], dentitions: list[Dentition | None]) -> dict[str, Picture]:
    """View name -> the photograph with the outlines and numbers of its teeth, if it has some."""
    return {
        view.name: labelled_overlay(view.image, dentition)
        for view, dentition in zip(views, dentitions, strict=True)
        if dentition is not None
    }


def evidence(pictures: Mapping[str, Picture]) -> dict[str, Picture]:
    """What is kept of labelled photographs when a run fails: each, and all beside each other."""
    if not pictures:
        return {}
    named = {f"teeth_{name}": picture for name, picture in pictures.items()}
    return {"teeth": sheet(list(pictures.values())), **named}
