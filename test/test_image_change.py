# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Changes of map and query: speed, darkness, and standstills, whose images count as one."""

import numpy as np
from places import features_of, map_of, recognize_all, route_strips
import pytest
from stavpr_ros.alignment.cpu.dot import change_between
from stavpr_ros.features import FeatureSettings
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.method.loop_closer import LoopCloser
from stavpr_ros.method.model import LOOK_AHEAD, STANDSTILL, STRETCH
from stavpr_ros.method.motion import change_weights, expected_change, ImageChange, MIN_DISTINCT
from stavpr_ros.prepare.blocks import MAX_LAG, PlaceChanges

pytestmark = pytest.mark.usefixtures('one_thread')


def drive_strips(places, seed=0):
    """Return unit-norm strips (3, places, 24) that change from place to place."""
    strips = route_strips(seed, places)[:3]
    return (strips / np.linalg.norm(strips, axis=2, keepdims=True)).astype(np.float32)


def plain_change(a, b):
    pairs = list(zip(a, b, strict=True))
    return 1 - np.mean([1.0 if not x.any() and not y.any() else x @ y for x, y in pairs])


def learn(strips):
    n = strips.shape[1]
    change, changes = ImageChange(n, 20), PlaceChanges(n, MAX_LAG)
    changes.add(strips)
    change.learn(changes.changes)
    return change


def learned_on_route(strips, room):
    """Return what is learned from one place after the other; memory grows to the room."""
    route = ImageChange(5, 20)
    for n in range(1, strips.shape[1] + 1):
        if n == 6:
            route.grow(room)
        route.learn_newest(strips[:, :n], n)
    return route


def test_curve_is_mean_change_of_places_apart():
    strips = drive_strips(40)
    strips[0, 7:9] = strips[1, 20] = 0  # one strip, and two in the same place, without features
    expected = [0.0] + [
        np.mean([plain_change(strips[:, y], strips[:, y - apart]) for y in range(apart, 40)])
        for apart in range(1, MAX_LAG + 1)
    ]
    np.testing.assert_allclose(learn(strips).curve, expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize('places', [0, 1, 3])
def test_curve_beyond_short_map_is_that_of_unrelated_images(places):
    curve = learn(drive_strips(places)).curve
    np.testing.assert_array_equal(curve[max(places, 1) :], 1)
    assert curve[0] == 0
    assert (curve[1 : max(places, 1)] < 1).all()


def test_learn_newest_of_each_place_equals_learn():
    strips = drive_strips(30)
    curve = learned_on_route(strips, 32).curve
    np.testing.assert_allclose(curve, learn(strips).curve, rtol=1e-5)


def test_next_query_is_change_from_image_before():
    strips = drive_strips(3)
    strips[1, :2] = strips[2, 1] = 0
    change = learn(drive_strips(9))
    assert change.next_query(strips[:, 0]) == 1
    result = change.next_query(strips[:, 1])
    assert result == pytest.approx(plain_change(strips[:, 0], strips[:, 1]), abs=1e-6)
    assert result == pytest.approx(change_between(strips[:, 1], strips[:, 0]))
    change.reset()
    assert change.next_query(strips[:, 2]) == 1


def test_standstill_and_weight_are_relative_to_neighboring_places():
    change = learn(drive_strips(200))
    near = change.curve[1]
    assert change.is_standstill(0.99 * STANDSTILL * near)
    assert not change.is_standstill(1.01 * STANDSTILL * near)
    for relative, weight in ((0.0, 0.2), (0.1, 0.2), (0.5, 0.5), (1, 1), (1.5, 1.5), (3, 2)):
        assert change.weight(relative * near) == pytest.approx(weight)


def decaying_strips(places, similarity, seed=0):
    """Return strips (3, places, 400) whose similarity decays exponentially with the distance."""
    rng = np.random.default_rng(seed)
    strips = rng.standard_normal((3, places, 400)).astype(np.float32)
    for y in range(1, places):
        fresh = np.sqrt(1 - similarity**2) * strips[:, y]
        strips[:, y] = similarity * strips[:, y - 1] + fresh
    return strips / np.linalg.norm(strips, axis=2, keepdims=True)


@pytest.mark.parametrize('step', [2, 3])
def test_expected_change_below_one_place_is_that_of_a_denser_map(step):
    strips = decaying_strips(300, 0.6)
    dense, sparse = learn(strips), learn(strips[:, ::step])
    places = np.arange(4)
    result = [expected_change(place / step, *sparse._curve_with_tail) for place in places]
    np.testing.assert_allclose(result, dense.curve[places], atol=0.03)


def test_expected_change_is_the_curve_at_whole_places_and_never_decreases():
    change = learn(drive_strips(300))
    result = [
        expected_change(places, *change._curve_with_tail) for places in np.linspace(0, 30, 301)
    ]
    np.testing.assert_allclose(result[: 10 * MAX_LAG + 1 : 10], change.curve)
    assert (np.diff(result) >= 0).all()


@pytest.mark.parametrize('noise', [0.0, 0.5])
def test_excess_is_of_motion_and_not_of_noise(noise):
    rng = np.random.default_rng(2)
    change, query = learn(decaying_strips(300, 0.6)), decaying_strips(60, 0.6, seed=1)
    query += noise / 20 * rng.standard_normal(query.shape).astype(np.float32)
    query /= np.linalg.norm(query, axis=2, keepdims=True)
    for i in range(query.shape[1]):
        change.next_query(query[:, i])
    assert abs(change.excess(1.0)) < 0.04
    assert change.excess(0.25) > 0.2
    assert change.excess(2.0) < 0.0


def test_creep_is_of_a_path_that_moves_less_than_the_camera():
    """Where the map itself changes little, a path through many of its places creeps as well."""
    strips, query = decaying_strips(300, 0.6), decaying_strips(60, 0.6, seed=1)
    alike = (1 - 0.3) * strips[:, 100:101] + 0.3 * strips[:, 100:200]
    strips[:, 100:200] = alike / np.linalg.norm(alike, axis=2, keepdims=True)
    change = learn(strips)
    assert change.creep(20, 39, 20) == 0  # of no image
    for i in range(query.shape[1]):
        change.next_query(query[:, i])
    assert change.creep(20, 39, 20) < 0.3
    assert change.creep(20, 39, 20) + 0.5 < change.creep(20, 24, 20)
    assert change.creep(20, 39, 20) + 0.3 < change.creep(120, 139, 20)
    assert change.creep(20, 77, 20) == 0


def test_equal_places_do_not_count_unless_few_would():
    strips = drive_strips(60)
    strips[:, 21:25] = strips[:, 20:21]
    expected = np.isin(np.arange(60), range(21, 25), invert=True)
    change, route = learn(strips), learned_on_route(strips, 60)
    np.testing.assert_array_equal(change.distinct(slice(60)), expected)
    np.testing.assert_array_equal(route.distinct(slice(60)), expected)
    change.evict(22)
    np.testing.assert_array_equal(change.distinct(slice(38)), expected[22:])
    assert change.distinct(slice(MIN_DISTINCT + 2)).all()  # five of seven places do not


def probable_at(place, n):
    by_place = np.full(n, 0.2 / n)
    by_place[place] += 0.8
    return by_place


def test_dark_stretch_is_where_places_of_map_are_equal_or_soon_will_be():
    strips = drive_strips(60)
    strips[:, 30:41] = 0  # 31..40 equal the one before
    change = learn(strips)
    dark = [change.is_dark_stretch(probable_at(place, 60)) for place in range(60)]
    assert dark == [30 + STRETCH - LOOK_AHEAD < place <= 40 for place in range(60)]
    assert not change.is_dark_stretch(np.zeros(60))
    change.evict(5)
    assert [change.is_dark_stretch(probable_at(place, 55)) for place in range(55)] == dark[5:]


# Long standstills, in the map, of the query, and of a route: all their images count as one

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


def match(recognizer, features):
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
        assert not match(PlaceRecognizer(place_map, robust()), noisy(route(seed)))
    result = match(PlaceRecognizer(place_map, robust()), noisy(route(1), 9))
    assert len(result) > PLACES - 60
    assert all(abs(places[place] - image) <= 2 for image, place in result.items())


def test_query_is_matched_during_a_long_standstill_and_after_it():
    place_map = map_of(noisy(route(1)))
    query, places = with_stop(route(1, light=1, strength=0.8), images=1000)
    result = match(PlaceRecognizer(place_map, robust()), noisy(query, 9))
    assert len(result) > len(places) - 60
    assert all(abs(place - places[image]) <= 2 for image, place in result.items())


def standing(strips, images=60, seed=0):
    """Return features of a drive that ends with a standstill of so many equal images."""
    last = strips.shape[1] - 1
    return features_of(strips, 0.2, seed)[np.r_[:last, np.full(images, last)]]


def test_match_of_a_standing_camera_is_kept():
    """Its path has the images before the stop, and then only the place."""
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
    result = {i: place for i, place in match(closer, noisy(strips)).items() if i >= STOP}
    back = first.shape[1] + unknown.shape[1]
    assert min(result) >= back
    assert len(result) > PLACES - 60
    assert all(abs(places[place] - (image - back)) <= 2 for image, place in result.items())


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
