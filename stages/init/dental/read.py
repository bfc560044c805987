"""The teeth that the dental path starts from."""

from __future__ import annotations

from dataclasses import replace

from pipeline.artifacts.dental.corrections import (
    CORRECTIONS,
    Corrections,
    CrownCorrection,
    PhotoCorrection,
    read_corrections,
)
from pipeline.artifacts.teeth import Teeth
from pipeline.artifacts.views import Views
from pipeline.errors import RequestError
from pipeline.stage import StageContext
from stages.dentition.corrections import apply_corrections


def labelled_teeth(context: StageContext, views: Views) -> Teeth:
    """The teeth that were read from the photographs, with what a person has said of them.

    Raises:
        RequestError: the stage `teeth` has not run, or what was said fits no crown.
    """
    if not context.has("teeth"):
        raise RequestError(
            "The teeth of these photographs have not been read. Name the stage `teeth` before "
            "`init`, as in --stages teeth,init."
        )
    read: Teeth = context.load("teeth")
    for label, path in context.sources.items():
        if label == CORRECTIONS:
            read = apply_corrections(read, views, read_corrections(path))
    said = context.config.dental.labels
    if not isinstance(said, str) and said:
        photographs: dict[str, PhotoCorrection] = {}
        for hint in said:
            before = photographs.get(hint.photo, PhotoCorrection())
            crown = CrownCorrection((hint.x, hint.y), hint.tooth)
            photographs[hint.photo] = replace(before, crowns=(*before.crowns, crown))
        read = apply_corrections(read, views, Corrections(photographs, "init.dental.labels"))
    return read
