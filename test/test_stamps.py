"""Gaps and jumps of the clock, seen from stamps alone."""

import math

import pytest

from stavpr_ros.errors import SettingsError
from stavpr_ros.pipeline.stamps import StampEvent, StampWatch

MS = 1_000_000
START = 1_700_000_000_000 * MS  # a camera's clock today: differences are exact only in whole numbers


def events(watch, *milliseconds):
    return [watch.see(START + ms * MS) for ms in milliseconds]


def test_a_steady_stream_has_no_events():
    assert events(StampWatch(0.5), *range(0, 3000, 33)) == [None] * 91


def test_a_gap_is_longer_than_the_limit():
    assert events(StampWatch(0.5), 0, 500, 1001, 1500) == [None, None, StampEvent('gap', 0.501), None]


def test_a_jump_back_is_told_once_and_the_stream_goes_on_from_there():
    jump = StampEvent('jump back', 60.0)
    assert events(StampWatch(0.5), 60_000, 60_033, 33, 66, 99) == [None, None, jump, None, None]


def test_a_tenth_of_a_second_is_a_jump_less_is_reordering():
    assert events(StampWatch(0.5), 1000, 900) == [None, StampEvent('jump back', 0.1)]
    assert events(StampWatch(0.5), 1000, 901) == [None, None]


def test_reordering_does_not_move_the_newest_stamp_back():
    # 1 ms more than the limit after the reordered image, but within it after the newest
    assert events(StampWatch(0.5), 1000, 910, 1411) == [None, None, None]
    # two steps back, each of them small, are together a jump
    assert events(StampWatch(0.5), 1000, 940, 880) == [None, None, StampEvent('jump back', 0.12)]


def test_equal_stamps_are_nothing():
    assert events(StampWatch(0.5), 7, 7, 7) == [None] * 3


def test_unknown_stamps_are_ignored():
    watch = StampWatch(0.5)
    assert watch.see(0) is None
    assert events(watch, 0) == [None]
    assert watch.see(0) is None  # neither a jump back ...
    assert events(watch, 501) == [StampEvent('gap', 0.501)]  # ... nor a new beginning


def test_the_limit_changes_live():
    watch = StampWatch(0.5)
    assert events(watch, 0, 400) == [None, None]
    watch.gap = 0.3
    assert events(watch, 800) == [StampEvent('gap', 0.4)]
    assert watch.gap == 0.3
    watch.gap = 0
    assert events(watch, 100_000) == [None]


def test_reset_forgets_the_newest_stamp():
    watch = StampWatch(0.5)
    events(watch, 60_000)
    watch.reset()
    assert events(watch, 0, 501) == [None, StampEvent('gap', 0.501)]


@pytest.mark.parametrize('gap', [-0.1, math.nan])
def test_nonsense_is_refused_and_changes_nothing(gap):
    with pytest.raises(SettingsError, match='longest pause'):
        StampWatch(gap)
    watch = StampWatch(0.5)
    with pytest.raises(SettingsError):
        watch.gap = gap
    assert watch.gap == 0.5
