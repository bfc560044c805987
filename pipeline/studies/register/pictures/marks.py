"""The marks of the enamel: what tells the turns of a smooth crown.

Contrast over several pixels is mostly shading, which stays with the light when a tooth turns.
Shading is smooth, and marks are as sharp as the picture: so they are looked for in the largest
pictures that are at hand, once optical flow has found a crown to a pixel. Contrast is that among
pixels of the crown alone; what lies beside it, and highlights, would put edges into it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from pipeline.studies.register.pictures.matching import (
    Spots,
    cores,
    inside_crowns,
    without_shine,
)
from pipeline.studies.register.pictures.photometric import Facing, Pictures, contrast_spots
from pipeline.studies.register.solving import State
from pipeline.studies.register.visit import Labels, Look

#: Window of the contrast, pixels of any picture: marks are as sharp as the picture.
WINDOW = 2.0
#: So many pixels of a picture 512 wide beside its outline a crown's picture is blurred by what is
#: there.
EDGE = 1.0
#: Blur of the contrast, pixels of any picture: a little, and hardly.
BLURS = (1.0, 0.4)


@dataclass(frozen=True)
class Marked:
    """Attributes:
    look: a photograph with all its pixels.
    core: [H, W] uint8 the tooth well inside whose crown a pixel lies.
    marks: [H, W] uint8 contrast.
    """

    look: Look
    core: Labels
    marks: npt.NDArray[np.uint8]


def marked(look: Look) -> Marked:
    """Find the marks in a photograph."""
    from stages.flow.estimate import local_contrast

    look = look.enlarged
    scale = max(look.image.shape) / 512
    picture = look.without_hardware
    _, shiny = without_shine(picture, scale)
    inside = inside_crowns(look.enamel)
    shown = (inside > EDGE * scale) & look.valid & ~shiny
    gray = np.clip(np.rint(picture * 255), 0, 255).astype(np.uint8)
    return Marked(look, cores(look, shiny, inside), local_contrast(gray, WINDOW, shown))


def marks_of(looks: Sequence[Look]) -> Pictures:
    """The marks in a visit's photographs."""
    found = [marked(look) for look in looks]
    return Pictures(found, [m.marks for m in found], BLURS)


def mark_spots(views: Sequence[Facing], level: int, state: State) -> list[Spots]:
    """What the marks of crowns say at a state, in pixels of the state's cameras.

    Args:
        views: crowns in pairs of photographs (see `photometric.facings`).
        level: which of `BLURS`.
        state: motions and cameras; the cameras may be of smaller pictures than the marks.
    """
    found = []
    for view in views:
        camera = state.cameras[view.second]
        near = camera.resized(view.camera.width, view.camera.height)
        motion = state.motions[view.tooth]
        spots = contrast_spots(replace(view, camera=near), level, motion)
        if spots is not None:
            size = np.array([camera.width / near.width, camera.height / near.height])
            information = spots.information / (size[:, None] * size)
            found.append(replace(spots, pixels=spots.pixels * size, information=information))
    return found
