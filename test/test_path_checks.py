# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checks of a path as a whole: evenness of its distances, and motion."""

import numpy as np
from places import features_of, map_of, recognize_all, route_strips
import pytest
from stavpr_ros.filter import checks as path_checks
from stavpr_ros.filter import choice
from stavpr_ros.filter.checks import (
    least_at_rest,
    SURE_AT_REST,
    unevenness,
)
from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings

PLACES = 240


def test_unevenness_counts_each_place_once_with_its_nearest_image():
    path = np.array([3, 3, 4, 4, 5, 5])
    assert unevenness(path, np.array([-4.0, 1.0, 1.0, -4.0, -4.0, 1.0])) == 0


def test_camera_at_rest_needs_less_where_its_images_are_near():
    assert least_at_rest(np.array([-1.0]), -2.0, 0.25) == pytest.approx(SURE_AT_REST)
    assert least_at_rest(np.array([np.inf, 0.0]), -2.0, 0.25) == pytest.approx(SURE_AT_REST)
    near = least_at_rest(np.array([-2.0, -4.0]), -2.0, 0.25)  # mean -3: logarithm 6 - 2
    assert near / (1 - near) == pytest.approx(9 * np.exp(-0.75 * 4))


def test_place_that_only_some_images_show_is_not_matched(monkeypatch):
    route, other = route_strips(0, PLACES), route_strips(7, PLACES)
    mixed = np.where((np.arange(PLACES) % 6 < 4)[None, :, None], route, other)
    query = features_of(mixed[:, 40:120], 0.2, 1)
    recognizer = PlaceRecognizer(map_of(features_of(route)), RecognizerSettings(mode='robust'))
    matched = np.mean([match.accepted for match in recognize_all(recognizer, query)])
    monkeypatch.setattr(path_checks, 'UNEVEN_WEIGHT', 0.0)
    without = np.mean([match.accepted for match in recognize_all(recognizer, query)])
    assert without > 0.4
    assert matched < 0.1


def test_where_the_most_probable_path_is_refuted_the_next_one_is_matched(monkeypatch):
    route = route_strips(0, PLACES)
    route[:, 140:220] = route[:, 40:120]
    query = features_of(route[:, 40:120], 0.2, 1)
    recognizer = PlaceRecognizer(
        map_of(features_of(route, 0.05)), RecognizerSettings(mode='robust', min_probability=1e-9)
    )

    refined = choice.refined

    def refuted_first(*arguments):
        path, placed, z, masses, _, compared = refined(*arguments)
        return path, placed, z, masses, 10.0 if path.mean() < 130 else 0.0, compared

    monkeypatch.setattr(choice, 'refined', refuted_first)
    matches = [match for match in recognize_all(recognizer, query) if match.accepted]
    assert len(matches) > 50
    for match in matches:
        assert match.place_index >= 140
        assert match.sequence.second_best_distance >= match.distance
