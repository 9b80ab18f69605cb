# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Means of places over the latest images, and loop closure on a new street in a known light."""

import numpy as np
from places import features_of, recognize_all, route_strips
import pytest
from stavpr_ros.method import RecognizerSettings
from stavpr_ros.method.loop_closer import LoopCloser
from stavpr_ros.method.model import DELAY, MEAN_IMAGES, MEAN_PRIOR, NEAREST
from stavpr_ros.method.place_means import PlaceMeans

EXCLUDED = 50


def expected_means(rows, places):
    """Return the means by the definition, (places,), of rows that count, oldest first."""
    weights = (1 - 1 / MEAN_IMAGES) ** np.arange(len(rows))[::-1]
    known = [np.append(row, np.full(places - len(row), row[-1])) for row in rows]
    clipped = np.maximum(np.reshape(known, (len(rows), places)), NEAREST)
    return weights @ clipped / (weights.sum() + MEAN_PRIOR)


def test_means_are_weighted_ones_of_earlier_rows_with_unknown_places_as_the_last():
    rng = np.random.default_rng(0)
    rows = [rng.normal(0, 2, 3 + i).astype(np.float32) for i in range(12)]
    means = PlaceMeans()
    for i, row in enumerate(rows):
        counted = rows[: max(0, i - DELAY)]
        less = means.correct(row, False)
        np.testing.assert_allclose(less, row - expected_means(counted, len(row)), atol=1e-5)


def test_places_that_are_excluded_count_as_mean_0():
    means = PlaceMeans()
    for _ in range(10):
        means.correct(np.array([np.inf, 1.0], np.float32), False)
    less = means.correct(np.array([2.0, 2.0], np.float32), False)
    assert less[0] == 2
    assert less[1] < 2
    assert means.correct(np.array([np.inf, 1.0], np.float32), False)[0] == np.inf


def test_evicted_places_take_their_means_with_them():
    rng = np.random.default_rng(2)
    rows = rng.normal(0, 1, (30, 40)).astype(np.float32)
    whole, evicted = PlaceMeans(), PlaceMeans()
    for row in rows:
        whole.correct(row, False)
        evicted.correct(row, False)
    evicted.evict(7)
    for row in rows:
        kept = evicted.correct(row[7:], False)
        np.testing.assert_array_equal(kept, whole.correct(row, False)[7:])
    evicted.evict(33)
    assert len(evicted.correct(np.empty(0, np.float32), False)) == 0


def drive(strips, noise=0.3):
    """Return the matches of a route with images of these strips."""
    features = features_of(strips, noise)
    closer = LoopCloser(RecognizerSettings(mode='robust'), EXCLUDED, features.settings)
    return recognize_all(closer, features)


def with_shared_content(seed, amount):
    """Return strips; from place 200 on, all share content with places 60 to 75."""
    strips = route_strips(seed, 300)
    shared = amount * np.random.default_rng(seed + 50).standard_normal((7, 1, strips.shape[2]))
    strips[:, 60:75] += shared
    strips[:, 200:260] += shared
    return strips


def probable(matches):
    return sum(match.probability > RecognizerSettings.min_probability for match in matches)


@pytest.mark.parametrize('seed', [0, 1])
def test_stretch_that_looks_like_an_earlier_one_throughout_is_seldom_probable(monkeypatch, seed):
    """No place is passed again, then all are."""
    strips = with_shared_content(seed, 1.6)
    assert probable(drive(strips)) <= 10
    twice = drive(np.concatenate([strips, strips], axis=1))
    places = [match.path.place for match in twice if match.accepted]
    off = np.array(places) - np.arange(len(places))
    assert len(places) > 265
    assert np.mean(np.abs(off - np.median(off)) <= 4) > 0.95
    assert probable(drive(strips, noise=1.0)) <= 3
    monkeypatch.setattr(PlaceMeans, 'correct', lambda self, z, is_standstill: z)
    assert probable(drive(strips, noise=1.0)) > 8


@pytest.mark.parametrize('seed', [0, 3, 4])
def test_stretch_that_looks_alike_for_less_than_a_window_is_not_closed(seed):
    matches = drive(with_shared_content(seed, 1.8))
    assert probable(matches) <= 15
    assert not any(match.accepted or match.late for match in matches)
