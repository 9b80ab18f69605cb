# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Long standstills, in the map, of the query, and of a route: all their images count as one."""

import numpy as np
from places import features_of, map_of, recognize_all, route_strips
import pytest
from stavpr_ros.features import FeatureSettings
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.method.loop_closer import LoopCloser
from stavpr_ros.method.motion import change_weights

pytestmark = pytest.mark.usefixtures('one_thread')
PLACES, STOP, STANDING, D = 160, 70, 400, 32
NOISE = 0.01  # of images of a camera that stands, over the norm of an image


def route(seed, light=0, strength=1.0):
    """Return strips (7, PLACES, D) of a route; neighbors are alike. Routes share their light."""
    walk = np.random.default_rng(seed).standard_normal((7, PLACES + 2, D)).cumsum(1)
    shared = np.random.default_rng(1000 + light).standard_normal((7, 1, D))
    return strength * (walk[:, 2:] - walk[:, :-2]) / 2**0.5 + 2 * shared


def with_stop(strips, at=STOP, images=STANDING):
    """Return strips with a stop, and the place of each image before there was one."""
    places = np.r_[:at, np.full(images, at), at : strips.shape[1]]
    return strips[:, places], places


def noisy(strips, seed=0):
    """Return features of images of these places."""
    norms = np.linalg.norm(strips, axis=2, keepdims=True)
    return features_of(strips / norms, NOISE / D**0.5, seed)


def matched(recognizer, features):
    """Return the place of each image that has a match, by image."""
    matches = [recognizer.update(features[i : i + 1]) for i in range(len(features))]
    return {
        i - 10: match.path.place
        for i, match in enumerate(matches)
        if match.accepted and len(match.window_stamps) == 20
    }


def robust():
    return RecognizerSettings(mode='robust')


def test_unknown_route_is_not_matched_with_a_map_that_has_a_standstill():
    strips, places = with_stop(route(1))
    place_map = map_of(noisy(strips))
    for seed in range(2, 6):
        assert not matched(PlaceRecognizer(place_map, robust()), noisy(route(seed)))
    found = matched(PlaceRecognizer(place_map, robust()), noisy(route(1), 9))
    assert len(found) > PLACES - 60
    assert all(abs(places[place] - image) <= 2 for image, place in found.items())


def test_query_is_matched_during_a_long_standstill_and_after_it():
    place_map = map_of(noisy(route(1)))
    query, places = with_stop(route(1, light=1, strength=0.8), images=1000)
    found = matched(PlaceRecognizer(place_map, robust()), noisy(query, 9))
    assert len(found) > len(places) - 60
    assert all(abs(place - places[image]) <= 2 for image, place in found.items())


def standing(strips, images=60, seed=0):
    """Return features of a drive that ends with a standstill of so many equal images."""
    last = strips.shape[1] - 1
    return features_of(strips, 0.2, seed)[np.r_[:last, np.full(images, last)]]


def test_camera_that_stops_beyond_the_map_is_not_matched_for_as_long_as_it_stands():
    """With images that are somewhat near, for which the filter has not left the map yet."""
    wrong = 0
    for seed in range(12):
        known, unknown = route_strips(seed, PLACES), route_strips(90 + seed, 8)
        beyond = 0.15 * known[:, 100:108] + 0.85 * unknown
        query = standing(np.concatenate([known[:, 40:100], beyond], axis=1), seed=seed)
        matches = recognize_all(PlaceRecognizer(map_of(features_of(known)), robust()), query)
        wrong += any(match.accepted for match in matches[-50:])
    assert wrong <= 1  # of 12


def test_match_of_a_standing_camera_is_kept():
    """Its path is that of the images before the stop, and then only of the place."""
    known = route_strips(0, PLACES)
    settings = RecognizerSettings(mode='robust', min_probability=0.9)
    query = standing(known[:, 40:80])
    matches = recognize_all(PlaceRecognizer(map_of(features_of(known)), settings), query)[-50:]
    assert all(match.accepted for match in matches)
    assert len({match.probability for match in matches}) == 1
    assert matches[0].path.pairs[0, 1] == pytest.approx(79 - 9, abs=2)
    assert set(matches[-1].path.pairs[:, 1]) == {matches[-1].place} == {79}


def test_route_with_a_standstill_is_closed_where_it_comes_back_alone():
    first, places = with_stop(route(1))
    unknown = np.concatenate([route(seed) for seed in (2, 3)], axis=1)
    strips = np.concatenate([first, unknown, route(1)], axis=1)
    closer = LoopCloser(robust(), 30, FeatureSettings('gradient', None, 7))
    found = {i: place for i, place in matched(closer, noisy(strips)).items() if i >= STOP}
    back = first.shape[1] + unknown.shape[1]
    assert min(found) >= back
    assert len(found) > PLACES - 60
    assert all(abs(places[place] - (image - back)) <= 2 for image, place in found.items())


def test_change_weights_are_small_at_standstills_alone():
    rng = np.random.default_rng(0)
    moving, noise = rng.uniform(0.1, 0.3, 100), rng.uniform(0.001, 0.002, 1500)
    weights = change_weights(np.r_[moving, noise, moving])
    assert (weights[:100] == 1).all()
    assert (weights[-100:] == 1).all()
    assert weights[100:-100].max() < 0.05
    cuts = np.r_[rng.uniform(0.004, 0.01, 500), np.ones(10), rng.uniform(0.004, 0.01, 500)]
    assert (change_weights(cuts) == 1).all()
    turns = np.where(np.arange(1000) % 10 == 0, 0.2, 0.01)  # on the spot, between straight ways
    assert change_weights(turns).min() > 0.15
    assert (change_weights(np.zeros(50)) == 1).all()
    assert change_weights(np.empty(0)).shape == (0,)
