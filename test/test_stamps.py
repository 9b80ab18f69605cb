# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Gaps and jumps of the clock, and missing images, from stamps alone."""

import numpy as np
import pytest
from stavpr_ros.pipeline.statistics import INTERVALS, PeriodWatch, StampWatch

MS = 1_000_000
START = 1_700_000_000_000 * MS  # a camera's clock today: only whole numbers have exact differences


def events(watch, *milliseconds):
    return [watch.see(START + ms * MS) for ms in milliseconds]


def test_watch_of_steady_stream_reports_nothing():
    assert events(StampWatch(0.5), *range(0, 3000, 33)) == [0] * 91


def test_watch_of_pause_above_limit_reports_gap():
    expected = [0, 0, 0.501, 0]
    assert events(StampWatch(0.5), 0, 500, 1001, 1500) == expected


def test_watch_of_jump_back_reports_it_once():
    jump = -60.0
    found = events(StampWatch(0.5), 60_000, 60_033, 33, 66, 99)
    assert found == [0, 0, jump, 0, 0]


def test_watch_of_reordered_images_reports_jumps_from_tenth_of_second():
    assert events(StampWatch(0.5), 1000, 900) == [0, -0.1]
    assert events(StampWatch(0.5), 1000, 901) == [0, 0]


def test_watch_after_reordered_images_compares_with_newest_stamp():
    # 1 ms more than the limit after the reordered image, but within it after the newest
    assert events(StampWatch(0.5), 1000, 910, 1411) == [0, 0, 0]
    # two small steps back are together a jump
    assert events(StampWatch(0.5), 1000, 940, 880) == [0, 0, -0.12]


def test_watch_of_equal_stamps_reports_nothing():
    assert events(StampWatch(0.5), 7, 7, 7) == [0] * 3


def test_watch_of_unknown_stamps_ignores_them():
    watch = StampWatch(0.5)
    assert watch.see(0) == 0
    assert events(watch, 0) == [0]
    assert watch.see(0) == 0  # no jump back ...
    assert events(watch, 501) == [0.501]  # ... and no new start


def test_watch_with_changed_limit_applies_it():
    watch = StampWatch(0.5)
    assert events(watch, 0, 400) == [0, 0]
    watch.gap = 0.3
    assert events(watch, 800) == [0.4]
    watch.gap = 0
    assert events(watch, 100_000) == [0]


def missing(seconds, kept=slice(None)):
    """Return the estimate of missing images for stamps in seconds."""
    watch = PeriodWatch()
    return sum(watch.see(START + round(1e9 * t)) for t in np.asarray(seconds)[kept])


@pytest.mark.parametrize('hertz', [1, 30])
@pytest.mark.parametrize('loss', [0.0, 0.05, 0.3, 0.5])
@pytest.mark.parametrize('jitter', [0.0, 0.1])
def test_period_watch_of_steady_camera_estimates_losses(hertz, loss, jitter):
    rng = np.random.default_rng(0)
    stamps = (np.arange(1000) + rng.normal(0, jitter, 1000)) / hertz
    kept = rng.random(1000) >= loss
    lost = 1000 - kept.sum()
    # none are counted before the period is known
    assert 0.75 * lost - INTERVALS / 2 <= missing(stamps, kept) <= lost


def test_period_watch_of_irregular_camera_estimates_nothing():
    rng = np.random.default_rng(0)
    assert missing(np.cumsum(rng.exponential(1 / 30, 1000))) == 0
    assert missing(np.cumsum(np.tile([0.001, 0.001, 0.098], 300))) == 0  # bursts


def test_period_watch_of_pause_and_unknown_stamps_estimates_nothing():
    steady = np.arange(100) / 30
    assert missing([*steady, *(steady + 60), *(steady + 120)]) == 0
    watch = PeriodWatch()
    assert [watch.see(0) for _ in range(100)] == [0] * 100
    # reordered or equal stamps
    assert missing([*steady, 2.0, 2.0, *(steady[1:] + steady[-1])]) == 0


def test_period_watch_by_hand_counts_images_between_two_stamps():
    watch = PeriodWatch()
    assert [watch.see(START + 100 * MS * i) for i in range(INTERVALS)] == [0] * INTERVALS
    late = START + 100 * MS * (INTERVALS + 2)
    assert watch.see(late) == 2
    assert watch.see(late + 210 * MS) == 1
    assert watch.see(late + 1100 * MS) == 8
    assert watch.see(late + 2300 * MS) == 0  # twelve periods are a pause
