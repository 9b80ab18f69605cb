# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The Bayes filter of mode robust against plain loops over its states."""

from dataclasses import replace

import numpy as np
import oracle
import pytest
from stavpr_ros.compilation import kernel
from stavpr_ros.filter.kernels import exp
from stavpr_ros.filter.model import FilterSettings
from stavpr_ros.filter.paths import CLOSE, NEGLIGIBLE, sum_close, TOP
from stavpr_ros.filter.place_filter import PlaceFilter
from stavpr_ros.simd import LANES, load, store


@kernel
def _exponentials(x, out):
    for i in range(0, len(x), LANES):
        store(out, i, exp(load(x, i)))


def exponentials(x):
    """Return e^x of whole vectors by the kernel's function."""
    out = np.empty_like(x)
    _exponentials(x, out)
    return out


pytestmark = pytest.mark.usefixtures('one_thread')
# Every probability large enough to matter, and the levels not as likely as each other
LIVELY = FilterSettings(
    keep_level=0.7, keep_speed=0.6, spread=0.15, leave=0.07, enter=0.2, start=0.6
)
FEW = replace(LIVELY, speeds=(0.0, 1.0, 2.5), levels=(-1.0, -2.0))
LAG = 4


def random_image(rng, n, s):
    z = rng.standard_normal(n).astype(np.float32)
    z[rng.random(n) < 0.1] = np.inf
    V = len(s.speeds)
    likelihoods = np.random.default_rng(n).uniform(0.3, 1, V)
    return z, float(rng.uniform(0.1, 0.5)), rng.uniform(0.1, 1, V), likelihoods


def assert_equal(one, plain):
    n = plain.a.shape[2]
    of_places = one.places_of_states()
    np.testing.assert_allclose(of_places[:n], plain.a.sum(axis=(0, 1)), rtol=1e-4, atol=2e-6)
    assert not of_places[n:].any()
    assert 1 - of_places.sum(dtype=np.float64) == pytest.approx(sum(plain.off), abs=2e-5)


def driven(s, sizes, seed=0):
    """Return filter and oracle after random images of so many places each, compared at each."""
    rng = np.random.default_rng(seed)
    one, plain = PlaceFilter(max(sizes) + 3, LAG, s), oracle.PlaceFilter(s)
    for n in sizes:
        image = random_image(rng, n, s)
        one.update(*image)
        plain.update(*image)
        assert_equal(one, plain)
    return one, plain


@pytest.mark.parametrize(
    ('s', 'sizes'),
    [
        (LIVELY, [1] * 6),
        (LIVELY, [2] * 6),
        (LIVELY, [5] * 9),
        (FilterSettings(), [30] * 8),
        (replace(LIVELY, levels=(-2.0,), speeds=(1.33,)), [9] * 5),
        (LIVELY, [300] * 3),
        (FEW, [2049] * 3),  # the second block shorter than a step
        (LIVELY, [0, 0, 4, 5]),
        (LIVELY, [6, 7, 9, 9, 4, 4, 5, 8]),  # after fewer places, more again
    ],
)
def test_filter_equals_plain_loops(s, sizes):
    driven(s, sizes)


def test_filter_that_evicts_and_grows_equals_plain_loops():
    one, plain = driven(LIVELY, [12] * 5)
    rng = np.random.default_rng(1)
    for n, evicted, room in ((9, 4, 15), (10, 0, 30), (25, 0, 30), (20, 6, 30), (21, 0, 30)):
        if evicted:
            one.evict(evicted)
            plain.evict(evicted)
        one.grow(room)
        image = random_image(rng, n, LIVELY)
        one.update(*image)
        plain.update(*image)
        assert_equal(one, plain)
        assert_belief_equal(one, plain, n, LAG)


def test_filter_after_reset_is_as_new():
    one, _ = driven(FEW, [9] * 5)
    one.reset()
    assert one.count == 0
    plain, rng = oracle.PlaceFilter(FEW), np.random.default_rng(3)
    for n in (4, 5, 8):
        image = random_image(rng, n, FEW)
        one.update(*image)
        plain.update(*image)
        assert_equal(one, plain)


@pytest.mark.parametrize('n', [1, 127, 129, 1000])
def test_most_probable_place_equals_that_of_all(n):
    """Whatever is excluded: nothing, the best places, whole blocks, all."""
    one, rng = PlaceFilter(n + 5, LAG, FEW), np.random.default_rng(n)
    for _ in range(3):
        one.update(*random_image(rng, n, FEW))
    by_place = one.places_of_states()[:n].astype(float)
    best = np.argsort(by_place)[::-1]
    for excluded in (best[:0], best[:1], best[:5], np.arange(min(n, 300)), np.arange(n)):
        left = by_place.copy()
        left[excluded] = 0
        place, probability = one.most_probable(np.sort(excluded))
        assert probability == pytest.approx(left.max(), rel=1e-5)
        assert left[place] == pytest.approx(left.max(), rel=1e-5)


def test_exponential_of_kernel_is_that_of_numpy():
    """Below what float32 holds it is 0, so that a banned place is; far above, it stays finite."""
    x = np.linspace(-86, 79, 1001).astype(np.float32)[: 1001 // LANES * LANES]
    np.testing.assert_allclose(exponentials(x), np.exp(x.astype(float)), rtol=3e-7)
    few = np.resize(np.array([-np.inf, -88, 0, 500], np.float32), LANES)
    assert exponentials(few).tolist()[:3] == [0, 0, 1]
    assert np.isfinite(exponentials(few)).all()


# ------------------------------------------------ where the camera was


def dense(places, values, n):
    """Return values of some places for all n."""
    out = np.zeros(n)
    out[places] = values
    return out


def assert_belief_equal(one, plain, n, images_ago):
    found = one.belief(n, images_ago)
    by_place = plain.a.sum(axis=(0, 1))
    tops = set(np.argsort(by_place)[-TOP:].tolist())
    largest = plain.a.max()
    weights, states = np.zeros(n), {}
    for state in np.ndindex(plain.a.shape):
        p = plain.a[state]
        there = plain.way(state, images_ago)[-1]
        if state[2] in tops and p >= NEGLIGIBLE * largest > 0 and there and there[2] >= 0:
            weights[there[2]] += p
            states[there[2]] = max(states.get(there[2], (0,)), (p, *state, there[1]))
    np.testing.assert_allclose(
        dense(found.places, found.weights, n), weights, rtol=1e-4, atol=1e-5
    )
    close = np.minimum([weights[max(y - CLOSE, 0) : y + CLOSE + 1].sum() for y in range(n)], 1)
    found_close = dense(*sum_close(found.places, found.weights, n), n)
    np.testing.assert_allclose(found_close, close, rtol=1e-4, atol=1e-5)
    found_states = dict(zip(found.places.tolist(), found.states.tolist(), strict=True))
    for place, (p, *state) in states.items():
        assert found_states[place] == state, (place, p)
        earlier = plain.way(tuple(state[:3]), images_ago)
        places = [-1 if each is None else each[2] for each in earlier]
        np.testing.assert_array_equal(one.path(np.array(state), images_ago), places)


@pytest.mark.parametrize('sizes', [[1] * 5, [5] * 6, [40] * 7, [90] * 9, [6, 8, 9, 12, 5, 5]])
@pytest.mark.parametrize('spread', [0.12, 0.4])  # 0.4: most paths are not straight
def test_belief_equals_plain_paths(sizes, spread):
    """At every turn of the ring, up to the oldest image in it."""
    s = replace(LIVELY, enter=0.02, spread=spread)
    one, plain = driven(s, sizes, 2)
    for images_ago in range(LAG + 1):
        assert_belief_equal(one, plain, sizes[-1], images_ago)


def test_belief_of_states_that_entered_since_then_is_nothing():
    """States that entered the map later were off it."""
    one = PlaceFilter(9, LAG, replace(FEW, enter=0.9))
    for places in (0, 0, 9):
        one.update(np.zeros(places, np.float32), 0.1, np.ones(3))
    assert one.belief(9, 0).weights.sum() > 0.5
    assert not one.belief(9, 1).places.size
