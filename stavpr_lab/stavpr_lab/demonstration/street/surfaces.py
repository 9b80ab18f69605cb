# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Hashes, noise, and the paint of the ground and the sky of the synthetic street, in numba.

Paint is red, green and blue in [0, 1] before light, fog and exposure, as a function of a point.
Randomness is a hash of whole numbers: the same point has the same paint in every image, on every
machine. The arithmetic is float64 because it is scalar: float32 would be no faster.
"""

# Numba infers the types of kernels.
# mypy: disable-error-code="no-untyped-def"

from math import floor, sin, sqrt

from stavpr_lab.demonstration.street.street import PARK, ROAD_HALF_WIDTH, SIDE_STREET
from stavpr_ros.compilation import kernel

_X, _Y, _SEED, _MIX = (
    0x2545F4914F6CDD1D,
    0x369DEA0F31A53F85,
    0x1B873593CC9E2D51,
    0x5851F42D4C957F2D,
)
_HALF = ROAD_HALF_WIDTH


@kernel
def part(x):
    """Return the fraction of a number; several times as fast as `x % 1`."""
    return x - floor(x)


@kernel
def _mix(h):
    """Scramble an integer, which may have overflowed, to [0, 1)."""
    h = (h ^ (h >> 32)) * _MIX
    return ((h ^ (h >> 29)) >> 20 & 0xFFFFFF) / 16777216.0


@kernel
def hash01(x, y, seed):
    """Hash three integers to [0, 1)."""
    return _mix(x * _X + y * _Y + seed * _SEED)


@kernel
def noise(x, y, seed):
    """Interpolate hashed values between the whole numbers; in [0, 1)."""
    ix, iy = floor(x), floor(y)
    u, v = x - ix, y - iy
    u, v = u * u * (3 - 2 * u), v * v * (3 - 2 * v)
    h = ix * _X + iy * _Y + seed * _SEED
    low, low_right, high = _mix(h), _mix(h + _X), _mix(h + _Y)
    low += (low_right - low) * u
    high += (_mix(h + _X + _Y) - high) * u
    return low + (high - low) * v


@kernel
def ground(along, across, kind, seed, far):
    """Paint a point of road, pavement, side street or park; `kind`: of the lot beside it."""
    fine = max(0.0, 1.0 - far / 30.0)
    coarse = noise(along * 0.35, across * 0.8, seed)
    grain = 0.9 + 0.16 * coarse
    if fine > 0:
        grain += 0.18 * fine * (noise(along * 6.0, across * 9.0, seed + 2) - 0.5)
    side = abs(across)
    if side < _HALF or (kind == SIDE_STREET and side >= _HALF):
        return _asphalt(along, across, side, seed, grain, fine)
    if side < _HALF + 0.22:  # kerb
        stone = (0.66 if part(along * 1.0) > 0.05 else 0.45) * grain
        return stone, stone, stone * 0.97
    if kind == PARK and side > 13.5:
        grass = 0.7 + 0.6 * noise(along * 1.4, across * 1.6, seed + 4)
        return 0.26 * grass, 0.38 * grass, 0.17 * grass
    tile = 0.56 * grain * (0.93 + 0.14 * hash01(floor(along * 1.25), floor(across * 1.25), seed))
    if fine > 0.2 and (part(along * 1.25) < 0.07 or part(across * 1.25) < 0.07):
        tile *= 0.8
    return tile, tile * 0.97, tile * 0.92


@kernel
def _asphalt(along, across, side, seed, grain, fine):
    """Paint tarmac with patches, cracks, covers and markings."""
    tar = 0.34 * grain
    cell = floor(along / 9.0)
    x = along - cell * 9.0
    if hash01(cell, 1, seed) < 0.35:  # a repaired trench
        left = -4.5 + 7.0 * hash01(cell, 2, seed)
        near = 5.0 * hash01(cell, 4, seed)
        if near < x < near + 1.2 + 3.5 * hash01(
            cell, 5, seed
        ) and left < across < left + 0.8 + 2.0 * hash01(cell, 3, seed):
            tar *= 0.72
    if side < _HALF:
        cx, cy = 1.5 + 6.0 * hash01(cell, 6, seed), -3.0 + 6.0 * hash01(cell, 7, seed)
        radius = sqrt((x - cx) ** 2 + (across - cy) ** 2)
        if radius < 0.42 and hash01(cell, 8, seed) < 0.45:
            tar *= 0.6 if radius < 0.34 else 1.25
        paint = _marking(along, across, side, seed)
        if paint > 0:
            paint *= 0.78 + 0.3 * noise(along * 2.0, across * 4.0, seed + 6)  # worn by wheels
            return paint, paint, paint * 0.97
        if side > _HALF - 0.35:
            tar *= 0.82
    cracked = fine > 0.3 and hash01(cell, 9, seed) < 0.3
    if cracked and abs(noise(along * 0.5, across * 1.7, seed + 8) - 0.5) < 0.008:
        tar *= 1.0 - 0.35 * fine
    return tar, tar, tar * 1.03


@kernel
def _marking(along, across, side, seed):
    """Return how bright the paint on the road is, 0 where there is none."""
    crossing = floor(along / 46.0)
    start = crossing * 46.0 + 30.0 * hash01(crossing, 21, seed)
    if start < along < start + 3.2 and hash01(crossing, 22, seed) < 0.5 and side < 4.9:
        return 0.8 if part(across) < 0.52 else 0.0
    if side < 0.08 and part(along / 6.0) < 0.5:
        return 0.8
    if 3.52 < side < 3.62 and hash01(floor(along / 23.0), 3, seed) < 0.7:
        return 0.72
    return 0.0


@kernel
def sky(azimuth, rise, cover, seed, glow):
    """
    Paint the sky.

    :param azimuth: radians to the right of where the street began.
    :param rise: tangent of the elevation.
    :param cover: clouds, 0 to 1.
    :param glow: closeness to the sun, 0 to 1.
    """
    up = min(1.0, max(0.0, rise / 0.7))
    r, g, b = 0.74 - 0.42 * up, 0.84 - 0.32 * up, 0.93 - 0.13 * up
    x, y = azimuth * 4.0, rise * 5.0 + 1.4 * up
    cloud = (
        0.5 * noise(x, y * 1.8, seed)
        + 0.3 * noise(x * 2.1, y * 4.0, seed + 1)
        + 0.2 * noise(x * 4.4, y * 8.0, seed + 2)
    )
    amount = min(1.0, max(0.0, (cloud - 0.72 + 0.85 * cover) * 4.5))
    body = 0.97 - 0.12 * cover * cover - 0.12 * cover * (cloud - 0.4)
    r, g, b = r + (body - r) * amount, g + (body - g) * amount, b + (body * 1.02 - b) * amount
    r, g, b = r + glow * 0.5, g + glow * 0.42, b + glow * 0.25
    if rise < 0.13 and rise < 0.055 + 0.05 * sin(azimuth * 3.0 + 1.0) * sin(
        azimuth * 7.0
    ) + 0.02 * noise(azimuth * 40, 0.0, 5):
        return 0.5, 0.56, 0.6  # hills
    return r, g, b
