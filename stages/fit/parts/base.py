"""What a part of the fit is: one thing that it does beside moving Gaussians towards colours.

A part has its settings, says what it adds at each point of an iteration, and keeps its own state.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from stages.fit.config import FitSettings
    from stages.fit.initial import Cloud
    from stages.fit.scene import Scene
    from stages.fit.targets import FlowTarget, Target
    from stages.fit.trainer import Trainer
    from stages.splatting.rasterizer import Gradients, Rendering, Viewpoint

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]
Indices = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]
Arrays = dict[str, npt.NDArray[Any]]
Figures = dict[str, float | int | str]


@dataclass
class Start:
    """What a fit starts from, in a frame where the scene's depth is about 1.

    Attributes:
        settings: all of them.
        packed: [N, 11 + 3 K] float32 initial Gaussians (K = 1 with a light).
        poses: [V, 3, 4] cam_from_frame.
        held: the camera whose pose is not refined.
        targets: per view, factor -> target.
        extent: size of the scene that the position rate is relative to.
        lit: by a light beside the lens, in place of harmonics.
        scene: that it is a fit of; None where only colours are fitted once more.
        cloud: the points that became Gaussians; None where they are found view by view.
    """

    settings: FitSettings
    packed: Floats
    poses: Array
    held: int
    targets: Sequence[dict[int, Target]]
    extent: float
    lit: bool = False
    scene: Scene | None = None
    cloud: Cloud | None = None


@dataclass
class Step:
    """One iteration: a view, and what parts make of it.

    Attributes:
        view: index of the view; factor: its images are reduced by; target, viewpoint: so reduced.
        done: share of the fit that is over, 0..1.
        depth: a plane of depth is drawn too.
        flow, following: what a plane of flow is compared with, and the view that it leads to.
        rendering: of the view.
        loss, psnr: of the image.
        d_planes, d_transmittance: gradients by what was drawn.
        gradients: by the Gaussians and by the camera.
        by_pose: [6] gradient by the camera's twist.
        rates: [D] learning rate of each column.
    """

    view: int
    factor: int
    target: Target
    viewpoint: Viewpoint
    done: float
    depth: bool = False
    flow: FlowTarget | None = None
    following: Viewpoint | None = None
    loss: float = 0.0
    psnr: float = 0.0
    # there from when it is drawn, compared, and stepped
    rendering: Rendering = field(init=False)
    d_planes: Floats = field(init=False)
    d_transmittance: Floats = field(init=False)
    gradients: Gradients = field(init=False)
    by_pose: Array = field(init=False)
    rates: Floats = field(init=False)


class Part:
    """A part that does nothing; each of them overrides what it has a say in.

    What follows is said where a part's class is declared. `Settings`, in it, are its settings.

    Attributes:
        name: in ``fit.parts``.
        switch: the setting that is 0 or False where a fit is without the part; ``""``: never; None:
            the part is settings and nothing else.
        needs: attributes of `Start` that are not None where there can be such a part.
        present, absent: what its settings are in a method that names its parts, with it among them
            or not, where the method does not say otherwise.
        kept: dotted names of attributes that a checkpoint holds.
    """

    name: ClassVar[str]
    switch: ClassVar[str | None]
    needs: ClassVar[tuple[str, ...]]
    present: ClassVar[Mapping[str, Any]]
    absent: ClassVar[Mapping[str, Any]]
    kept: ClassVar[tuple[str, ...]]
    #: iteration from which on losses can be compared
    latest: int = 0

    def __init_subclass__(
        cls,
        name: str,
        switch: str | None = None,
        needs: tuple[str, ...] = (),
        present: Mapping[str, Any] | None = None,
        absent: Mapping[str, Any] | None = None,
        kept: tuple[str, ...] = (),
    ) -> None:
        cls.name, cls.switch, cls.needs, cls.kept = name, switch, needs, kept
        cls.present, cls.absent = present or {}, absent or {}

    @classmethod
    def of(cls, start: Start) -> Part | None:
        """The part of a fit, or None where it has none."""
        if cls.switch is None or any(getattr(start, name) is None for name in cls.needs):
            return None
        return cls(start) if not cls.switch or getattr(start.settings, cls.switch) else None

    def __init__(self, start: Start) -> None:
        self.settings = start.settings

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
