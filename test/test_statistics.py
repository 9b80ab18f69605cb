"""Counts, rates and times of the node, on a clock that the tests move."""

import dataclasses
import math
import threading
import tracemalloc

import pytest

from stavpr_ros.pipeline.statistics import MOST_WORDS, OTHER, SHORTEST_SPAN, StageTime, Statistics


class Clock:
    """Seconds that pass when a test says so."""

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
    """Have events at a steady pace; the clock stands at the last of them."""
    for _ in range(round(seconds * hertz)):
        clock.now += 1 / hertz
        event()


def answer(statistics, status='match', reason='', place=0, distance=0.5, **stages):
    statistics.answered(status, reason, place, distance, stages)


def test_nothing_yet(clock, statistics):
    clock.now += 3
    snapshot = statistics.snapshot()
    assert snapshot.uptime == pytest.approx(3)
    assert snapshot.rate_in == snapshot.rate_out == snapshot.received == snapshot.answered == 0
    assert snapshot.received_age is snapshot.answered_age is snapshot.total is snapshot.work is None
    assert snapshot.drops == snapshot.recent_drops == snapshot.statuses == snapshot.stages == {}
    assert (snapshot.status, snapshot.place) == ('', -1)
    assert math.isnan(snapshot.distance)


@pytest.mark.parametrize('hertz', [2, 5, 30, 200])
@pytest.mark.parametrize('seconds', [1, 3, 9.3, 10, 11.7, 40])
def test_the_rate_is_right_from_the_beginning(clock, statistics, hertz, seconds):
    clock.now += 100  # the node has waited for long
    stream(clock, seconds, hertz, statistics.received)
    snapshot = statistics.snapshot()
    # Once the window is full it opens between two events: one more or less in nine seconds.
    assert snapshot.rate_in == pytest.approx(hertz, abs=0.112 if seconds > 9 else 1e-6)
    assert snapshot.received == round(hertz * seconds)
    assert snapshot.rate_out == 0


@pytest.mark.parametrize('pause', [10.1, 25, 3600])
def test_the_rate_is_right_after_a_pause(clock, statistics, pause):
    stream(clock, 30, 30, statistics.received)
    clock.now += pause
    assert statistics.snapshot().rate_in == 0
    stream(clock, 2, 30, statistics.received)
    assert statistics.snapshot().rate_in == pytest.approx(30)


def test_the_rate_falls_to_zero_within_the_window(clock, statistics):
    stream(clock, 30, 30, statistics.received)
    rates = [statistics.snapshot().rate_in]
    for _ in range(10):
        clock.now += 1
        rates.append(statistics.snapshot().rate_in)
    assert rates == sorted(rates, reverse=True)
    assert rates[5] == pytest.approx(15, abs=2)
    assert rates[-1] == 0


def test_a_burst_and_a_single_image_are_no_fast_stream(clock, statistics):
    statistics.received()
    assert statistics.snapshot().rate_in == pytest.approx(0.1)
    for _ in range(3):
        clock.now += 0.001
        statistics.received()
    assert statistics.snapshot().rate_in == pytest.approx(3 / SHORTEST_SPAN)


def test_in_and_out_have_rates_of_their_own(clock, statistics):
    turn = iter(range(10**6))

    def event():
        statistics.received()
        if next(turn) % 3 == 0:
            answer(statistics)

    stream(clock, 20, 30, event)
    snapshot = statistics.snapshot()
    assert snapshot.rate_in == pytest.approx(30, abs=0.2)
    assert snapshot.rate_out == pytest.approx(10, abs=0.2)
    assert (snapshot.received, snapshot.answered) == (600, 200)


def test_drops_by_cause_and_the_recent_ones(clock, statistics):
    statistics.dropped('queue full')
    statistics.dropped('lost in transport', 7)
    clock.now += 20
    statistics.dropped('queue full', 2)
    clock.now += 5
    statistics.dropped('max_rate')
    snapshot = statistics.snapshot()
    assert snapshot.drops == {'queue full': 3, 'lost in transport': 7, 'max_rate': 1}
    assert snapshot.recent_drops == {'queue full': 2, 'max_rate': 1}
    clock.now += 5.1
    assert statistics.snapshot().recent_drops == {'max_rate': 1}


def test_nothing_is_recent_for_more_than_the_window_nor_for_less_than_nine_seconds(clock, statistics):
    for start in (50.0, 50.3, 50.999):
        statistics.reset()
        clock.now = start + 1000
        statistics.dropped('x')
        clock.now = start + 1008.99
        assert statistics.snapshot().recent_drops == {'x': 1}
        clock.now = start + 1010.01
        assert statistics.snapshot().recent_drops == {}


def test_verdicts_and_the_last_answer(clock, statistics):
    answer(statistics, 'NO_MATCH', 'not near enough', -1, 1.25)
    clock.now += 30
    answer(statistics, 'match', place=17, distance=0.25)
    clock.now += 1
    answer(statistics, 'no match', 'failed the check', -1, 0.5)
    clock.now += 4
    snapshot = statistics.snapshot()
    assert snapshot.statuses == {'no match': 2, 'match': 1}
    assert snapshot.recent_statuses == {'match': 1, 'no match': 1}
    last = (snapshot.status, snapshot.reason, snapshot.place, snapshot.distance)
    assert last == ('no match', 'failed the check', -1, 0.5)
    assert snapshot.answered_age == pytest.approx(4)


def test_stage_times_over_several_seconds(clock, statistics):
    answer(statistics, waiting=9, matching=9)
    clock.now += 20
    answer(statistics, waiting=0.002, decoding=0.004, matching=0.010)
    clock.now += 2
    answer(statistics, waiting=0.004, decoding=0.002)
    answer(statistics)  # not measured: no zero in the mean
    snapshot = statistics.snapshot()
    assert list(snapshot.stages) == ['waiting', 'decoding', 'matching']
    expected = {'waiting': (3, 4), 'decoding': (3, 4), 'matching': (10, 10)}
    for stage, (mean, largest) in expected.items():
        assert dataclasses.astuple(snapshot.stages[stage]) == pytest.approx((mean, largest))
    assert dataclasses.astuple(snapshot.total) == pytest.approx((11, 16))
    assert dataclasses.astuple(snapshot.work) == pytest.approx((8, 14))
    assert isinstance(snapshot.total, StageTime)


def test_every_answer_weighs_the_same_in_the_mean(clock, statistics):
    for milliseconds in (10, 10, 10):
        answer(statistics, matching=milliseconds / 1e3)
    clock.now += 1
    answer(statistics, matching=0.050)
    assert statistics.snapshot().stages['matching'].mean == pytest.approx(20)


def test_gaps_and_jumps(statistics):
    for seconds in (0.5, 3.0, 2.0):
        statistics.gap(seconds)
    statistics.jump_back(60)
    snapshot = statistics.snapshot()
    assert (snapshot.gaps, snapshot.longest_gap) == (3, 3.0)
    assert (snapshot.jumps_back, snapshot.longest_jump_back) == (1, 60)


def test_age_of_the_last_image(clock, statistics):
    statistics.received()
    clock.now += 4
    assert statistics.snapshot().received_age == pytest.approx(4)


def test_reset_forgets_everything(clock, statistics):
    fresh = statistics.snapshot()
    statistics.received()
    answer(statistics, 'no match', 'x', 3, 0.1, matching=1)
    statistics.dropped('queue full')
    statistics.gap(1)
    statistics.jump_back(1)
    clock.now += 5
    assert statistics.snapshot() != fresh
    statistics.reset()
    assert str(statistics.snapshot()) == str(fresh)  # as text, in which NaN equals NaN


def test_a_snapshot_does_not_change(clock, statistics):
    statistics.dropped('queue full')
    answer(statistics, matching=0.001)
    before = statistics.snapshot()
    text = str(before)
    statistics.dropped('queue full')
    answer(statistics, matching=0.5)
    assert str(before) == text
    with pytest.raises(dataclasses.FrozenInstanceError):
        before.received = 3


def test_many_threads_lose_no_count():
    statistics = Statistics()
    threads, each, errors = 8, 2000, []
    begin = threading.Barrier(threads + 1)

    def hammer(number):
        try:
            begin.wait(10)
            for _ in range(each):
                statistics.received()
                statistics.answered('match', '', 1, 0.5, {'waiting': 0.001, 'matching': 0.001})
                statistics.dropped(f'cause {number % 2}')
                statistics.gap(0.5)
                statistics.jump_back(0.5)
        except Exception as error:
            errors.append(error)

    workers = [threading.Thread(target=hammer, args=(number,)) for number in range(threads)]
    for worker in workers:
        worker.start()
    begin.wait(10)
    while any(worker.is_alive() for worker in workers):
        snapshot = statistics.snapshot()
        assert sum(snapshot.statuses.values()) == snapshot.answered
    snapshot = statistics.snapshot()
    assert not errors
    count = threads * each
    assert snapshot.received == snapshot.answered == snapshot.gaps == snapshot.jumps_back == count
    assert snapshot.statuses == {'match': count}
    assert snapshot.drops == {'cause 0': count // 2, 'cause 1': count // 2}


def test_the_clock_is_read_in_turn():
    """A clock read before the lock is taken would open buckets out of order."""
    statistics = None

    def clock():
        assert statistics is None or statistics._lock.locked()
        return 5.0

    statistics = Statistics(clock)
    for call in (statistics.received, statistics.snapshot, statistics.reset, lambda: statistics.dropped('x')):
        call()
    answer(statistics)


@pytest.mark.parametrize('kind', ['gap', 'jump_back'])
def test_pauses_are_counted_under_the_lock(statistics, kind, monkeypatch):
    locked = []
    for name in ('_gaps', '_jumps_back'):
        add = getattr(statistics, name).add
        spy = lambda seconds, add=add: (locked.append(statistics._lock.locked()), add(seconds))  # noqa: E731
        monkeypatch.setattr(getattr(statistics, name), 'add', spy)
    getattr(statistics, kind)(1.0)
    assert locked == [True]


def test_memory_does_not_grow(clock, statistics):
    def drive(events, hertz, first):
        for number in range(first, first + events):
            clock.now += 1 / hertz
            statistics.received()
            answer(statistics, f'status {number}', **{'matching': 0.001, f'stage {number}': 0.001})
            statistics.dropped(f'cause {number}')
            statistics.dropped(f'invalid: kind {number}')
            statistics.gap(1)

    drive(2000, 200, 0)
    tracemalloc.start()
    try:
        drive(2000, 200, 2000)
        before = tracemalloc.get_traced_memory()[0]
        drive(10_000, 200, 4000)
        drive(300, 0.5, 14_000)
        assert tracemalloc.get_traced_memory()[0] - before < 20_000
    finally:
        tracemalloc.stop()
    snapshot = statistics.snapshot()
    assert sum(snapshot.drops.values()) == 2 * snapshot.received
    assert len(snapshot.drops) == len(snapshot.statuses) == MOST_WORDS + 1
    assert snapshot.drops[OTHER] > 1000


def test_kinds_do_not_crowd_out_causes(statistics):
    for number in range(200):
        statistics.dropped(f'invalid: kind {number}')
    statistics.dropped('queue full')
    snapshot = statistics.snapshot()
    assert snapshot.recent_drops['queue full'] == snapshot.drops['queue full'] == 1
    assert snapshot.drops['invalid: other'] == 200 - MOST_WORDS // 2
    assert OTHER not in snapshot.drops
