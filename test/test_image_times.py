# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Times of images by their stamps."""

from dataclasses import replace

import numpy as np
from places import features_of, map_of, route_strips
import pytest
from stavpr_ros.filter.refine import image_times, LONGEST, usual_interval
from stavpr_ros.mapping.place_map import Session
from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings

SECOND = 10**9


def times(stamps, numbers=None):
    numbers = np.arange(len(stamps)) if numbers is None else np.array(numbers)
    stamps = (np.array(stamps) * SECOND).astype(np.int64)
    return image_times(stamps, numbers, usual_interval(stamps)).tolist()


def test_times_are_in_intervals_of_most_images():
    assert times([3, 5, 7, 9, 13, 15]) == [0, 1, 2, 3, 5, 6]
    assert times([3, 3.5, 4, 4.5]) == [0, 1, 2, 3]


def test_long_gaps_are_limited():
    assert times([1, 2, 3, 4, 100, 101]) == [0, 1, 2, 3, 3 + LONGEST, 4 + LONGEST]


@pytest.mark.parametrize('stamps', [[0, 0, 0, 0], [0, 1, 2, 3], [5, 4, 4, 5], [7, 8, 0, 1]])
def test_interval_of_unknown_or_falling_stamps_is_one(stamps):
    assert times(stamps) == [0, 1, 2, 3]


def test_no_time_passes_at_rest():
    assert times([1, 2, 3, 5, 6], [4, 5, 5, 5, 6]) == [0, 1, 1, 1, 2]


def test_times_of_few_images():
    assert times([]) == []
    assert times([5]) == [0]


def test_times_of_the_places_of_sessions():
    """Each session has its own columns; between them, one column is one interval."""
    one = map_of(features_of(route_strips(0, 60)))
    sessions = np.repeat(np.arange(2, dtype=np.int32), 30)
    stamps = np.r_[np.arange(1, 31), 1000 + 2 * np.arange(30)] * SECOND
    stamps[10:30] += 2 * SECOND
    names = Session('a'), Session('b')
    place_map = replace(one, stamps=stamps, sessions=names, session_index=sessions)
    window = PlaceRecognizer(place_map, RecognizerSettings(mode='robust'))._window
    steps = np.diff(window.choice._place_times[window.layout.columns])
    steps /= steps[0]
    np.testing.assert_allclose(np.delete(steps[:29], 9), 1)
    assert steps[9] == pytest.approx(3)
    np.testing.assert_allclose(steps[30:], 2)
