# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One run: measurements are collected, each with its lower bound and its peers."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
import sys
from typing import Any

from lower_bounds import bound_seconds, Peaks, Work
from results import Row
from timing import Job, measure, timed_job
from tqdm import tqdm


@dataclass(frozen=True)
class Peer:
    """
    A program or product that a stage is compared with.

    :param job: returns the seconds for the whole stage, a sample's scaled.
    :param note: conditions of the comparison.
    :param partial: the peer does only a part of the stage's work.
    """

    name: str
    job: Job
    note: str = ''
    partial: bool = False


@dataclass
class Run:
    """
    Measures and collects.

    :param seconds: duration of the measurement of one stage and its peers.
    :param skipped: stages and peers that are left out: name, n, d, reason.
    """

    peaks: Peaks
    seconds: float = 0.5
    rows: list[Row] = field(default_factory=list)
    skipped: list[dict[str, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._bar = tqdm(unit='stage', file=sys.stderr, disable=None)

    def measure(
        self,
        stage: str,
        size: tuple[int, int],
        call: Callable[[], Any],
        works: Sequence[Work],
        peers: Sequence[Peer] = (),
        precision: str = 'float32',
        mode: str = '',
        cells: int = 0,
    ) -> None:
        """
        Measure a stage, interleaved with its peers.

        :param size: places n, dimensions d (0 for a stage that reads no features).
        :param works: for its lower bound.
        :param cells: cells of a recursion that it updates.
        """
        self._bar.set_description(f'{stage} {mode} n={size[0]:,} d={size[1]} {precision}')
        jobs = {'': timed_job(call)} | {peer.name: peer.job for peer in peers}
        timings = measure(jobs, self.seconds)
        own = timings['']
        times = tuple(
            {
                'name': peer.name,
                'median_s': timings[peer.name].median_s,
                'spread_s': timings[peer.name].spread_s,
                'ratio': timings[peer.name].median_s / own.median_s,
                'note': peer.note,
                'partial': peer.partial,
            }
            for peer in peers
        )
        bound, extra = bound_seconds(works, self.peaks), {'cells': cells} if cells else {}
        summary = own.median_s, own.spread_s, own.runs, bound, times, extra
        self.rows.append(Row(stage, mode, size[0], size[1], precision, *summary))
        self._bar.update()

    def skip(self, name: str, n: int, d: int, reason: str) -> None:
        """Record once that a stage or peer is left out, and print why; n = d = 0 for all sizes."""
        skipped = {'name': name, 'n': n, 'd': d, 'reason': reason}
        if skipped not in self.skipped:
            size = f', n = {n:,}, d = {d}' if n else ''
            self._bar.write(f'left out: {name}{size}: {reason}', file=sys.stderr)
            self.skipped.append(skipped)
