# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is odd about a stream: two sources in one, clocks that jump, numbers of another unit."""

from collections import Counter, deque
from collections.abc import Sequence
from itertools import pairwise
from statistics import median
from typing import Any

import numpy as np
from stavpr_ros.units import SECOND

RECENT = 100  # messages that are compared
MIN_MESSAGES = 8
MIN_CHANGES = 4  # of the source: fewer are a camera that was set up anew
MAX_REORDERING = SECOND // 2
HOUR, DAY = 3600 * SECOND, 86400 * SECOND
MAX_RATIO = 50  # of two clocks; a replay may be faster
MAX_SPEED = 80.0  # m/s


def source_of(message: Any) -> str:
    """Return what differs between cameras on one topic: frame, and size of raw images."""
    size = f' {message.width}x{message.height}' if hasattr(message, 'width') else ''
    return f'{message.header.frame_id!r}{size}'


class StreamWatch:
    """
    The last images of one topic; their texts name what came and what to do.

    Adding is for one thread, the texts are for any.
    """

    def __init__(self) -> None:
        self._rows: deque[tuple[int, int, str]] = deque(maxlen=RECENT)

    def add(self, stamp: int, recorded: int, source: str) -> None:
        """
        Take an image.

        :param stamp: of the header, nanoseconds.
        :param recorded: when it was recorded or arrived, nanoseconds of any clock.
        :param source: see :func:`source_of`.
        """
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
        if text := _clock_oddity(stamps, times, has_epoch):
            texts.append(text)
        return texts


def _clock_oddity(stamps: Sequence[int], times: Sequence[int], has_epoch: bool) -> str:
    """Return what is odd about stamps beside times of recording, '' = nothing; both ns."""
    remedy = 'correct the clock of the driver'
    if not any(stamps):
        return ''  # unknown, and documented
    if len(set(stamps)) == 1:
        return f'all stamps are {stamps[0] / SECOND:.3f} s: {remedy}'
    steps = [b - a for a, b in pairwise(stamps)]
    jumps = [step for step in steps if step < -MAX_REORDERING or step > HOUR]
    if jumps:
        largest = max(jumps, key=abs) / SECOND
        return f'stamps jump {len(jumps)} times, by up to {largest:.1f} s: {remedy}'
    # of all, since images come in bursts, and of two, since cameras pause
    stamped, passed = stamps[-1] - stamps[0], times[-1] - times[0]
    step, pause = median(steps), median(b - a for a, b in pairwise(times))
    slow = stamped * MAX_RATIO < passed and step * MAX_RATIO < pause
    fast = stamped > passed * MAX_RATIO and step > pause * MAX_RATIO
    if passed > SECOND // 2 and (slow or fast):
        took = f'{stamped / SECOND:.4g} s in {passed / SECOND:.4g} s'
        return f'stamps advance by {took}, as of another unit: {remedy}'
    apart = median(stamp - time for stamp, time in zip(stamps, times, strict=True))
    if has_epoch and abs(apart) > DAY and all(times):
        return f'stamps are {apart / DAY:.1f} days from the times of recording: {remedy}'
    return ''


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
    speeds = moved[(seconds > 0) & (moved > 0)] / seconds[(seconds > 0) & (moved > 0)]
    if not len(speeds) or not np.median(speeds) > MAX_SPEED:
        return ''
    return (
        f'odometry moves at {np.median(speeds):.0f} m/s: expected meters, perhaps it has '
        'millimeters; correct its publisher'
    )
