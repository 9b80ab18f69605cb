# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Counts, rates and times of the node, on a clock that the tests move."""

import dataclasses
import math
import sys
import threading
import tracemalloc

import pytest
from stavpr_ros.pipeline.statistics import RECENT, SHORTEST_SPAN, Statistics


class Clock:
    """Seconds that only the test moves."""

    def __init__(self, now=1234.56):
        self.now = now

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def statistics(clock):
    return Statistics(clock)


def stream(clock, seconds, hertz, event):
    """Make events at a steady pace; the clock stops at the last of them."""
    for _ in range(round(seconds * hertz)):
        clock.now += 1 / hertz
        event()


def answer(statistics, status='match', reason='', place=0, distance=0.5, **stages):
    statistics.answered(status, reason, place, distance, stages)


def test_counts_without_events_are_zero(clock, statistics):
    clock.now += 3
    counts = statistics.counts()
    assert counts.uptime == pytest.approx(3)
    assert counts.rate_in == counts.rate_out == counts.received == counts.answered == 0
    assert counts.received_age is counts.answered_age is counts.total is counts.work is None
    assert counts.drops == counts.recent_drops == counts.statuses == counts.stages == {}
    assert (counts.status, counts.place) == ('', -1)
    assert math.isnan(counts.distance)


@pytest.mark.parametrize('hertz', [2, 30])
@pytest.mark.parametrize('seconds', [1, 9.3, 10, 11.7])
def test_rate_of_a_steady_stream_is_correct_from_the_start(clock, statistics, hertz, seconds):
    clock.now += 100
    stream(clock, seconds, hertz, statistics.received)
    counts = statistics.counts()
    assert counts.rate_in == pytest.approx(hertz, abs=0.112 if seconds > 9 else 1e-6)
    assert (counts.received, counts.rate_out) == (round(hertz * seconds), 0)


def test_rate_after_the_last_image_falls_to_zero_within_the_window(clock, statistics):
    stream(clock, 30, 30, statistics.received)
    rates = [statistics.counts().rate_in]
    for _ in range(RECENT):
        clock.now += 1
        rates.append(statistics.counts().rate_in)
    assert rates == sorted(rates, reverse=True)
    assert rates[5] == pytest.approx(15, abs=2)
    assert rates[-1] == 0


def test_rate_of_a_burst_is_finite(clock, statistics):
    statistics.received()
    assert statistics.counts().rate_in == pytest.approx(1 / RECENT)
    for _ in range(3):
        clock.now += 0.001
        statistics.received()
    assert statistics.counts().rate_in == pytest.approx(3 / SHORTEST_SPAN)


def test_drops_are_counted_by_cause_ever_and_recently(clock, statistics):
    statistics.dropped('queue full')
    statistics.dropped('lost in transport', 7)
    clock.now += 20
    statistics.dropped('queue full', 2)
    clock.now += 5
    statistics.dropped('max_rate')
    counts = statistics.counts()
    assert counts.drops == {'queue full': 3, 'lost in transport': 7, 'max_rate': 1}
    assert counts.recent_drops == {'queue full': 2, 'max_rate': 1}
    clock.now += 5.1
    assert statistics.counts().recent_drops == {'max_rate': 1}


def test_statuses_are_counted_in_lower_case_with_the_last_result(clock, statistics):
    answer(statistics, 'NO_MATCH', 'not near enough', -1, 1.25)
    clock.now += 30
    answer(statistics, 'match', place=17, distance=0.25)
    clock.now += 1
    answer(statistics, 'no match', 'failed the check', -1, 0.5)
    clock.now += 4
    counts = statistics.counts()
    assert counts.statuses == {'no match': 2, 'match': 1}
    assert counts.recent_statuses == {'match': 1, 'no match': 1}
    last = (counts.status, counts.reason, counts.place, counts.distance)
    assert last == ('no match', 'failed the check', -1, 0.5)
    assert counts.answered_age == pytest.approx(4)
    assert counts.received_age is None


def test_stage_times_are_mean_and_maximum_of_recent_images(clock, statistics):
    answer(statistics, waiting=9, matching=9)
    clock.now += 20
    answer(statistics, waiting=0.002, decoding=0.004, matching=0.010)
    clock.now += 2
    answer(statistics, waiting=0.004, decoding=0.002)
    answer(statistics)  # not measured: no zero in the mean
    counts = statistics.counts()
    assert list(counts.stages) == ['waiting', 'decoding', 'matching']
    expected = {'waiting': (3, 4), 'decoding': (3, 4), 'matching': (10, 10)}
    for stage, (mean, largest) in expected.items():
        assert dataclasses.astuple(counts.stages[stage]) == pytest.approx((mean, largest))
    assert dataclasses.astuple(counts.total) == pytest.approx((11, 16))
    assert dataclasses.astuple(counts.work) == pytest.approx((8, 14))


def test_gaps_and_jumps_are_counted_with_the_longest(statistics):
    for seconds in (0.5, 3.0, 2.0):
        statistics.gap(seconds)
    statistics.jump_back(60)
    counts = statistics.counts()
    assert (counts.gaps, counts.longest_gap) == (3, 3.0)
    assert (counts.jumps_back, counts.longest_jump_back) == (1, 60)


def test_restart_keeps_totals_and_nothing_recent(clock, statistics):
    fresh = statistics.counts()
    statistics.received()
    answer(statistics, 'no match', 'x', 3, 0.1, matching=1)
    statistics.dropped('queue full')
    statistics.gap(2)
    statistics.jump_back(3)
    clock.now += 5
    statistics.restart()
    totals = {'received': 1, 'answered': 1, 'gaps': 1, 'longest_gap': 2, 'jumps_back': 1}
    totals |= {
        'nearest': 0.1,
        'longest_jump_back': 3,
        'drops': {'queue full': 1},
        'statuses': {'no match': 1},
    }
    expected = dataclasses.replace(fresh, **totals)
    assert str(statistics.counts()) == str(expected)  # as text, in which NaN equals NaN


@pytest.fixture
def frequent_switches():
    """Let threads interrupt each other everywhere."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(interval)


@pytest.mark.usefixtures('frequent_switches')
def test_counts_from_many_threads_are_complete():
    statistics = Statistics()
    threads, each, errors = 8, 300, []
    begin = threading.Barrier(threads + 1)

    def count(number):
        try:
            begin.wait(10)
            for _ in range(each):
                statistics.received()
                answer(statistics, waiting=0.001, matching=0.001)
                statistics.dropped(f'cause {number % 2}')
                statistics.gap(0.5)
                statistics.jump_back(0.5)
        except Exception as error:
            errors.append(error)

    workers = [threading.Thread(target=count, args=(number,)) for number in range(threads)]
    for worker in workers:
        worker.start()
    begin.wait(10)
    while any(worker.is_alive() for worker in workers):
        counts = statistics.counts()
        assert sum(counts.statuses.values()) == counts.answered
    counts = statistics.counts()
    assert not errors
    total = threads * each
    assert counts.received == counts.answered == counts.gaps == counts.jumps_back == total
    assert counts.drops == {'cause 0': total // 2, 'cause 1': total // 2}


def test_memory_of_a_long_stream_does_not_grow(clock, statistics):
    def event():
        statistics.received()
        answer(statistics, matching=0.001)
        statistics.dropped('queue full')

    stream(clock, 2 * RECENT, 100, event)
    tracemalloc.start()
    try:
        stream(clock, 2 * RECENT, 100, event)
        before = tracemalloc.get_traced_memory()[0]
        stream(clock, 4 * RECENT, 100, event)
        assert tracemalloc.get_traced_memory()[0] - before < 20_000
    finally:
        tracemalloc.stop()
