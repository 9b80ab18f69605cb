# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the pipeline counts; gaps and jumps of the clock and missing images, from stamps alone."""

from collections import Counter
from concurrent.futures import ThreadPoolExecutor
import sys
import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest
from stavpr_ros.pipeline.statistics import (
    ImageCounts,
    INTERVALS,
    RECENT,
    StampWatch,
    Statistics,
    Tally,
)


@pytest.fixture
def clock():
    return SimpleNamespace(now=1234.56)


@pytest.fixture
def statistics(clock):
    return Statistics(lambda: clock.now)


def stream(clock, seconds, hertz, event):
    """Make events at a steady pace; the clock stops at the last of them."""
    for _ in range(round(seconds * hertz)):
        clock.now += 1 / hertz
        event()


def test_edges_are_counted_by_source_with_the_last_reason(clock, statistics):
    for source, reason in (('PNP', ''), ('REFUTED', 'PnP: 3 inliers')):
        statistics.add_edge(source, reason)
    counts = statistics.counts()
    assert (counts.edges.total, counts.edge_reason) == ({'pnp': 1, 'refuted': 1}, 'PnP: 3 inliers')
    clock.now += RECENT + 1
    statistics.restart()
    counts = statistics.counts()
    assert (counts.edges.count, counts.edges.recent, counts.edge_reason) == (2, {}, '')


def answer(statistics, status='match', reason='', place=0, distance=0.5, **stages):
    statistics.add_match(status, reason, place, distance, stages)


@pytest.mark.parametrize('hertz', [2, 30])
@pytest.mark.parametrize('seconds', [1, 9.3, 10, 11.7])
def test_rate_of_a_steady_stream_is_correct_from_the_start(clock, statistics, hertz, seconds):
    clock.now += 100
    stream(clock, seconds, hertz, statistics.add_image)
    received = statistics.counts().received
    assert received.rate == pytest.approx(hertz, abs=0.112 if seconds > 9 else 1e-6)
    assert received.count == round(hertz * seconds)


def test_rate_after_the_last_image_falls_to_zero_within_the_window(clock, statistics):
    stream(clock, 30, 30, statistics.add_image)
    rates = [statistics.counts().received.rate]
    for _ in range(RECENT):
        clock.now += 1
        rates.append(statistics.counts().received.rate)
    assert rates == sorted(rates, reverse=True)
    assert rates[5] == pytest.approx(15, abs=2)
    assert rates[-1] == 0


def test_drops_are_counted_by_cause_ever_and_recently(clock, statistics):
    statistics.add_drop('queue full')
    statistics.add_drop('lost in transport', 7)
    clock.now += 20
    statistics.add_drop('queue full', 2)
    clock.now += 5
    statistics.add_drop('max_rate')
    dropped = statistics.counts().dropped
    clock.now += 5.1
    statistics.add_drop('lost in transport')
    assert statistics.counts().dropped.recent == {'max_rate': 1, 'lost in transport': 1}
    # later events do not change counts
    assert dropped.total == {'queue full': 3, 'lost in transport': 7, 'max_rate': 1}
    assert dropped.recent == {'queue full': 2, 'max_rate': 1}


def test_statuses_are_counted_in_lower_case_with_the_last_result(clock, statistics):
    answer(statistics, 'NO_MATCH', 'not near enough', -1, 1.25)
    clock.now += 30
    answer(statistics, 'match', place=17, distance=0.25)
    clock.now += 1
    answer(statistics, 'no match', 'failed the check', -1, 0.5)
    clock.now += 4
    counts = statistics.counts()
    assert counts.answered.total == {'no match': 2, 'match': 1}
    assert counts.answered.recent == {'match': 1, 'no match': 1}
    last = (counts.status, counts.reason, counts.place, counts.distance)
    assert last == ('no match', 'failed the check', -1, 0.5)
    assert counts.answered.age == pytest.approx(4)
    assert counts.nearest == 0.25


def test_stage_times_are_mean_and_maximum_of_recent_images(clock, statistics):
    answer(statistics, waiting=9, matching=9)
    clock.now += 20
    answer(statistics, waiting=0.002, decoding=0.004, matching=0.010)
    clock.now += 2
    answer(statistics, waiting=0.004, decoding=0.002)
    answer(statistics)  # not measured: no zero in the mean
    expected = {'total': (11, 16), 'work': (8, 14)}
    expected |= {'waiting': (3, 4), 'decoding': (3, 4), 'matching': (10, 10)}
    times = statistics.counts().times
    assert list(times) == list(expected)
    assert [*times.values()] == [pytest.approx(pair) for pair in expected.values()]
    clock.now += RECENT
    assert statistics.counts().times == {}


def test_steps_of_the_stamps_are_counted_with_the_longest(clock, statistics):
    for ahead, missing in ((0.5, 0), (3.0, 2), (2.0, 1), (-60.0, 0), (-5.0, 0), (0.0, 0)):
        statistics.add_stamp_jump(ahead, missing)
    counts = statistics.counts()
    assert (counts.gaps, counts.longest_gap) == (3, 3.0)
    assert (counts.jumps_back, counts.longest_jump_back) == (2, 60.0)
    assert counts.missing.recent.total() == 3
    clock.now += RECENT
    missing = statistics.counts().missing
    assert (missing.recent.total(), missing.count) == (0, 3)


def test_restart_keeps_totals_and_nothing_recent(clock, statistics):
    statistics.add_image()
    answer(statistics, 'no match', 'x', 3, 0.1, matching=1)
    statistics.add_drop('queue full')
    statistics.add_stamp_jump(2, 1)
    statistics.add_stamp_jump(-3, 0)
    clock.now += 5
    statistics.restart()
    tallies = {'received': '', 'answered': 'no match', 'dropped': 'queue full', 'missing': ''}
    expected = ImageCounts(
        **{name: Tally(Counter({cause: 1})) for name, cause in tallies.items()},
        **{'nearest': 0.1, 'gaps': 1, 'longest_gap': 2, 'jumps_back': 1, 'longest_jump_back': 3},
    )
    assert str(statistics.counts()) == str(expected)  # as text, in which NaN equals NaN


def test_counts_from_many_threads_are_complete():
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)  # threads interrupt each other everywhere
    statistics = Statistics()

    def count(number):
        for _ in range(300):
            statistics.add_image()
            answer(statistics, waiting=0.001, matching=0.001)
            statistics.add_drop(f'cause {number % 2}')
            statistics.add_stamp_jump(0.5, 1)

    try:
        with ThreadPoolExecutor(8) as pool:
            list(pool.map(count, range(8)))
    finally:
        sys.setswitchinterval(interval)
    counts = statistics.counts()
    tallies = (counts.received, counts.answered, counts.dropped, counts.missing)
    assert [tally.count for tally in tallies] == [2400] * 4
    assert (counts.gaps, counts.dropped.total) == (2400, {'cause 0': 1200, 'cause 1': 1200})


def test_memory_of_a_long_stream_does_not_grow(clock, statistics):
    def event():
        statistics.add_image()
        answer(statistics, matching=0.001)
        statistics.add_drop('queue full')

    stream(clock, 2 * RECENT, 100, event)
    tracemalloc.start()
    try:
        stream(clock, 2 * RECENT, 100, event)
        before = tracemalloc.get_traced_memory()[0]
        stream(clock, 4 * RECENT, 100, event)
        assert tracemalloc.get_traced_memory()[0] - before < 20_000
    finally:
        tracemalloc.stop()


# Gaps and jumps of the clock, and missing images, from stamps alone

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
