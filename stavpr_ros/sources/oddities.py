# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Oddities of a stream: two sources in one, clocks that jump, numbers of another unit."""

from collections import Counter, deque
from collections.abc import Iterator, Sequence
from itertools import pairwise
from statistics import median
from typing import Any

import numpy as np
from stavpr_ros.units import SECOND

RECENT = 100  # messages that are compared
MIN_MESSAGES = 8
MIN_CHANGES = 4  # fewer changes of the source are a camera that was set up anew
MAX_REORDERING = SECOND // 2
HOUR, DAY = 3600 * SECOND, 86400 * SECOND
MAX_RATIO = 50  # speeds of two clocks; a replay may be faster
MAX_SPEED = 80.0  # m/s


def source_of(message: Any) -> str:
    """Return what differs between cameras on one topic: frame, and size of raw images."""
    size = f' {message.width}x{message.height}' if hasattr(message, 'width') else ''
    return f'{message.header.frame_id!r}{size}'


class StreamWatch:
    """The last images of one topic: adding is for one thread, the texts on them are for any."""

    def __init__(self) -> None:
        self._rows: deque[tuple[int, int, str]] = deque(maxlen=RECENT)

    def add(self, stamp: int, recorded: int, source: str) -> None:
        """Take an image, by its stamp, when it was recorded or arrived, ns, and its source."""
        self._rows.append((stamp, recorded, source))

    def oddities(self, has_epoch: bool = True) -> list[str]:
        """
        Return texts, none for an ordinary stream.

        :param has_epoch: whether the times of recording are of the clock of the stamps.
        """
        rows = list(self._rows)
        if len(rows) < MIN_MESSAGES:
            return []
        stamps, times, sources = zip(*rows, strict=True)
        texts, counts = [], Counter(sources)
        if len(counts) > 1 and sum(a != b for a, b in pairwise(sources)) >= MIN_CHANGES:
            names = ', '.join(f'{source} ({n})' for source, n in counts.most_common(4))
            texts.append(f'images of {len(counts)} sources alternate, {names}: a topic for each')
        return [*texts, *_clock_oddities(stamps, times, has_epoch)]


def _clock_oddities(stamps: Sequence[int], times: Sequence[int], has_epoch: bool) -> Iterator[str]:
    """Yield at most one text on stamps beside times of recording, both ns."""
    if not any(stamps):
        return  # unknown, and documented
    steps = [b - a for a, b in pairwise(stamps)]
    jumps = [step for step in steps if step < -MAX_REORDERING or step > HOUR]
    # of all, since images come in bursts, and of two, since cameras pause
    stamp_span, time_span = stamps[-1] - stamps[0], times[-1] - times[0]
    step, pause = median(steps), median(b - a for a, b in pairwise(times))
    differ = all(
        min(pair) * MAX_RATIO < max(pair) for pair in ((stamp_span, time_span), (step, pause))
    )
    ahead = median(stamp - time for stamp, time in zip(stamps, times, strict=True))
    remedy = 'correct the clock of the driver'
    if len(set(stamps)) == 1:
        yield f'all stamps are {stamps[0] / SECOND:.3f} s: {remedy}'
    elif jumps:
        largest = max(jumps, key=abs) / SECOND
        yield f'stamps jump {len(jumps)} times, by up to {largest:.1f} s: {remedy}'
    elif time_span > SECOND // 2 and differ:
        took = f'{stamp_span / SECOND:.4g} s in {time_span / SECOND:.4g} s'
        yield f'stamps advance by {took}, as of another unit: {remedy}'
    elif has_epoch and abs(ahead) > DAY and all(times):
        yield f'stamps are {ahead / DAY:.1f} days from the times of recording: {remedy}'


def speed_oddity(stamps: np.ndarray, poses: np.ndarray) -> str:
    """
    Return that odometry is too fast for meters and seconds, '' = it is not.

    :param stamps: nanoseconds, shape (n,), int64.
    :param poses: x y z first, shape (n, 3 or more).
    """
    if len(stamps) < MIN_MESSAGES:
        return ''
    seconds = np.diff(stamps) / SECOND
    moved = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1)
    moves = (seconds > 0) & (moved > 0)
    speed = np.median(moved[moves] / seconds[moves]) if moves.any() else 0
    text = f'odometry moves at {speed:.0f} m/s: expected meters, perhaps it has millimeters'
    return f'{text}; correct its publisher' if speed > MAX_SPEED else ''
