"""The project's targets: bounds for single rows, and whether a run reached them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from results import Row


@dataclass(frozen=True)
class Target:
    """
    One target.

    :param text: description, with the meaning of its value.
    :param device, stage, mode, n, d: the rows that decide it.
    :param value: the value of a row; None if the row does not have it.
    :param wanted: the bound.
    :param at_most: whether the bound is an upper one.
    :param precisions: of the rows that decide it.
    """

    text: str
    device: str
    stage: str
    mode: str
    n: int
    d: int
    value: Callable[[Row], float | None]
    wanted: float
    at_most: bool = True
    precisions: tuple[str, ...] = ('float32',)

    def results(self, rows: Sequence[Row]) -> list[dict[str, Any]]:
        """Return value, bound and outcome for each row that decides the target."""
        own = (self.device, self.stage, self.mode, self.n, self.d)
        found = []
        for row in rows:
            if (row.device, row.stage, row.mode, row.n, row.d) != own or row.precision not in self.precisions:
                continue
            value = self.value(row)
            if value is not None:
                reached = value <= self.wanted if self.at_most else value >= self.wanted
                bound = f'{"<=" if self.at_most else ">="} {self.wanted:g}'
                found.append(
                    {'target': self.text, 'value': value, 'wanted': bound, 'reached': reached}
                    | {'precision': row.precision}
                )
        return found


def seconds(row: Row) -> float:
    """Return the median."""
    return row.median_s


def over_bound(row: Row) -> float | None:
    """Return the median over the lower bound."""
    return row.ratio


def cell_rate(row: Row) -> float | None:
    """Return cell updates per second."""
    return row.extra.get('cells_per_s')


def speedup(peer: str) -> Callable[[Row], float | None]:
    """Return the peer's median over the row's."""
    return lambda row: next((time.ratio for time in row.peers if time.name == peer), None)


def over_product(row: Row) -> float | None:
    """Return the median over that of torch's float32 product."""
    ratio = speedup('torch float32')(row)
    return 1 / ratio if ratio else None


HALF = ('float16',)
TARGETS = (
    *(
        target
        for n in (20_000, 100_000)
        for target in (
            Target(
                f'LM-DTW, {n:,} starts: cells/s', 'cpu', 'lm_dtw', 'paper', n, 0, cell_rate, 2.5e9, False
            ),
            Target(
                f'LM-DTW, {n:,} starts: times plain prange',
                'cpu', 'lm_dtw', 'paper', n, 0, speedup('prange'), 8, False,
            ),
            Target(
                f'LM-DTW, {n:,} starts: times librosa',
                'cpu', 'lm_dtw', 'paper', n, 0, speedup('librosa'), 100, False,
            ),
        )
    ),
    *(
        Target(
            f'distance matrix 20 x {n:,}, 512-d: over the float32 product',
            'cpu', 'distance_matrix', '', n, 512, over_product, 1.25,
        )
        for n in (2_000, 20_000)
    ),
    Target(
        'frame, mode paper, 20,000 places, 512-d: over the lower bound',
        'cpu', 'frame', 'paper', 20_000, 512, over_bound, 1.5,
    ),
    Target(
        'frame, mode paper, 20,000 places, 512-d, half precision: over the float32 product',
        'cpu', 'frame', 'paper', 20_000, 512, over_product, 0.6, precisions=HALF,
    ),
    Target(
        'frame, mode paper, 100,000 places, 512-d, half precision: seconds',
        'cpu', 'frame', 'paper', 100_000, 512, seconds, 0.1, precisions=HALF,
    ),
    Target(
        'GPU: distance matrix 20 x 2,000, 512-d: seconds',
        'cuda', 'distance_matrix', '', 2_000, 512, seconds, 3e-4,
    ),
    Target('GPU: retrieval in 2,000 places: seconds', 'cuda', 'retrieval', 'paper', 2_000, 0, seconds, 1e-4),
    Target(
        'GPU: frame, mode paper, 1,000,000 places, 512-d, half precision: seconds',
        'cuda', 'frame', 'paper', 1_000_000, 512, seconds, 5e-3, precisions=HALF,
    ),
)  # fmt: skip


def evaluate(
    rows: Sequence[Row], device: str, targets: Sequence[Target] = TARGETS
) -> list[dict[str, Any]]:
    """Return all targets of a device with their outcome; those that no row decides without a value."""
    found = []
    for target in targets:
        if target.device == device:
            found += target.results(rows) or [{'target': target.text, 'value': None, 'reached': None}]
    return found
