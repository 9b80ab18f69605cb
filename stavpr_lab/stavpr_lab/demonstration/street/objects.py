# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Objects in the synthetic street: trees, lamps, signs, cars, vans; in numba.

They are drawn after walls and ground, from far to near, each sample compared with the depth so
far. Cars are boxes that the rays enter from behind or from the side; all else is a flat card
facing the camera.
"""

# Numba infers the types of kernels.
# mypy: disable-error-code="no-untyped-def"
# ruff: noqa: PLR0911, PLR0912  (one return for each part of a thing reads best)

from math import floor, sqrt

from stavpr_lab.demonstration.street.street import CAR, CELL, LAMP, TREE, VAN
from stavpr_lab.demonstration.street.surfaces import hash01, noise
from stavpr_ros.compilation import kernel

_LAMPS, _FOLIAGE, _SUN, _AMBIENT = 5, 8, 0, 4  # of the array of light; see rendering.py
MIN_DEPTH = 0.9  # meters; nearer parts of a thing are not drawn


@kernel
def draw_things(color, depth, things, line, camera, light, fine):
    """
    Draw the things over the scene; they come sorted from far to near.

    :param fine: samples per row of the image.
    """
    for k in range(len(things)):
        kind = things[k].kind
        if kind in (CAR, VAN):
            _draw_car(color, depth, things[k], line, camera, light, fine)
        else:
            _draw_card(color, depth, things[k], line, camera, light, fine)


@kernel
def _from_camera(line, along, ahead, across):
    """Return the depth of a point of the street, and meters to the right of its tangent."""
    cell = max(0, min(int(ahead / CELL), len(line) - 1))
    forward, right, sine, cosine = line[cell]
    beyond = ahead - ((int(along / CELL) + 1 + cell) * CELL - along)
    z = forward + beyond * cosine - across * sine
    return z, right + beyond * sine + across * cosine


@kernel
def _draw_card(color, depth, thing, line, camera, light, fine):
    """Draw a tree, lamp or sign as a card that faces the camera."""
    along, across, eye, focal, horizon, yaw, _ = camera
    rows, columns = depth.shape
    z, right = _from_camera(line, along, thing.along - along, thing.across)
    if z < 2.0:
        return
    size, seed, kind = thing.scale, thing.seed, thing.kind
    scale = focal / z
    mid = columns / 2 + ((right - across) / z - yaw) * focal
    half, tall = (
        (3.3 * size, 9.0 * size) if kind == TREE else (1.5, 7.0) if kind == LAMP else (0.5, 3.2)
    )
    bottom = horizon + eye * scale
    for x in range(max(0, int(mid - half * scale)), min(columns, int(mid + half * scale) + 1)):
        u = (x + 0.5 - mid) / scale
        for y in range(
            max(0, int((bottom - tall * scale) * fine)), min(rows, int(bottom * fine) + 1)
        ):
            if depth[y, x] < z:
                continue
            h = (bottom - (y + 0.5) / fine) / scale
            if kind == TREE:
                cover, r, g, b = _tree(u / size, h / size, seed, light[_FOLIAGE], size * scale)
            elif kind == LAMP:
                cover, r, g, b = _lamp(u, h, thing.across > 0, light[_LAMPS])
            else:
                cover, r, g, b = _sign(u, h, seed)
            if cover:
                power = light[_AMBIENT] + 0.35 * light[_SUN] if r <= 1 else 1.0
                color[y, x, 0], color[y, x, 1], color[y, x, 2] = r * power, g * power, b * power
                depth[y, x] = z


@kernel
def _tree(u, h, seed, foliage, scale):
    """Paint a tree of unit size: trunk, then ragged leaves; `foliage` 0 is summer, 1 autumn."""
    trunk = 0.13 + 0.09 * hash01(1, 1, seed) + max(0.0, 0.35 - h) * 0.2
    dx, dy = u - 0.5 * (hash01(2, 1, seed) - 0.5), (h - 5.6) / 1.12
    away = sqrt(dx * dx + dy * dy) / (2.1 + 0.5 * hash01(3, 1, seed))
    clump = noise(u * 1.1 + 50, h * 1.1, seed)
    leaf = noise(u * 4.3 + 50, h * 4.3, seed + 1)
    if away + 0.75 * (clump - 0.5) + 0.5 * (leaf - 0.5) < 0.82 - 0.22 * foliage and away < 1.3:
        light = 0.5 + 0.3 * (h - 5.0) / 2.2 + 0.7 * (leaf - 0.5) + 0.7 * (clump - 0.4)
        if scale > 25:
            light += 0.35 * (noise(u * 13, h * 13, seed + 2) - 0.5)
        light = min(1.3, max(0.22, light))
        tint = hash01(4, 1, seed)
        r = (0.26 + 0.1 * tint) * (1 - foliage) + (0.68 + 0.2 * tint) * foliage
        g = (0.46 + 0.06 * tint) * (1 - foliage) + (0.38 + 0.16 * tint) * foliage
        return True, r * light, g * light, 0.16 * light
    if h < 5.5 and abs(u) < trunk:
        bark = (0.8 + 0.4 * noise(u * 20, h * 3, seed)) * (0.75 + u / trunk * 0.25)
        return True, 0.3 * bark, 0.24 * bark, 0.19 * bark
    return False, 0.0, 0.0, 0.0


@kernel
def _lamp(u, h, right, lamps):
    """Paint a street lamp whose arm reaches over the road."""
    u = -u if right else u
    if abs(u) < 0.07 + (0.06 if h < 0.9 else 0.0) and h < 6.4:
        return True, 0.2, 0.22, 0.22
    if 0 <= u < 1.25 and abs(h - 6.3 - 0.2 * u) < 0.06:
        return True, 0.2, 0.22, 0.22
    if 0.85 < u < 1.4 and 6.28 < h < 6.5:
        return (True, 1.5, 1.3, 0.9) if lamps > 0.05 else (True, 0.6, 0.6, 0.58)
    return False, 0.0, 0.0, 0.0


@kernel
def _sign(u, h, seed):
    """Paint a traffic sign: a disc, a triangle or a plate."""
    shape = int(hash01(1, 2, seed) * 3)
    v = h - 2.6
    if shape == 0:
        away = u * u + v * v
        if away < 0.14:
            return (True, 0.75, 0.1, 0.1) if away > 0.08 else (True, 0.92, 0.92, 0.9)
    elif shape == 1:
        edge = 0.45 - abs(u) * 1.75 - (v + 0.1)
        if edge > 0 and v > -0.35:
            if edge < 0.18 or v < -0.26:
                return True, 0.78, 0.12, 0.1
            return True, 0.95, 0.92, 0.85
    elif abs(u) < 0.36 and abs(v) < 0.36:
        if abs(u) < 0.31 and abs(v) < 0.31 and abs(u + v) > 0.1:
            return True, 0.1, 0.27, 0.6
        return True, 0.9, 0.9, 0.9
    if abs(u) < 0.045 and h < 2.6:
        return True, 0.45, 0.46, 0.46
    return False, 0.0, 0.0, 0.0


@kernel
def _draw_car(color, depth, thing, line, camera, light, fine):
    """Draw a car or van: its shadow, its body and its cabin."""
    along, across, eye, focal, horizon, yaw, _ = camera
    size, seed, van = thing.scale, thing.seed, thing.kind == VAN
    length = (5.2 if van else 4.3) * size
    middle = thing.along - along + length / 2
    z, u = _from_camera(line, along, middle, thing.across)
    z, u = z - length / 2, u - across
    half = 0.98 if van else 0.88
    lens = (focal, horizon, yaw, eye, fine)
    _draw_shadow(color, depth, u, half + 0.25, z - 0.25, z + length + 0.3, lens)
    if van:
        _draw_box(color, depth, u, half, z, z + length, 0.3, 2.25, 2, seed, lens, light)
    else:
        near, far = z + 0.35, z + length * 0.72
        _draw_box(color, depth, u, half - 0.14, near, far, 0.85, 1.44, 1, seed, lens, light)
        _draw_box(color, depth, u, half, z, z + length, 0.24, 0.9, 0, seed, lens, light)


@kernel
def _draw_shadow(color, depth, u, half, z0, z1, lens):
    """Darken the ground below a car."""
    focal, horizon, yaw, eye, fine = lens
    rows, columns = depth.shape
    if z1 < MIN_DEPTH:
        return
    near = max(z0, MIN_DEPTH)
    first = int((horizon + eye * focal / z1) * fine) + 1
    last = int((horizon + eye * focal / near) * fine) + 1
    for y in range(max(0, first), min(rows, last)):
        z = eye * focal / ((y + 0.5) / fine - horizon)
        mid = columns / 2 + (u / z - yaw) * focal
        for x in range(
            max(0, int(mid - half * focal / z)), min(columns, int(mid + half * focal / z) + 1)
        ):
            if z0 < z < z1 and depth[y, x] > z - 0.5:
                edge = min(z - z0, z1 - z, half - abs((x + 0.5 - mid) * z / focal))
                dark = 1.0 - 0.68 * min(1.0, max(0.0, edge * 2.5))
                color[y, x, 0] *= dark
                color[y, x, 1] *= dark
                color[y, x, 2] *= dark


@kernel
def _draw_box(color, depth, u, half, z0, z1, low, high, part, seed, lens, light):
    """Draw the visible faces of a box: the one behind, one side and the top."""
    focal, horizon, yaw, eye, fine = lens
    rows, columns = depth.shape
    if z1 < MIN_DEPTH + 0.2:
        return
    near = max(z0, MIN_DEPTH)
    left = min((u - half) / near, (u - half) / z1)
    right = max((u + half) / near, (u + half) / z1)
    first, last = columns / 2 + (left - yaw) * focal, columns / 2 + (right - yaw) * focal
    for x in range(max(0, int(first)), min(columns, int(last) + 1)):
        slope = (x + 0.5 - columns / 2) / focal + yaw
        enter, leave = near, z1
        if abs(slope) > 1e-6:
            a, b = (u - half) / slope, (u + half) / slope
            enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
        elif abs(u) > half:
            continue
        if enter >= leave:
            continue
        behind = enter <= z0 + 1e-9
        top, bottom = horizon + (eye - high) * focal / enter, horizon + (eye - low) * focal / enter
        roof = min(top, horizon + (eye - high) * focal / leave)
        for row in range(max(0, int(roof * fine + 0.5)), min(rows, int(bottom * fine + 0.5))):
            if depth[row, x] < enter:
                continue
            y = (row + 0.5) / fine
            if y < top:
                face, h = 2, high
            else:
                face, h = 0 if behind else 1, eye - (y - horizon) * enter / focal
            place = (slope * enter - u) / half if face == 0 else (enter - z0) / (z1 - z0)
            r, g, b = _car_paint(face, place, h, part, seed, light[_LAMPS])
            power = (light[_AMBIENT] + 0.4 * light[_SUN]) * (
                1.12 if face == 2 else 1.0 if face == 0 else 0.82
            )
            if r > 1.0:
                power = 1.0
            color[row, x, 0], color[row, x, 1], color[row, x, 2] = r * power, g * power, b * power
            depth[row, x] = enter


@kernel
def _car_paint(face, place, h, part, seed, lamps):
    """
    Paint a point of a car.

    :param face: 0 behind, 1 side, 2 top.
    :param place: behind: -1 to 1 across; side: 0 to 1 along.
    :param part: 0 body, 1 cabin, 2 van.
    """
    hue = hash01(1, 4, seed)
    light = 0.2 + 0.65 * hash01(2, 4, seed)
    r, g, b = light, light, light * 1.02
    if hue > 0.85:
        r, g, b = 0.5 * light + 0.15, 0.13, 0.12
    elif hue > 0.7:
        r, g, b = 0.16, 0.22 + 0.1 * light, 0.34 + 0.25 * light
    elif hue > 0.6:
        r, g, b = 0.2 + 0.1 * light, 0.3 + 0.1 * light, 0.24
    if part == 2:
        r, g, b = (0.85, 0.85, 0.83) if hue < 0.6 else (r, g, b)
    if face == 2:
        return (0.12, 0.14, 0.17) if part == 1 and hue < 0.15 else (r, g, b)
    if face == 1:
        wheel = min(abs(place - 0.19), abs(place - 0.8)) * 4.3
        away = wheel * wheel + (h - 0.33) ** 2
        if part != 1 and away < 0.1:
            return (0.5, 0.5, 0.52) if away < 0.03 else (0.05, 0.05, 0.055)
        if part == 1 and 0.06 < place < 0.94 and abs(place - 0.5) > 0.03 and h < 1.36:
            return 0.11, 0.13, 0.16
        if abs(place - 0.5) < 0.006 or (part == 0 and h < 0.36):
            return r * 0.45, g * 0.45, b * 0.45
        return r, g, b
    if part == 1:
        if abs(place) < 0.86 and h < 1.37:
            return 0.1 + 0.1 * (h - 0.85), 0.13, 0.17
        return r, g, b
    top = 0.82 if part == 0 else 1.35
    if abs(place) > 0.72 and top - 0.24 < h < top:
        return (1.3, 0.16, 0.12) if lamps > 0.05 else (0.62, 0.07, 0.06)
    if abs(place) < 0.3 and 0.5 < h < 0.62:
        return 0.85, 0.85, 0.8
    if part == 2 and abs(place) < 0.85 and 1.45 < h < 2.1 and abs(place) > 0.04:
        return 0.1, 0.12, 0.15
    if h < 0.42:
        return 0.12, 0.12, 0.13
    shade = 0.85 + 0.15 * floor(h * 4) / 4
    return r * shade, g * shade, b * shade
