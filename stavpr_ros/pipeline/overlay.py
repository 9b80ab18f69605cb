# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Draws a query beside the place that it was matched with, fast enough for every frame."""

import math

import cv2
import numpy as np
from stavpr_ros.errors import InputError
from stavpr_ros.mapping import GrowingMap, PlaceMap
from stavpr_ros.recognition import Match

RIGHT, NO_MATCH = (46, 125, 80), (200, 150, 40)  # RGB
_INK, _PAPER, _EMPTY = (32, 34, 38), (250, 250, 248), (226, 226, 222)


def draw_match(match: Match, places: PlaceMap | GrowingMap | None) -> np.ndarray:
    """
    Draw an image beside its nearest place, with status and probability, or distance.

    :returns: RGB, uint8.
    """
    assert match.image is not None
    if match.sequence is None or places is None:
        return match_image(
            match.image, None, f'{match.status.label} {match.reason}'.strip(), False
        )
    place = match.newest_index if match.accepted else match.sequence.middle
    text = f'{match.status.label}: place {place}, '
    if match.relative:
        text += f'p {match.probability:.2f}'
    else:
        text += f'distance {match.distance:.3f}'
    if not (match.relative or math.isnan(match.threshold)):
        text += f' (threshold {match.threshold:.3f})'
    if match.inliers >= 0:
        text += f', {match.inliers} inliers'
    return match_image(match.image, places.thumbnail(place), text, match.accepted)


def match_image(
    query: np.ndarray, place: np.ndarray | None, text: str, accepted: bool
) -> np.ndarray:
    """
    Put a query and the place it was matched with side by side, with a line of text below.

    :param query: RGB, shape (h, w, 3), uint8.
    :param place: RGB uint8 of any size, or None where there is nothing to show.
    :param text: the status, one line of ASCII; shrunk until it fits.
    :param accepted: whether the bar at the edge is that of a match.
    :returns: RGB, shape (h + bar, 2 w + gap, 3), uint8.
    """
    for name, image in (('query', query), ('place', place)):
        if image is not None and (
            image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8
        ):
            raise InputError(
                f'{name} has shape {image.shape} and type {image.dtype}; expected (h, w, 3) uint8'
            )
    height, width = query.shape[:2]
    gap, bar = max(2, width // 80), max(18, height // 9)
    sheet = np.full((height + bar, 2 * width + gap, 3), _PAPER, np.uint8)
    sheet[:height, :width] = query
    if place is None:
        sheet[:height, width + gap :] = _EMPTY
        _write(sheet[:height, width + gap :], 'no place', bar * 0.4, centered=True)
    else:
        if place.shape[:2] != (height, width):
            shrinks = place.shape[0] > height
            place = cv2.resize(
                place,
                (width, height),
                interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR,
            )
        sheet[:height, width + gap :] = place
    strip = sheet[height:]
    strip[:, : max(4, bar // 3)] = RIGHT if accepted else NO_MATCH
    _write(strip[:, max(4, bar // 3) :], text, bar * 0.45)
    return sheet


def _write(area: np.ndarray, text: str, size: float, centered: bool = False) -> None:
    """Write a line into a part of an image, in letters of `size` pixels or smaller."""
    height, width = area.shape[:2]
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, size / 22
    across, up = cv2.getTextSize(text, font, scale, 1)[0]
    margin = max(4, height // 4) if not centered else 4
    if across > width - 2 * margin:
        scale *= (width - 2 * margin) / across
        across, up = cv2.getTextSize(text, font, scale, 1)[0]
    left = (width - across) // 2 if centered else margin
    # OpenCV writes into contiguous memory only; a view of columns is not.
    patch = np.ascontiguousarray(area)
    cv2.putText(patch, text, (left, (height + up) // 2), font, scale, _INK, 1, cv2.LINE_AA)
    area[:] = patch
