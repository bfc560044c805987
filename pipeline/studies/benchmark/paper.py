"""The figures of the paper's tables 1, 2 and 3 (DentalSplat, section 4): facts to compare with.

Its data are not public: 195 clinical videos (tables 1 and 3) and 950 cases of three photographs
(table 2), on an RTX 4090. None stands where the paper has a dash: the method failed.
"""

from __future__ import annotations

from typing import NamedTuple


class PaperFigures(NamedTuple):
    """One entry of the paper's tables; None where it gives none."""

    psnr: float
    ssim: float
    lpips: float
    seconds: float | None = None


#: Table 1, held-out frames of videos: row -> number of input views -> figures.
VIEWS: dict[str, dict[int, PaperFigures | None]] = {
    "ours": {
        3: PaperFigures(23.96, 0.822, 0.301),
        6: PaperFigures(28.41, 0.872, 0.247),
        9: PaperFigures(29.363, 0.891, 0.237),
        12: PaperFigures(30.174, 0.897, 0.213),
    },
    "instantsplat": {
        3: PaperFigures(23.81, 0.826, 0.304),
        6: PaperFigures(27.01, 0.863, 0.268),
        9: PaperFigures(28.656, 0.890, 0.241),
        12: PaperFigures(29.315, 0.898, 0.235),
    },
    "cf3dgs": {
        3: PaperFigures(15.32, 0.748, 0.443),
        6: PaperFigures(18.01, 0.795, 0.277),
        9: PaperFigures(21.29, 0.812, 0.374),
        12: PaperFigures(23.02, 0.853, 0.337),
    },
    "3dgs": {3: None, 6: None, 9: None, 12: PaperFigures(11.51, 0.53, 0.574)},
}

#: Table 2, three photographs, training views.
PHOTOS: dict[str, PaperFigures | None] = {
    "ours": PaperFigures(34.50, 0.954, 0.135, 69),
    "instantsplat": PaperFigures(32.78, 0.945, 0.160, 57),
    "cf3dgs": PaperFigures(18.37, 0.803, 0.32, 372),
    "3dgs": None,
}

#: Table 3, ablations at 6 views.
ABLATIONS: dict[str, PaperFigures | None] = {
    "ours": PaperFigures(28.41, 0.872, 0.247, 72),
    "no_gradient": PaperFigures(27.58, 0.857, 0.288, 62),
    "no_flow_mask": PaperFigures(27.94, 0.843, 0.261, 64),
    "no_flow": PaperFigures(27.35, 0.852, 0.285, 57),
    "no_sap": PaperFigures(28.31, 0.867, 0.254, 70),
}

ROWS = tuple(dict.fromkeys([*VIEWS, *PHOTOS, *ABLATIONS]))

DATA = {
    "views": "195 clinical videos",
    "photos": "950 clinical cases of three photographs",
    "ablations": "195 clinical videos",
}


def paper_figures(form: str, row: str | None, views: int) -> PaperFigures | str | None:
    """What the paper gives for a row of one of its tables.

    Returns:
        The figures; None where the paper says that the method failed; ``"absent"`` where its table
        has no such entry.
    """
    if form == "views":
        return VIEWS.get(row or "", {}).get(views, "absent")
    if form == "photos":
        return PHOTOS.get(row or "", "absent") if views == 3 else "absent"
    return ABLATIONS.get(row or "", "absent") if views == 6 else "absent"
