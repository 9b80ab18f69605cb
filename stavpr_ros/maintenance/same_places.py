# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Relates places to earlier ones with the same view, by recognition.

A session is related to the sessions before it, and the end of a closed route to its start. A
recording of several laps is divided into a session for each.
"""

from dataclasses import replace
from itertools import pairwise
import math

import numpy as np
from stavpr_ros.alignment.settings import SequenceSettings
from stavpr_ros.errors import SettingsError
from stavpr_ros.mapping import Map, merge_maps, select_places
from stavpr_ros.method.localizer import PlaceRecognizer
from stavpr_ros.method.match import Match
from stavpr_ros.method.model import MODEL
from stavpr_ros.method.settings import RecognizerSettings
from stavpr_ros.progress import Progress

SURE = 0.9  # probability above which two places are taken to be the same
RELATED = 0.5  # part of the places of later laps that is related to earlier ones
MAX_END = 60  # last places of a route, which are compared with its first ones
PROBES = 16  # runs of MAX_END images that show whether a recording has laps
MAX_PLACES = 20_000  # of a map whose laps and seam are sought


class SamePlaces:
    """
    The place of each image of a drive, as matches of windows come; -1 = none.

    The middle image of a full window has the matched place, its others the places of the path
    until they are the middle themselves.

    ``middles`` has the places of the middle images only, (N,).

    :param count: number of images.
    """

    def __init__(self, count: int) -> None:
        self.middles, self._near = (np.full(count, -1) for _ in range(2))

    def add(self, match: Match, image: int, length: int) -> None:
        """Take the match of the window that ends with an image; only a full one counts."""
        if match.accepted and len(match.window_stamps) == length:
            window = image - length + 1 + match.path.pairs[:, 0]
            is_sure = match.path_probabilities > SURE  # beyond an end of the places, it is not
            self._near[window[is_sure]] = match.path.pairs[is_sure, 1]
            self.middles[window[(len(window) - 1) // 2]] = match.place

    @property
    def places(self) -> np.ndarray:
        """Return the place of each image, (N,)."""
        return np.where(self.middles >= 0, self.middles, self._near)


def with_repeats(place_map: Map) -> Map:
    """
    Return the map after a recording, which is its last session, with what that repeats related.

    A map of one session is closed (:func:`with_seam`) or has a session for each lap
    (:func:`with_laps`). Of another map, the last session is divided into laps. Where nothing is
    repeated, or of more than ``MAX_PLACES`` places, the map is returned as it is.
    """
    index, number = place_map.session_index, len(place_map.sessions) - 1
    if len(place_map) > MAX_PLACES:
        return place_map
    if index is None or number < 1:
        divided = with_laps(place_map)
        closed = with_seam(place_map) if len(divided.sessions) < 3 else divided
        return divided if closed.seam is None else closed
    recording = select_places(place_map, np.flatnonzero(index == number))
    if (divided := with_laps(recording)) is recording:
        return place_map
    earlier = select_places(place_map, np.flatnonzero(index < number))
    return with_same_places(merge_maps([earlier, divided], ['', '']), number)


def repeats_of(place_map: Map) -> str:
    """Return in a sentence what :func:`with_repeats` made of a map without sessions."""
    if place_map.seam is not None:
        return f'the route is closed: its last place shows place {place_map.seam}'
    laps = len(place_map.sessions)
    return f'the recording repeats its route: {laps} laps became a session each' if laps else ''


def with_last_related(place_map: Map) -> Map:
    """Return the map with the places of its last session related, and its laps divided."""
    return with_repeats(with_same_places(place_map, len(place_map.sessions) - 1))


def with_same_places(place_map: Map, first: int = 1) -> Map:
    """
    Return the map with the places of its sessions related (:attr:`Map.same_as`).

    Each session is driven, as a query of mode robust, on a map of the sessions before it. Where it
    is matched, its place is the matched one. Sessions of cameras whose yaws differ by more than 45
    degrees are not compared. The time grows with the square of the places, and a terminal shows
    the progress.

    :param first: session to begin with; earlier ones stay as they are.
    """
    index, n = place_map.session_index, len(place_map)
    if index is None:
        return place_map
    same_as, numbers = np.arange(n), range(max(first, 1), len(place_map.sessions))
    if first > 1 and place_map.same_as is not None:
        same_as = place_map.same_as.astype(np.int64)
    for session in Progress(numbers, desc='comparing sessions', unit='session'):
        views = [n for n in range(session) if not _looks_elsewhere(place_map, n, session)]
        earlier, places = np.flatnonzero(np.isin(index, views)), np.flatnonzero(index == session)
        if not len(earlier):
            continue
        reference = select_places(replace(place_map, same_as=same_as.astype(np.int32)), earlier)
        matched = fill_gaps(recognize_places(reference, place_map, places), index[earlier])
        is_matched = matched >= 0
        same_as[places[is_matched]] = same_as[earlier[matched[is_matched]]]
    return replace(place_map, same_as=same_as.astype(np.int32))


def fill_gaps(matched: np.ndarray, sessions: np.ndarray) -> np.ndarray:
    """
    Return the matched places of images in order, those of short gaps by their neighbors.

    Within a window, a camera at a possible speed along one session has not been elsewhere.

    :param matched: place of each image, -1 = none, (n,).
    :param sessions: session of each place, (m,).
    """
    filled, length = matched.copy(), SequenceSettings().length
    images = np.flatnonzero(matched >= 0)
    for first, last in pairwise(images.tolist()):
        start, end, gap = int(matched[first]), int(matched[last]), last - first
        is_short = gap <= length and sessions[start] == sessions[end]
        if is_short and 0 <= end - start <= max(MODEL.speeds) * gap:
            filled[first : last + 1] = np.rint(np.linspace(start, end, gap + 1))
    return filled


def _looks_elsewhere(place_map: Map, session: int, other: int) -> bool:
    yaws = place_map.sessions[session].yaw, place_map.sessions[other].yaw
    if yaws[0] is None or yaws[1] is None:
        return False
    return abs(math.remainder(yaws[0] - yaws[1], 2 * math.pi)) > math.pi / 4


def with_seam(place_map: Map, is_closed: bool = False) -> Map:
    """
    Return the map of a closed route with its end related to its start, another map as it is.

    Its last places are driven, as a query of mode robust, on its first third. The route is closed
    where one of the last, at most a window from the end, is matched: it was recorded beyond its
    start, by two windows or so.

    :param is_closed: the route is closed. Where its end is not matched, its last place shows the
        same as its first.
    :raises SettingsError: it is stated to be closed, but has several sessions or too few places.
    """
    n, same_as = len(place_map), np.arange(len(place_map))
    third = n // 3
    if len(place_map.sessions) > 1 or third < SequenceSettings().length:
        if is_closed:
            raise SettingsError('a closed route has one session and at least 60 places')
        return place_map
    reference = select_places(place_map, np.arange(third))
    end = np.arange(n - min(third, MAX_END), n)
    matched = recognize_places(reference, place_map, end)
    last = int(np.flatnonzero(matched >= 0).max(initial=0))
    is_found = matched[last] >= 0 and len(end) - last <= SequenceSettings().length
    if not is_found and not is_closed:
        return place_map
    # places after a lap
    count = int(matched[last]) + len(end) - last if is_found else 1
    same_as[n - count :] = np.arange(count)
    is_matched = (matched >= 0) & (end >= n - count)
    same_as[end[is_matched]] = matched[is_matched]
    return replace(place_map, same_as=same_as.astype(np.int32))


def with_laps(place_map: Map) -> Map:
    """
    Return the map of a recording of several laps with a session for each; another map as it is.

    Its places are driven, as a query of mode robust, on its first third: a lap begins where these
    are matched again. Most places of the later laps must be matched to earlier ones. Where no run
    of a sample is matched, the others are not driven.
    """
    n, bounds, length = len(place_map), [0], SequenceSettings().length
    if len(place_map.sessions) > 1 or n <= 3 * MAX_END:
        return place_map
    reference = select_places(place_map, np.arange(n // 3))

    def begins_of(images: np.ndarray) -> np.ndarray:
        matched = recognize_places(reference, place_map, images)
        # the images behind the reference may look like its last places
        return (images - matched)[(matched >= 0) & (matched < n // 3 - length)]

    firsts = np.linspace(n // 3, n - MAX_END, PROBES).astype(np.int64)
    sample = np.add.outer(firsts, np.arange(MAX_END)).ravel()
    if len(sample) < n / 2 and (begins_of(sample) <= MAX_END).all():
        return place_map
    begins = begins_of(np.arange(MAX_END, n))
    for begin in begins[begins < n - MAX_END].tolist():
        is_sure = (abs(begins - begin) < MAX_END // 2).sum() > length
        shortest = bounds[1] // 2 if len(bounds) > 1 else MAX_END
        if is_sure and begin > bounds[-1] + shortest:
            bounds.append(begin)
    laps = [np.arange(first, end) for first, end in pairwise([*bounds, n])]
    if len(laps) == 1:
        return place_map
    names = [f'lap {number}' for number in range(1, len(laps) + 1)]
    divided = with_same_places(merge_maps([select_places(place_map, lap) for lap in laps], names))
    is_related = np.asarray(divided.same_as) < np.arange(n)
    return divided if is_related[len(laps[0]) :].mean() > RELATED else place_map


def recognize_places(reference: Map, drive: Map, images: np.ndarray) -> np.ndarray:
    """Return the place of a reference that each image of a drive shows, -1 = none, (m,)."""
    settings = RecognizerSettings(min_probability=SURE)
    recognizer, length = PlaceRecognizer(reference, settings), settings.sequence.length
    same = SamePlaces(len(images))
    for i, image in enumerate(images.tolist()):
        same.add(recognizer.update(drive.features[image : image + 1]), i, length)
    return same.places
