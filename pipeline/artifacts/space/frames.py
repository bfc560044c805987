"""The frames that a scene can be given in, and which one the exports are in.

Frames of a mouth and of what stands upright have one convention: x to the right as one looks at it
(the patient's left), y up, z towards the viewer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from pipeline.artifacts.cameras import Cameras

Array = npt.NDArray[np.float64]

#: What a setting may ask for.
Wanted = Literal["auto", "mouth", "upright", "input", "world"]
WANTED = (
    "auto (input where cameras were given, else mouth where its teeth say how it lies, else "
    "upright), mouth (x to the patient's left, y up, z to the front, origin between the upper "
    "central incisors' edges), upright (x right, y up, z towards the photographs), input (that of "
    "given cameras, where there are some) or world (the reconstruction's own, in "
    "its own units, never millimetres)"
)
#: Our world has y down and z ahead (`pipeline.geometry.world.normalising_similarity`).
UPRIGHT_FROM_WORLD = np.diag([1.0, -1.0, -1.0, 1.0])
#: Viewers take a 3DGS `.ply` to have y down and turn it by 180 degrees about z; so do we before.
VIEWERS_PLY = np.diag([-1.0, -1.0, 1.0, 1.0])
#: What a `.ply` that is turned like that says in a comment of its header.
TURNED = "dentalsplat turned: 180 degrees about z against colmap/ and transforms.json"
#: How such a comment begins that says the colour behind the scene, RGB in 0..1.
BACKGROUND = "dentalsplat background:"


@dataclass(frozen=True)
class Frame:
    """A frame of the exports.

    Attributes:
        name: ``mouth``, ``upright``, ``input`` or ``world``.
        from_world: [4, 4] similarity from our world.
        lacking: what was asked for and can't be had, as a sentence; empty: it is as asked.
        mouth_from_world: [4, 4], of the cameras; None: not known.
    """

    name: str
    from_world: Array
    lacking: str = ""
    mouth_from_world: Array | None = None

    @property
    def stands(self) -> bool:
        """Has it x right, y up, z towards the viewer?"""
        return self.name in ("mouth", "upright")

    @property
    def to_mouth(self) -> Array | None:
        """[4, 4] rotation and shift, in its units, to the frame of the mouth; None: not known."""
        if self.name == "mouth" or self.mouth_from_world is None:
            return np.eye(4) if self.name == "mouth" else None
        found = self.mouth_from_world @ np.linalg.inv(self.from_world)
        found[:3] /= np.cbrt(np.linalg.det(found[:3, :3]))
        return found


def frame_of(cameras: Cameras, wanted: Wanted = "auto") -> Frame:
    """The frame that a setting asks for, of a scene with these cameras.

    In millimetres where they are known; else in the units of given cameras; else in our world's, as
    the frame ``world`` always is.
    """
    return replace(_frame_of(cameras, wanted), mouth_from_world=cameras.mouth_from_world)


def _frame_of(cameras: Cameras, wanted: Wanted) -> Frame:
    given = cameras.input_from_world
    if wanted == "world":
        return Frame("world", np.eye(4))
    if wanted in ("auto", "input") and cameras.given:
        return Frame("input", given)
    lacking = ""
    if wanted == "input":
        lacking = (
            "The frame of given cameras was asked for, but no cameras were given. The exports are "
            "in the frame that 'auto' means instead."
        )
    known = cameras.given or cameras.scale.unit == "mm"
    scale = float(np.cbrt(np.linalg.det(given[:3, :3]))) if known else 1.0
    enlarged = np.diag([scale, scale, scale, 1.0])
    if wanted != "upright" and cameras.mouth_from_world is not None:
        return Frame("mouth", enlarged @ cameras.mouth_from_world, lacking)
    if wanted == "mouth":
        lacking = (
            "The frame of a mouth was asked for, but too few of its teeth "
            "are known with their numbers to tell it. The exports stand upright instead, as the "
            "photographs do."
        )
    return Frame("upright", enlarged @ UPRIGHT_FROM_WORLD, lacking)
