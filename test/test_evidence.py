# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The probability of a window's place by quantities without a unit."""

from dataclasses import replace

import numpy as np
from places import features_of, map_of, recognize_all, route_strips
import pytest
from stavpr_ros.method import evidence, PlaceRecognizer, RecognizerSettings
from stavpr_ros.method.evidence import (
    probability_of,
    Quantities,
    RecentWindows,
    unevenness,
)


def test_probability_by_hand():
    """Of odds 3, a lead of 1, and half a window; of a drive that rarely matched."""
    window = Quantities(0.75, lead=1.0, images=10, cells=4.0)
    assert window.odds == pytest.approx(np.log(3))
    expected = -7.0 + 0.5 * np.log(3) + 1.5 * np.log(11) + 2.0 * np.log(5)
    assert window.own(-7.0) == pytest.approx(expected)
    plain = window._replace(cells=0.0)
    assert window._replace(cells=-2.0).own(-7.0) == plain.own(-7.0)
    assert plain._replace(creep=0.4).own(-7.0) == pytest.approx(plain.own(-7.0) - 2 * 0.4)
    own = plain._replace(lead=0.6).own(-7.0)
    expected = 1 / (1 + np.exp(5 * np.log(3) - own))
    assert probability_of(own, 0.25) == pytest.approx(expected)
    assert probability_of(own, 0.5) == probability_of(own, 0.9) > expected
    sure = Quantities(1.0, lead=4.0, images=20)
    assert sure.own(-7.0) == sure._replace(belief=1 - 1e-9).own(-7.0) > 1
    assert probability_of(-np.inf, 0.9) == 0


def test_checks_of_a_path_lower_its_odds_by_hand():
    window = Quantities(0.75, uneven=0.05, excess=0.06)
    assert window.odds == pytest.approx(np.log(3) - 10 * 0.05 - 25 * 0.02)
    assert window._replace(uneven=0.0, excess=0.04).odds == pytest.approx(np.log(3))
    assert window._replace(excess=9.0).odds == -evidence.LIMIT


def test_unevenness_is_of_each_place_once_with_its_nearest_image():
    path = np.array([3, 3, 4, 4, 5, 5])
    assert unevenness(path, np.array([-4, 1, 1, -4, -4, 1], np.float32)) == 0
    z = np.array([-4, np.inf, -1, 2, 0.5, np.inf], np.float32)
    assert unevenness(path, z) == pytest.approx(np.std([-4, -1, 0.5]) - 1.4)
    far = np.array([-9, -9, -3, -3, -3, -3], np.float32)
    assert unevenness(path, far) == pytest.approx(np.std([9, 3, 3]) - 0.45 * 5)
    assert unevenness(path, np.array([-9, 1, np.inf, np.inf, 9, 9], np.float32)) == 0  # of two


def test_recent_windows_start_even_and_forget():
    recent = RecentWindows()
    for _ in range(4):
        recent.add(1.0)
    assert recent.share == pytest.approx((0.5 + 4) / 5)
    for _ in range(600):
        recent.add(-np.inf)
    assert recent.share < 0.01
    for _ in range(30):
        recent.add(1.0)
    assert 0.4 < recent.share < 0.5


def test_weak_windows_make_a_drive_less_likely_with_learned_features():
    """Where right windows are farther ahead, on floors that look alike, these are not right."""
    probabilities = []
    for kind in ('gradient', 'hybrid', 'unknown'):
        places, query = features_of(route_strips(0, 120)), features_of(route_strips(0, 120), 7.0)
        places, query = (
            replace(part, settings=replace(part.settings, kind=kind)) for part in (places, query)
        )
        recognizer = PlaceRecognizer(map_of(places), RecognizerSettings(mode='robust'))
        matches = recognize_all(recognizer, query)
        probabilities.append(np.array([match.probability for match in matches]))
    gradient, hybrid, unknown = np.nan_to_num(probabilities)
    assert unknown.tolist() == gradient.tolist()
    assert (hybrid <= gradient).all()
    assert hybrid[40:].mean() < 0.9 * gradient[40:].mean()


def test_place_that_only_some_images_show_is_not_matched(monkeypatch):
    route, other = route_strips(0, 240), route_strips(7, 240)
    mixed = np.where((np.arange(240) % 6 < 4)[None, :, None], route, other)
    query = features_of(mixed[:, 40:120], 0.2, 1)
    recognizer = PlaceRecognizer(map_of(features_of(route)), RecognizerSettings(mode='robust'))
    matched = np.mean([match.accepted for match in recognize_all(recognizer, query)])
    monkeypatch.setattr(evidence, 'UNEVEN_WEIGHT', 0.0)
    without = np.mean([match.accepted for match in recognize_all(recognizer, query)])
    assert without > 0.4
    assert matched < 0.1
