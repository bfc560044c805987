"""Contact sheets and the curve of accepted against wrong, for `triads.py`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from triads_data import SERIES
from triads_run import Outcome

from stages.dentition.overlay import sheet

Picture = npt.NDArray[np.uint8]
#: Widths of a row of a sheet, pixels: of photographs of cases, of series, of turned scenes.
WIDTH = 1500
CAPTION = 26
#: Pages of more rows than this become several files.
MOST_ROWS = 12


def overlay_row(outcome: Outcome, sort: str) -> Picture | None:
    """The labelled pictures of an item side by side; of a series, those of the reader."""
    if sort != SERIES and "teeth" in outcome.pictures:  # of a failure
        return outcome.pictures["teeth"]
    teeth = outcome.read if sort == SERIES else outcome.teeth
    labelled = teeth.pictures if teeth else {}
    return sheet([labelled[name] for name in sorted(labelled)]) if labelled else None


def captioned(picture: Picture, text: str, width: int = WIDTH) -> Picture:
    """[H, width, 3]: a picture at a width with a line above it."""
    height = max(1, round(picture.shape[0] * width / picture.shape[1]))
    small = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    band = np.full((CAPTION, width, 3), 255, np.uint8)
    cv2.putText(band, text, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
    return np.ascontiguousarray(np.vstack([band, small]))


def write_sheets(folder: Path, name: str, rows: Sequence[Picture]) -> None:
    """Rows [H, W, 3] of one width under each other, as NAME_0.png, NAME_1.png, ..."""
    for path in folder.glob(f"{name}_[0-9].png"):
        path.unlink()
    for page, start in enumerate(range(0, len(rows), MOST_ROWS)):
        picture = np.vstack(list(rows[start : start + MOST_ROWS]))
        cv2.imwrite(str(folder / f"{name}_{page}.png"), picture[..., ::-1])


def draw_curve(
    path: Path, found: Mapping[str, Any], decided: tuple[float, float], threshold: float | None
) -> None:
    """Share accepted and wrong ones accepted over the threshold of the confidence.

    Args:
        path: of the picture.
        found: as `triads_scores.curve` has it.
        decided: shares of the good and of the wrong items that the pipeline accepted.
        threshold: the lowest that accepts no wrong item.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    points = np.array(found["points"], np.float64).reshape(-1, 3)
    good, wrong = points[:, 1] / max(found["good"], 1), points[:, 2] / max(found["wrong"], 1)
    figure, (over, against) = pyplot.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    over.step(points[:, 0], good, where="pre", label=f"right ones accepted (of {found['good']})")
    over.step(points[:, 0], wrong, where="pre", label=f"wrong ones accepted (of {found['wrong']})")
    if threshold is not None and np.isfinite(threshold):
        over.axvline(threshold, color="0.6", lw=1, label="lowest that accepts no wrong one")
    over.set(xlabel="threshold of the confidence", ylabel="share", ylim=(-0.02, 1.02))
    over.legend(fontsize=8)
    against.plot(wrong, good, ".-", label="by the confidence alone")
    against.plot([decided[1]], [decided[0]], "k*", ms=10, label="as the pipeline decides")
    against.set(
        xlabel="share of the wrong ones accepted", ylabel="share of the right ones accepted",
        xlim=(-0.02, 1.02), ylim=(-0.02, 1.02),
    )  # fmt: skip
    against.legend(fontsize=8)
    figure.savefig(path, dpi=120)
    pyplot.close(figure)
