# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Many sessions of one route: which places are compared, and a light that changes."""

from dataclasses import replace

import numpy as np
from places import features_of, map_of, route_strips
import pytest
from stavpr_ros.mapping import merge_maps
from stavpr_ros.prepare.several_sessions import NEAREST, SeveralSessions
from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings

pytestmark = pytest.mark.usefixtures('one_thread')
PLACES, SESSIONS, CHANGE = 400, 8, 200
NIGHT = SESSIONS - 1  # session by night; the others are by day


def drive(seed, is_night, places=slice(None)):
    """Return features of the route by day or by night."""
    by_day, by_night = route_strips(0, PLACES), route_strips(1, PLACES)
    strips = by_day + (2.0 * by_night if is_night else 0.0)
    return features_of(strips[:, places], 0.9, seed)


@pytest.fixture(scope='module')
def place_map():
    maps = [map_of(drive(seed, seed == NIGHT)) for seed in range(SESSIONS)]
    same_as = np.tile(np.arange(PLACES, dtype=np.int32), SESSIONS)
    return replace(merge_maps(maps, [str(i) for i in range(SESSIONS)]), same_as=same_as)


@pytest.fixture
def recognizer(place_map):
    one = PlaceRecognizer(place_map, RecognizerSettings())
    assert isinstance(one._matcher, SeveralSessions)
    return one


def sessions_of(recognizer):
    """Return the probability of each session."""
    return recognizer.place_probabilities().reshape(SESSIONS, PLACES).sum(axis=1)


def test_light_change_in_mid_drive_is_recognized_within_20_images(recognizer):
    day, night = drive(10, False), drive(11, True)
    for i in range(CHANGE):
        recognizer.update(day[i : i + 1])
    assert sessions_of(recognizer)[NIGHT] < 0.01
    for i in range(CHANGE, CHANGE + 20):
        match = recognizer.update(night[i : i + 1])
    assert sessions_of(recognizer)[NIGHT] > 0.9
    assert match.accepted
    assert match.newest_index == pytest.approx(NIGHT * PLACES + CHANGE + 19, abs=2)


def test_certain_camera_is_compared_with_one_session_and_parts_of_others(recognizer, place_map):
    query, compared = drive(10, False), []
    for i in range(150):
        match = recognizer.update(query[i : i + 1])
        is_compared = np.isfinite(recognizer.newest_row())
        compared.append(int(is_compared.sum()))
        if i > 100:
            assert match.place_index % PLACES == pytest.approx(i - 10, abs=2)
            assert is_compared[match.newest_index]
    assert compared[0] == len(place_map)
    assert np.median(compared[100:]) < len(place_map) / 2


def test_each_session_is_compared_in_turn(recognizer):
    query, counts = drive(10, False), np.zeros(SESSIONS, int)
    for i in range(150):
        recognizer.update(query[i : i + 1])
        row = recognizer.newest_row().reshape(SESSIONS, PLACES)
        if i >= 150 - SESSIONS:
            is_compared = np.isfinite(row).sum(axis=1) > PLACES / 8  # not of a shared chunk only
            assert is_compared.sum() <= NEAREST + 2
            counts += is_compared
    assert counts.min() >= 1
    assert counts.max() == SESSIONS


def test_camera_that_leaves_the_map_is_compared_with_all_places(recognizer, place_map):
    query, elsewhere = drive(10, False), features_of(route_strips(7, PLACES))
    for i in range(100):
        recognizer.update(query[i : i + 1])
    assert not np.isfinite(recognizer.newest_row()).all()
    for i in range(40):
        recognizer.update(elsewhere[i : i + 1])
    assert np.isfinite(recognizer.newest_row()).all()


def test_few_sessions_and_unrelated_ones_are_compared_whole(place_map):
    maps = [map_of(drive(seed, False)) for seed in range(3)]
    pair = replace(
        merge_maps(maps[:2], 'ab'), same_as=np.tile(np.arange(PLACES, dtype=np.int32), 2)
    )
    for each in (pair, merge_maps(maps, 'abc')):
        one = PlaceRecognizer(each, RecognizerSettings())
        assert not isinstance(one._matcher, SeveralSessions)


def test_matches_are_as_with_all_places(place_map, recognizer):
    whole = PlaceRecognizer(place_map, RecognizerSettings())
    whole._matcher = whole._matcher._matcher
    for is_night in (False, True):
        query = drive(20, is_night)
        recognizer.reset()
        whole.reset()
        for i in range(len(query)):
            match, expected = (one.update(query[i : i + 1]) for one in (recognizer, whole))
            assert match.accepted == expected.accepted
            if match.accepted:
                assert match.place_index % PLACES == pytest.approx(
                    expected.place_index % PLACES, abs=1
                )
