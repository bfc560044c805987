"""Frames of the video: the Gaussians as a camera sees them, in the encoder's own colours."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.kernels import kernel
from stages.splatting.rendering import Painter

Floats = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]
F = np.float32

#: Shares of red, green and blue in the brightness (BT.709).
RED, GREEN, BLUE = F(0.2126), F(0.7152), F(0.0722)


def film_frame(painter: Painter, camera: Camera, near: float) -> Bytes:
    """[3 H / 2, W] uint8 planar 4:2:0, see `yuv420`.

    Args:
        painter: of the scene.
        camera: its width and height are even.
        near: near plane, world units.
    """
    drawn = painter.composited(camera, near, depth=False)
    frame = np.empty((3 * camera.height // 2, camera.width), np.uint8)
    yuv420(drawn.planes, drawn.transmittance, painter.background, frame)
    return frame


@kernel(nogil=True)
def yuv420(planes: Floats, transmittance: Floats, background: Floats, frame: Bytes) -> None:
    """Put what was composited before a background, as H.264 takes it (BT.709, 16..235).

    Args:
        planes: [3, H, W] RGB without background; H and W are even.
        transmittance: [H, W], what is left of the background.
        background: [3] RGB in 0..1.
        frame: [3 H / 2, W] output: Y [H, W], then U and V [H / 2, W / 2] in the order of memory.
    """
    height, width = transmittance.shape
    flat = frame.reshape(-1)
    across = width // 2
    u0, v0 = height * width, height * width + height // 2 * across
    rows = np.empty((3, width), np.float32)
    for top in range(0, height, 2):
        rows[:] = F(0)
        for y in range(top, top + 2):
            for x in range(width):
                left = transmittance[y, x]
                red = min(max(planes[0, y, x] + left * background[0], F(0)), F(1))
                green = min(max(planes[1, y, x] + left * background[1], F(0)), F(1))
                blue = min(max(planes[2, y, x] + left * background[2], F(0)), F(1))
                bright = RED * red + GREEN * green + BLUE * blue
                flat[y * width + x] = np.uint8(F(16.5) + F(219) * bright)
                rows[0, x] += bright
                rows[1, x] += blue
                rows[2, x] += red
        start = top // 2 * across
        for x in range(across):
            bright = rows[0, 2 * x] + rows[0, 2 * x + 1]
            blue = rows[1, 2 * x] + rows[1, 2 * x + 1]
            red = rows[2, 2 * x] + rows[2, 2 * x + 1]
            # a quarter each, times 224, over the range of the difference
            flat[u0 + start + x] = np.uint8(F(128.5) + F(28) * (blue - bright) / (F(1) - BLUE))
            flat[v0 + start + x] = np.uint8(F(128.5) + F(28) * (red - bright) / (F(1) - RED))
