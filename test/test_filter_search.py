# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The search of mode robust: matches of a drive at any speed, off the map and standing."""

import numpy as np
from places import features_of, map_of, recognize_all, route_strips
import pytest
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings, Status
from stavpr_ros.method.columns import ColumnLayout
from stavpr_ros.method.localizer import EARLY
from stavpr_ros.method.window import FilterWindow
from stavpr_ros.prepare.blocks import MAX_LAG, PlaceChanges

pytestmark = pytest.mark.usefixtures('one_thread')
PLACES, LENGTH = 240, 12
MIDDLE = (LENGTH - 1) // 2


@pytest.fixture(scope='module')
def route():
    return route_strips(0, PLACES)


@pytest.fixture
def recognizer(route):
    settings = RecognizerSettings(sequence=SequenceSettings(LENGTH), nms_radius=10, mode='robust')
    return PlaceRecognizer(map_of(features_of(route)), settings)


def drive(recognizer, strips, noise=1.0, seed=1):
    return recognize_all(recognizer, features_of(strips, noise, seed))


def at_speed(first, last, speed):
    return np.rint(np.arange(first, last, speed)).astype(int)


@pytest.mark.parametrize('speed', [1 / 3, 0.5, 1, 1.5, 2, 3])
def test_query_at_other_speed_is_matched(recognizer, route, speed):
    places = at_speed(20, 230, speed)
    answers = drive(recognizer, route[:, places])[LENGTH:]
    middles = places[1 + MIDDLE :][: len(answers)]
    matched = np.array([answer.place for answer in answers])
    assert np.mean(matched >= 0) > 0.9
    right = np.abs(matched - middles) <= 2
    assert right[matched >= 0].mean() > 0.95


def test_camera_that_is_carried_elsewhere_is_matched_by_the_images_since(recognizer, route):
    images, since = np.r_[20:80, 160:200], []
    for count, answer in enumerate(drive(recognizer, route[:, images], 0.5)[60:], 1):
        if answer.accepted:
            shown = len(answer.window_stamps)
            assert answer.path.pairs[-1, 0] == shown - 1 == len(answer.window_changes) - 1
            assert shown == LENGTH or answer.probability > EARLY
            image = 60 + count - shown + answer.position
            assert abs(answer.place - images[image]) <= 2
            since += [count] if image >= 60 else []
    assert since[0] <= MIDDLE + 1
    assert len(since) >= 35


def test_camera_off_the_map_is_not_matched_by_its_newest_images(recognizer, route):
    unknown = route_strips(7, 60)
    answers = drive(recognizer, np.concatenate([route[:, 20:80], unknown], axis=1))
    assert not any(answer.accepted for answer in answers[60 + LENGTH :])


def test_map_of_every_third_place_is_matched_by_faint_images():
    """A speed between two of the model would cost more than these images show."""
    strips = route_strips(3, PLACES)
    place_map = map_of(features_of(strips[:, ::3]))
    answers = drive(PlaceRecognizer(place_map, RecognizerSettings(mode='robust')), strips, 5.0)
    assert np.mean([answer.accepted for answer in answers[20:]]) > 0.7  # without 1/3: 0.52


def test_match_is_path_and_second_best_of_its_window(recognizer, route):
    answers = drive(recognizer, route[:, 20:120])
    for answer in answers[: LENGTH - 1]:
        assert answer.status is Status.WARMING_UP or answer.probability > EARLY
    for i, answer in enumerate(answers[LENGTH + 3 :], LENGTH + 3):
        result, path = answer.path, answer.path.pairs
        assert answer.status is Status.MATCH
        assert path.shape == (LENGTH, 2)
        assert path[:, 0].tolist() == list(range(LENGTH))
        assert (np.diff(path[:, 1]) >= 0).all()
        assert path.min() >= 0
        assert path[:, 1].max() < PLACES
        assert (path[0, 1], path[-1, 1]) == (result.first, result.last)
        assert abs(path[MIDDLE, 1] - result.place) <= 2
        assert np.abs(path[:, 1] - np.arange(20 + i - LENGTH + 1, 20 + i + 1)).max() <= 4
        assert answer.distance == result.distance == 1 - answer.probability
        assert 0 <= result.distance <= result.second_best_distance or result.second_best < 0
        if result.second_best >= 0:
            assert abs(result.second_best - result.place) > 10
        ranked = recognizer.ranked(3)
        assert [c.place for c in ranked[1:2]] in ([], [answers[-1].path.second_best])


def test_window_that_is_not_full_has_no_candidates_without_a_match(recognizer):
    for answer in drive(recognizer, route_strips(7, 3)):
        assert answer.status is Status.WARMING_UP
    assert recognizer.ranked(3) == []
    assert not len(recognizer.candidates(3)[0])


def test_path_follows_images_whose_speed_changes(recognizer, route):
    """From the oldest image of the window on, also before the middle, and at dropped images."""
    rng = np.random.default_rng(4)
    places = np.flatnonzero(rng.random(PLACES) < 0.6)
    answers = drive(recognizer, route[:, places], noise=0.5)
    off = [
        np.abs(answer.path.pairs[:, 1] - places[i - LENGTH + 1 : i + 1])
        for i, answer in enumerate(answers)
        if answer.accepted and len(answer.path.pairs) == LENGTH
    ]
    assert len(off) > 0.8 * len(places)
    assert np.mean(np.concatenate(off) <= 2) > 0.98
    assert np.mean([distances[0] <= 2 for distances in off]) > 0.95


def test_places_of_path_have_probabilities_that_scale_the_match(recognizer, route):
    answers = drive(recognizer, route[:, 20:60])[LENGTH:]
    for answer in answers:
        assert answer.path_probabilities.shape == (LENGTH,)
        assert 0 <= answer.path_probabilities.min() <= answer.path_probabilities.max() <= 1
        assert answer.path_probabilities[MIDDLE] == pytest.approx(answer.probability)


def test_equal_places_of_the_map_are_one_place_of_the_path(route):
    """The camera stood while the map was recorded: how long, the query cannot know."""
    stop = np.r_[:100, [100] * 40, 101:PLACES]
    settings = RecognizerSettings(sequence=SequenceSettings(LENGTH), nms_radius=10, mode='robust')
    places = map_of(features_of(route[:, stop]))
    recognizer, query = PlaceRecognizer(places, settings), features_of(route[:, stop], 1.0, 1)
    shares = []
    for i in range(len(query)):
        recognizer.update(query[i : i + 1])
        shares.append(recognizer._newest.path.shares)
    assert np.min(shares[118:135]) > 0.8


def test_standing_camera_changes_no_probability(recognizer, route):
    features = features_of(route[:, 50:90], 1.0)
    for i in range(40):
        before = recognizer.update(features[i : i + 1])
    for _ in range(100):
        after = recognizer.update(features[39:40])
        assert after.status is Status.MATCH
    # the middle of the window has caught up with the newest image, nothing else has changed
    assert after.place == pytest.approx(before.newest, abs=1)
    assert after.path.pairs[0, 1] == after.path.pairs[-1, 1]
    again = recognizer.update(features[39:40])
    assert repr(again.path) == repr(after.path)  # NaN like NaN


def test_equal_images_in_dark_stretch_of_map_move_on(route):
    """Without evidence, at the speed before: the camera may move there."""
    dark = features_of(route).strips.copy()
    dark[:, 20:50] = 0
    window = FilterWindow(SequenceSettings(4), PLACES, ColumnLayout(), constant=-7.0)
    seen = PlaceChanges(PLACES, MAX_LAG)
    seen.add(dark)
    window.change.learn(seen.changes)
    at, images = np.arange(PLACES), 30
    for i in range(images):
        z = np.where(np.abs(at - i) < 2, -4, 0).astype(np.float32)
        lit = i < 18
        z = z if lit else np.zeros_like(z)
        window.add(z, i, window.change.curve[1] * lit, z)
    assert window.filter.count == images
    by_place = window.filter.by_place()
    mean = by_place @ at / by_place.sum()
    assert 25 < mean < 34


def test_drive_that_leaves_map_and_returns_is_followed(recognizer, route):
    elsewhere = route_strips(7, 60)
    strips = np.concatenate([route[:, 20:80], elsewhere, route[:, 120:200]], axis=1)
    answers = drive(recognizer, strips)
    probability = np.array([answer.probability for answer in answers])
    assert (probability[20:60] > 0.6).all()
    gone = 60 + LENGTH // 2 + MIDDLE + 1  # the middle has left half a window ago
    assert (probability[gone:120] < 0.3).all()
    assert not any(answer.accepted for answer in answers[gone:120])
    assert (probability[120 + 2 * LENGTH :] > 0.6).all()
    middles = np.array([answer.place for answer in answers[120 + 2 * LENGTH :]])
    expected = np.arange(120 + 2 * LENGTH, 200) - (LENGTH - 1 - MIDDLE)
    assert (np.abs(middles - expected) <= 2).all()


def test_drive_in_reverse_is_not_matched_wrongly(recognizer, route):
    answers = drive(recognizer, route[:, 200:40:-1])[LENGTH:]
    for i, answer in enumerate(answers, LENGTH):
        there = 200 - i + LENGTH - 1 - MIDDLE
        assert not answer.accepted or abs(answer.place - there) <= LENGTH
