# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The recognizer image by image, its candidates, and each option of mode robust."""

from dataclasses import astuple, replace
import math

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from places import features_of, recognize_all
import pytest
from stavpr_ros.alignment import best_match, match_sequence, SequenceSettings, SpatialSettings
from stavpr_ros.alignment.lm_dtw import trace_sequence
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.features import LocalFeatures
from stavpr_ros.mapping import build_map, load_map, Map
from stavpr_ros.method import Candidate, PlaceRecognizer, RecognizerSettings, Status
from stavpr_ros.method.columns import ColumnLayout
from stavpr_ros.method.match import WindowSequences
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
from stavpr_ros.sources import open_source

SHORT = SequenceSettings(length=5, beta=2.0)


def recognizer(place_map: Map, threshold: float = 0.3, **changes) -> PlaceRecognizer:
    changes = {'sequence': SHORT, 'nms_radius': 5, 'mode': 'paper'} | changes
    threshold = threshold if changes['mode'] == 'paper' else None
    return PlaceRecognizer(place_map, RecognizerSettings(threshold, **changes))


def empty_map(like: Map) -> Map:
    return Map(like.features[0:0], like.projection, like.stamps[:0], (), None, ())


def test_recognizer_of_its_own_map_matches_every_window(small_map):
    answers = recognize_all(recognizer(small_map), small_map.features)
    for i, answer in enumerate(answers[:4]):
        assert answer.status is Status.WARMING_UP
        assert answer.place == answer.newest == -1
        assert f'{i + 1} of 5' in answer.reason
    for i, answer in enumerate(answers[4:], start=4):
        assert answer.status is Status.MATCH
        assert (answer.place, answer.newest) == (i - 2, i)
        assert answer.path.distance == pytest.approx(0, abs=1e-5)
        assert abs(answer.path.second_best - (i - 2)) > 5
        assert answer.path.second_best_distance > answer.path.distance


@pytest.mark.parametrize('strategy', ['adaptive', 'vanilla', 'sliding_window', 'none'])
def test_recognizer_by_image_equals_whole_matrix_at_once(small_map, strategy):
    """Exactly, at every turn of the ring buffer."""
    one = recognizer(small_map, spatial=SpatialSettings(strategy))
    query = small_map.features[7:40]
    D = one.distances(query)
    answers = recognize_all(one, query)
    for end in range(4, len(query)):
        window = D[end - 4 : end + 1]
        expected = best_match(match_sequence(window, SHORT), 5)
        path = answers[end].path
        second = path.second_best, path.second_best_distance
        assert (path.first, path.last, path.place, path.distance, *second) == astuple(expected)
        np.testing.assert_array_equal(
            answers[end].path.pairs, trace_sequence(window, expected.first, SHORT.k)
        )


def test_recognizer_at_threshold_does_not_match(small_map, route):
    query = small_map.extractor().extract([255 - image for image in route[3:8]])
    distance = recognize_all(recognizer(small_map), query)[-1].path.distance
    assert distance > 0.01
    for threshold, status in (
        (distance, Status.NO_MATCH),
        (np.nextafter(distance, 1), Status.MATCH),
    ):
        assert recognize_all(recognizer(small_map, float(threshold)), query)[-1].status is status


@pytest.mark.parametrize('mode', ['paper', 'robust'])
def test_recognizer_on_empty_map_never_matches(small_map, mode):
    one = recognizer(empty_map(small_map), mode=mode)
    answers = recognize_all(one, small_map.features[:7])
    assert one.ranked(5) == []
    assert answers[-1].status is Status.NO_MATCH
    assert answers[-1].place == -1
    assert 'empty' in answers[-1].reason


@pytest.mark.parametrize('places', [1, 4])
def test_recognizer_on_map_shorter_than_window_matches(small_map, places):
    stamps, ids = small_map.stamps[:places], small_map.ids[:places]
    short = Map(small_map.features[:places], small_map.projection, stamps, ids, None, ())
    answer = recognize_all(recognizer(short, 2.0), small_map.features[:6])[-1]
    assert answer.status is Status.MATCH
    assert 0 <= answer.place < places
    assert answer.path.pairs[:, 1].max() < places


@pytest.mark.parametrize('mode', ['paper', 'robust'])
@pytest.mark.parametrize('value', [np.nan, np.inf])
def test_features_not_finite_are_rejected_and_change_nothing(small_map, value, mode):
    one, other = (recognizer(small_map, mode=mode) for _ in range(2))
    features = small_map.features
    strips = features[:].strips.copy()
    strips[2, 0, 0] = value
    damaged = LocalFeatures(strips, features.weights, features.settings)
    for localizer in (one, other):
        recognize_all(localizer, features[:3])
    for call in (one.update, one.distances):
        with pytest.raises(InputError, match='features of the image are not finite'):
            call(damaged[:1])
    for i in range(3, 6):
        result, expected = (localizer.update(features[i : i + 1]) for localizer in (one, other))
        assert repr(vars(result)) == repr(vars(expected))
    with pytest.raises(InputError, match='features of the map are not finite'):
        recognizer(replace(small_map, features=damaged))


def test_arguments_of_wrong_types_or_values_are_rejected_with_the_expected_one(small_map):
    one, settings, image = recognizer(small_map), RecognizerSettings(), np.zeros((9, 9, 3))
    for call, error, words in (
        (lambda: PlaceRecognizer('route.stavpr', settings), InputError, 'Map.load'),
        (
            lambda: PlaceRecognizer(small_map, 0.5),
            InputError,
            r'float: expected RecognizerSettings',
        ),
        (lambda: one.update(image), InputError, 'expected the LocalFeatures of one image'),
        (lambda: build_map('monday/', small_map.extractor()), InputError, 'expected open_source'),
        (lambda: build_map([], 'gradient'), InputError, 'str: expected a FeatureExtractor'),
        (lambda: open_source(None), InputError, 'NoneType: expected the path of a folder'),
        (lambda: load_map(3), InputError, 'int: expected the path of a map file'),
        (lambda: RecognizerSettings('0.5'), SettingsError, "'0.5' is str: expected a number"),
        (lambda: RecognizerSettings(nms_radius='2'), SettingsError, "nms_radius = '2' is str"),
        (lambda: RecognizerSettings(nms_radius=-1), SettingsError, 'nms_radius'),
        (lambda: RecognizerSettings(0.5), SettingsError, 'applies to mode paper'),
        (lambda: RecognizerSettings(0.0, mode='paper'), SettingsError, 'threshold'),
        (lambda: RecognizerSettings(-1.0, mode='paper'), SettingsError, 'threshold'),
        (lambda: RecognizerSettings(np.nan, mode='paper'), SettingsError, 'threshold'),
        (lambda: RecognizerSettings(0.5, mode='other'), SettingsError, 'other'),
        (lambda: recognizer(small_map, spatial=SpatialSettings(xi=8)), SettingsError, 'xi = 8'),
        (lambda: one.set_limits(0.0, 0.5), SettingsError, 'threshold'),
    ):
        with pytest.raises(error, match=words):
            call()


@pytest.mark.parametrize('mode', ['paper', 'robust'])
def test_match_has_stamps_of_its_window(small_map, mode):
    one = recognizer(small_map, mode=mode)
    for i in range(7):
        match = one.update(small_map.features[i : i + 1], 100 + i)
        assert match.window_stamps == tuple(range(100 + max(0, i - 4), 101 + i))
        changes = match.window_changes
        if mode == 'robust':
            assert len(changes) == len(match.window_stamps)
            assert changes[-1] > 0
    assert bool(changes) is (mode == 'robust')
    one.reset()
    match = one.update(small_map.features[:1], 3)
    assert (match.status, match.window_stamps) == (Status.WARMING_UP, (3,))
    assert len(match.window_changes) == (mode == 'robust')


def plain(costs, places, count, nms_radius):
    """Return the indices of the sequences that are taken, one after the other."""
    taken = []
    for index in sorted(range(len(costs)), key=lambda i: (costs[i], i)):
        apart = all(abs(places[index] - places[other]) > nms_radius for other in taken)
        if apart and len(taken) < count and math.isfinite(costs[index]):
            taken.append(index)
    return taken


def pairs_of(candidates):
    """Return place and distance of each: NaN, an unknown probability, equals nothing."""
    return [(candidate.place, candidate.distance) for candidate in candidates]


def nearest_of(costs, places, distance):
    best = int(np.argmin(costs))
    return Candidate(int(places[best]), distance)


cases = st.integers(1, 40).flatmap(
    lambda n: st.tuples(
        st.lists(st.sampled_from([-1.5, -1.0, 0.0, 0.25, 0.5, math.inf]), min_size=n, max_size=n),
        st.lists(st.integers(0, 50), min_size=n, max_size=n),
        st.integers(0, 12),
        st.integers(0, 15),
    )
)


@given(cases)
def test_ranked_candidates_equal_plain_loop(case):
    """Few different costs: most of them are ties."""
    costs, places, count, nms_radius = case
    costs, places = np.array(costs, np.float32), np.array(places, np.int32)
    nearest = nearest_of(costs, places, float(costs.min())) if np.isfinite(costs).any() else None
    before = costs.copy()
    layout = ColumnLayout(nms_radius=nms_radius)
    result = layout.ranked(nearest, WindowSequences(costs, places), count)
    expected = plain(costs.tolist(), places.tolist(), count, nms_radius)
    assert pairs_of(result) == [(int(places[i]), float(costs[i])) for i in expected]
    np.testing.assert_array_equal(costs, before)


@pytest.mark.parametrize('mode', ['paper', 'robust', 'dtw'])
def test_ranked_begins_with_nearest_and_second_best(small_map, mode):
    settings = RecognizerSettings(
        sequence=SHORT,
        nms_radius=5,
        mode=RobustOptions(place_filter=False) if mode == 'dtw' else mode,
    )
    one = PlaceRecognizer(small_map, settings)
    assert one.ranked(3) == []
    for i in [*range(10, 20), *range(0, 6)]:
        nearest = one.update(small_map.features[i : i + 1]).path
        ranked = one.ranked(4)
        if nearest.place < 0:
            assert ranked == []
            continue
        assert (ranked[0].place, ranked[0].distance) == (nearest.place, nearest.distance)
        if mode == 'robust' and nearest.second_best < 0:  # nowhere else, by the filter
            assert len(ranked) == 1
            continue
        assert ranked[1].place == nearest.second_best
        assert ranked[1].distance == pytest.approx(nearest.second_best_distance, abs=1e-6)
        assert len(ranked) == 4 or mode == 'robust'  # of other places, nothing is left
    one.reset()
    assert one.ranked(3) == []
    with pytest.raises(InputError, match='-1'):
        one.ranked(-1)


def robust(place_map, **changes) -> PlaceRecognizer:
    return PlaceRecognizer(place_map, RecognizerSettings(mode='robust', **changes))


# ------------------------------------------------ the options


def test_robust_options_by_name():
    assert RecognizerSettings(mode='robust').applied_options == ROBUST == RobustOptions()
    assert RecognizerSettings(mode='paper').applied_options == PAPER


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
    whitening = Whitening.learn(strips.astype(np.float32))
    some = rng.normal(size=(2, 4, 6))
    for j in range(2):
        values, directions = np.linalg.eigh(strips[j].T @ strips[j])
        shares = values / values.sum()
        gains = 1 / np.sqrt(1 + STRENGTH * shares / np.sum(shares**2))
        assert gains.max() / gains.min() > 1.3
        expected = some[j] @ directions * gains @ directions.T
        result = whitening(some.astype(np.float32))
        np.testing.assert_allclose(result[j], expected, atol=1e-5)
        np.testing.assert_allclose(whitening.inverse(result)[j], some[j], atol=1e-5)


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


@pytest.mark.parametrize('around', [0, 3])
@pytest.mark.parametrize('firsts', [[0], [0, 20, 21]])
def test_z_normalized_equals_plain_loop(around, firsts):
    """Parts by themselves, by the finite entries that count; less the mean of neighbors."""
    row = np.random.default_rng(0).normal(3, 2, 60).astype(np.float32)
    row[[3, 40]] = np.inf
    counted = np.arange(60) % 7 > 0
    result = z_normalized(row, around, counted, np.array(firsts))
    for part in np.split(np.arange(60), firsts[1:]):
        own = row[part].astype(float)
        known = own[counted[part] & np.isfinite(own)]
        z = (own - known.mean()) / max(known.std(), 1e-3)
        near = np.pad(np.where(np.isfinite(z), np.maximum(z, -1), 0), around, 'edge')
        for i, entry in enumerate(part):
            expected = z[i] - near[i : i + 2 * around + 1].mean() * bool(around)
            assert result[entry] == pytest.approx(expected, abs=1e-5)
    assert len(z_normalized(row[:0])) == 0


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
