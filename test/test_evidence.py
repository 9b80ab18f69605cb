# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The probability of a path by quantities without a unit."""

import numpy as np
import pytest
from stavpr_ros.filter.evidence import (
    changed_images,
    path_probability,
    RecentMean,
    straight_steps,
)
from stavpr_ros.recognition.device_windows import DeviceBuffer
from stavpr_ros.recognition.window import SequenceBuffer
import torch


def plain_elsewhere(z, steps, excluded):
    """Return the largest mean of -z of straight paths, by plain loops."""
    n, means = z.shape[1], []
    counted = [place for place in range(n) if not any(a <= place < b for a, b in excluded)]
    for place in counted:
        for path in place + steps:
            near = [
                z[i, y] if 0 <= y < n and np.isfinite(z[i, y]) else 1 for i, y in enumerate(path)
            ]
            means.append(-np.mean(near))
    return max(means, default=-np.inf)


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
        steps = straight_steps(numbers, (count - 1) // 2)
        counted = changed_images(numbers)
        assert counted.tolist() == [True, True, False, True, True, True][:count]
        expected = plain_elsewhere(rows[-count:][counted], steps[:, counted], excluded)
        for buffer in buffers:
            found = buffer.best_elsewhere(steps, np.array(excluded), counted)
            assert found == pytest.approx(expected, abs=1e-5)


def test_path_probability_by_hand():
    """Of odds 3, a lead of 1, a drive of recent odds 1/3, and half a window."""
    x = -7.28 + 0.64 * np.log(3) + 2.59 * np.log(1 + 10) - 1.71 * np.log(3)
    assert path_probability(0.75, 2.0, 1.0, 0.25, 10) == pytest.approx(1 / (1 + np.exp(-x)))
    sure = path_probability(1.0, 4.0, 0.0, 0.9, 20)
    assert sure == path_probability(1 - 1e-9, 4.0, -8.0, 0.5, 20) > 0.98
    assert path_probability(0.0, 4.0, 0.0, 0.9, 20) == 0
    assert path_probability(0.5, -1.0, 0.0, 0.5, 20) == path_probability(0.5, 1.0, 2.0, 0.5, 20)


def test_recent_mean_starts_even_and_forgets():
    recent = RecentMean()
    for _ in range(4):
        recent.add(1.0)
    assert recent.value == pytest.approx((8 * 0.5 + 4) / 12)
    for _ in range(600):
        recent.add(0.0)
    assert recent.value < 0.01
