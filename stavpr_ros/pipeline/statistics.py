# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""ImageCounts of the node: images, results, drops, gaps of the stamps, time of each stage."""

from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
import math
import threading
import time
from typing import Generic, TypeVar

RECENT = 10
"""Length of the window behind rates, recent counts and times [s]."""

SHORTEST_SPAN = 0.5
"""
Shortest time over which a rate is taken [s], so that two images of a burst are not a thousand Hz.
"""

WAITING = 'waiting'
"""The stage before the worker takes an image: part of the total, not of the work."""

NANOSECONDS = 1_000_000_000
REORDERING_SECONDS = 0.1
"""Images less than this out of order were reordered on the way, as on best-effort links."""

Value = TypeVar('Value')


@dataclass(frozen=True)
class StageTime:
    """Mean and maximum over recent images [ms]."""

    mean: float
    max: float


@dataclass(frozen=True)
class ImageCounts:
    """
    All counts at one moment. 'Recent' is the last ``RECENT`` seconds.

    :param uptime: seconds since the start or the last activation; totals are since the start.
    :param received: images received; ``answered``: those with a result.
    :param rate_in: images received per second, recently; ``rate_out``: results per second.
    :param received_age: seconds since the last image, None = there was none; ``answered_age``
        alike.
    :param drops: images dropped, by cause; ``recent_drops``: the recent ones.
    :param statuses: results by status in lower case, as ``'no match'``; ``recent_statuses``:
        recent ones.
    :param status: of the last result, with its reason, place (-1 = none) and distance (NaN =
        none).
    :param nearest: smallest distance of all results, +inf = none had one.
    :param stages: recent times by stage.
    :param total: recent times of all stages together, None = no measurement; ``work``: without
        waiting.
    :param gaps: pauses in the stamps, the longest of ``longest_gap`` seconds.
    :param jumps_back: jumps back of the stamps, by at most ``longest_jump_back`` seconds.
    """

    uptime: float = 0.0
    received: int = 0
    answered: int = 0
    rate_in: float = 0.0
    rate_out: float = 0.0
    received_age: float | None = None
    answered_age: float | None = None
    drops: Mapping[str, int] = field(default_factory=dict)
    recent_drops: Mapping[str, int] = field(default_factory=dict)
    statuses: Mapping[str, int] = field(default_factory=dict)
    recent_statuses: Mapping[str, int] = field(default_factory=dict)
    status: str = ''
    reason: str = ''
    place: int = -1
    distance: float = math.nan
    nearest: float = math.inf
    stages: Mapping[str, StageTime] = field(default_factory=dict)
    total: StageTime | None = None
    work: StageTime | None = None
    gaps: int = 0
    longest_gap: float = 0.0
    jumps_back: int = 0
    longest_jump_back: float = 0.0


class _Recent(Generic[Value]):
    """Events of the last ``RECENT`` seconds, each with a value."""

    def __init__(self) -> None:
        self._events: deque[tuple[float, Value]] = deque()
        self._last: float | None = None

    def add(self, now: float, value: Value) -> None:
        self._events.append((now, value))
        self._last = now
        self._evict(now)

    def values(self, now: float) -> list[Value]:
        self._evict(now)
        return [value for _, value in self._events]

    def rate(self, now: float) -> float:
        """Return events per second, correct at the start and after a pause, and finite."""
        self._evict(now)
        if not self._events:
            return 0.0
        # the first event opens the span, so there is one period less than there are events
        span = max(now - self._events[0][0], SHORTEST_SPAN)
        return max((len(self._events) - 1) / span, len(self._events) / RECENT)

    def age(self, now: float) -> float | None:
        return None if self._last is None else now - self._last

    def _evict(self, now: float) -> None:
        while self._events and self._events[0][0] <= now - RECENT:
            self._events.popleft()


class Statistics:
    """
    ImageCounts events; every method may be called from any thread. Only recent events are kept.

    :param clock: returns seconds that never go back.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._counts = ImageCounts()
        self._drops: Counter[str] = Counter()
        self._statuses: Counter[str] = Counter()
        self.restart()

    def restart(self) -> None:
        """Begin another activation: totals stay, recent events and the last result are gone."""
        with self._lock:
            self._start = self._clock()
            self._count(status='', reason='', place=-1, distance=math.nan)
            self._received: _Recent[None] = _Recent()
            self._results: _Recent[tuple[str, Mapping[str, float]]] = _Recent()
            self._dropped: _Recent[tuple[str, int]] = _Recent()

    def received(self) -> None:
        """Count a received image."""
        with self._lock:
            self._received.add(self._clock(), None)
            self._count(received=self._counts.received + 1)

    def answered(
        self, status: str, reason: str, place: int, distance: float, stages: Mapping[str, float]
    ) -> None:
        """
        Count an image with a result.

        :param status: name of the status, as ``'NO_MATCH'`` or ``'no match'``.
        :param reason: why there is no match; empty if there is one.
        :param place: index of the recognized place, -1 = none.
        :param distance: of the nearest sequence, NaN = none.
        :param stages: seconds by stage, ``WAITING`` among them; empty = not measured.
        """
        status = status.lower().replace('_', ' ')
        with self._lock:
            self._results.add(self._clock(), (status, dict(stages)))
            self._statuses[status] += 1
            self._count(
                answered=self._counts.answered + 1,
                status=status,
                reason=reason,
                place=place,
                distance=distance,
                nearest=min(self._counts.nearest, distance),  # NaN is not less
            )

    def dropped(self, cause: str, count: int = 1) -> None:
        """Count images without a result, by cause: ``'queue full'``, ``'invalid: encoding'``."""
        with self._lock:
            self._dropped.add(self._clock(), (cause, count))
            self._drops[cause] += count

    def gap(self, seconds: float) -> None:
        """Count a pause in the stamps."""
        with self._lock:
            self._count(
                gaps=self._counts.gaps + 1, longest_gap=max(self._counts.longest_gap, seconds)
            )

    def jump_back(self, seconds: float) -> None:
        """Count a jump back of the stamps."""
        with self._lock:
            self._count(
                jumps_back=self._counts.jumps_back + 1,
                longest_jump_back=max(self._counts.longest_jump_back, seconds),
            )

    def counts(self) -> ImageCounts:
        """Return all counts; later events do not change them."""
        with self._lock:
            now = self._clock()
            results = self._results.values(now)
            measured = [stages for _, stages in results if stages]
            return replace(
                self._counts,
                uptime=now - self._start,
                rate_in=self._received.rate(now),
                rate_out=self._results.rate(now),
                received_age=self._received.age(now),
                answered_age=self._results.age(now),
                drops=dict(self._drops),
                recent_drops=_sum(self._dropped.values(now)),
                statuses=dict(self._statuses),
                recent_statuses=dict(Counter(status for status, _ in results)),
                stages=_by_stage(measured),
                total=_time(sum(stages.values()) for stages in measured),
                work=_time(sum(stages.values()) - stages.get(WAITING, 0.0) for stages in measured),
            )

    def _count(self, **changes: object) -> None:
        self._counts = replace(self._counts, **changes)  # type: ignore[arg-type]


class StampWatch:
    """
    Compares each stamp with the newest one; for one thread, while any may set ``gap``.

    :param gap: longer pauses are reported [s]; 0 = none is.
    """

    def __init__(self, gap: float) -> None:
        self.gap = gap
        self._newest = 0

    def see(self, stamp: int) -> float:
        """
        Take the next stamp; return the seconds of a gap, minus those of a jump back, 0 = neither.

        A jump back is an earlier stamp, as when a bag starts again. A reordered image does not
        move the newest stamp back: otherwise the image after it would seem to come after a gap.

        :param stamp: nanoseconds; 0 = unknown, ignored.
        """
        if stamp == 0:
            return 0.0
        newest, self._newest = self._newest, stamp
        if newest == 0:
            return 0.0
        ahead = (stamp - newest) / NANOSECONDS
        if ahead <= -REORDERING_SECONDS:
            return ahead
        if ahead < 0:
            self._newest = newest
        return ahead if 0 < self.gap < ahead else 0.0


def _sum(counted: Iterable[tuple[str, int]]) -> dict[str, int]:
    """Return the counts by word."""
    total: Counter[str] = Counter()
    for word, count in counted:
        total[word] += count
    return dict(total)


def _by_stage(measured: list[Mapping[str, float]]) -> dict[str, StageTime]:
    """Return the times of each stage, in the order of the stages."""
    names = dict.fromkeys(name for stages in measured for name in stages)
    times = {name: _time(stages[name] for stages in measured if name in stages) for name in names}
    return {name: time for name, time in times.items() if time is not None}


def _time(seconds: Iterable[float]) -> StageTime | None:
    values = list(seconds)
    return StageTime(1e3 * sum(values) / len(values), 1e3 * max(values)) if values else None
