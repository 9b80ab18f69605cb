"""What the node counts: images, answers, drops, and how long each stage took."""

import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

RATE_WINDOW = 10
"""Seconds behind 'recent': the running one and those before it, so 9 to 10 of them."""

SHORTEST_SPAN = 0.5
"""Seconds that a rate is taken over at least: two images in a burst are no thousand a second."""

MOST_WORDS = 64
"""Causes, statuses, stages told apart, each; what comes beyond is counted together, as ``OTHER``."""

OTHER = 'other'
WAITING = 'waiting'
"""The stage in which nothing is done: it counts for the total, but not as work."""


@dataclass(frozen=True)
class StageTime:
    """Mean and maximum over the recent answers [ms]."""

    mean: float
    max: float


@dataclass(frozen=True)
class Snapshot:
    """
    All counts at one moment. 'Recent' is the last ``RATE_WINDOW`` seconds.

    :param uptime: seconds since the start or the last reset.
    :param received: images received since then.
    :param answered: images answered since then.
    :param rate_in: images received per second, recently.
    :param rate_out: images answered per second, recently.
    :param received_age: seconds since the last image; None = there was none.
    :param answered_age: seconds since the last answer; None = there was none.
    :param drops: images dropped, by cause.
    :param recent_drops: the recent ones of them.
    :param statuses: answers by status, in small words: ``'no match'``.
    :param recent_statuses: the recent ones of them.
    :param status: of the last answer, with its reason, place (-1 = none) and distance.
    :param stages: recent times by stage.
    :param total: recent times of all stages together; None = nothing was measured recently.
    :param work: the same without waiting.
    :param gaps: pauses in the stamps, the longest of them ``longest_gap`` seconds.
    :param jumps_back: how often the stamps jumped back, at most ``longest_jump_back`` seconds.
    """

    uptime: float
    received: int
    answered: int
    rate_in: float
    rate_out: float
    received_age: float | None
    answered_age: float | None
    drops: Mapping[str, int]
    recent_drops: Mapping[str, int]
    statuses: Mapping[str, int]
    recent_statuses: Mapping[str, int]
    status: str
    reason: str
    place: int
    distance: float
    stages: Mapping[str, StageTime]
    total: StageTime | None
    work: StageTime | None
    gaps: int
    longest_gap: float
    jumps_back: int
    longest_jump_back: float


@dataclass
class _Times:
    """Seconds: how many times were measured, their sum and their maximum."""

    count: int = 0
    sum: float = 0.0
    max: float = 0.0

    def add(self, seconds: float) -> None:
        self.count += 1
        self.sum += seconds
        self.max = max(self.max, seconds)

    @staticmethod
    def together(parts: Iterable['_Times']) -> StageTime | None:
        measured = [times for times in parts if times.count]
        if not measured:
            return None
        mean = sum(times.sum for times in measured) / sum(times.count for times in measured)
        return StageTime(1e3 * mean, 1e3 * max(times.max for times in measured))


@dataclass
class _Bucket:
    """What happened in one second."""

    second: int
    received: int = 0
    answered: int = 0
    drops: Counter[str] = field(default_factory=Counter)
    statuses: Counter[str] = field(default_factory=Counter)
    stages: dict[str, _Times] = field(default_factory=dict)
    total: _Times = field(default_factory=_Times)
    work: _Times = field(default_factory=_Times)


@dataclass
class _Flow:
    """One kind of event; ``began`` is the first one after a pause of a whole window, or of all."""

    count: int = 0
    began: float = 0.0
    last: float | None = None

    def add(self, now: float) -> None:
        if self.last is None or now - self.last >= RATE_WINDOW:
            self.began = now
        self.count += 1
        self.last = now

    def rate(self, now: float, recent: int) -> float:
        """Return events per second, neither low at first nor after a pause, nor infinite ever."""
        opens = math.floor(now) - RATE_WINDOW + 1
        if self.began < opens:
            return recent / (now - opens)
        # The window opens with an event, so there is one period less than there are events.
        since_began = (recent - 1) / max(now - self.began, SHORTEST_SPAN)
        return max(since_began, recent / RATE_WINDOW)

    def age(self, now: float) -> float | None:
        return None if self.last is None else now - self.last


class Statistics:
    """
    Counts; every method may be called from any thread. Its memory does not grow with the rate or time.

    :param clock: seconds that never go back.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self.reset()

    def reset(self) -> None:
        """Forget everything and begin anew."""
        with self._lock:
            self._start = self._clock()
            self._in, self._out = _Flow(), _Flow()
            self._buckets: deque[_Bucket] = deque(maxlen=RATE_WINDOW)
            self._drops: Counter[str] = Counter()
            self._statuses: Counter[str] = Counter()
            self._stages: Counter[str] = Counter()
            self._last = ('', '', -1, math.nan)
            self._gaps, self._jumps_back = _Times(), _Times()

    def received(self) -> None:
        """Count an image that came."""
        with self._lock:
            now = self._clock()
            self._in.add(now)
            self._bucket(now).received += 1

    def answered(
        self, status: str, reason: str, place: int, distance: float, stages: Mapping[str, float]
    ) -> None:
        """
        Count an image that was worked on.

        :param status: in words or the message's constant, which is the same: no match, NO_MATCH.
        :param reason: why there is no match; empty if there is one.
        :param place: index of the recognized place, -1 = none.
        :param distance: of the nearest sequence, NaN = none.
        :param stages: seconds by stage, ``WAITING`` among them; empty = not measured.
        """
        status = status.lower().replace('_', ' ')
        total = sum(stages.values())
        with self._lock:
            now = self._clock()
            self._out.add(now)
            bucket = self._bucket(now)
            bucket.answered += 1
            _count(status, 1, self._statuses, bucket.statuses)
            self._last = (status, reason, place, distance)
            if stages:
                bucket.total.add(total)
                bucket.work.add(total - stages.get(WAITING, 0.0))
            for stage, seconds in stages.items():
                name = _count(stage, 1, self._stages)
                bucket.stages.setdefault(name, _Times()).add(seconds)

    def dropped(self, cause: str, count: int = 1) -> None:
        """Count images that are not matched, and why: ``'queue full'``, ``'invalid: encoding'``."""
        with self._lock:
            _count(cause, count, self._drops, self._bucket(self._clock()).drops)

    def gap(self, seconds: float) -> None:
        """Count a pause in the stamps."""
        with self._lock:
            self._gaps.add(seconds)

    def jump_back(self, seconds: float) -> None:
        """Count a jump of the stamps, so many seconds back."""
        with self._lock:
            self._jumps_back.add(seconds)

    def snapshot(self) -> Snapshot:
        """Return all counts; later events do not change it."""
        with self._lock:
            now = self._clock()
            oldest = math.floor(now) - RATE_WINDOW
            recent = [bucket for bucket in self._buckets if bucket.second > oldest]
            status, reason, place, distance = self._last
            return Snapshot(
                uptime=now - self._start,
                received=self._in.count,
                answered=self._out.count,
                rate_in=self._in.rate(now, sum(bucket.received for bucket in recent)),
                rate_out=self._out.rate(now, sum(bucket.answered for bucket in recent)),
                received_age=self._in.age(now),
                answered_age=self._out.age(now),
                drops=dict(self._drops),
                recent_drops=_sum(bucket.drops for bucket in recent),
                statuses=dict(self._statuses),
                recent_statuses=_sum(bucket.statuses for bucket in recent),
                status=status,
                reason=reason,
                place=place,
                distance=distance,
                stages=_stage_times(recent),
                total=_Times.together(bucket.total for bucket in recent),
                work=_Times.together(bucket.work for bucket in recent),
                gaps=self._gaps.count,
                longest_gap=self._gaps.max,
                jumps_back=self._jumps_back.count,
                longest_jump_back=self._jumps_back.max,
            )

    def _bucket(self, now: float) -> _Bucket:
        """Return the bucket of the running second; a new one pushes out the oldest."""
        second = math.floor(now)
        if not self._buckets or self._buckets[-1].second != second:
            self._buckets.append(_Bucket(second))
        return self._buckets[-1]


def _count(word: str, count: int, ever: Counter[str], *more: Counter[str]) -> str:
    """
    Count a word and return the name under which it is counted.

    Free words must not fill the memory, so late ones share a name. Kinds, ``'invalid: encoding'``, share
    theirs sooner and keep what is before the colon: they must not crowd out ``'queue full'``.
    """
    if word not in ever and ':' in word and len(ever) >= MOST_WORDS // 2:
        word = f'{word.partition(":")[0]}: {OTHER}'
    if word not in ever and len(ever) >= MOST_WORDS:
        word = OTHER
    for counter in (ever, *more):
        counter[word] += count
    return word


def _sum(counters: Iterable[Counter[str]]) -> dict[str, int]:
    """Add up counts by word."""
    total: Counter[str] = Counter()
    for counter in counters:
        total.update(counter)
    return dict(total)


def _stage_times(buckets: list[_Bucket]) -> dict[str, StageTime]:
    """Put the times of several seconds together, by stage, in the order of the stages."""
    names = dict.fromkeys(name for bucket in buckets for name in bucket.stages)
    times = {name: _Times.together(b.stages[name] for b in buckets if name in b.stages) for name in names}
    return {name: time for name, time in times.items() if time is not None}
