# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The camera in the synthetic street: rays, light, shadows and fog, in numba.

A column of an image is a vertical plane. One walk along the tables of the street finds all walls
of a column; each sample then needs one comparison per wall. The center line ahead is a table,
relative to the camera: a bend turns the street, or only moves it sideways with depth.
"""

# Numba infers the types of kernels.
# mypy: disable-error-code="no-untyped-def"
# ruff: noqa: PLR0912  (one branch for each thing that a ray meets reads best)

from math import atan, cos, exp, hypot, pi, sin

import numpy as np
from stavpr_lab.demonstration.street.objects import draw_things
from stavpr_lab.demonstration.street.street import CELL, SIDE_STREET, Street, VIEW
from stavpr_lab.demonstration.street.surfaces import ground, hash01, noise, sky
from stavpr_lab.demonstration.street.walls import roof_height, wall
from stavpr_ros.compilation import kernel

# Rays per pixel, one above the other: most lines lean, and upright ones need no smoothing.
SAMPLES = 2
MAX_WALLS = 8  # walls kept per column; each is higher in the image than the one before
BLOCK_DEPTH = 14.0  # meters from a building's front to its back
EYE = 1.55  # height of the camera, meters
FOCAL = 0.62  # focal length over the width of the image: 78 degrees
HORIZON = 0.56  # height of the horizon over the height of the image
FAR = 1e4
MIN_TOWARDS = 0.1  # cosine of a ray and the street from which a bend hides the rest

# Columns of the table of walls that a column of samples meets.
WALL_DEPTH, WALL_TOP, WALL_LOT, WALL_ALONG, WALL_FRONT, WALL_ROW, WALL_AHEAD = range(7)
# Light as one array of numbers for the kernels, in this order.
(SUN, SUN_RIGHT, SUN_AHEAD, SUN_UP, AMBIENT, LAMPS, COVER, WET, FOLIAGE, SUN_AZIMUTH, SKY_SEED,
 FOG, EXPOSURE, WARMTH, RAIN, NOISE) = range(16)  # fmt: skip


def render(
    street: Street, along: float, across: float, pitch: float, yaw: float, light: np.ndarray,
    traffic: np.ndarray, grain_seed: int, width: int, height: int,
) -> np.ndarray:  # fmt: skip
    """
    Render one image.

    :param along, across: where the camera is, meters along the street and to the right of its
        center line.
    :param pitch, yaw: radians that it looks up, and to the right of the street's direction.
    :param light: the conditions; the direction of the sun is filled in here.
    :param traffic: cars, as the things of a :class:`Street`.
    :param grain_seed: seed of sensor noise and rain drops.
    :returns: RGB, shape (height, width, 3), uint8.
    """
    heading = float(street.headings[int(along / CELL)])
    line = center_line_ahead(street, along)
    light = light.copy()
    towards = light[SUN_AZIMUTH] - heading
    level = np.sqrt(1 - light[SUN_UP] ** 2)
    light[SUN_RIGHT], light[SUN_AHEAD] = sin(towards) * level, cos(towards) * level
    things = np.concatenate([street.things, traffic])
    ahead = things['along'] - along
    visible = np.flatnonzero((ahead > -3) & (ahead < 150))
    things = things[visible[np.argsort(-ahead[visible], kind='stable')]]
    focal = FOCAL * width
    horizon = HORIZON * height + pitch * focal
    camera = np.array([along, across, EYE, focal, horizon, yaw, heading])
    # Columns lie together in memory, because the scene is drawn column by column.
    color = np.empty((width, height * SAMPLES, 3), np.float32).transpose(1, 0, 2)
    depth = np.empty((width, height * SAMPLES), np.float32).T
    _draw_scene(color, depth, street.lots, street.lot_of, line, street.seed, camera, light)
    draw_things(color, depth, things, line, camera, light, SAMPLES)
    image = np.empty((height, width, 3), np.uint8)
    _expose(color, depth, light, grain_seed, image)
    if light[RAIN] > 0:
        _streak(image, light[RAIN], grain_seed)
    return image


def center_line_ahead(street: Street, along: float) -> np.ndarray:
    """
    Return the center line at the end of each cell ahead, relative to its point at ``along``.

    :returns: meters ahead and to the right, sine and cosine of the direction, shape (steps, 4).
    """
    first = int(along / CELL)
    steps = min(int(VIEW / CELL) - 2, len(street.curvature) - first - 2)
    if not street.rigid:
        heading = np.cumsum(street.curvature[first : first + steps]) * CELL
        ahead = (first + 1 + np.arange(steps)) * CELL - along
        zero = np.zeros(steps)
        return np.column_stack([ahead, np.cumsum(heading) * CELL, zero, zero + 1])
    directions = street.headings[first : first + steps + 1] - street.headings[first]
    middle = (directions[1:] + directions[:-1]) / 2
    lengths = np.full(steps, CELL)
    lengths[0] -= along - first * CELL
    return np.column_stack([
        np.cumsum(lengths * np.cos(middle)), np.cumsum(lengths * np.sin(middle)),
        np.sin(directions[1:]), np.cos(directions[1:]),
    ])  # fmt: skip


@kernel
def _find_walls(lots, lot_of, line, along, across, slope, eye, walls):
    """Walk along one column's plane; return the number of visible walls."""
    count, highest = 0, -FAR
    first = int(along / CELL)
    last_near, last_far = -1, -1
    z0, u0, ahead0 = 0.0, across, 0.0
    for step in range(len(line)):
        ahead1 = (first + 1 + step) * CELL - along
        forward, right, sine, cosine = line[step]
        towards = cosine + slope * sine
        if towards < MIN_TOWARDS:
            break
        z1 = (forward * cosine + (right - across) * sine) / towards
        u1 = (across + slope * z1 - right) * cosine - (z1 - forward) * sine
        side = 1 if u1 > 0 else 0
        for row in range(side, 4, 2):
            lot = lot_of[row, first + step]
            last = last_near if row < 2 else last_far
            inside = -1
            setback = lots[lot].setback
            if lots[lot].kind != SIDE_STREET and setback <= abs(u1) < setback + BLOCK_DEPTH:
                inside = lot
                if lot != last and count < len(walls):
                    front = abs(u0) < setback
                    part = (setback - abs(u0)) / (abs(u1) - abs(u0)) if front else 0.0
                    z = max(z0 + part * (z1 - z0), 0.05)
                    ahead = max(ahead0 + part * (ahead1 - ahead0), 0.05)
                    place = ahead + along - lots[lot].start if front else abs(u0) - setback
                    top = roof_height(lots[lot], place) if front else lots[lot].height
                    if (top - eye) / z > highest:
                        highest = (top - eye) / z
                        walls[count, WALL_DEPTH], walls[count, WALL_TOP] = z, top
                        walls[count, WALL_LOT], walls[count, WALL_ALONG] = lot, place
                        walls[count, WALL_FRONT], walls[count, WALL_ROW] = front, row
                        walls[count, WALL_AHEAD] = ahead
                        count += 1
            if row < 2:
                last_near = inside
            else:
                last_far = inside
        z0, u0, ahead0 = z1, u1, ahead1
    return count


@kernel
def _on_ground(line, along, across, slope, z):
    """Return meters along the street from the camera, and across, of a point at a depth z."""
    first, last = int(along / CELL), len(line) - 1
    ahead, u = z, 0.0
    for _ in range(4):  # along the tangent at the cell of the last guess
        cell = min(max(int(ahead / CELL), 0), last)
        forward, right, sine, cosine = line[cell]
        beyond, beside = z - forward, across + slope * z - right
        u = beside * cosine - beyond * sine
        if sine == 0:
            break
        ahead = (first + 1 + cell) * CELL - along + beyond * cosine + beside * sine
    return ahead, u


@kernel
def sunlit(lots, lot_of, along, across, height, light):
    """Return how much of the sun reaches a point: 0 in the shadow of a building, else up to 1."""
    right = light[SUN_RIGHT]
    if light[SUN] <= 0 or abs(right) < 0.02:
        return 0.3
    row = 1 if right > 0 else 0
    reach = max(0.0, (16.0 - across * (1 if right > 0 else -1)) / abs(right))
    there = along + light[SUN_AHEAD] * reach
    lot = lot_of[row, min(max(int(there / CELL), 0), lot_of.shape[1] - 1)]
    if lots[lot].kind == SIDE_STREET:
        return 1.0
    above = height + light[SUN_UP] * reach - roof_height(lots[lot], there - lots[lot].start)
    return min(1.0, max(0.0, above * 1.5 + 0.5))


@kernel
def _lit_wall(lots, lot_of, walls, k, height, street_along, light):
    """Paint and light one point of a wall."""
    lot, front, row = int(walls[k, WALL_LOT]), walls[k, WALL_FRONT] > 0, int(walls[k, WALL_ROW])
    r, g, b = wall(
        lots[lot], front, walls[k, WALL_ALONG], height, walls[k, WALL_DEPTH], light[LAMPS]
    )
    if r > 0.9 and b < 0.75 * r and light[LAMPS] > 0:  # a lamp behind the window shines by itself
        return r * 0.75, g * 0.75, b * 0.75
    facing = light[SUN_RIGHT] * (-1 if row & 1 else 1) if front else -light[SUN_AHEAD]
    power = light[AMBIENT] * (0.72 + 0.28 * min(1.0, height / 9.0)) * (1.0 if front else 0.9)
    if facing > 0 and light[SUN] > 0:
        setback = lots[lot].setback
        across = min(setback, 18.0) * (1 if row & 1 else -1)
        power += light[SUN] * facing * sunlit(lots, lot_of, street_along, across, height, light)
    return r * power, g * power, b * power


@kernel
def _lit_ground(lots, lot_of, seed, along, across, depth, light):
    """Paint and light one point of the ground."""
    lot = lot_of[1 if across > 0 else 0, min(max(int(along / CELL), 0), lot_of.shape[1] - 1)]
    r, g, b = ground(along, across, lots[lot].kind, seed, depth)
    power = light[AMBIENT] * (1.0 - 0.3 * min(1.0, abs(across) / 17.0))
    if light[SUN] > 0:
        power += light[SUN] * light[SUN_UP] * sunlit(lots, lot_of, along, across, 0.0, light)
    power *= 1.0 - 0.3 * light[WET]
    return r * power, g * power, b * power


@kernel
def _draw_scene(color, depth, lots, lot_of, line, seed, camera, light):
    """Fill the samples with sky, ground and walls, and their depths."""
    along, across, eye, focal, horizon, yaw, heading = camera
    rows, columns = depth.shape
    walls = np.empty((MAX_WALLS, 7))
    sun_rise = light[SUN_UP] / max(0.1, hypot(light[SUN_RIGHT], light[SUN_AHEAD]))
    cloud_seed = int(light[SKY_SEED])
    for x in range(columns):
        slope = (x + 0.5 - columns / 2) / focal + yaw
        count = _find_walls(lots, lot_of, line, along, across, slope, eye, walls)
        azimuth = atan(slope) + heading
        off = (azimuth - light[SUN_AZIMUTH] + 3 * pi) % (2 * pi) - pi
        for y in range(rows):
            rise = (horizon - (y + 0.5) / SAMPLES) / focal
            hit, height = -1, 0.0
            for k in range(count):
                height = eye + rise * walls[k, WALL_DEPTH]
                if height < 0:
                    break
                if height <= walls[k, WALL_TOP]:
                    hit = k
                    break
            if hit >= 0:
                z = walls[hit, WALL_DEPTH]
                at = along + walls[hit, WALL_AHEAD]
                r, g, b = _lit_wall(lots, lot_of, walls, hit, height, at, light)
            elif rise < -1e-3:
                z = -eye / rise
                ahead, u = _on_ground(line, along, across, slope, z)
                r, g, b = _lit_ground(lots, lot_of, seed, along + ahead, u, z, light)
                if light[WET] > 0:
                    puddle = 0.35 + 0.9 * noise((along + ahead) * 0.5, u * 0.9, 77)
                    shine = light[WET] * min(0.62, 0.1 + z / 60.0) * puddle
                    far = walls[0, WALL_DEPTH]
                    mirrored = 0.5 * (hash01(x, y, 31) - 0.5) - eye - rise * far
                    if count > 0 and mirrored < walls[0, WALL_TOP]:
                        height = max(0.0, mirrored)
                        at = along + walls[0, WALL_AHEAD]
                        mr, mg, mb = _lit_wall(lots, lot_of, walls, 0, height, at, light)
                    else:
                        mr = mg = mb = 0.75 * light[AMBIENT]
                    r, g, b = r + (mr - r) * shine, g + (mg - g) * shine, b + (mb - b) * shine
            else:
                z = FAR
                if y & 1 and depth[y - 1, x] == FAR:  # clouds are soft: one ray a pixel is enough
                    depth[y, x] = z
                    for channel in range(3):
                        color[y, x, channel] = color[y - 1, x, channel]
                    continue
                glow = light[SUN] * exp(-(off * off + (rise - sun_rise) ** 2) * 9.0)
                r, g, b = sky(azimuth, rise, light[COVER], cloud_seed, glow)
                power = 0.5 + 0.5 * min(1.0, light[AMBIENT] + 0.3 * light[SUN])
                r, g, b = r * power, g * power, b * power
            color[y, x, 0], color[y, x, 1], color[y, x, 2] = r, g, b
            depth[y, x] = z


@kernel
def _expose(color, depth, light, seed, image):
    """Average the samples of each pixel and let fog, lens and sensor act on them."""
    rows, columns, _ = image.shape
    bright = 0.4 + 0.6 * min(1.0, light[AMBIENT] + 0.3 * light[SUN])
    fr, fg, fb = 0.74 * bright, 0.79 * bright, 0.84 * bright
    gain = light[EXPOSURE]
    for x in range(columns):
        for y in range(rows):
            r = g = b = 0.0
            for sy in range(y * SAMPLES, (y + 1) * SAMPLES):
                far = depth[sy, x]
                clear = exp(-light[FOG] * (far if far < FAR else 120.0))
                r += fr + (min(color[sy, x, 0], 1.6) - fr) * clear
                g += fg + (min(color[sy, x, 1], 1.6) - fg) * clear
                b += fb + (min(color[sy, x, 2], 1.6) - fb) * clear
            dx, dy = x / columns - 0.5, y / rows - 0.5
            power = gain * (1.0 - 0.45 * (dx * dx + dy * dy)) / SAMPLES
            for channel in range(3):
                value = (r * (1 + light[WARMTH]), g, b * (1 - light[WARMTH]))[channel]
                # highlights roll off as on film
                value = 1.585 * value * power / (value * power + 0.714)
                across = x * 3 + channel
                spot = hash01(across, y, seed) + hash01(across, y, seed + 1) - 1.0
                value += light[NOISE] * 2.4 * spot
                image[y, x, channel] = int(min(255.0, max(0.0, value * 255.0 + 0.5)))


@kernel
def _streak(image, rain, seed):
    """Draw drops that fall through the image while the shutter is open."""
    rows, columns, _ = image.shape
    for drop in range(int(rain * 0.0032 * rows * columns)):
        x = hash01(drop, 1, seed) * columns
        y = hash01(drop, 2, seed) * rows
        size = rows * (0.03 + 0.07 * hash01(drop, 3, seed))
        strength = 0.12 + 0.25 * hash01(drop, 4, seed)
        for step in range(int(size)):
            px, py = int(x + step * 0.12), int(y + step)
            if px < columns and py < rows:
                for channel in range(3):
                    value = float(image[py, px, channel])
                    image[py, px, channel] = int(value + (205.0 - value) * strength)
