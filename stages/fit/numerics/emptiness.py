"""Where photographs show what is behind everything, and where points were measured all the same."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial import cKDTree

from stages.fit.arrays import Array, Bools, Floats
from stages.splatting.threads import workers

#: a photograph looks like the background where, blurred by so many pixels of one 512 wide, no
#: channel is off by more. With final_prune_empty at .8, unseen views of five triples of scan video
#: whose cameras features found gain .23 dB, of four wide ones with exact cameras .29, and the input
#: views lose .2; 3/255 and .8: .03; 12/255 and .6: .3 and .4, but input views lose .5. From six
#: views on nothing is gained (twelve: -.07).
UNSEEN, NOISE_PX = 8 / 255, 1.5
#: what lies within so many spacings of a point that was measured is something, however dark
MEASURED_REACH = 2.0
#: so many points tell the spacing
SAMPLED = 5000


def looks_like(photograph: Floats, background: Floats, scale: float) -> Floats:
    """[H, W] float32, 1 where a photograph [3, H, W] looks like the background [3, H, W].

    Args:
        scale: of its pixels, in pixels of a picture 512 wide.
    """
    off = [
        np.abs(cv2.GaussianBlur(channel, (0, 0), NOISE_PX * scale) - behind)
        for channel, behind in zip(photograph, background, strict=True)
    ]
    return np.asarray(np.max(off, axis=0) < UNSEEN, np.float32)


def near_measured(positions: Floats, measured: Array) -> Bools:
    """[N] which of some positions [N, 3] lie where points [M, 3] were measured, in one frame."""
    if not len(positions) or len(measured) < 2:
        return np.zeros(len(positions), bool)
    tree = cKDTree(measured)
    some = measured[:: max(1, len(measured) // SAMPLED)]
    reach = MEASURED_REACH * np.median(tree.query(some, 2, workers=workers())[0][:, 1])
    away, _ = tree.query(positions, distance_upper_bound=reach, workers=workers())
    return np.asarray(np.isfinite(away))
