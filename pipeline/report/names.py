"""What views and pictures are called on a page."""

from __future__ import annotations

from collections.abc import Mapping

from pipeline.report.case import Case


def labels_of(case: Case) -> dict[str, str]:
    """View name -> ``000 · frontal.jpg``."""
    found = {}
    for kind in ("views", "held_out"):
        artifact = case.latest(kind)
        for view in artifact.views if artifact else ():
            found[view.name] = (
                f"{view.name} · {view.source_name}" if view.source_name else view.name
            )
    return found


def title_of(stem: str, labels: Mapping[str, str]) -> str:
    """The name of a picture with the names of the views in it made readable."""
    words = [labels.get(word, word) for word in stem.split("_")]
    return " ".join(words[:2]) + "".join(f" — {word}" for word in words[2:])
