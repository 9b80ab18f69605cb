# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Counts of images, results, drops and gaps of the stamps, and the time of each stage."""

from collections import Counter, defaultdict, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
import math
from statistics import median
import threading
import time
from typing import Any

from stavpr_ros.units import SECOND

RECENT = 10  # seconds behind rates, recent counts and times
MIN_SPAN = 0.5  # seconds of a rate at least: two images of a burst are not a thousand Hz
WAITING = 'waiting'  # stage before the worker takes an image: in the total, not in the work
REORDERING_SECONDS = 0.1  # images less than this out of order were reordered in transport
INTERVALS = 40  # pauses between images for the period of a camera, which needs half of them
REGULAR = 0.75  # share of them near a multiple of the period, from which on a camera has one
MAX_LOSS = 10  # periods; longer pauses are pauses of the camera, not losses


@dataclass(frozen=True)
class Tally:
    """The events of one kind, by name; recent: in the last ``RECENT`` seconds."""

    total: Counter[str] = field(default_factory=Counter)  # since the start
    recent: Counter[str] = field(default_factory=Counter)
    rate: float = 0.0  # recent events per second
    age: float | None = None  # seconds since the last event of this activation

    @property
    def count(self) -> int:
        """Return the number since the start, of all names."""
        return self.total.total()


@dataclass
class ImageCounts:
    """
    All counts at one moment; totals are since the start.

    :param times: mean and maximum over recent images [ms] of all stages together (``total``),
        without waiting (``work``), and of each stage; empty = no measurement.
    """

    uptime: float = 0.0  # seconds since the start or the last activation
    received: Tally = field(default_factory=Tally)  # without names
    answered: Tally = field(default_factory=Tally)  # by status in lower case, as 'no match'
    dropped: Tally = field(default_factory=Tally)  # without a result, by cause, as 'queue full'
    missing: Tally = field(default_factory=Tally)  # by the stamps and the camera's rate: estimate
    edges: Tally = field(default_factory=Tally)  # of loop closures, by source in lower case
    edge_reason: str = ''  # why the last edge is not by PnP; empty = it is
    status: str = ''  # of the last result, as are reason, place and distance
    reason: str = ''
    place: int = -1  # -1 = none
    distance: float = math.nan  # NaN = none
    nearest: float = math.inf  # smallest distance of all results
    times: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    gaps: int = 0  # pauses in the stamps
    longest_gap: float = 0.0  # seconds
    odometry_rejected: int = 0  # messages with an invalid pose or stamp
    jumps_back: int = 0  # of the stamps
    longest_jump_back: float = 0.0  # seconds


class Statistics:
    """
    Counts events; every method may be called from any thread. Only recent events are kept.

    :param clock: returns seconds that never go back.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._counts = ImageCounts()
        self._totals: defaultdict[str, Counter[str]] = defaultdict(Counter)
        self.restart()

    def restart(self) -> None:
        """Begin another activation: totals stay, recent events and the last result are gone."""
        with self._lock:
            self._start = self._clock()
            self._counts = replace(
                self._counts, status='', reason='', place=-1, distance=math.nan, edge_reason=''
            )
            self._last: dict[str, float] = {}  # time of the last event by kind
            # time, name and number of the events by kind
            self._recent: defaultdict[str, deque[tuple[float, str, int]]] = defaultdict(deque)
            self._stages: deque[tuple[float, Mapping[str, float]]] = deque()

    def add_image(self) -> None:
        """Count a received image."""
        with self._lock:
            self._add('received')

    def add_match(
        self, status: str, reason: str, place: int, distance: float, stages: Mapping[str, float]
    ) -> None:
        """
        Count an image with a result.

        :param status: name of the status, as ``'NO_MATCH'`` or ``'no match'``.
        :param reason: why there is no match; empty if there is one.
        :param place: index of the place of the image itself, newest_index, -1 = none.
        :param distance: of the nearest sequence, NaN = none.
        :param stages: seconds by stage, ``WAITING`` among them; empty = not measured.
        """
        status = status.lower().replace('_', ' ')
        with self._lock:
            self._add('answered', status)
            if stages:
                self._stages.append((self._last['answered'], dict(stages)))
                _evict(self._stages, self._last['answered'])
            counts = self._counts
            counts.status, counts.reason = status, reason
            counts.place, counts.distance = place, distance
            counts.nearest = min(counts.nearest, distance)  # NaN is not less

    def add_drop(self, cause: str, count: int = 1) -> None:
        """Count images without a result, by cause: ``'queue full'``, ``'invalid: encoding'``."""
        with self._lock:
            self._add('dropped', cause, count)

    def add_odometry_rejected(self) -> None:
        """Count a message of odometry with an invalid pose or stamp."""
        with self._lock:
            self._counts.odometry_rejected += 1

    def add_edge(self, source: str, reason: str) -> None:
        """Count a loop closure by the source of its edge; reason: why it is not PnP."""
        with self._lock:
            self._add('edges', source.lower())
            self._counts.edge_reason = reason

    def add_stamp_jump(self, ahead: float, missing: int) -> None:
        """Count a gap or jump back of the stamps, and missing images (:class:`StampWatch`)."""
        with self._lock:
            counts = self._counts
            if missing:
                self._add('missing', number=missing)
            if ahead > 0:
                counts.gaps += 1
                counts.longest_gap = max(counts.longest_gap, ahead)
            elif ahead < 0:
                counts.jumps_back += 1
                counts.longest_jump_back = max(counts.longest_jump_back, -ahead)

    def counts(self) -> ImageCounts:
        """Return all counts; later events do not change them."""
        with self._lock:
            now = self._clock()
            _evict(self._stages, now)
            return replace(
                self._counts,
                uptime=now - self._start,
                times=_times([stages for _, stages in self._stages]),
                received=self._tally('received', now),
                answered=self._tally('answered', now),
                dropped=self._tally('dropped', now),
                missing=self._tally('missing', now),
                edges=self._tally('edges', now),
            )

    def _add(self, kind: str, name: str = '', number: int = 1) -> None:
        self._last[kind] = now = self._clock()
        self._totals[kind][name] += number
        self._recent[kind].append((now, name, number))
        _evict(self._recent[kind], now)

    def _tally(self, kind: str, now: float) -> Tally:
        events, last = self._recent[kind], self._last.get(kind)
        _evict(events, now)
        recent: Counter[str] = Counter()
        for _, name, number in events:
            recent[name] += number
        rate = 0.0
        if events:
            # the first event opens the span, so there is one period less than there are events
            span = max(now - events[0][0], MIN_SPAN)
            rate = max((len(events) - 1) / span, len(events) / RECENT)
        age = None if last is None else now - last
        return Tally(self._totals[kind].copy(), recent, rate, age)


class StampWatch:
    """
    Finds gaps, jumps back and missing images in stamps; for one thread, any may set ``gap``.

    :param gap: longer pauses are reported [s]; 0 = none is.
    """

    def __init__(self, gap: float) -> None:
        self.gap = gap
        self._newest = self._last = 0  # stamps
        self._intervals: deque[float] = deque(maxlen=INTERVALS)

    def update(self, stamp: int) -> tuple[float, int]:
        """
        Take the next stamp; return the step and the number of images missing before it.

        The step is the seconds of a gap, negative of a jump back, 0 = neither. A reordered
        image does not move the newest stamp back: the next image comes after no gap.

        Missing images are estimated at a camera of steady rate, with jitter up to a tenth of the
        period and the loss of half of the images: 0 while the rate is unknown, and after a pause.

        :param stamp: nanoseconds; 0 = unknown, ignored.
        """
        if stamp == 0:
            return 0.0, 0
        last, newest = self._last, self._newest
        self._last = self._newest = stamp
        ahead = (stamp - newest) / SECOND if newest else 0.0
        if ahead <= -REORDERING_SECONDS:
            self._last = 0
            self._intervals.clear()
            return ahead, 0
        if ahead < 0:
            self._newest = newest
        missing = self._missing((stamp - last) / SECOND) if last else 0
        return (ahead if 0 < self.gap < ahead else 0.0), missing

    def _missing(self, interval: float) -> int:
        """Return the number of images missing in an interval [s] by the period of the others."""
        if interval <= 0:  # equal or out of order
            return 0
        self._intervals.append(interval)
        intervals = sorted(self._intervals)
        if len(intervals) < INTERVALS // 2:
            return 0
        # a short interval, since long ones have losses, but not the shortest: it has most jitter
        guess = intervals[len(intervals) // 5]
        if interval < 1.1 * guess:  # the period is at least three quarters of it
            return 0
        period = median(pause / max(round(pause / guess), 1) for pause in intervals)
        multiples = [pause / period for pause in intervals]
        near = sum(abs(multiple - max(round(multiple), 1)) < 0.25 for multiple in multiples)
        if near < REGULAR * len(multiples) or interval > MAX_LOSS * period:
            return 0
        return max(round(interval / period) - 1, 0)


def _evict(events: deque[Any], now: float) -> None:
    """Remove the events that are no longer recent; the time is the first item of each."""
    while events and events[0][0] <= now - RECENT:
        events.popleft()


def _times(rows: list[Mapping[str, float]]) -> dict[str, tuple[float, float]]:
    """Return mean and maximum [ms] of total, work and each stage."""
    seconds: dict[str, list[float]] = {}
    for stages in rows:
        total = sum(stages.values())
        sums = {'total': total, 'work': total - stages.get(WAITING, 0.0)}
        for name, value in {**sums, **stages}.items():
            seconds.setdefault(name, []).append(value)
    return {
        name: (1e3 * sum(values) / len(values), 1e3 * max(values))
        for name, values in seconds.items()
    }
