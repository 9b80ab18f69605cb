# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The recognizer image by image: equal to the whole matrix at once, never a false place 0."""

from dataclasses import astuple, replace

import numpy as np
from places import recognize_all
import pytest
from stavpr_ros.alignment import best_match, match_sequence, SequenceSettings, SpatialSettings
from stavpr_ros.alignment.lm_dtw import trace_sequence
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.features import LocalFeatures
from stavpr_ros.mapping import build_map, load_map, PlaceMap
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings, Status
from stavpr_ros.sources import open_source

SHORT = SequenceSettings(length=5, beta=2.0)


def recognizer(place_map: PlaceMap, threshold: float = 0.3, **changes) -> PlaceRecognizer:
    changes = {'sequence': SHORT, 'nms_radius': 5, 'mode': 'paper'} | changes
    threshold = threshold if changes['mode'] == 'paper' else None
    return PlaceRecognizer(place_map, RecognizerSettings(threshold, **changes))


def empty_map(like: PlaceMap) -> PlaceMap:
    return PlaceMap(like.features[0:0], like.projection, like.stamps[:0], (), None, ())


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
    short = PlaceMap(small_map.features[:places], small_map.projection, stamps, ids, None, ())
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
    for each in (one, other):
        recognize_all(each, features[:3])
    for call in (one.update, one.distances):
        with pytest.raises(InputError, match='features of the image are not finite'):
            call(damaged[:1])
    for i in range(3, 6):
        found, expected = (each.update(features[i : i + 1]) for each in (one, other))
        assert repr(vars(found)) == repr(vars(expected))
    with pytest.raises(InputError, match='features of the map are not finite'):
        recognizer(replace(small_map, features=damaged))


def test_arguments_of_wrong_types_are_rejected_with_the_expected_one(small_map):
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
    ):
        with pytest.raises(error, match=words):
            call()


def test_recognizer_settings_out_of_range_are_rejected(small_map):
    for threshold in (0.0, -1.0, float('nan')):
        with pytest.raises(SettingsError, match='threshold'):
            RecognizerSettings(threshold, mode='paper')
    with pytest.raises(SettingsError, match='is of mode paper'):
        RecognizerSettings(0.5)
    with pytest.raises(SettingsError, match='nms_radius'):
        RecognizerSettings(nms_radius=-1)
    with pytest.raises(SettingsError, match='xi = 8'):
        recognizer(small_map, spatial=SpatialSettings(xi=8))
    with pytest.raises(SettingsError, match='threshold'):
        recognizer(small_map).set_limits(0.0, 0.5)


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
