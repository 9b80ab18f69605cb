# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Candidates: non-maximum suppression against a plain loop, and those of a recognizer."""

import math

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.errors import InputError
from stavpr_ros.method import Candidate, PlaceRecognizer, RecognizerSettings
from stavpr_ros.method.columns import ColumnLayout
from stavpr_ros.method.match import WindowSequences
from stavpr_ros.method.settings import RobustOptions

SHORT = SequenceSettings(length=5, beta=2.0)


def plain(costs, places, count, nms_radius):
    """Return the indices of the sequences that are taken, one after the other."""
    taken = []
    for index in sorted(range(len(costs)), key=lambda i: (costs[i], i)):
        apart = all(abs(places[index] - places[other]) > nms_radius for other in taken)
        if apart and len(taken) < count and math.isfinite(costs[index]):
            taken.append(index)
    return taken


def known(candidates):
    """Return place and distance of each: NaN, an unknown probability, equals nothing."""
    return [(each.place, each.distance) for each in candidates]


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
    found = layout.ranked(nearest, WindowSequences(costs, places), count)
    expected = plain(costs.tolist(), places.tolist(), count, nms_radius)
    assert known(found) == [(int(places[i]), float(costs[i])) for i in expected]
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
