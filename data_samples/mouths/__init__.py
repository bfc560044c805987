"""Varied synthetic mouths: to train a small reader of teeth, and to test reconstruction.

`random_mouth` grows a mouth (3D meshes with an FDI number on every vertex), `photograph` takes a
photograph of it: the picture, FDI labels and depth per pixel, and the exact camera. From the shell:

    python data_samples/mouths/__main__.py --count 100 --out FOLDER --seed 1

Frames: the world is in mm, x towards the patient's left, y up, z out of the mouth; cameras are
OpenCV's (x right, y down, z forward), pixel centres at .5. Nothing here is anybody's.
"""

import sys
from pathlib import Path

_samples = str(Path(__file__).resolve().parents[1])
if _samples not in sys.path:  # anatomy, appearance, make_samples: modules of the folder above
    sys.path.insert(0, _samples)

from .mouth import Mouth, random_mouth  # noqa: E402
from .options import MouthOptions, random_options  # noqa: E402
from .photo import Photograph, photograph  # noqa: E402

__all__ = [
    "Mouth",
    "MouthOptions",
    "Photograph",
    "photograph",
    "random_mouth",
    "random_options",
]
