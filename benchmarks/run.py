# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One run: measurements are collected, and get their lower bounds once the peaks are known."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
import sys
from typing import Any

from lower_bounds import bound_seconds, Peaks, Work
from results import PeerTime, Row, Skipped
from timing import Job, measure, synchronizer, timed
from tqdm import tqdm


@dataclass(frozen=True)
class Peer:
    """
    A program or product that a stage is compared with.

    :param job: returns the seconds for the whole stage, a sample's scaled.
    :param note, partial: see :class:`results.PeerTime`.
    """

    name: str
    job: Job
    note: str = ''
    partial: bool = False


@dataclass
class Run:
    """
    Measures and collects.

    :param device: ``cpu`` or ``cuda``.
    :param seconds: duration of the measurement of one stage and its peers.
    :param rows: as measured so far, without lower bounds, and their work.
    """

    device: str
    seconds: float = 0.5
    rows: list[tuple[Row, Sequence[Work]]] = field(default_factory=list)
    skipped: list[Skipped] = field(default_factory=list)

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
        extra: Mapping[str, Any] | None = None,
    ) -> None:
        """
        Measure a stage, interleaved with its peers.

        :param size: places n, dimensions d (0 for a stage that reads no features).
        :param works: for its lower bound.
        """
        n, d = size
        self._bar.set_description(f'{stage} {mode} n={n:,} d={d} {precision}')
        jobs = {'': timed(call, synchronizer(self.device))} | {p.name: p.job for p in peers}
        timings = measure(jobs, self.seconds)
        own = timings['']
        times = tuple(
            PeerTime(p.name, t.median_s, t.spread_s, t.median_s / own.median_s, p.note, p.partial)
            for p, t in ((peer, timings[peer.name]) for peer in peers)
        )
        row = Row(stage, mode, n, d, precision, own.median_s, own.spread_s, own.runs)
        self.rows.append((replace(row, peers=times, extra=dict(extra or {})), works))
        self._bar.update()

    def skip(self, name: str, n: int, d: int, reason: str) -> None:
        """Record once that a stage or peer is left out, and print why; n = d = 0 for all sizes."""
        skipped = Skipped(name, n, d, reason)
        if skipped not in self.skipped:
            size = f', n = {n:,}, d = {d}' if n else ''
            self._bar.write(f'left out: {name}{size}: {reason}', file=sys.stderr)
            self.skipped.append(skipped)

    def finish(self, peaks: Peaks) -> tuple[list[Row], Peaks]:
        """Return the rows with their lower bounds, and the peaks as raised by stages."""
        self._bar.close()
        for row, works in self.rows:
            if row.stage in ('image_distances', 'distance_matrix'):
                # product and alignment are one pass
                whole = replace(works[0], operations=sum(work.operations for work in works))
                peaks = peaks.raised(whole, row.median_s, f'{row.stage}, n = {row.n:,}')
        bounds = [bound_seconds(works, peaks) for _, works in self.rows]
        rows = [row for row, _ in self.rows]
        return [replace(row, lower_bound_s=b) for row, b in zip(rows, bounds, strict=True)], peaks
