# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A recognizer after its reset gives the same answers as a new one, with every option."""

from dataclasses import fields, replace

import numpy as np
from places import features_of, map_of, route_strips
import pytest
from stavpr_ros.mapping import merge_maps
from stavpr_ros.recognition import Match, PlaceRecognizer, RecognizerSettings
from stavpr_ros.recognition.loop_closer import LoopCloser

pytestmark = pytest.mark.usefixtures('one_thread')
N = 120
ROUTE, ELSEWHERE = route_strips(0, N), route_strips(9, 30)
PARTS = [ROUTE[:, :70], np.repeat(ROUTE[:, 70:71], 25, axis=1), ELSEWHERE, ROUTE[:, 85:]]
DRIVE = features_of(np.concatenate(PARTS, axis=1), 0.5, 7)  # with a stop, and a detour
DRIVE.strips[:, 70:95] = DRIVE.strips[:, 69:70]
POSES = np.tile([0.0, 0, 0, 0, 0, 0, 1], (2 * N, 1))
POSES[:, 0] = 1.1 * np.arange(2 * N)


def of_sessions(count):
    maps = [map_of(features_of(ROUTE, 0.5, seed), POSES[:N]) for seed in range(count)]
    same_as = np.tile(np.arange(N, dtype=np.int32), count)
    return replace(merge_maps(maps, [str(i) for i in range(count)]), same_as=same_as)


def closed_map():
    around = np.concatenate([ROUTE[:, :-20], ROUTE[:, :20]], axis=1)
    same_as = np.append(np.arange(N - 20), np.arange(20)).astype(np.int32)
    return map_of(features_of(around, 0.5, 1), same_as=same_as)


def fields_of(recognizer, features, images=None):
    """Drive on; return all fields of all matches as text."""
    matches = [
        recognizer.update(features[i : i + 1], (i + 1) * 10**8, POSES[i])
        for i in images or range(len(features))
    ]
    names = [each.name for each in fields(Match)]
    return [
        [(name, np.asarray(getattr(match, name), object).tolist()) for name in names]
        for match in matches
    ]


def assert_same(found, expected):
    for image, (one, other) in enumerate(zip(found, expected, strict=True)):
        assert repr(one) == repr(other), image
    assert sum('Status.MATCH' in repr(each) for each in expected) > 10


@pytest.mark.parametrize(
    ('sessions', 'changes', 'precision'),
    [
        (1, {'odometry_error': 0.0}, 'float32'),
        (1, {}, 'float32'),
        (1, {}, 'int8'),
        (1, {'direction': 'both'}, 'float32'),
        (1, {'mode': 'paper', 'threshold': 0.5}, 'float32'),
        (2, {}, 'float32'),
        (5, {}, 'float32'),  # parts of some are compared
        (0, {}, 'float32'),  # a closed route
    ],
)
def test_recognizer_after_a_reset_answers_as_a_new_one(sessions, changes, precision):
    place_map = of_sessions(sessions) if sessions else closed_map()
    settings = RecognizerSettings(**changes)
    one, new = (PlaceRecognizer(place_map, settings, precision=precision) for _ in range(2))
    fields_of(one, DRIVE)
    one.reset()
    assert_same(fields_of(one, DRIVE), fields_of(new, DRIVE))


@pytest.mark.parametrize('precision', ['float32', 'int8'])
def test_loop_closer_after_a_reset_answers_as_a_new_one_on_its_route(precision):
    """The route stays; another one has the same without any window, by a reset at each image."""
    options = {'limit': 150, 'precision': precision}
    one, new = (LoopCloser(RecognizerSettings(), 30, DRIVE.settings, **options) for _ in 'ab')
    fields_of(one, DRIVE)
    for image in range(len(DRIVE)):
        fields_of(new, DRIVE, [image])
        new.reset()
    one.reset()
    again = features_of(ROUTE, 0.5, 8)
    assert_same(fields_of(one, again), fields_of(new, again))
