# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Draws a query beside its place, and the distances of a window, fast enough for every frame."""

import math

import cv2
import numpy as np
from stavpr_ros.mapping import GrowingMap, Map
from stavpr_ros.mapping.place_map import resized
from stavpr_ros.method import Match
from stavpr_ros.palette import BLUE, INK, ORANGE, PAPER, rgb, SHADE
from stavpr_ros.pipeline.result import ImageResult

RIGHT, NO_MATCH = rgb(BLUE), rgb(ORANGE)
NEARBY = 150  # places shown to each side of a match
SIZE = (900, 240)  # pixels of the drawn distances, about
_INK, _PAPER, _EMPTY = rgb(INK), rgb(PAPER), rgb(SHADE)


def draw_match(result: ImageResult, places: Map | GrowingMap | None) -> np.ndarray:
    """
    Draw an image beside its nearest place, with status and probability, or distance.

    :returns: RGB, uint8.
    """
    assert result.image is not None
    match = result.match
    place = match.newest if match.accepted else match.path.place
    if place < 0 or places is None:
        return match_image(
            result.image, None, f'{match.status.label} {match.reason}'.strip(), False
        )
    text = f'{match.status.label}: place {place}, '
    if not math.isnan(match.probability):
        text += f'p {match.probability:.2f}'
    else:
        text += f'distance {match.distance:.3f}'
        if not math.isnan(match.threshold):
            text += f' (threshold {match.threshold:.3f})'
    if match.inliers >= 0:
        text += f', {match.inliers} inliers'
    return match_image(
        result.image, places.thumbnail(place), text, match.accepted, f'map place {place}'
    )


def match_image(
    query: np.ndarray, place: np.ndarray | None, text: str, accepted: bool, label: str = ''
) -> np.ndarray:
    """
    Put a query and the place it was matched with side by side, with a line of text below.

    :param query: RGB, shape (h, w, 3), uint8.
    :param place: RGB uint8 of any size, or None where there is nothing to show.
    :param text: the status, one line of ASCII; shrunk until it fits.
    :param accepted: whether the bar at the edge has the color of a match.
    :param label: of the place.
    :returns: RGB, shape (h + bar, 2 w + gap, 3), uint8.
    """
    height, width = query.shape[:2]
    gap, bar = max(2, width // 80), max(18, height // 9)
    sheet = np.full((height + bar, 2 * width + gap, 3), _PAPER, np.uint8)
    sheet[:height, :width] = query
    if place is None:
        sheet[:height, width + gap :] = _EMPTY
        _write(sheet[:height, width + gap :], 'no place', bar * 0.4, centered=True)
    else:
        sheet[:height, width + gap :] = resized(place, (width, height))
        _label(sheet[:height, width + gap :], label, bar)
    _label(sheet[:height, :width], 'camera', bar)
    strip = sheet[height:]
    strip[:, : max(4, bar // 3)] = RIGHT if accepted else NO_MATCH
    _write(strip[:, max(4, bar // 3) :], text, bar * 0.45)
    return sheet


def places_to_draw(match: Match, first: int, count: int) -> np.ndarray:
    """Return the places from ``first`` on that are around the nearest sequence, (k,)."""
    middle = match.path.place if match.path.place >= 0 else first
    start = min(max(first, middle - NEARBY), max(first, first + count - 2 * NEARBY))
    return np.arange(start, min(start + 2 * NEARBY, first + count))


def draw_window(rows: np.ndarray, first: int, match: Match) -> np.ndarray:
    """
    Draw the distances of a window, one row per image, and the warping path over them.

    :param rows: distances to successive places, shape (m, k), oldest image first; +inf = not
        compared.
    :param first: index of the place of the first column.
    :returns: RGB, uint8, dark = near.
    """
    height, width = rows.shape
    across, down = max(1, round(SIZE[0] / width)), max(1, round(SIZE[1] / max(height, 1)))
    finite = np.where(np.isfinite(rows), rows, np.nan)
    low, high = (
        np.nan_to_num(f(finite)) if np.isfinite(finite).any() else 0.0
        for f in (np.nanmin, np.nanmax)
    )
    gray = np.nan_to_num((finite - low) / max(high - low, 1e-9), nan=1.0) * 255
    sheet = cv2.cvtColor(gray.astype(np.uint8), cv2.COLOR_GRAY2RGB)
    sheet = sheet.repeat(down, axis=0).repeat(across, axis=1)
    if len(match.path.pairs):
        points = [
            ((place - first) * across + across // 2, image * down + down // 2)
            for image, place in match.path.pairs.tolist()
        ]
        ink = RIGHT if match.accepted else NO_MATCH
        cv2.polylines(sheet, [np.array(points, np.int32)], False, ink, 2, cv2.LINE_AA)
    bar = np.full((24, sheet.shape[1], 3), _PAPER, np.uint8)
    text = f'images of the window (newest below) x places {first} to {first + width - 1}'
    if match.path.place >= 0 and not math.isnan(match.probability):
        text += f'; place {match.path.place}, p {match.probability:.2f}'
    _write(bar, text, 11)
    return np.vstack([sheet, bar])


def column_minima(rows: np.ndarray, columns: int) -> np.ndarray:
    """
    Return rows of at most so many columns; each is the minimum over its places.

    :param rows: shape (m, n), n at least 1.
    """
    n = rows.shape[1]
    if n <= columns:
        return rows
    return np.minimum.reduceat(rows, np.arange(columns) * n // columns, axis=1)


def _label(area: np.ndarray, text: str, height: int) -> None:
    """Write a label into the upper left corner of an image."""
    if text:
        width = min(area.shape[1], round(len(text) * height * 0.4) + 8)
        corner = area[: round(height * 0.8), :width]
        corner[:] = _PAPER
        _write(corner, text, height * 0.45)


def _write(area: np.ndarray, text: str, size: float, centered: bool = False) -> None:
    """Write a line into a part of an image, in letters of `size` pixels or smaller."""
    height, width = area.shape[:2]
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, size / 22
    across, up = cv2.getTextSize(text, font, scale, 1)[0]
    margin = max(4, height // 4) if not centered else 4
    if across > width - 2 * margin:
        scale *= (width - 2 * margin) / across
        across, up = cv2.getTextSize(text, font, scale, 1)[0]
    x = (width - across) // 2 if centered else margin
    # OpenCV writes into contiguous memory only; a view of columns is not.
    patch = np.ascontiguousarray(area)
    cv2.putText(patch, text, (x, (height + up) // 2), font, scale, _INK, 1, cv2.LINE_AA)
    area[:] = patch
