"""How each exported file stands, so that it opens the right way up and from the front.

The exports share one frame: x right, y up, z towards the viewer. Files whose readers take another
direction for up are turned:

- 3DGS `.ply`, compressed `.ply` and `.sog`: SuperSplat and PlayCanvas turn them by 180 degrees
  about z when they load them (`Transform.PLY` of @playcanvas/splat-transform), for scenes of 3DGS
  have y down.
- `.stl`: slicers and CAD have z up and look along y. Slicers take a file as it lies, so the closed
  models (`model_*.stl`) lie on their bases, in whatever frame the rest is.

Lengths in `.glb` are metres, as glTF wants it, where a millimetre is known.

`.spz` declares x right, y up, z back, and MeshLab (`.ply` meshes) and glTF have y up and look along
-z: as it is. splat-transform 3 and SuperSplat do not heed what `.spz` declares and show it upside
down; there are three other files for them. nerfstudio turns scenes upright itself, by the cameras.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.space.frames import VIEWERS_PLY

Array = npt.NDArray[np.float64]

#: y up -> z up, the front towards -y.
Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


#: y up -> the upper side down, onto a printer's bed, the front towards -y.
ON_ITS_BASE = np.diag([-1.0, 1.0, -1.0, 1.0]) @ Z_UP

#: Millimetres -> metres.
METRES = np.diag([1e-3, 1e-3, 1e-3, 1.0])


def file_from_frame(
    name: str, stands: bool, millimetres: bool = False, to_mouth: Array | None = None
) -> Array:
    """[4, 4] rotation (of `.glb`: scale) from the frame of the exports to that of a file.

    Args:
        name: of the file.
        stands: the frame has y up and z towards the viewer. Where it has not (that of given
            cameras, our own world), all files but closed models are in it as it is.
        millimetres: that is the unit of the frame.
        to_mouth: [4, 4] to the frame of the mouth, whose y the bases of closed models stand on;
            None: not known, and there are no models.
    """
    if millimetres and name.endswith(".glb"):
        return METRES
    if stands and name.startswith("splats") and name.endswith((".ply", ".sog")):
        return VIEWERS_PLY
    if to_mouth is not None and name.startswith("model_"):
        turn = np.eye(4)
        turn[:3, :3] = to_mouth[:3, :3]
        return (ON_ITS_BASE if name == "model_upper.stl" else Z_UP) @ turn
    if stands and name.endswith(".stl"):
        return Z_UP
    return np.eye(4)
