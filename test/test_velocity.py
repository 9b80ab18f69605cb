# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Matching at several velocities: by hand, against plain loops, and at the borders of blocks."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from stavpr_ros.alignment import velocity as kernel
from stavpr_ros.alignment import VelocitySettings
from stavpr_ros.alignment.velocity import (
    best_velocity_match,
    match_velocities,
    trace_velocity,
)
from stavpr_ros.errors import InputError, SettingsError

INF = np.inf


def plain_paths(costs, speeds, penalty):
    """Return every end's best (mean cost, first, middle, speed, path), trying all."""
    l, n = costs.shape
    answers = [(INF, 0, 0, 0, None)] * n
    for v, speed in enumerate(speeds):
        line = [int(np.floor(speed * i + 0.5)) for i in range(l)]
        best = {y: (costs[0][y], [y]) for y in range(n)}
        for i in range(1, l):
            step = line[i] - line[i - 1]
            nearer = {}
            for y in range(n):
                for moved, extra in ((step, 0), (step - 1, penalty), (step + 1, penalty)):
                    if moved < 0 or y - moved not in best:
                        continue
                    cost = best[y - moved][0] + extra
                    if y not in nearer or cost < nearer[y][0]:
                        nearer[y] = (cost, [*best[y - moved][1], y])
            best = {y: (costs[i][y] + cost, path) for y, (cost, path) in nearer.items()}
        for y, (cost, path) in best.items():
            if cost / l < answers[y][0]:
                answers[y] = (cost / l, path[0], path[(l - 1) // 2], v, path)
    return answers


def test_match_velocities_by_hand():
    """
    Three images, five places, speeds 1 and 2, a step more or less costs 1.

    Speed 2 passes places 0, 2, 4 at 0 + 0 + 0; speed 1 pays 1 a step for the same places. To end
    at place 3, speed 1 passes 1, 2, 3 at 5 + 0 + 5, or 0, 2, 3 at 0 + (0 + 1) + 5 = 6; speed 2
    passes 0, 2, 3 at 0 + 0 + (5 + 1) = 6 as well: the first speed wins the tie.
    """
    costs = np.array([[0, 5, 5, 5, 5], [5, 5, 0, 5, 5], [5, 5, 5, 5, 0]], float)
    chosen = VelocitySettings((1.0, 2.0), 1.0)
    matches = match_velocities(costs, chosen)
    assert matches.distances[[3, 4]].tolist() == [2, 0]
    assert (matches.firsts[4], matches.middles[4], matches.speeds[4]) == (0, 2, 1)
    assert (matches.firsts[3], matches.middles[3], matches.speeds[3]) == (0, 2, 0)
    np.testing.assert_array_equal(
        trace_velocity(costs, 4, chosen.steps(3)[1], chosen.penalty), [[0, 0], [1, 2], [2, 4]]
    )
    nearest = best_velocity_match(matches, 0)
    assert (nearest.first, nearest.last, nearest.middle, nearest.distance) == (0, 4, 2, 0)
    assert nearest.second_best_index != 2


def test_steps_of_speed_round_its_line():
    np.testing.assert_array_equal(
        VelocitySettings((0.5, 1.33)).steps(6), [[0, 1, 0, 1, 0, 1], [0, 1, 2, 1, 1, 2]]
    )


@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    l=st.integers(2, 8),
    n=st.integers(1, 25),
    levels=st.sampled_from([0, 0, 2, 5]),
    speeds=st.lists(
        st.sampled_from([0.0, 0.5, 0.75, 1.0, 1.33, 2.0, 3.0]), min_size=1, max_size=4
    ),
    penalty=st.sampled_from([0.0, 0.25, 2.0]),
    banned=st.sampled_from([0.0, 0.2]),
    dtype=st.sampled_from([np.float32, np.float64]),
)
def test_match_velocities_equals_plain_loops(seed, l, n, levels, speeds, penalty, banned, dtype):
    rng = np.random.default_rng(seed)
    costs = rng.integers(-levels, levels, (l, n)) / 4 if levels else rng.standard_normal((l, n))
    costs[rng.random((l, n)) < banned] = INF
    costs = costs.astype(dtype)
    chosen = VelocitySettings(tuple(speeds), penalty)
    matches = match_velocities(costs, chosen)
    for end, (distance, first, middle, speed, path) in enumerate(
        plain_paths(costs, speeds, dtype(penalty))
    ):
        assert matches.distances[end] == pytest.approx(distance, abs=1e-5)
        if not np.isfinite(distance) or levels != 0:
            continue  # of equal paths any may be taken
        found = (matches.firsts[end], matches.middles[end], matches.speeds[end])
        assert found == (first, middle, speed)
        traced = trace_velocity(costs, end, chosen.steps(len(costs))[speed], chosen.penalty)
        np.testing.assert_array_equal(traced[:, 1], path)


@pytest.mark.parametrize('n', [kernel.ENDS, kernel.ENDS + 1, 2 * kernel.ENDS + 17])
def test_match_velocities_at_block_borders_equals_cut_map(n):
    rng = np.random.default_rng(n)
    window = rng.standard_normal((20, n)).astype(np.float32)
    shift, scale = (rng.uniform(0.5, 2, n).astype(np.float32) for _ in range(2))
    whole = match_velocities(window, VelocitySettings(), shift, scale)
    for border in range(kernel.ENDS, n, kernel.ENDS):
        near = slice(border - 100, min(n, border + 20))
        part = match_velocities(window[:, near], VelocitySettings(), shift[near], scale[near])
        ends = slice(80, None)
        for name, offset in (('distances', 0), ('firsts', near.start), ('middles', near.start)):
            np.testing.assert_array_equal(
                getattr(whole, name)[near][ends], getattr(part, name)[ends] + offset
            )


def test_path_one_place_faster_at_every_step_crosses_block_border():
    l, end = 40, kernel.ENDS
    places = end - 3 * np.arange(l)[::-1]
    costs = np.full((l, end + 1), 10.0)
    costs[np.arange(l), places] = 0
    chosen = VelocitySettings((2.0,), 0.5)
    matches = match_velocities(costs, chosen)
    assert matches.distances[end] == 0.5 * (l - 1) / l
    assert (matches.firsts[end], matches.middles[end]) == (places[0], places[(l - 1) // 2])
    path = trace_velocity(costs, end, chosen.steps(l)[0], chosen.penalty)
    assert path[:, 1].tolist() == places.tolist()


def test_match_velocities_applies_shift_and_scale():
    rng = np.random.default_rng(0)
    window, shift = rng.random((5, 30)), rng.random(30)
    scale = rng.uniform(0.5, 2, 30)
    given = match_velocities(window, VelocitySettings(), shift, scale)
    done = match_velocities((window - shift) * scale, VelocitySettings())
    np.testing.assert_array_equal(given.distances, done.distances)
    np.testing.assert_array_equal(given.firsts, done.firsts)


def test_best_velocity_match_has_second_best_elsewhere():
    costs = np.full((4, 30), 1.0)
    costs[np.arange(4), np.arange(4) + 20] = 0
    costs[np.arange(4), np.arange(4) + 2] = 0.25
    matches = match_velocities(costs, VelocitySettings())
    nearest = best_velocity_match(matches, 17)
    assert (nearest.first, nearest.last, nearest.middle) == (20, 23, 21)
    assert (nearest.second_best_index, nearest.second_best_distance) == (3, 0.25)
    assert best_velocity_match(matches, 18).second_best_index != 3  # 21 - 3 is not above 18
    equal = match_velocities(np.zeros((4, 30)), VelocitySettings())
    assert best_velocity_match(equal, 18).last == 0  # the lowest end on a tie
    alone = best_velocity_match(matches, 30)
    assert alone.second_best_index == -1
    assert np.isnan(alone.second_best_distance)


@pytest.mark.parametrize('costs', [np.full((4, 6), INF), np.empty((4, 0))])
def test_best_velocity_match_without_path_is_none(costs):
    assert best_velocity_match(match_velocities(costs, VelocitySettings()), 0) is None


def test_match_velocities_of_invalid_input_is_rejected():
    with pytest.raises(InputError, match='NaN'):
        match_velocities(np.full((3, 4), np.nan), VelocitySettings())
    with pytest.raises(InputError, match='shift'):
        match_velocities(np.zeros((3, 4)), VelocitySettings(), shift=np.zeros(3))
    for speeds in ((), (-1.0,), (np.nan,)):
        with pytest.raises(SettingsError, match='speeds'):
            VelocitySettings(speeds)
    with pytest.raises(SettingsError, match='penalty'):
        VelocitySettings(penalty=-1)
