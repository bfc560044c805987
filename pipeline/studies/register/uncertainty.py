"""How sure motions are: what changes when a photograph or a reference tooth is left out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from pipeline.studies.register import solving
from pipeline.studies.register.estimate import Estimate, pulls

Array = npt.NDArray[np.float64]

#: A crown's pictures correlate by this, usually, and by no less and no more than these.
USUAL, RANGE = 0.85, (0.2, 0.98)


def misfit(likeness: float) -> float:
    """Factor of a tooth's standard deviations, by how well its pictures agree (-1..1).

    Residuals are what correlation leaves unexplained: their size against what it explains, over
    the same of a usual crown. A motion by which pictures do not fit is the wrong one, however sure
    the equations are of it.
    """
    r, usual = np.square([np.clip(likeness, *RANGE), USUAL])
    return float(np.sqrt((1 - r) / r / ((1 - usual) / usual)))


def measured(found: Estimate, by_photograph: float = 1.0) -> dict[int, tuple[Array, Array]]:
    """FDI number -> displacement [6] (shift mm, rotation vector rad) and its covariance [6, 6].

    A tooth that stood still is let go, all others stay: so its own motion is measured as well. The
    covariance is that of the equations and of two jackknives, over the photographs of the second
    visit and over the teeth that everything is measured against.

    Args:
        found: the estimate.
        by_photograph: share of the first of these jackknifes that counts.
    """
    blocks = [b for b in found.blocks if b.weight > 0]
    teeth = sorted({b.tooth for b in blocks})
    cameras = sorted({b.second for b in blocks})
    state = found.state
    drift = {n: solving.displacement(state.motions[n], found.centres[n]) for n in teeth}
    still = [n for n in found.still if n in teeth]
    system = solving.system_of(blocks, len(state.cameras))
    matrix, vector = system.matrices.sum(0), system.vectors.sum(0)
    result = {}
    moved = [n for n in teeth if n not in still]
    groups = [[n] for n in still] + ([moved] if moved else [])

    def solved(
        without_view: int | None, without_tooth: int | None, free: Sequence[int]
    ) -> tuple[dict[int, Array], Array]:
        held = [n for n in still if n not in free and n != without_tooth]
        some = without_view is not None
        change, whole = solving.solved(
            system, matrix - system.matrices[without_view] if some else matrix,
            vector - system.vectors[without_view] if some else vector,
            pulls(drift, held, found.laid), drift,
        )  # fmt: skip
        return {n: drift[n] + change[system.place(n)] for n in free}, whole

    for group in groups:
        whole, equations = solved(None, None, group)
        inverse = np.linalg.inv(equations)
        by_view = [solved(v, None, group)[0] for v in cameras] if len(cameras) > 1 else []
        others = [n for n in still if n not in group]
        by_tooth = [solved(None, n, group)[0] for n in others] if len(others) > 3 else []
        for n in group:
            at = system.place(n)
            covariance = inverse[at, at].copy()
            for sample, counts in ((by_view, by_photograph), (by_tooth, 1.0)):
                if sample:
                    off = np.array([s[n] for s in sample]) - whole[n]
                    # A photograph that does not show the tooth says nothing of it.
                    covariance += counts * (len(sample) - 1) / len(sample) * off.T @ off
            best = whole[n]
            if n in found.seen:  # what flow says differs from what the pictures say: doubt
                best = solving.displacement(found.seen[n], found.centres[n])
                half = (best - whole[n]) / 2
                covariance += np.outer(half, half)
            result[n] = best, np.asarray(covariance, np.float64)
    return result
