"""Watches the stamps of images: pauses between them, and clocks that jump back."""

import math
from dataclasses import dataclass
from typing import Literal

from stavpr_ros.errors import SettingsError

NANOSECONDS = 1_000_000_000
REORDERING_SECONDS = 0.1
"""Images less than this out of order only overtook each other, as they do on best-effort links."""


@dataclass(frozen=True)
class StampEvent:
    """
    Something unusual between two stamps.

    :param kind: ``'gap'``: the stream paused; ``'jump back'``: the clock did, as when a bag starts anew.
    :param seconds: length of the gap, or how far back; above 0.
    """

    kind: Literal['gap', 'jump back']
    seconds: float


class StampWatch:
    """
    Compares each stamp with the newest so far. One thread sees stamps; any may change ``gap``.

    :param gap: pauses longer than this are reported [s]; 0 = none is.
    :raises SettingsError: a negative gap, or NaN.
    """

    def __init__(self, gap: float) -> None:
        self.gap = gap
        self._newest = 0

    @property
    def gap(self) -> float:
        """Pauses longer than this are reported [s]; 0 = none is. Setting it forgets no stamp."""
        return self._gap

    @gap.setter
    def gap(self, gap: float) -> None:
        if math.isnan(gap) or gap < 0:
            raise SettingsError(f'the longest pause is {gap:g} s: expected seconds above 0, or 0 = any')
        self._gap = gap

    def see(self, stamp: int) -> StampEvent | None:
        """
        Take the next stamp; tell what is unusual about it.

        A reordered image is no event and does not move the newest stamp back: otherwise the image
        after it would seem to come after a gap that is none.

        :param stamp: nanoseconds; 0 = unknown, which is ignored.
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
        elif 0 < self._gap < ahead:
            return StampEvent('gap', ahead)
        return None

    def reset(self) -> None:
        """Forget the newest stamp: the next one is compared with nothing."""
        self._newest = 0
