# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Gaps and jumps of the clock, and missing images, from stamps alone."""

import numpy as np
import pytest
from stavpr_ros.pipeline.statistics import INTERVALS, StampWatch

MS = 1_000_000
START = 1_700_000_000_000 * MS  # a camera's clock today: only whole numbers have exact differences


@pytest.mark.parametrize(
    ('milliseconds', 'steps'),
    [
        (range(0, 3000, 33), [0] * 91),
        ((7, 7, 7), [0] * 3),
        ((0, 500, 1001, 1500), [0, 0, 0.501, 0]),  # longer than 0.5 s
        ((60_000, 60_033, 33, 66, 99), [0, 0, -60.0, 0, 0]),  # reported once
        ((1000, 900), [0, -0.1]),
        ((1000, 901), [0, 0]),  # reordered
        ((1000, 910, 1411), [0, 0, 0]),  # after a reordered image, but near the newest
        ((1000, 940, 880), [0, 0, -0.12]),  # two small steps back are together a jump
        ((None, 0, None, 501), [0, 0, 0, 0.501]),  # unknown: no jump back and no new start
    ],
)
def test_watch_reports_gaps_and_jumps_back(milliseconds, steps):
    watch = StampWatch(0.5)
    stamps = [0 if ms is None else START + ms * MS for ms in milliseconds]
    assert [watch.update(stamp)[0] for stamp in stamps] == steps


def missing(seconds, kept=slice(None)):
    """Return the estimate of missing images for stamps in seconds."""
    watch = StampWatch(0)
    return sum(watch.update(START + round(1e9 * t))[1] for t in np.asarray(seconds)[kept])


@pytest.mark.parametrize('hertz', [1, 30])
@pytest.mark.parametrize('loss', [0.0, 0.05, 0.3, 0.5])
@pytest.mark.parametrize('jitter', [0.0, 0.1])
def test_watch_of_steady_camera_estimates_losses(hertz, loss, jitter):
    rng = np.random.default_rng(0)
    stamps = (np.arange(1000) + rng.normal(0, jitter, 1000)) / hertz
    kept = rng.random(1000) >= loss
    lost = 1000 - kept.sum()
    # none are counted before the period is known
    assert 0.75 * lost - INTERVALS / 2 <= missing(stamps, kept) <= lost


STEADY = np.arange(100) / 30


@pytest.mark.parametrize(
    'seconds',
    [
        np.cumsum(np.random.default_rng(0).exponential(1 / 30, 1000)),
        np.cumsum(np.tile([0.001, 0.001, 0.098], 300)),  # bursts
        [*STEADY, *(STEADY + 60), *(STEADY + 120)],  # pauses
        [*STEADY, 2.0, 2.0, *(STEADY[1:] + STEADY[-1])],  # reordered or equal stamps
        [-START / 1e9] * 100,  # unknown ones
    ],
)
def test_watch_of_an_irregular_camera_estimates_nothing(seconds):
    assert missing(seconds) == 0
