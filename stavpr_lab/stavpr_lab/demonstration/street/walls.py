# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The paint of walls, roofs and hedges of the synthetic street, in numba, as in `surfaces`."""

# Numba infers the types of kernels.
# mypy: disable-error-code="no-untyped-def"
# ruff: noqa: PLR0911  (one return for each part of a wall reads best)

from math import floor, sin

from stavpr_lab.demonstration.street.street import BRICK, HALL, OFFICE, PARK
from stavpr_lab.demonstration.street.surfaces import hash01, noise, part
from stavpr_ros.compilation import kernel


@kernel
def roof_height(lot, along):
    """Return how high a lot's building is at a distance along its front: gables and chimneys."""
    height = lot.height
    if lot.kind == PARK:
        return height + 0.5 * noise(along * 1.3, 0.0, lot.seed)
    if lot.gable > 0:
        height += min(along, lot.length - along) * 0.55
    seed = lot.seed
    chimney = lot.length * (0.15 + 0.7 * hash01(1, 2, seed))
    if abs(along - chimney) < 0.5 and lot.style != OFFICE:
        height += 1.5
    return height


@kernel
def wall(lot, front, along, height, far, lamps):
    """
    Paint a point of a building or hedge.

    :param front: the wall along the street; otherwise the wall between two lots.
    :param along: meters along the wall.
    :param far: meters from the camera; fine grain fades with it.
    :param lamps: share of windows that are lit.
    """
    seed = lot.seed
    style = lot.style
    grain = 0.16 * (noise(along * 0.5, height * 0.35, seed) - 0.5)
    fine = max(0.0, 1.0 - far / 32.0)
    if fine > 0:
        grain += 0.16 * fine * (noise(along * 5.0, height * 7.0, seed + 1) - 0.5)
    if lot.kind == PARK:
        leaf = 0.75 + 2.0 * grain + 0.45 * noise(along * 2.2, height * 2.5, seed + 3) - 0.2
        return 0.24 * leaf, 0.37 * leaf, 0.17 * leaf
    top = lot.height
    if front and height > top:  # tiles and chimneys above the eaves
        tile = 0.8 + 0.2 * part(height * 3.0) + 2 * grain
        if seed & 1:
            return 0.42 * tile, 0.25 * tile, 0.21 * tile
        return 0.27 * tile, 0.28 * tile, 0.31 * tile
    r, g, b = lot.red, lot.green, lot.blue
    shade = 1.0 + grain * 1.5
    if style == BRICK and far < 30:
        course = floor(height * 7.0)
        joint = part(height * 7.0) < 0.16 or part(along * 3.2 + 0.5 * (course & 1)) < 0.07
        shade *= 1.0 + (0.16 if joint else -0.03) * (1.0 - far / 30.0)
    dirt = 1.2 if height < 6 else 0.6
    shade *= 1.0 - 0.16 * noise(along * 0.9, height * 0.12, seed + 9) * dirt
    if not front:
        shade *= 0.86
        column, story = floor(along / 3.4), floor((height - 1.2) / 3.1)
        if hash01(column, story, seed) < 0.16 and height < top - 1.2:
            x, y = along / 3.4 - column, (height - 1.2) / 3.1 - story
            if 0.3 < x < 0.7 and 0.25 < y < 0.75:
                return 0.2, 0.22, 0.26
        return r * shade, g * shade, b * shade
    if height < lot.ground_floor and style != HALL:
        return _ground_floor(lot, along, height, shade, lamps)
    return _upper_floors(lot, along, height, shade, lamps)


@kernel
def _glass(x, y, seed, lamps):
    """Paint a pane: sky in it, a curtain, or a lamp behind it."""
    mood = hash01(3, 5, seed)
    if hash01(7, 1, seed) < lamps:
        warm = 0.75 + 0.35 * noise(x * 5, y * 4, seed)
        return 1.25 * warm, 0.98 * warm, 0.56 * warm
    dark = 0.13 + 0.2 * mood + 0.17 * y * hash01(4, 4, seed)
    if mood > 0.62 and (x < 0.3 or x > 0.7):
        return dark + 0.34, dark + 0.33, dark + 0.29
    if mood < 0.2 and y > 0.55:  # a blind, half down
        return 0.62, 0.6, 0.54
    return dark * 0.88, dark * 0.98, dark * 1.12


@kernel
def _upper_floors(lot, along, height, shade, lamps):
    """Paint the floors above the ground floor, and all of a hall."""
    seed = lot.seed
    r, g, b = lot.red * shade, lot.green * shade, lot.blue * shade
    style, trim = lot.style, lot.trim
    bays = max(1, floor(lot.length / lot.pitch))
    x = along / lot.length * bays
    bay = floor(x)
    if style == HALL:
        return _hall(lot, along, height, shade, bay)
    under = lot.height - height
    if under < 0.55:  # cornice with dentils
        tooth = 0.72 if under > 0.3 and part(along * 1.7) < 0.5 else 1.0
        if trim > 0.4:
            tooth *= (0.84 + 0.1 * trim) * shade
            return tooth, tooth * 0.97, tooth * 0.92
        return r * tooth * 0.7, g * tooth * 0.7, b * tooth * 0.7
    y = (height - lot.ground_floor) / lot.floor
    story = floor(y)
    if style != OFFICE:
        return _house_bay(lot, along, height, x - bay, y - story, bay, story, shade, lamps)
    x, y = x - bay, y - story
    if x < 0.06 or y < 0.2:
        band = 0.9 + 0.25 * hash01(0, story, seed)
        return r * band, g * band, b * band
    if 0.5 < x < 0.54:
        return 0.3, 0.31, 0.33
    return _glass(x, y, seed + bay * 131 + story * 7177, lamps)


@kernel
def _hall(lot, along, height, shade, bay):
    """Paint sheet metal, a gate and a painted name."""
    seed = lot.seed
    rib = (0.9 + 0.16 * (part(along * 1.6) < 0.5)) * shade
    if height < 3.9 and hash01(bay, 0, seed) < 0.3:
        slat = 0.42 + 0.2 * part(height * 2.5)
        return slat, slat * 0.98, slat * 0.95
    if 4.2 < height < 5.4 and 0.25 < along / lot.length < 0.75:
        if letters(along, (height - 4.2) / 1.2, seed):
            return 0.92 * shade, 0.9 * shade, 0.86 * shade
        rib *= 0.6
    return lot.red * rib, lot.green * rib, lot.blue * rib


@kernel
def _house_bay(lot, along, height, x, y, bay, story, shade, lamps):
    """
    Paint a bay of a house: window, shutters, balcony.

    :param x: place within the bay, 0 to 1.
    :param y: place within the floor, 0 to 1.
    """
    seed = lot.seed
    r, g, b = lot.red * shade, lot.green * shade, lot.blue * shade
    trim = lot.trim
    pale = (0.84 + 0.1 * trim) * shade
    half, tall, off = lot.window / 2, 0.8 + 0.08 * trim, abs(x - 0.5)
    roomy = lot.height - height > 0.9  # no window is cut by the eaves
    if off < half and 0.26 < y < tall and roomy and hash01(bay, 77, seed) > 0.08:
        edge = 0.16 / lot.pitch
        bar = (seed & 4 and off < edge * 0.35) or (seed & 8 and 0.56 < y < 0.585)
        if bar or off > half - edge or y > tall - 0.05 or y < 0.3:
            if trim > 0.3:
                return pale, pale, pale * 0.96
            return 0.2 * shade, 0.24 * shade, 0.23 * shade
        pane = seed + bay * 131 + story * 7177
        return _glass((x - 0.5 + half) / (2 * half), (y - 0.26) / (tall - 0.26), pane, lamps)
    if seed & 16 and half <= off < half * 1.62 and 0.26 < y < tall and lot.style != BRICK:
        slat = 0.75 + 0.35 * part(height * 5)  # of a shutter
        return 0.3 * slat, (0.3 + 0.2 * trim) * slat, (0.45 - 0.2 * trim) * slat
    if off < half * 1.15 and (0.2 < y < 0.26 or tall < y < tall + 0.05):  # sill and lintel
        return pale, pale * 0.98, pale * 0.93
    if seed & 32 and y < 0.34 and story > 0 and off < half * 1.5 and (bay + seed) & 1:  # balcony
        if y < 0.07 or y > 0.31 or part(along * 5.0) < 0.4:
            return 0.16, 0.16, 0.18
        return r * 0.75, g * 0.75, b * 0.75
    if y < 0.05 and seed & 64:  # a band between two floors
        return pale, pale * 0.97, pale * 0.92
    return r, g, b


@kernel
def letters(along, height, seed):
    """Return whether a point of a sign lies on a stroke of its writing."""
    x = along / 0.55
    letter = floor(x)
    x -= floor(x)
    if x > 0.8 or height < 0.2 or height > 0.82 or hash01(letter, 9, seed) < 0.15:
        return False
    return hash01(letter * 3 + int(x * 3.75), int((height - 0.2) * 4.8), seed) < 0.62


@kernel
def _ground_floor(lot, along, height, shade, lamps):
    """Paint shops (sign, awning, window) or a plinth with a door and windows."""
    seed = lot.seed
    r, g, b = lot.red * shade, lot.green * shade, lot.blue * shade
    length, top = lot.length, lot.ground_floor
    bays = max(1, floor(length / 4.2))
    x = along / length * bays
    bay = floor(x)
    x -= bay
    own = seed + bay * 977
    hue = hash01(11, 3, own if seed & 128 else seed)
    light = 0.55 + 0.4 * hash01(12, 3, seed)
    sr, sg, sb = (
        light * (0.55 + 0.45 * sin(hue * 6.3)),
        light * (0.5 + 0.4 * sin(hue * 6.3 + 2.1)),
        light * (0.5 + 0.45 * sin(hue * 6.3 + 4.2)),
    )
    door = bay == int(hash01(5, 5, seed) * bays)
    if hash01(2, 9, seed) < 0.58:
        return _shop(along, height, top, x, seed, own, door, (r, g, b), (sr, sg, sb), lamps)
    if door and 0.34 < x < 0.66 and height < 2.7:
        if height >= 2.5 or not 0.36 < x < 0.64:
            return 0.85, 0.84, 0.8
        panel = 0.75 if 0.4 < x < 0.6 and (0.3 < height < 1.1 or 1.4 < height < 2.4) else 1.0
        return sr * panel, sg * panel, sb * panel
    if not door and (0.16 < x < 0.42 or 0.58 < x < 0.84) and 1.1 < height < top - 0.8:
        inside = (x - 0.16) / 0.26 if x < 0.5 else (x - 0.58) / 0.26
        if inside < 0.1 or inside > 0.9 or height < 1.22:
            return 0.86 * shade, 0.85 * shade, 0.81 * shade
        return _glass(inside, (height - 1.1) / (top - 1.9), own + int(x * 2), lamps)
    if height < 0.7:
        return r * 0.55, g * 0.55, b * 0.55
    groove = 0.84 if part(height * 1.9) < 0.1 and seed & 256 else 0.94
    return r * groove, g * groove, b * groove


@kernel
def _shop(along, height, top, x, seed, own, door, wall_color, sign_color, lamps):
    """
    Paint a shop: sign, awning, window.

    :param top: height of the ground floor.
    :param x: place within the bay, 0 to 1.
    :param own: seed of the bay; `seed` is the building's.
    """
    r, g, b = wall_color
    sr, sg, sb = sign_color
    if top - 0.95 < height < top - 0.2:
        if letters(along, (height - top + 0.95) / 0.75, seed + 5):
            return (0.95, 0.93, 0.86) if hash01(12, 3, seed) < 0.6 else (0.12, 0.12, 0.14)
        return sr, sg, sb
    if hash01(6, 6, own) < 0.45 and top - 1.7 < height <= top - 0.95:  # an awning
        fold = 0.75 + 0.25 * (height - top + 1.7) / 0.75
        if part(along * 1.5) < 0.5:
            return 0.9 * fold, 0.88 * fold, 0.82 * fold
        return sr * fold, sg * fold, sb * fold
    if 0.05 < x < 0.95 and 0.5 < height < top - 1.15:
        if (door and 0.4 < x < 0.44) or (not door and 0.49 < x < 0.51):
            return 0.18, 0.18, 0.2
        goods = noise(along * 2.6, height * 3.2, own)
        if hash01(8, 8, own) < lamps * 1.6:
            return 0.5 + 0.7 * goods, 0.42 + 0.55 * goods, 0.25 + 0.4 * goods
        dark = 0.1 + 0.26 * goods * (1 if height < 1.7 else 0.4) + 0.07 * height / top
        return dark + 0.08 * sr, dark + 0.08 * sg, dark + 0.1 * sb
    return r * 0.6, g * 0.6, b * 0.6
