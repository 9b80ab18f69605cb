# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The first stage of large maps: coarse distances by plain loops, candidates, time budget."""

from dataclasses import replace

import numpy as np
from places import features_of, map_of
import pytest
from stavpr_ros.alignment.settings import SpatialSettings
from stavpr_ros.errors import SettingsError
from stavpr_ros.mapping import Session
from stavpr_ros.prepare import first_stage
from stavpr_ros.prepare.centering import unit_norm
from stavpr_ros.prepare.cpu_matcher import CpuMatcher
from stavpr_ros.prepare.first_stage import CHUNK, FirstStage
from stavpr_ros.prepare.matcher import make_matcher
from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings

W, d = 7, 40
SETTINGS = RecognizerSettings(mode='robust')
pytestmark = pytest.mark.usefixtures('one_thread')


def random_features(n, seed=0, strips=W):
    return features_of(np.random.default_rng(seed).standard_normal((strips, n, d), np.float32))


def noisy(features, share=0.4, seed=1):
    """Return the same images, seen otherwise."""
    mixed = features.strips + share * random_features(len(features), seed).strips
    return replace(features, strips=unit_norm(mixed))


def stage_of(features, probable=(), precision='float32', spatial=None):
    matcher = make_matcher(features, spatial or SpatialSettings(), 'cpu', precision)
    return matcher, FirstStage(matcher, features, lambda: np.array(probable, np.int64))


@pytest.fixture
def few(monkeypatch):
    """Let few chunks be compared exactly."""
    monkeypatch.setattr(first_stage, 'SAMPLED', 12)
    monkeypatch.setattr(first_stage, 'NEAREST', 3)


@pytest.mark.parametrize(('precision', 'strips'), [('float32', 1), ('float32', 9), ('int8', 7)])
def test_first_stage_of_few_places_returns_exact_distances(precision, strips):
    features = random_features(77, strips=strips)  # fewer than are sampled
    matcher, stage = stage_of(features, precision=precision)
    query = random_features(1, seed=5, strips=strips)
    found = stage.distances(query.strips[:, 0], query.weights[:, 0])
    expected = matcher.distances(query.strips[:, 0], query.weights[:, 0])
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert stage.places == 77


def test_coarse_distances_equal_plain_loops_over_shifts(monkeypatch):
    monkeypatch.setattr(first_stage, 'BYTES', W * d)  # nothing is left out
    places, query = random_features(300), random_features(1, seed=2)
    _, stage = stage_of(places)
    rows = stage._shifted(query.strips[:, 0])
    out, nearest = np.empty(300, np.float32), np.empty(10, np.float32)
    queries = first_stage.int8.tiled(rows[:, None])
    features = stage._reduced.kernel_arguments()
    first_stage.int8.smallest_distances(features, queries, CHUNK, out, nearest)
    x, y = query.strips[:, 0].astype(np.float64), places.strips.astype(np.float64)
    for place in range(300):
        cosines = []
        for shift in range(-3, 4):
            pairs = [(j, j + shift) for j in range(W) if 0 <= j + shift < W]
            total = sum(x[i] @ y[j, place] for j, i in pairs)
            cosines.append(total / np.sqrt(len(pairs) * W))
        assert out[place] == pytest.approx(1 - max(cosines), abs=0.01)
    np.testing.assert_array_equal(nearest, [out[i : i + CHUNK].min() for i in range(0, 300, 32)])


def test_row_is_exact_at_candidates_and_of_same_scale_elsewhere(few):
    features = random_features(5000)
    matcher, stage = stage_of(features, probable=[1280])
    query = noisy(features[3333:3334])
    found = stage.distances(query.strips[:, 0], query.weights[:, 0])
    expected = matcher.distances(query.strips[:, 0], query.weights[:, 0])
    exact = np.isclose(found, expected, atol=1e-6)
    assert exact[3328 : 3328 + CHUNK].all(), 'the nearest chunk'
    assert exact[1280 : 1280 + 128 + CHUNK].all(), 'what the filter finds probable'
    assert exact[:CHUNK].all(), 'the sample'
    assert np.count_nonzero(exact) < 1000
    assert np.argmin(found) == 3333
    assert found.mean() == pytest.approx(expected.mean(), abs=0.3 * float(expected.std()))
    assert found.std() == pytest.approx(expected.std(), rel=0.25)


@pytest.mark.parametrize('shift', [-2, -1, 1, 2])
def test_image_shifted_by_strips_is_among_candidates(few, shift):
    features = random_features(5000)
    _, stage = stage_of(features)
    query = noisy(features[3333:3334], 0.2)
    strips = np.roll(query.strips, shift, axis=0)
    found = stage.distances(strips[:, 0], query.weights[:, 0])
    assert np.argmin(found) == 3333


def recognizer(features, sessions=1, **changes):
    index = (np.arange(len(features)) * sessions // len(features)).astype(np.int32)
    names = tuple(Session(str(i)) for i in range(sessions))
    place_map = map_of(features, sessions=names, session_index=index)
    return PlaceRecognizer(place_map, replace(SETTINGS, **changes))


def matches(one, query):
    found = [one.update(query[i : i + 1]) for i in range(len(query))]
    return [(m.accepted, m.sequence and m.sequence.middle) for m in found]


@pytest.mark.parametrize('sessions', [1, 3])
def test_recognizer_over_time_budget_matches_as_exact_one(few, sessions):
    features = random_features(3000)
    query = noisy(features[2000:2040], 1.5)
    exact = recognizer(features, sessions, time_budget_ms=60000)
    coarse = recognizer(features, sessions, time_budget_ms=1e-6)
    assert isinstance(coarse._matcher, FirstStage)
    assert isinstance(exact._matcher, CpuMatcher)
    assert recognizer(features).start_notes == ''
    assert 'exact matching takes' in exact.start_notes
    assert 'with a first stage' in coarse.start_notes
    assert 'with a first stage' not in exact.start_notes
    found = matches(coarse, query)
    assert found == matches(exact, query)
    assert found[-1] == (True, 2029)


@pytest.mark.parametrize(
    'changes',
    [
        {'time_budget_ms': -1.0},
        {'time_budget_ms': float('inf')},
        {'time_budget_ms': 10.0, 'mode': 'paper'},
        {'time_budget_ms': 10.0, 'spatial': SpatialSettings('none')},
        {'time_budget_ms': 10.0, 'spatial': SpatialSettings(vertical=True)},
    ],
)
def test_invalid_time_budget_is_rejected_by_name(changes):
    with pytest.raises(SettingsError, match='time_budget_ms'):
        replace(SETTINGS, **changes)
