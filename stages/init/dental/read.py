"""The teeth that the dental path starts from."""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import replace

from pipeline.artifacts.dental.corrections import (
    CORRECTIONS,
    Corrections,
    CrownCorrection,
    Kind,
    PhotoCorrection,
    read_corrections,
)
from pipeline.artifacts.teeth import UNREAD, Teeth
from pipeline.artifacts.views import Views
from pipeline.errors import ReconstructionError, RequestError
from pipeline.stage import StageContext
from stages.dentition.corrections import LEFT_OUT, apply_corrections, photographs_of
from stages.init.place import photo_name

#: Photographs that are named one by one where one thing is said of several.
MOST_NAMED = 3


def turned_as_said(context: StageContext, views: Views) -> Views:
    """The views; those of which a person has said that they are mirror images, turned over."""
    if CORRECTIONS not in context.sources or not context.has("teeth"):
        return views
    said = {seen.name for seen in labelled_teeth(context, views).views if seen.mirrored}
    return replace(views, views=tuple(v.mirrored() if v.name in said else v for v in views.views))


def said_to_use(context: StageContext, views: Views) -> list[int]:
    """Which of the views a person wants to be used, whatever they show."""
    said = _said_of_photographs(context)
    return [k for k, view in enumerate(views.views) if view.name in said and said[view.name].use]


def said_to_show(context: StageContext, views: Views) -> dict[int, Kind]:
    """From where each of the views shows the teeth, if a person has said so."""
    said = _said_of_photographs(context)
    kinds = {k: said[view.name].kind for k, view in enumerate(views.views) if view.name in said}
    return {k: kind for k, kind in kinds.items() if kind is not None}


def _said_of_photographs(context: StageContext) -> dict[str, PhotoCorrection]:
    """View name -> what a person has said of it."""
    if CORRECTIONS not in context.sources:
        return {}
    said = read_corrections(context.sources[CORRECTIONS])
    found = photographs_of(context.load("views"), said)
    return {name: photo for name, (_, photo) in found.items()}


def without_left_out(context: StageContext, views: Views) -> Views:
    """The views but for those that a person leaves out.

    Raises:
        RequestError: not two are left.
    """
    if CORRECTIONS not in context.sources or not context.has("teeth"):
        return views
    read = labelled_teeth(context, views).views
    out = {seen.name for seen in read if seen.set_aside == LEFT_OUT}
    kept = tuple(view for view in views.views if view.name not in out)
    if len(kept) < 2:
        raise RequestError(
            f"{context.sources[CORRECTIONS]} leaves out {len(out)} of {len(views)} photographs; "
            "two are needed."
        )
    return replace(views, views=kept)


def refuse_mirrored(context: StageContext, views: Views, known: Container[str]) -> None:
    """Refuse that a photograph with a known camera is said to be a mirror image.

    Args:
        known: names of views with a camera.
    """
    turned = turned_as_said(context, views)
    said = [
        view.source_name or view.name
        for view, other in zip(views.views, turned.views, strict=True)
        if view is not other and view.name in known
    ]
    if said:
        raise RequestError(
            f"{', '.join(said)} {'is' if len(said) == 1 else 'are'} said to be mirrored, but "
            "init.cameras gives a camera for the picture as it is. Take `mirrored` out of the "
            "corrections, or leave init.cameras out."
        )


def set_aside_reasons(teeth: Teeth, views: Views) -> str:
    """Which photographs are set aside, and why, and how many were not read; empty: none."""
    names = {view.name: photo_name(view) for view in views.views}
    reasons: dict[str, list[str]] = {}
    for dentition in teeth.views:
        if dentition.set_aside:
            reasons.setdefault(dentition.set_aside, []).append(names[dentition.name])
    said = [f"{_some(those)}: {reason}" for reason, those in reasons.items()]
    if unread := sum(d.kind == UNREAD and not d.set_aside for d in teeth.views):
        said.append(f"{unread} were not read: --set teeth.method=reader reads every one")
    return "; ".join(said)


def _some(names: Sequence[str]) -> str:
    """Names for a sentence: frames of a film are many."""
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return ", ".join(names[:MOST_NAMED]) + more


def teeth_to_place_by(context: StageContext, views: Views) -> Teeth:
    """As `labelled_teeth`, where nothing can be done without teeth.

    Raises:
        ReconstructionError: no photograph was read.
    """
    teeth = labelled_teeth(context, views)
    if all(seen.kind == UNREAD for seen in teeth.views):
        raise ReconstructionError(
            "None of these photographs was read: teeth.method=none reads none, auto none where it "
            "sees hardly any teeth at a first look. --set teeth.method=reader reads every one."
        )
    return teeth


def labelled_teeth(context: StageContext, views: Views) -> Teeth:
    """The teeth that were read from the photographs, with what a person has said of them.

    Args:
        views: the photographs, or some of them.

    Raises:
        RequestError: the stage `teeth` has not run, or what was said fits no crown.
    """
    if not context.has("teeth"):
        raise RequestError(
            "The teeth of these photographs have not been read. Name the stage `teeth` before "
            "`init`, as in --stages teeth,init."
        )
    read: Teeth = context.load("teeth")
    corrections = []
    if CORRECTIONS in context.sources:
        corrections.append(read_corrections(context.sources[CORRECTIONS]))
    said = context.config.dental.labels
    if not isinstance(said, str) and said:
        photographs: dict[str, PhotoCorrection] = {}
        for hint in said:
            before = photographs.get(hint.photo, PhotoCorrection())
            crown = CrownCorrection((hint.x, hint.y), hint.tooth)
            photographs[hint.photo] = replace(before, crowns=(*before.crowns, crown))
        corrections.append(Corrections(photographs, "init.dental.labels"))
    if corrections and len(views) < len(read.views):  # what is said may be of the others
        views = context.load("views")
    for each in corrections:
        read = apply_corrections(read, views, each)
    return read
