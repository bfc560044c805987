"""Dense optical flow between two photographs, and where it can be trusted."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from stages.flow.geometry import pixel_grid

Array = npt.NDArray[np.float32]
Gray = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]
Method = Literal["dis", "farneback"]

#: Weight of the smoothness in DIS's variational refinement (OpenCV: 20).
_SMOOTHNESS = 40.0
#: Smallest image side that the pyramid of the flow methods works on.
_SMALLEST_SIDE = 16


def local_contrast(gray: Gray, sigma: float, among: npt.NDArray[np.bool_] | None = None) -> Gray:
    """Take out brightness and contrast that vary slowly: (I - mean) / (deviation + 4), 8 bits.

    The flash moves with the camera, so shading slides over the surface; on teeth, which have
    little texture, plain flow follows the shading.

    Args:
        gray: [H, W] uint8.
        sigma: of the Gaussian window for mean and deviation, in pixels; 0 leaves the image alone.
        among: [H, W] the pixels that count, beside which there is no contrast; None: all.
    """
    if sigma <= 0:
        return gray
    image = gray.astype(np.float32)
    weight, mass = np.ones_like(image), np.ones_like(image)
    if among is not None:
        weight = among.astype(np.float32)
        mass = np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma), 1e-3)
    mean = np.asarray(cv2.GaussianBlur(image * weight, (0, 0), sigma)) / mass
    square = np.asarray(cv2.GaussianBlur(image * image * weight, (0, 0), sigma)) / mass
    # 4 grey levels: where only noise is left, it must not be blown up to full contrast.
    normal = weight * (image - mean) / (np.sqrt(np.maximum(square - mean * mean, 0)) + 4)
    return np.clip(np.rint(128 + 40 * normal), 0, 255).astype(np.uint8)


def centred_start(size_i: tuple[int, int], size_j: tuple[int, int]) -> Array:
    """The flow that lays image j centred over image i, scaled to the same long side.

    Args:
        size_i, size_j: (width, height) of the images.

    Returns:
        [H_i, W_i, 2] float32; zero for images of the same size.
    """
    scale = max(size_j) / max(size_i)
    from_centre = pixel_grid(size_i[1], size_i[0]) + 0.5 - np.asarray(size_i, np.float32) / 2
    in_j = from_centre * scale + np.asarray(size_j, np.float32) / 2
    return np.asarray(in_j - 0.5 - pixel_grid(size_i[1], size_i[0]), np.float32)


def sample(field: Array | Gray, positions: Array, outside: float | None = None) -> Array:
    """Bilinear samples of `field` [H, W(, C)] at pixel `positions` [..., 2] (column, row).

    Outside the field its border is repeated, or the value `outside` is given.
    """
    border = cv2.BORDER_REPLICATE if outside is None else cv2.BORDER_CONSTANT
    value = (outside or 0.0,) * 4
    columns, rows = (np.ascontiguousarray(positions[..., axis], np.float32) for axis in (0, 1))
    sampled = cv2.remap(
        field, columns, rows, cv2.INTER_LINEAR, borderMode=border, borderValue=value
    )  # fmt: skip
    return np.asarray(sampled)


def estimate_flow(
    gray_i: Gray,
    gray_j: Gray,
    start: Array,
    method: Method = "dis",
) -> tuple[Array, Array]:
    """Estimate the flow from image i to image j, beginning with a guess.

    Image j is warped onto i by the guess, the motion that is left is estimated, and both are
    composed: with w(y) = J(y + start(y)) and I(x) = w(x + r(x)), the flow is r + start(x + r).

    Args:
        gray_i: [H_i, W_i] uint8.
        gray_j: [H_j, W_j] uint8, of any size.
        start: [H_i, W_i, 2] guess in pixels (predicted from geometry, or `centred_start`).
        method: ``"dis"`` (Kroeger et al., ECCV 2016) or ``"farneback"`` (Farnebäck, SCIA 2003).

    Returns:
        The flow [H_i, W_i, 2] and the residual r [H_i, W_i, 2], float32 pixels.
    """
    height, width = gray_i.shape
    grid = pixel_grid(height, width)
    shrink = max(gray_j.shape) / max(gray_i.shape)
    if shrink > 1.2:  # sampling a larger image sparsely would alias
        gray_j = np.asarray(cv2.GaussianBlur(gray_j, (0, 0), 0.5 * np.sqrt(shrink**2 - 1)))
    warped_j = np.asarray(sample(gray_j, grid + start), np.uint8)
    residual = _residual(gray_i, warped_j, method)
    flow = residual + sample(start, grid + residual)
    return np.asarray(flow, np.float32), residual


def _residual(gray_i: Gray, warped_j: Gray, method: Method) -> Array:
    """Flow between two images of the same size, padded where they are too small for a pyramid."""
    height, width = gray_i.shape
    down, right = max(0, _SMALLEST_SIDE - height), max(0, _SMALLEST_SIDE - width)
    images = [
        cv2.copyMakeBorder(image, 0, down, 0, right, cv2.BORDER_REPLICATE)
        for image in (gray_i, warped_j)
    ]
    empty = np.zeros((*images[0].shape, 2), np.float32)
    if method == "dis":
        dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        dis.setFinestScale(0)  # full resolution
        dis.setVariationalRefinementAlpha(_SMOOTHNESS)
        flow = dis.calc(images[0], images[1], empty)
    else:
        flow = cv2.calcOpticalFlowFarneback(
            images[0], images[1], empty,
            pyr_scale=0.5, levels=5, winsize=15, iterations=5, poly_n=7, poly_sigma=1.5, flags=0,
        )  # fmt: skip
    return np.ascontiguousarray(flow[:height, :width], np.float32)


def consistency_mask(
    forward: Array,
    backward: Array,
    motion_forward: Array,
    motion_backward: Array,
    relative: float,
    absolute: float,
) -> Mask:
    """Where following the flow to the other image and back ends near the start.

    |F_f(x) + F_b(x + F_f(x))|^2 < relative (|m_f|^2 + |m_b|^2) + absolute (Sundaram, Brox and
    Keutzer, ECCV 2010, equation 5), and x + F_f(x) inside image j.

    Args:
        forward: [H_i, W_i, 2] flow from i to j, pixels.
        backward: [H_j, W_j, 2] flow from j to i.
        motion_forward, motion_backward: the motion m that the tolerance grows with: the flow
            itself, or only the estimated residual where the rest was predicted from geometry.
        relative: share of the squared motion that may be wrong.
        absolute: squared error in pixels^2 that is always allowed.

    Returns:
        [H_i, W_i] bool.
    """
    target = pixel_grid(*forward.shape[:2]) + forward
    returning = sample(backward, target)
    motion = sample(motion_backward, target)
    error = ((forward + returning) ** 2).sum(-1)
    bound = relative * ((motion_forward**2).sum(-1) + (motion**2).sum(-1)) + absolute
    return np.asarray((error < bound) & inside(forward, backward.shape[:2]))


def inside(flow: Array, target_shape: tuple[int, ...]) -> Mask:
    """[H, W] bool: does the flow end inside an image of `target_shape` (height, width)?"""
    height, width = target_shape[:2]
    target = pixel_grid(*flow.shape[:2]) + flow
    return np.asarray(((target >= 0) & (target <= (width - 1, height - 1))).all(-1))


def lands_on(flow: Array, allowed: Mask) -> Mask:
    """[H_i, W_i] bool: does the flow end on a pixel of the mask `allowed` [H_j, W_j]?

    All pixels that the landing point lies between must be allowed.
    """
    target = pixel_grid(*flow.shape[:2]) + flow
    return np.asarray(sample(allowed.astype(np.float32), target, outside=0.0) > 0.999)


def textured(gray: Gray, least: float, window: int = 9) -> Mask:
    """[H, W] bool: is the standard deviation in a `window`-sized square at least `least` levels?"""
    image = gray.astype(np.float32)
    mean = np.asarray(cv2.blur(image, (window, window)))
    square = np.asarray(cv2.blur(image * image, (window, window)))
    return np.asarray(np.maximum(square - mean * mean, 0) >= least * least)


def highlights(image: Array, level: float, grow: int = 5) -> Mask:
    """[H, W] bool: glare of the flash, which moves with the camera and not with the surface.

    Args:
        image: [H, W, 3] sRGB in 0..1.
        level: a pixel is glare if its darkest channel is above this.
        grow: side in pixels of the square by which glare is widened (its soft edge moves too).
    """
    glare = (image.min(-1) > level).astype(np.uint8)
    return np.asarray(cv2.dilate(glare, np.ones((grow, grow), np.uint8)) > 0)
