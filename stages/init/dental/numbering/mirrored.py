"""Is a photograph of the front a mirror image?

Its teeth then stand on the other side of the midline. No mouth is quite symmetric: widths, gaps and
places of the teeth fit the side views' better one way than the other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from pipeline.artifacts.teeth import Dentition
from stages.dentition.crowns import mirrored_dentition
from stages.dentition.tooth_rows import NO_TOOTH, POSITIONS
from stages.init.dental.numbering.labellings.scorer import (
    Labelling,
    Scored,
    Scorer,
    ViewLabels,
)
from stages.init.dental.numbering.sightings import seen_rows

#: Twice the log Bayes factor above which a photograph is called a mirror image (some per cent of
#: photographs are), and above which it may be one. Of the most symmetric of twelve patients it is
#: -1.8 to -7.1 as the photographs were taken and in seven altered versions, of the others -13 and
#: less; of that patient's mirror image 4; of a mirror image with wrong numbers it was -.7.
MIRRORED, PERHAPS_MIRRORED = 8.0, -1.0


def mirror_evidence(
    scorer: Scorer, best: Scored, dentitions: Sequence[Dentition]
) -> dict[int, float]:
    """Twice the log Bayes factor, for each photograph from the front, that it is a mirror image.

    Args:
        scorer, best: a labelling of all photographs.
        dentitions: their crowns.

    Returns:
        Number of the view in the labelling -> factor.
    """
    labelling = best.labelling
    fronts = [number for number, role in enumerate(labelling.roles) if role == "frontal"]
    if scorer.held is not None or len(fronts) == len(labelling.views):
        return {}
    result = {}
    for number in fronts:
        view = labelling.views[number]
        # Beside the others from the front, which may be mirror images too, it would look like one.
        kept = [k for k in range(len(labelling.views)) if k == number or k not in fronts]
        labels = dict(enumerate(labelling.labels))
        straight = _chosen(labelling, kept, labels)
        turned = _chosen(labelling, kept, labels | {number: mirrored_labels(labels[number])})
        rows = list(scorer.rows)
        # all numbers turn, so that the same crowns may be parts of one
        rows[view] = seen_rows(mirrored_dentition(dentitions[view], said_too=True))
        other = Scorer(
            rows, scorer.focals, scorer.focal_deviations, scorer.options, scorer.threads,
            None, scorer.primary,
        )  # fmt: skip
        result[number] = (
            scorer.solve(straight).adjusted.evidence - other.solve(turned).adjusted.evidence
        )
    return result


def _chosen(labelling: Labelling, kept: list[int], labels: Mapping[int, ViewLabels]) -> Labelling:
    """The labelling of some of its views, with these labels."""
    return replace(
        labelling,
        views=tuple(labelling.views[k] for k in kept),
        roles=tuple(labelling.roles[k] for k in kept),
        labels=tuple(labels[k] for k in kept),
    )


def mirrored_labels(labels: ViewLabels) -> ViewLabels:
    """The labels that the same crowns have in the picture turned over."""
    upper, lower = (
        tuple(label if label == NO_TOOTH else POSITIONS - 1 - label for label in reversed(row))
        for row in labels
    )
    return upper, lower
