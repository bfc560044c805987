"""Frames of HDR films (BT.2100, as phones film) as sRGB: as they stand they are pale and dark.

Up to `SHOULDER` of white what is shown stays as it is; what is brighter, such as highlights on
teeth, is pressed together above that and not cut off.

Sources: ITU-R BT.2100 (PQ and HLG), BT.2408 (white at 203 cd/m2), BT.2087 (primaries).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from stages.photographs.srgb import encoded

Floats = npt.NDArray[np.float32]

#: FFmpeg's numbers of the curves.
PQ, HLG = 16, 18
#: cd/m2 of white, and of the brightest that a display of HLG shows.
WHITE, HLG_PEAK = 203.0, 1000.0
HLG_GAMMA = 1.2
SHOULDER = 0.7
#: Pixels that are converted at a time.
STRIP = 1 << 20

_BT709_FROM_BT2020 = np.array(
    [[1.6605, -0.5877, -0.0728], [-0.1246, 1.1330, -0.0084], [-0.0182, -0.1006, 1.1187]], np.float32
)
_LUMINANCE = np.array([0.2627, 0.6780, 0.0593], np.float32)


def srgb_from_hdr(rgb: npt.NDArray[np.uint16], curve: int) -> npt.NDArray[np.uint8]:
    """[H, W, 3] uint8 sRGB of a frame.

    Args:
        rgb: [H, W, 3] in the primaries of BT.2020, 65535 as the most.
        curve: `PQ` or `HLG`.
    """
    made = np.empty(rgb.shape, np.uint8)
    light_of = _pq(_LEVELS) if curve == PQ else _hlg(_LEVELS)
    step = max(1, STRIP // rgb.shape[1])
    for top in range(0, len(rgb), step):
        light = light_of[rgb[top : top + step]]
        if curve == HLG:  # to how bright its display shows it
            luminance = np.maximum(light @ _LUMINANCE, np.float32(1e-6))
            light *= (HLG_PEAK / WHITE * luminance ** (HLG_GAMMA - 1))[..., None]
        light = np.maximum(light @ _BT709_FROM_BT2020.T, 0)
        most = np.maximum(light.max(-1, keepdims=True), np.float32(1e-6))
        light *= _pressed(most) / most
        made[top : top + step] = np.round(255 * encoded(light))
    return made


def _pressed(light: Floats) -> Floats:
    over = np.maximum(light - SHOULDER, 0) / (1 - SHOULDER)
    return np.minimum(light, SHOULDER) + (1 - SHOULDER) * over / (1 + over)


def _pq(signal: Floats) -> Floats:
    """Light, 1 at white."""
    root = signal ** (1 / 78.84375)
    bright = np.maximum(root - 0.8359375, 0) / (18.8515625 - 18.6875 * root)
    return np.asarray(10_000 / WHITE * bright ** (1 / 0.1593017578125), np.float32)


def _hlg(signal: Floats) -> Floats:
    """Light of the scene, 1 at the most."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.asarray(
        np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12), np.float32
    )


_LEVELS = np.linspace(0, 1, 65536, dtype=np.float32)
