# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Relates places of a session to places of earlier sessions with the same view, by recognition."""

from dataclasses import replace

import numpy as np
from stavpr_ros.mapping import PlaceMap, select_places
from stavpr_ros.progress import Progress
from stavpr_ros.recognition.match import Match
from stavpr_ros.recognition.recognizer import PlaceRecognizer
from stavpr_ros.recognition.settings import RecognizerSettings

SURE = 0.9  # probability above which two places are taken to be the same


class SamePlaces:
    """
    The place of each image of a drive, as matches of windows come; -1 = none.

    The middle image of a full window has the matched place, its others the places of the path
    until they are the middle themselves.

    :param count: of the images.
    """

    def __init__(self, count: int) -> None:
        self._matched, self._near = (np.full(count, -1) for _ in range(2))

    def add(self, match: Match, image: int, length: int) -> None:
        """Take the match of the window that ends with an image; only a full one counts."""
        if match.accepted and len(match.window_stamps) == length:
            window = image - length + 1 + match.path[:, 0]
            self._near[window] = match.path[:, 1]
            self._matched[window[(len(window) - 1) // 2]] = match.place_index

    @property
    def places(self) -> np.ndarray:
        """Return the place of each image, (N,)."""
        return np.where(self._matched >= 0, self._matched, self._near)


def with_last_related(place_map: PlaceMap) -> PlaceMap:
    """Return the map with the places of its last session related, as by with_same_places."""
    return with_same_places(place_map, len(place_map.sessions) - 1)


def with_same_places(place_map: PlaceMap, first: int = 1) -> PlaceMap:
    """
    Return the map with the places of its sessions related (:attr:`PlaceMap.same_as`).

    Each session is driven, as a query of mode robust, on a map of the sessions before it. Where it
    is matched, its place is the matched one. The time grows with the square of the places, and a
    terminal shows the progress.

    :param first: session to begin with; earlier ones stay as they are.
    """
    index, n = place_map.session_index, len(place_map)
    if index is None:
        return place_map
    same_as, numbers = np.arange(n), range(max(first, 1), len(place_map.sessions))
    if first > 1 and place_map.same_as is not None:
        same_as = place_map.same_as.astype(np.int64)
    for session in Progress(numbers, desc='same places', unit='session'):
        earlier, places = np.flatnonzero(index < session), np.flatnonzero(index == session)
        reference = select_places(replace(place_map, same_as=same_as.astype(np.int32)), earlier)
        matched = _recognized(reference, place_map, places)
        is_matched = matched >= 0
        same_as[places[is_matched]] = same_as[earlier[matched[is_matched]]]
    return replace(place_map, same_as=same_as.astype(np.int32))


def _recognized(reference: PlaceMap, place_map: PlaceMap, images: np.ndarray) -> np.ndarray:
    """Return the place of a reference that each image shows, -1 = none, (m,)."""
    settings = RecognizerSettings(min_probability=SURE)
    recognizer, length = PlaceRecognizer(reference, settings), settings.sequence.length
    same = SamePlaces(len(images))
    for i, image in enumerate(images.tolist()):
        same.add(recognizer.update(place_map.features[image : image + 1]), i, length)
    return same.places
