"""What is written on photographs with their teeth."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.artifacts.teeth import Dentition
from stages.dentition.overlay import DOUBTFUL, WIDTH, labelled_overlay


@pytest.mark.parametrize("letters", [5, 80, 250])
def test_why_a_photograph_is_not_used_is_all_to_be_read(letters: int) -> None:
    """Without its beginning, 'not used' would read 'used'."""
    grey = np.full((90, 120, 3), 0.4, np.float32)
    why = f"it shows the same as {'m' * letters}.jpg, which is clearer"
    picture = labelled_overlay(grey, Dentition("000", (120, 90), "front", set_aside=why))
    columns = np.flatnonzero((picture == DOUBTFUL).all(axis=2).any(axis=0))
    assert columns[0] > 0 and columns[-1] < WIDTH - 1
    assert columns[-1] - columns[0] > 0.35 * WIDTH
