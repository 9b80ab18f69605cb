# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checks the stamps of images for pauses and for clocks that jump back."""

from dataclasses import dataclass
from typing import Literal

NANOSECONDS = 1_000_000_000
REORDERING_SECONDS = 0.1
"""Images less than this out of order were reordered on the way, as on best-effort links."""


@dataclass(frozen=True)
class StampEvent:
    """
    An irregularity between two stamps.

    :param kind: ``'gap'``: a pause; ``'jump back'``: an earlier stamp, as when a bag starts again.
    :param seconds: length of the gap or of the jump; above 0.
    """

    kind: Literal['gap', 'jump back']
    seconds: float


class StampWatch:
    """
    Compares each stamp with the newest one; for one thread, while any may set ``gap``.

    :param gap: longer pauses are reported [s]; 0 = none is.
    """

    def __init__(self, gap: float) -> None:
        self.gap = gap
        self._newest = 0

    def see(self, stamp: int) -> StampEvent | None:
        """
        Take the next stamp and return its irregularity, if any.

        A reordered image does not move the newest stamp back: otherwise the image after it would
        seem to come after a gap.

        :param stamp: nanoseconds; 0 = unknown, ignored.
        """
        if stamp == 0:
            return None
        newest, self._newest = self._newest, stamp
        if newest == 0:
            return None
        ahead = (stamp - newest) / NANOSECONDS
        if ahead <= -REORDERING_SECONDS:
            return StampEvent('jump back', -ahead)
        if ahead < 0:
            self._newest = newest
        elif 0 < self.gap < ahead:
            return StampEvent('gap', ahead)
        return None
