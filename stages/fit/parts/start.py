"""Parts of a method that are settings and nothing else: what a fit starts from and looks at."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from pipeline.artifacts.confidence import MEASURED
from stages.fit.parts.base import Part
from stages.fit.settings import AutoFloat, Count, PartSettings, Positive, automatic

if TYPE_CHECKING:
    from stages.fit.config import FitSettings


class Filling(Part, absent={"trusted_confidence": 1.0, "fill_share": 1.0}):
    """Points that were measured count for more than points that were filled in."""

    class Settings(PartSettings):
        trusted_confidence: AutoFloat = automatic({3: MEASURED}, held=1.0, ge=1)
        """input points of less (raw) confidence were filled in: they are no depth prior, and are
        left out where they stand before others"""
        fill_share: AutoFloat = automatic({3: 0.03, 6: 0.0}, le=1)
        """largest share of the Gaussians that starts from points filled in: between many views,
        what was not measured grows better from what was"""


class Shading(Part, absent={"normal_neighbours": 0, "headlight": 0.0, "headlight_shoulder": 0.0}):
    """Harmonics start as a matte surface is lit from the camera."""

    class Settings(PartSettings):
        normal_neighbours: Annotated[int, Field(ge=0, le=200)] = 12
        """average normals over so many points; 0: as they are"""
        headlight: AutoFloat = automatic({3: 0.6}, held=0.8, lt=1)
        """share of the light that comes from the camera, to start degree 1 from normals"""
        # twelve patients' frontal photographs, each predicted from those of both sides: 19.5 dB,
        # with one share for dark and bright 19.2 (.4), 19.4 (.5), 19.2 (.6); their right ones: 19.1
        # and 18.2, 18.6, 18.7 (benchmarks/unseen_photograph.py). A castle in the sun loses by it
        headlight_shoulder: AutoFloat = automatic({3: 0.0}, held=1.0, le=1)
        """by how much less of itself that share is for each unit of brightness above .45, as tone
        curves press together what is bright"""


class Saturation(Part, absent={"saturation": 2.0}):  # above any colour
    """What is white in a photograph may be brighter still."""

    class Settings(PartSettings):
        saturation: Positive = 0.98
        """photographs are white from here on: a rendering may be brighter there without penalty"""


def reduction(settings: FitSettings, iteration: int, iterations: int) -> int:
    """By which factor images are reduced in an iteration, counted from 1, of so many; at 0 as at 1.

    From ``coarse_factor`` it is halved until it is 1; what is reduced at all takes equal shares.
    """
    factors = coarse_factors(settings)
    coarse = settings.coarse_fraction * iterations
    if not factors or iteration > coarse:
        return 1
    return factors[min(int(max(iteration - 1, 0) * len(factors) / coarse), len(factors) - 1)]


def coarse_factors(settings: FitSettings) -> list[int]:
    """Factors above 1 by which images are reduced one after another, the largest first."""
    factor = settings.coarse_factor if settings.coarse_fraction > 0 else 1
    return [factor >> k for k in range(factor.bit_length()) if factor >> k > 1]


class Coarse(Part, absent={"coarse_fraction": 0.0}):
    """Images are small at first."""

    class Settings(PartSettings):
        # on a held surface full size is where steps tell: 160 of them, half at full size, come to
        # more than 240 with three tenths, now that the colours are solved for at the end
        coarse_fraction: AutoFloat = automatic({3: 0.7}, held=0.5, le=1)
        """share of the iterations at reduced size"""
        coarse_factor: Annotated[Count, Field(le=16)] = 2
        """by which factor images are reduced at first; it is halved until it is 1"""
