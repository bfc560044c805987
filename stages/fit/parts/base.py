"""What a part of the fit is: one thing that it does beside moving Gaussians towards colours.

A part has its settings, says what it adds at each point of an iteration, and keeps its own state.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from stages.fit.arrays import Array, Arrays, Bools, Floats, Indices

if TYPE_CHECKING:
    from stages.fit.inputs.targets import FlowTarget, Target
    from stages.fit.trainer import Trainer
    from stages.splatting.rasterizer import Gradients, Rendering, Viewpoint

Figures = dict[str, float | int | str]


@dataclass
class Step:
    """One iteration: a view, and what parts make of it."""

    view: int  # its index
    factor: int  # by which its images are reduced
    target: Target
    viewpoint: Viewpoint
    done: float  # share of the fit that is over, 0..1
    depth: bool = False  # a plane of depth is drawn too
    flow: FlowTarget | None = None  # what a plane of flow is compared with
    following: Viewpoint | None = None  # the view that it leads to
    loss: float = 0.0
    psnr: float = 0.0
    # there from when it is drawn, compared, and stepped
    rendering: Rendering = field(init=False)
    d_planes: Floats = field(init=False)  # gradients by what was drawn
    d_transmittance: Floats = field(init=False)
    gradients: Gradients = field(init=False)  # by the Gaussians and by the camera
    by_pose: Array = field(init=False)  # [6] by the camera's twist
    rates: Floats = field(init=False)  # [D] learning rate of each column


class Part:
    """A part that does nothing; each of them overrides what it has a say in.

    `Settings`, in each of them, are its settings. What follows is said where a class is declared.

    Attributes:
        name: in ``fit.parts``: that of the class.
        switch: the setting that is 0 or False where a fit is without the part; ``""``: never; None:
            the part is settings and nothing else.
        needs: attributes of a fit that are not None where there can be such a part.
        present, absent: what settings are in a method that names its parts, with this one among
            them or not, where the method does not say otherwise (`on`, `off`: of the switch).
        kept: dotted names of attributes that a checkpoint holds.
    """

    name: ClassVar[str]
    switch: ClassVar[str | None]
    needs: ClassVar[Sequence[str]]
    present: ClassVar[dict[str, Any]]
    absent: ClassVar[dict[str, Any]]
    kept: ClassVar[Sequence[str]]
    #: iteration from which on losses can be compared
    latest: int = 0

    def __init_subclass__(
        cls, switch: str | None = None, on: Any = None, off: Any = None, needs: Sequence[str] = (),
        present: Mapping[str, Any] | None = None, absent: Mapping[str, Any] | None = None,
        kept: Sequence[str] = (),
    ) -> None:  # fmt: skip
        cls.name, cls.switch, cls.needs, cls.kept = cls.__name__.lower(), switch, needs, kept
        cls.present = dict(present or ({} if on is None else {str(switch): on}))
        cls.absent = dict(absent or ({} if off is None else {str(switch): off}))

    @classmethod
    def of(cls, fit: Trainer) -> Part | None:
        """The part of a fit that is about to begin, or None where it has none."""
        if cls.switch is None or any(getattr(fit, name) is None for name in cls.needs):
            return None
        return cls(fit) if not cls.switch or getattr(fit.settings, cls.switch) else None

    def __init__(self, fit: Trainer) -> None:
        self.settings = fit.settings

    def begin(self, fit: Trainer) -> None:
        """Before an iteration's view is drawn by lot."""

    def shade(self, packed: Floats, viewpoint: Viewpoint) -> None:
        """Before Gaussians are drawn, from anywhere: change their colours."""

    def ask(self, fit: Trainer, step: Step) -> None:
        """Ask for more than colours to be drawn."""

    def show(self, view: int | None, image: Floats, transmittance: Floats) -> Floats:
        """What becomes of an image [3, H, W] on its way to a view; the last part comes first."""
        return image

    def compare(self, fit: Trainer, step: Step) -> None:
        """Add to the loss and to the gradients by what was drawn."""

    def guide(self, fit: Trainer, step: Step) -> None:
        """Add to the gradients by the Gaussians and the camera."""

    def pace(self, step: Step) -> None:
        """Change the learning rates."""

    def follow(self, fit: Trainer, step: Step) -> None:
        """Step, after the Gaussians have."""

    def populate(self, fit: Trainer, step: Step) -> None:
        """Let Gaussians be born and die."""

    def select(self, source: Indices, fresh: Bools) -> None:
        """Gaussians have changed: where each comes from, and whether it is new."""

    def end(self, fit: Trainer) -> None:
        """After the last iteration."""

    def summary(self) -> Figures:
        """Figures for the run's summary."""
        return {}

    def arrays(self) -> Arrays:
        """The whole state, for a checkpoint."""
        return state_of(self, self.kept)

    def restore(self, arrays: Arrays) -> None:
        """Take up what `arrays` gave."""
        restore_state(self, self.kept, arrays)


def state_of(owner: Any, names: Sequence[str]) -> Arrays:
    """Attributes by their dotted names, as arrays; what is None is left out."""
    values = {name: attrgetter(name)(owner) for name in names}
    return {name: np.asarray(value) for name, value in values.items() if value is not None}


def restore_state(owner: Any, names: Sequence[str], arrays: Arrays) -> None:
    """Set attributes to what `state_of` gave."""
    for name in names:
        way, _, last = name.rpartition(".")
        value: Any = arrays.get(name)
        value = value.item() if value is not None and value.ndim == 0 else value
        setattr(attrgetter(way)(owner) if way else owner, last, value)


def interpolate(start: float, end: float, done: float) -> float:
    """Exponential from `start` (done = 0) to `end` (done = 1); linear where one of them is 0."""
    if start <= 0 or end <= 0:
        return start + (end - start) * done
    return float(start * (end / start) ** done)


def logit(probability: float) -> float:
    return float(np.log(probability / (1 - probability)))
