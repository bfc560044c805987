"""Colours of Gaussians under a light beside the lens, and their gradient; `light` has the model."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import prange

from pipeline.kernels import helper, kernel
from stages.splatting.kernels.features import C0
from stages.splatting.kernels.projection import CHUNK, HARMONICS
from stages.splatting.lanes.types import WIDTH
from stages.splatting.lanes.vectors import (
    at_least,
    exponential,
    load_from,
    log2,
    root,
    store_from,
)

Floats = npt.NDArray[np.float32]
F = np.float32

#: columns of a packed scene whose colour is written by `shade`
LIT_COLUMNS = HARMONICS + 3
#: columns of a material matrix: albedo 3, normal 3 (of any length)
MATERIAL_COLUMNS = 6
#: globals that get gradients: k, p, m and s of the narrow lobe, m and s of the broad one
GLOBALS = 6
#: below these, albedo and radiance are held: roots have no slope at zero
MIN_ALBEDO, MIN_RADIANCE = F(1e-3), F(1e-5)
#: natural logarithm of 2
LOG_2 = F(0.693147181)


@helper
def _shade_chunk(chunk, packed, material, centre, light, radiance):  # type: ignore[no-untyped-def]
    """One chunk of `shade_kernel`."""
    number = packed.shape[0]
    k, p, m1, s1, m2, s2 = light[0], light[1], light[2], light[3], light[4], light[5]
    log_distance, gamma = math.log(light[6]), light[7]
    inverse_gamma = F(1) / gamma
    for i in range(chunk * CHUNK, min(number, (chunk + 1) * CHUNK)):
        x = centre[0] - packed[i, 0]
        y = centre[1] - packed[i, 1]
        z = centre[2] - packed[i, 2]
        nx, ny, nz = material[i, 3], material[i, 4], material[i, 5]
        square = x * x + y * y + z * z
        cosine = (nx * x + ny * y + nz * z) / math.sqrt(square * (nx * nx + ny * ny + nz * nz))
        fall = math.exp(p * (log_distance - F(0.5) * math.log(square)))
        diffuse = F(1) - k + k * max(cosine, F(0))
        lobes = s1 * math.exp(m1 * (cosine - F(1))) + s2 * math.exp(m2 * (cosine - F(1)))
        for channel in range(3):
            albedo = max(material[i, channel], MIN_ALBEDO)
            value = fall * (math.exp(gamma * math.log(albedo)) * diffuse + lobes)
            radiance[i, channel] = value
            shown = math.exp(inverse_gamma * math.log(max(value, MIN_RADIANCE)))
            packed[i, HARMONICS + channel] = (shown - F(0.5)) / C0


@kernel(parallel=True)
def shade_kernel(  # type: ignore[no-untyped-def]
    packed: Floats, material: Floats, centre: Floats, light: Floats, radiance: Floats,
):  # fmt: skip
    """Colours of all Gaussians seen, and lit, from `centre`, in any precision.

    Args:
        packed: [N, 14] scene; columns 11:14 are written.
        material: [N, 6] albedo and normal.
        centre: [3] of the camera, in the frame of the scene.
        light: [8], see `coefficients`.
        radiance: [N, 3] output, what `shade_backward_kernel` needs.
    """
    number = packed.shape[0]
    for chunk in prange((number + CHUNK - 1) // CHUNK):
        _shade_chunk(np.int64(chunk), packed, material, centre, light, radiance)


@helper
def _shade_chunk_in_lanes(chunk, packed, material, centre, light, radiance):  # type: ignore[no-untyped-def]
    """One chunk of `shade_lanes`."""
    number = packed.shape[0]
    k, p, m1, s1, m2, s2 = light[0], light[1], light[2], light[3], light[4], light[5]
    log_distance, gamma = F(math.log2(light[6])), light[7]
    inverse_gamma = F(1) / gamma
    start, end = chunk * CHUNK, min(number, (chunk + 1) * CHUNK)
    # rows: position less the centre 0:3, albedo 3:6, normal 6:9; then radiance and colour
    given = np.ones((9, CHUNK), np.float32)
    result = np.empty((6, CHUNK), np.float32)
    for i in range(end - start):
        for column in range(3):
            given[column, i] = centre[column] - packed[start + i, column]
        for column in range(MATERIAL_COLUMNS):
            given[3 + column, i] = material[start + i, column]
    for i in range(0, end - start, WIDTH):
        x, y = load_from(given, i), load_from(given, CHUNK + i)
        z = load_from(given, 2 * CHUNK + i)
        nx, ny = load_from(given, 6 * CHUNK + i), load_from(given, 7 * CHUNK + i)
        nz = load_from(given, 8 * CHUNK + i)
        square = x * x + y * y + z * z
        lengths = root(square * (nx * nx + ny * ny + nz * nz))
        cosine = (nx * x + ny * y + nz * z) / lengths
        fall = exponential((log_distance - log2(square) * F(0.5)) * (p * LOG_2))
        diffuse = at_least(cosine, F(0)) * k + (F(1) - k)
        off = cosine - F(1)
        lobes = exponential(off * m1) * s1 + exponential(off * m2) * s2
        for channel in range(3):
            albedo = at_least(load_from(given, (3 + channel) * CHUNK + i), MIN_ALBEDO)
            value = fall * (exponential(log2(albedo) * (gamma * LOG_2)) * diffuse + lobes)
            store_from(result, channel * CHUNK + i, value)
            shown = exponential(log2(at_least(value, MIN_RADIANCE)) * (inverse_gamma * LOG_2))
            colour = (shown - F(0.5)) * (F(1) / C0)
            store_from(result, (3 + channel) * CHUNK + i, colour)
    for i in range(end - start):
        for channel in range(3):
            radiance[start + i, channel] = result[channel, i]
            packed[start + i, HARMONICS + channel] = result[3 + channel, i]


@kernel(parallel=True)
def shade_lanes(  # type: ignore[no-untyped-def]
    packed: Floats, material: Floats, centre: Floats, light: Floats, radiance: Floats,
):  # fmt: skip
    """`shade_kernel` in float32, 16 Gaussians at a time."""
    number = packed.shape[0]
    for chunk in prange((number + CHUNK - 1) // CHUNK):
        _shade_chunk_in_lanes(np.int64(chunk), packed, material, centre, light, radiance)


@helper
def _shade_chunk_back(  # type: ignore[no-untyped-def]
    chunk, packed, material, centre, pose, light, radiance, gradient, d_material, parts,
):  # fmt: skip
    """One chunk of `shade_backward_kernel`."""
    number = packed.shape[0]
    k, p, m1, s1, m2, s2 = light[0], light[1], light[2], light[3], light[4], light[5]
    log_distance, gamma = math.log(light[6]), light[7]
    inverse_gamma = F(1) / gamma
    for j in range(9):
        parts[chunk, j] = F(0)
    for i in range(chunk * CHUNK, min(number, (chunk + 1) * CHUNK)):
        for column in range(6):
            d_material[i, column] = F(0)
        red, green, blue = gradient[i, 11], gradient[i, 12], gradient[i, 13]
        if red == F(0) and green == F(0) and blue == F(0):
            continue
        x = centre[0] - packed[i, 0]
        y = centre[1] - packed[i, 1]
        z = centre[2] - packed[i, 2]
        square = x * x + y * y + z * z
        inverse = F(1) / math.sqrt(square)
        x, y, z = x * inverse, y * inverse, z * inverse
        nx, ny, nz = material[i, 3], material[i, 4], material[i, 5]
        inverse_length = F(1) / math.sqrt(nx * nx + ny * ny + nz * nz)
        nx, ny, nz = nx * inverse_length, ny * inverse_length, nz * inverse_length
        cosine = nx * x + ny * y + nz * z
        log_fall = log_distance - F(0.5) * math.log(square)
        fall = math.exp(p * log_fall)
        facing = max(cosine, F(0))
        diffuse = F(1) - k + k * facing
        narrow, broad = math.exp(m1 * (cosine - F(1))), math.exp(m2 * (cosine - F(1)))
        lobes = s1 * narrow + s2 * broad
        # by the two summands inside fall * (albedo^gamma * diffuse + lobes), and by fall
        by_diffuse, by_lobes, by_fall = F(0), F(0), F(0)
        for channel in range(3):
            value = radiance[i, channel]
            if value <= MIN_RADIANCE:
                continue
            shown = F(0.5) + C0 * packed[i, HARMONICS + channel]
            by_value = gradient[i, HARMONICS + channel] / C0 * inverse_gamma * shown / value
            matte = value / fall - lobes  # albedo^gamma * diffuse
            by_lobes += by_value
            by_fall += by_value * value
            by_diffuse += by_value * matte
            if material[i, channel] > MIN_ALBEDO:
                d_material[i, channel] = by_value * fall * gamma * matte / material[i, channel]
        # diffuse is at least 1 - k
        by_diffuse *= fall / diffuse
        by_lobes *= fall
        by_cosine = by_lobes * (s1 * m1 * narrow + s2 * m2 * broad)
        if cosine > F(0):
            by_cosine += by_diffuse * k
        parts[chunk, 0] += by_diffuse * (facing - F(1))
        parts[chunk, 1] += by_fall * log_fall
        parts[chunk, 2] += by_lobes * s1 * narrow * (cosine - F(1))
        parts[chunk, 3] += by_lobes * narrow
        parts[chunk, 4] += by_lobes * s2 * broad * (cosine - F(1))
        parts[chunk, 5] += by_lobes * broad
        d_material[i, 3] = by_cosine * (x - cosine * nx) * inverse_length
        d_material[i, 4] = by_cosine * (y - cosine * ny) * inverse_length
        d_material[i, 5] = by_cosine * (z - cosine * nz) * inverse_length
        # the position, through the direction and through the distance
        dx = -inverse * (by_cosine * (nx - cosine * x) - p * by_fall * x)
        dy = -inverse * (by_cosine * (ny - cosine * y) - p * by_fall * y)
        dz = -inverse * (by_cosine * (nz - cosine * z) - p * by_fall * z)
        gradient[i, 0] += dx
        gradient[i, 1] += dy
        gradient[i, 2] += dz
        # the centre -R^T t moves by -R^T v under a twist (v, w)
        for j in range(3):
            parts[chunk, 6 + j] += pose[j, 0] * dx + pose[j, 1] * dy + pose[j, 2] * dz


@kernel(parallel=True)
def shade_backward_kernel(  # type: ignore[no-untyped-def]
    packed: Floats, material: Floats, centre: Floats, pose: Floats, light: Floats,
    radiance: Floats, gradient: Floats, d_material: Floats, parts: Floats,
):  # fmt: skip
    """Gradient of `shade_kernel`.

    Args:
        packed, material, centre, light, radiance: as `shade_kernel` had and left them.
        pose: [3, 4] cam_from_world.
        gradient: [N, 14] of the packed scene; from columns 11:14, columns 0:3 are added to.
        d_material: [N, 6] output.
        parts: [chunks, 9] output per chunk: by k, p, m1, s1, m2, s2, and the translation of a twist
            applied to the camera from the left.
    """
    number = packed.shape[0]
    for chunk in prange((number + CHUNK - 1) // CHUNK):
        _shade_chunk_back(
            np.int64(chunk), packed, material, centre, pose, light, radiance, gradient, d_material,
            parts,
        )  # fmt: skip
