# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Mode robust: each option alone, and all together."""

from dataclasses import replace

import numpy as np
from places import features_of, recognize_all
import pytest
from stavpr_ros.alignment import SequenceSettings, SpatialSettings
from stavpr_ros.errors import SettingsError
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.method.model import CLOSE
from stavpr_ros.method.settings import PAPER, ROBUST, RobustOptions
from stavpr_ros.prepare.centering import (
    MeanCentering,
    norms_of,
    PRIOR,
    STRENGTH,
    unit_norm,
    Whitening,
    z_normalized,
)

SHORT = SequenceSettings(length=5, beta=2.0)


def robust(place_map, **changes) -> PlaceRecognizer:
    return PlaceRecognizer(place_map, RecognizerSettings(mode='robust', **changes))


# ------------------------------------------------ the options


def test_robust_options_by_name():
    assert RecognizerSettings(mode='robust').applied_options == ROBUST == RobustOptions()
    assert RecognizerSettings(mode='paper').applied_options == PAPER
    with pytest.raises(SettingsError, match='other'):
        RecognizerSettings(0.5, mode='other')


def test_mean_centering_subtracts_means_and_keeps_zeros():
    some = np.random.default_rng(0).standard_normal((3, 40, 8))  # changes of about 1: all count
    some[1, 5] = 0
    features = features_of(some)
    strips = features.strips
    mean_centering = MeanCentering(features, whitening=False)
    centered = mean_centering.places(features).strips
    mean = strips.mean(axis=1)
    for j in range(3):
        for y in (0, 5, 39):
            expected = strips[j, y] - mean[j] if strips[j, y].any() else np.zeros(8, np.float32)
            np.testing.assert_allclose(centered[j, y], unit_norm(expected), rtol=1e-5, atol=1e-5)
    seen = strips[:, :2]
    mean_centering.next_query(seen[:, 0])
    second = mean_centering.next_query(seen[:, 1])
    query_mean = (PRIOR * mean + seen[:, 0] + seen[:, 1]) / (PRIOR + 2)
    expected = seen[:, 1] - query_mean
    np.testing.assert_allclose(second, unit_norm(expected), rtol=1e-5, atol=1e-5)
    mean_centering.reset()
    first = mean_centering.next_query(seen[:, 1])
    assert not np.allclose(first, second)


def test_whitening_equals_equation_in_numpy():
    """Each principal direction is scaled by its gain; the inverse undoes it."""
    rng = np.random.default_rng(0)
    strips = rng.normal(size=(2, 30, 6)) * [3, 2, 1, 1, 0.5, 0.1] @ rng.normal(size=(6, 6))
    strips /= np.linalg.norm(strips, axis=2, keepdims=True)
    whitening = Whitening.learned(strips.astype(np.float32))
    some = rng.normal(size=(2, 4, 6))
    for j in range(2):
        values, directions = np.linalg.eigh(strips[j].T @ strips[j])
        shares = values / values.sum()
        gains = 1 / np.sqrt(1 + STRENGTH * shares / np.sum(shares**2))
        assert gains.max() / gains.min() > 1.3
        expected = some[j] @ directions * gains @ directions.T
        found = whitening(some.astype(np.float32))
        np.testing.assert_allclose(found[j], expected, atol=1e-5)
        np.testing.assert_allclose(whitening.inverse(found)[j], some[j], atol=1e-5)


def test_mean_centering_with_whitening_of_map_and_query_agree():
    some = np.random.default_rng(0).random((3, 40, 8))
    some[1, 5] = 0
    features = features_of(some)
    strips, before = features.strips, features.strips.copy()
    centering = MeanCentering(features, centering=False)
    places = centering.places(features).strips
    np.testing.assert_allclose(
        centering.next_query(strips[:, 7]), places[:, 7], rtol=1e-5, atol=1e-5
    )
    assert np.array_equal(strips, before)
    assert not places[1, 5].any()
    assert not np.allclose(places[0], strips[0], atol=1e-2)
    norms = norms_of(places)
    norms[1, 5] = 1
    np.testing.assert_allclose(norms, np.ones((3, 40), np.float32), rtol=1e-5, atol=1e-5)


def test_mean_centering_of_long_query_keeps_precision():
    """The difference of a constant image to the running mean keeps its direction."""
    some = features_of(np.random.default_rng(0).random((2, 4, 8)))
    mean_centering, strips = MeanCentering(some[:3]), some.strips[:, 3]
    first = mean_centering.next_query(strips)
    for _ in range(2000):
        last = mean_centering.next_query(strips)
    np.testing.assert_allclose(last, first, rtol=0, atol=1e-4)


def test_z_normalized_row_has_mean_0_and_deviation_1_of_finite_entries():
    row = np.random.default_rng(0).normal(3, 2, 9).astype(np.float32)
    row[4] = np.inf
    found = z_normalized(row)
    known = np.delete(row, 4).astype(float)
    expected = np.insert((known - known.mean()) / known.std(), 4, np.inf)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    np.testing.assert_array_equal(z_normalized(np.full(3, 0.5, np.float32)), [0, 0, 0])
    assert len(z_normalized(row[:0])) == 0


def test_z_normalized_around_subtracts_mean_of_neighbors():
    row = np.random.default_rng(0).normal(3, 2, 40).astype(np.float32)
    z = z_normalized(row)
    found = z_normalized(row, 3)
    for y in range(40):
        near = [max(z[min(max(i, 0), 39)], -1) for i in range(y - 3, y + 4)]
        assert found[y] == pytest.approx(z[y] - np.mean(near), abs=1e-5)
    row[4] = np.inf
    assert np.isinf(z_normalized(row, 3)).tolist() == [i == 4 for i in range(40)]


# ------------------------------------------------ the recognizer


@pytest.mark.parametrize(
    ('without', 'strategy'),
    [
        ('', 'none'),
        ('mean_centering', 'adaptive'),
        ('query_znorm', 'none'),
        ('place_filter', 'adaptive'),
    ],
)
def test_recognizer_without_one_option_finds_places(small_map, without, strategy):
    mode = replace(ROBUST, **{without: False}) if without else ROBUST
    settings = RecognizerSettings(None, SpatialSettings(strategy), SHORT, 5, mode)
    one = PlaceRecognizer(small_map, settings)
    answers = recognize_all(one, small_map.features[10:30])
    middles = [a.path.place for a in answers[4:]]
    assert np.mean(np.abs(np.array(middles) - np.arange(12, 28)) <= 1) > 0.9
    assert int(np.argmin(one.newest_row())) == 29
    places, distances = one.candidates(7)
    assert abs(places[0] - answers[-1].path.place) <= CLOSE
    assert len(set(places.tolist())) == len(places) >= 5
    assert (np.diff(distances) >= 0).all()
