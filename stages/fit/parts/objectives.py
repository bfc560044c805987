"""Terms of the loss beside colour: depth of the points, flow, silhouette, total variation.

Depth and flow take turns, each twice as heavy: they change slowly, and cost planes that are drawn.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from stages.fit import numerics
from stages.fit.arrays import Bools, Floats, Indices
from stages.fit.parts.base import Figures, Part, Step
from stages.fit.settings import AutoFloat, PartSettings, Weight, automatic

if TYPE_CHECKING:
    from stages.fit.trainer import Trainer


#: what draws neighbours together changes slowly, and costs as much as what is drawn: it has its say
#: every so many iterations
TURNS = 4
#: a scene lets through this much where it is said to show nothing
CLEAR = 0.99
#: Gaussians that each is compared with, and the difference of colour below which squares count
NEIGHBOURS, TOLERANCE = 24, 0.02


class Depth(Part, switch="lambda_depth", off=0.0):
    """What is seen lies where the points are."""

    class Settings(PartSettings):
        lambda_depth: AutoFloat = automatic({3: 0.5, 6: 0.3}, held=0.0)
        """weight of the depth prior from the input points, in units of the scene's depth; 0:
        none"""

    def ask(self, fit: Trainer, step: Step) -> None:
        step.depth = fit.iteration % 2 == 0 and bool(step.target.depth.any())

    def compare(self, fit: Trainer, step: Step) -> None:
        if step.depth:
            weight = 2 * self.settings.lambda_depth
            step.loss += weight * numerics.objectives.depth_loss(
                step.rendering, step.target.depth, weight, step.d_planes[3], step.d_transmittance
            )

    def summary(self) -> Figures:
        return {"lambda_depth": self.settings.lambda_depth}


class Flow(Part, switch="lambda_flow", off=0.0):
    """What is seen moves between two views as the photographs do."""

    class Settings(PartSettings):
        lambda_flow: Weight = 0.01
        """weight of the flow loss, per pixel of flow error; 0: none"""

    def __init__(self, fit: Trainer) -> None:
        super().__init__(fit)
        self.pairs = sum(len(target[1].flows) for target in fit.targets)

    def ask(self, fit: Trainer, step: Step) -> None:
        flows = step.target.flows
        if flows and fit.iteration % 2 == 1:
            # to which of several views is drawn by lot
            step.flow = flows[int(fit.random.integers(len(flows))) if len(flows) > 1 else 0]
            there = fit.targets[step.flow.to][step.factor]
            step.following = fit.viewpoint(step.flow.to, there)

    def compare(self, fit: Trainer, step: Step) -> None:
        if step.flow is not None:
            weight = 2 * self.settings.lambda_flow
            step.loss += weight * numerics.objectives.flow_loss(
                step.rendering.planes[3:], step.rendering.transmittance, step.flow.flow,
                step.flow.mask, weight, step.d_planes[3:], step.d_transmittance,
            )  # fmt: skip

    def summary(self) -> Figures:
        return {"flow_pairs": self.pairs}


class Silhouette(Part, switch="lambda_silhouette", off=0.0, needs=("cloud",)):
    """Beyond the masks, what was empty when the fit began stays empty.

    A mask that ends with the surface leaves nothing to draw its outermost Gaussians back: they grow
    outwards, each as far as it likes, and the rim is ragged and blurred.

    Attributes:
        outside: per view, factor -> [H, W] float32, 1 beyond the mask where nothing was.
    """

    class Settings(PartSettings):
        # six patients: their rims, midway between photographs, are 3.0 % longer than even ones, and
        # 4.3 % where masks went on and this was not there; the photographs gain .2 dB. With .4 two
        # of them lose 1.2 and 2.3 dB, as Gaussians leave what the masks hold
        lambda_silhouette: AutoFloat = automatic({3: 0.0}, held=0.1)
        """weight of what is drawn beyond the masks where nothing was at the start; 0: none"""

    @classmethod
    def of(cls, fit: Trainer) -> Part | None:
        whole = all(bool(view[1].colour.mask.all()) for view in fit.targets)
        return None if whole else super().of(fit)

    def __init__(self, fit: Trainer) -> None:
        super().__init__(fit)
        black = np.zeros((len(fit.packed), 3), np.float32)
        self.outside: list[dict[int, Floats]] = []
        for view, targets in enumerate(fit.targets):
            left = {f: fit.draw(fit.viewpoint(view, t), black).transmittance
                    for f, t in targets.items()}  # fmt: skip
            self.outside.append({
                f: ((targets[f].colour.mask == 0) & (clear > CLEAR)).astype(np.float32)
                for f, clear in left.items()
            })  # fmt: skip

    def compare(self, fit: Trainer, step: Step) -> None:
        outside, mask = self.outside[step.view][step.factor], step.target.colour.mask
        # as heavy for a pixel as colour is for one in the mask
        weight = np.float32(self.settings.lambda_silhouette / max(float(mask.sum()), 1.0))
        step.loss += float(weight * (outside * (1 - step.rendering.transmittance)).sum())
        step.d_transmittance -= weight * outside


class Variation(
    Part, switch="lambda_tv", on=0.2, off=0.0, kept=("graph.neighbours", "graph.starts")
):
    """Draws the colours of neighbours together: harmonics, or the albedos that a light shades.

    Attributes:
        graph: of the neighbours.
    """

    class Settings(PartSettings):
        lambda_tv: AutoFloat = automatic({3: 0.0}, held=0.2)
        """weight of the mean difference between the colours of neighbouring Gaussians: albedos with
        a light beside the lens, else harmonics"""

    def __init__(self, fit: Trainer) -> None:
        self.graph = numerics.total_variation.TotalVariation(
            TURNS * fit.settings.lambda_tv, NEIGHBOURS, TOLERANCE
        )

    def guide(self, fit: Trainer, step: Step) -> None:
        from stages.splatting.kernels.features import C0
        from stages.splatting.kernels.projection import HARMONICS

        if not fit.lit:
            packed = fit.packed
            self.add(fit, packed, HARMONICS, packed.shape[1], step.gradients.packed, float(C0))

    def add(
        self, fit: Trainer, values: Floats, first: int, last: int, gradient: Floats,
        unit: float = 1.0,
    ) -> None:  # fmt: skip
        """As `TotalVariation.add`, every so many iterations and as much heavier."""
        if fit.iteration % TURNS == 0:
            self.graph.add(fit.packed[:, :3], values, first, last, gradient, unit)

    def select(self, source: Indices, fresh: Bools) -> None:
        self.graph.forget()
