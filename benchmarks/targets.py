# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The project's targets: bounds for values of single rows, and whether a run reached them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from results import READING, Row

CELLS, PRANGE, LIBROSA = 'cells per second', 'times plain prange', 'times librosa'
PRODUCT, BOUND = 'over the float32 product', 'over the lower bound'
READ = f'over {READING}, in turn'


def _times(peer: str) -> Callable[[Row], float | None]:
    return lambda row: next((time.ratio for time in row.peers if time.name == peer), None)


def _over(peer: str) -> Callable[[Row], float | None]:
    times = _times(peer)
    return lambda row: 1 / ratio if (ratio := times(row)) else None


def cells_per_s(row: Row) -> float | None:
    """Return the cell updates per second of a row that counts cells."""
    return row.extra['cells'] / row.median_s if 'cells' in row.extra else None


VALUES: dict[str, Callable[[Row], float | None]] = {
    CELLS: cells_per_s,
    PRANGE: _times('prange'),
    LIBROSA: _times('librosa'),
    PRODUCT: _over('torch float32'),
    READ: _over(READING),
    BOUND: lambda row: row.ratio,
    'seconds': lambda row: row.median_s,
}


@dataclass(frozen=True)
class Target:
    """
    One target; the fields before ``value`` name the row that decides it.

    :param value: a name of :data:`VALUES`.
    :param relation: ``<=`` or ``>=``.
    """

    device: str
    stage: str
    mode: str
    n: int
    d: int
    precision: str
    value: str
    relation: str
    wanted: float

    def found(self, rows: Sequence[Row]) -> float | None:
        """Return the value of the row that decides the target; None if it was not measured."""
        own = (self.stage, self.mode, self.n, self.d, self.precision)
        for row in rows:
            if (row.stage, row.mode, row.n, row.d, row.precision) == own:
                return VALUES[self.value](row)
        return None

    def reached(self, found: float) -> bool:
        """Return whether a value reaches the target."""
        return found <= self.wanted if self.relation == '<=' else found >= self.wanted


TARGETS = (
    Target('cpu', 'lm_dtw', 'paper', 20_000, 0, 'float32', CELLS, '>=', 2.5e9),
    Target('cpu', 'lm_dtw', 'paper', 20_000, 0, 'float32', PRANGE, '>=', 8),
    Target('cpu', 'lm_dtw', 'paper', 20_000, 0, 'float32', LIBROSA, '>=', 100),
    Target('cpu', 'lm_dtw', 'paper', 100_000, 0, 'float32', CELLS, '>=', 2.5e9),
    Target('cpu', 'lm_dtw', 'paper', 100_000, 0, 'float32', PRANGE, '>=', 8),
    Target('cpu', 'lm_dtw', 'paper', 100_000, 0, 'float32', LIBROSA, '>=', 100),
    Target('cpu', 'distance_matrix', '', 2_000, 512, 'float32', PRODUCT, '<=', 1.25),
    Target('cpu', 'distance_matrix', '', 20_000, 512, 'float32', PRODUCT, '<=', 1.25),
    Target('cpu', 'frame', 'robust', 20_000, 224, 'float32', READ, '<=', 1.5),
    Target('cpu', 'frame', 'robust', 20_000, 512, 'float32', READ, '<=', 1.5),
    Target('cpu', 'frame', 'robust', 100_000, 224, 'float32', READ, '<=', 1.5),
    Target('cpu', 'frame', 'paper', 20_000, 512, 'float32', BOUND, '<=', 1.5),
    Target('cpu', 'frame', 'paper', 20_000, 512, 'float16', PRODUCT, '<=', 0.6),
    Target('cpu', 'frame', 'paper', 100_000, 512, 'float16', 'seconds', '<=', 0.1),
    Target('cuda', 'distance_matrix', '', 2_000, 512, 'float32', 'seconds', '<=', 3e-4),
    Target('cuda', 'retrieval', 'paper', 2_000, 0, 'float32', 'seconds', '<=', 1e-4),
    Target('cuda', 'frame', 'paper', 1_000_000, 512, 'float16', 'seconds', '<=', 5e-3),
)
