# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The probability of a path by quantities without a unit."""

from dataclasses import replace

import numpy as np
from places import features_of, map_of, recognize_all, route_strips
import pytest
from stavpr_ros.filter.evidence import (
    changed_images,
    lead_of,
    own_evidence,
    path_probability,
    RecentWindows,
    straight_steps,
)
from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings
from stavpr_ros.recognition.device_windows import DeviceBuffer
from stavpr_ros.recognition.window import SequenceBuffer
import torch


def plain_elsewhere(z, steps, excluded):
    """Return the largest mean of -z of straight paths, and its path, by plain loops."""
    n, means = z.shape[1], [(-np.inf, [])]
    counted = [place for place in range(n) if not any(a <= place < b for a, b in excluded)]
    for place in counted:
        for path in place + steps:
            near = [
                z[i, y] if 0 <= y < n and np.isfinite(z[i, y]) else 1 for i, y in enumerate(path)
            ]
            means.append((-np.mean(near), np.clip(path, 0, n - 1).tolist()))
    return max(means)


@pytest.mark.parametrize('n', [30, 60, 1100])
def test_best_path_elsewhere_equals_plain_loops_on_all_devices(device, n):
    rng = np.random.default_rng(n)
    buffers = SequenceBuffer(6, n, 10, copies=1), DeviceBuffer(6, n, 10, copies=1, device=device)
    rows = rng.standard_normal((9, n)).astype(np.float32)
    rows[rng.random((9, n)) < 0.05] = np.inf
    for row in rows:
        buffers[0].push(row)
        buffers[1].push(torch.from_numpy(row).to(device))
    for count, excluded in ((6, [[-3, 12]]), (3, [[2, 9], [20, n + 5]])):
        numbers = np.array([0, 1, 1, 2, 3, 5])[:count]
        position, counted = (count - 1) // 2, changed_images(numbers)
        steps = straight_steps(numbers, position)
        assert counted.tolist() == [True, True, False, True, True, True][:count]
        expected = plain_elsewhere(rows[-count:][counted], steps[:, counted], excluded)
        for buffer in buffers:
            score, path = buffer.best_elsewhere(numbers, position, np.array(excluded))
            assert score == pytest.approx(expected[0], abs=1e-5)
            assert path.tolist() == expected[1]
        everything = np.array([[0, n]])
        assert all(len(each.best_elsewhere(numbers, position, everything)[1]) == 0
                   for each in buffers)  # fmt: skip


def test_path_probability_by_hand():
    """Of odds 3, a lead of 1, and half a window; of a drive that rarely matched."""
    own = own_evidence(-7.0, 0.75, 1.0, 10, 4.0)
    expected = -7.0 + 0.5 * np.log(3) + 2.4 * np.log(11) + 2.06 * np.log(5)
    assert own == pytest.approx(expected)
    assert own_evidence(-7.0, 0.75, 1.0, 10, -2.0) == own_evidence(-7.0, 0.75, 1.0, 10)
    own = own_evidence(-7.0, 0.75, 0.6, 10)
    expected = 1 / (1 + np.exp(((own - 5 * np.log(3)) / 5) ** 2))
    assert path_probability(own, 0.25) == pytest.approx(expected)
    assert path_probability(own, 0.5) == path_probability(own, 0.9) > expected
    assert own_evidence(-7.0, 1.0, 4.0, 20) == own_evidence(-7.0, 1 - 1e-9, 4.0, 20) > 4
    assert lead_of(4.0, -8.0) == lead_of(4.0, 0.0) == 4
    assert lead_of(1.0, 2.0) == 0
    least = np.log(0.02 / 0.98) + 4  # a path that has left the map stays improbable
    assert own_evidence(-7.0, 0.02, 4.0, 20, 20.0) == pytest.approx(least)
    assert path_probability(own_evidence(-7.0, 0.0, 4.0, 20), 0.9) == 0


def test_log_odds_below_one_half_are_squared_and_keep_their_order():
    owns = np.linspace(-20, 8, 300)
    probabilities = np.array([path_probability(own, 0.5) for own in owns])
    assert (np.diff(probabilities) > 0).all()
    plain = 1 / (1 + np.exp(-owns))
    np.testing.assert_allclose(probabilities[owns > 0], plain[owns > 0])
    assert (probabilities[owns < 0] < 0.5).all()
    assert path_probability(-5.0, 0.5) == pytest.approx(1 / (1 + np.e))


def test_recent_windows_start_even_forget_and_trust_sure_ones_soon():
    recent = RecentWindows()
    for _ in range(4):
        recent.add(1.0)
    assert recent.share == pytest.approx((8 * 0.5 + 4) / 12)
    for _ in range(600):
        recent.add(-np.inf)
    assert recent.share < 0.01
    for _ in range(15):
        recent.add(6.0)
    assert recent.share > 0.5
    for _ in range(30):
        recent.add(1.0)  # likely, not sure
    assert 0.3 < recent.share < 0.5


def test_weak_windows_make_a_drive_less_likely_with_learned_features():
    """Where right windows are farther ahead, on floors that look alike, these are not right."""
    probabilities = []
    for kind in ('gradient', 'hybrid', 'unknown'):
        places, query = features_of(route_strips(0, 120)), features_of(route_strips(0, 120), 7.0)
        places, query = (
            replace(part, settings=replace(part.settings, kind=kind)) for part in (places, query)
        )
        recognizer = PlaceRecognizer(map_of(places), RecognizerSettings(mode='robust'))
        matches = recognize_all(recognizer, query)
        probabilities.append(np.array([match.probability for match in matches]))
    gradient, hybrid, unknown = np.nan_to_num(probabilities)
    assert unknown.tolist() == gradient.tolist()
    assert (hybrid <= gradient).all()
    assert hybrid[40:].mean() < 0.9 * gradient[40:].mean()
