# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A loop closer after its reset, as test_golden_streams has the recognizers of maps."""

from dataclasses import fields

import numpy as np
from places import features_of, route_strips
import pytest
from stavpr_ros.method import Match, RecognizerSettings
from stavpr_ros.method.loop_closer import LoopCloser

pytestmark = pytest.mark.usefixtures('one_thread')
N = 120
ROUTE = route_strips(0, N)
DRIVE = features_of(np.concatenate([ROUTE[:, :95], route_strips(9, 30), ROUTE[:, 85:]], 1), 0.5, 7)
DRIVE.strips[:, 70:95] = DRIVE.strips[:, 69:70]  # a stop before the detour
POSES = np.tile([0.0, 0, 0, 0, 0, 0, 1], (2 * N, 1))
POSES[:, 0] = 1.1 * np.arange(2 * N)


def drive(recognizer, features, image):
    """Return all fields of the match of the next image as text."""
    match = recognizer.update(features[image : image + 1], (image + 1) * 10**8, POSES[image])
    return repr([np.asarray(getattr(match, each.name), object).tolist() for each in fields(Match)])


def assert_same(one, new, features):
    pairs = [
        [drive(each, features, image) for each in (one, new)] for image in range(len(features))
    ]
    assert [first for first, _ in pairs] == [second for _, second in pairs]
    assert sum('Status.MATCH' in first for first, _ in pairs) > 10


@pytest.mark.parametrize('precision', ['float32', 'int8'])
def test_loop_closer_after_a_reset_answers_as_a_new_one_on_its_route(precision):
    """The route stays; another one has the same without any window, by a reset at each image."""
    options = {'limit': 240, 'precision': precision}
    one, new = (LoopCloser(RecognizerSettings(), 30, DRIVE.settings, **options) for _ in 'ab')
    for image in range(len(DRIVE)):
        drive(one, DRIVE, image)
        drive(new, DRIVE, image)
        new.reset()
    one.reset()
    assert_same(one, new, features_of(ROUTE, 0.5, 8))
