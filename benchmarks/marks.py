"""The project's marks: what is wanted of which figure, and whether a run reached it."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from records import Record

Value = Callable[[Record], float | None]
MEASURED = math.inf  # a bound that every figure keeps: what is wanted is that there is one


def _rate(record: Record) -> float | None:
    return record.extra.get('cells_per_s')


def _speedup(record: Record) -> float | None:
    return record.speedup


def _of_peer(record: Record) -> float | None:
    return 1 / record.speedup if record.speedup else None


def _of_floor(record: Record) -> float | None:
    return record.ratio_to_floor


def _seconds(record: Record) -> float | None:
    return record.median_s


@dataclass(frozen=True)
class Mark:
    """
    One mark.

    :param text: in words, with what its numbers are.
    :param device, name, n, dim, peer: which records decide it; peer None = those without one.
    :param value: the figure of a record.
    :param wanted: the bound; ``at_most`` says on which side.
    :param where: the values that other fields of a record may have: dtype, xi, data.
    """

    text: str
    device: str
    name: str
    n: int
    value: Value
    wanted: float
    at_most: bool = True
    peer: str | None = None
    dim: int = 512
    where: dict[str, tuple[Any, ...]] = field(default_factory=dict)

    def decided_by(self, record: Record) -> bool:
        """Whether the record is one that the mark speaks of, and has a figure."""
        mine = (record.device, record.name, record.n, record.dim, record.peer)
        fields = {'dtype': record.dtype} | record.extra
        return (
            mine == (self.device, self.name, self.n, self.dim, self.peer)
            and all(fields.get(name) in values for name, values in self.where.items())
            and self.value(record) is not None
        )

    def judge(self, record: Record) -> dict[str, Any]:
        """Return mark, value, wanted, reached."""
        value = self.value(record)
        assert value is not None
        reached = value <= self.wanted if self.at_most else value >= self.wanted
        bound = 'measured' if self.wanted == MEASURED else f'{"<=" if self.at_most else ">="} {self.wanted:g}'
        return {'mark': self.text, 'value': value, 'wanted': bound, 'reached': reached}


FLOAT, HALF = {'dtype': ('float32',)}, {'dtype': ('float16', 'bfloat16')}


def _sequence_marks(n: int) -> tuple[Mark, ...]:
    of = partial(Mark, device='cpu', name='lm_dtw', n=n, dim=0, at_most=False)
    text = f'(a) LM-DTW, {n:,} starts'
    return (
        of(f'{text}: cell updates a second', value=_rate, wanted=2.5e9),
        of(f'{text}: times the plain prange', value=_speedup, wanted=8, peer='prange'),
        of(f'{text}: times librosa', value=_speedup, wanted=100, peer='librosa'),
    )


def _matrix_mark(n: int) -> Mark:
    text = f'(b) distance matrix 20 x {n:,}, 512-d: over the bare float32 product'
    return Mark(text, 'cpu', 'distance_matrix', n, _of_peer, 1.25, peer='torch_float32', where=FLOAT)


_frame = partial(Mark, device='cpu', name='online_frame')
MARKS = (
    *_sequence_marks(20_000),
    *_sequence_marks(100_000),
    _matrix_mark(2_000),
    _matrix_mark(20_000),
    _frame(
        '(c) frame, 20,000 places, 512-d: over the floor',
        n=20_000,
        value=_of_floor,
        wanted=1.5,
        where=FLOAT,
    ),
    _frame(
        '(c) frame, 20,000 places, 512-d, half width: over the bare float32 product',
        n=20_000,
        value=_of_peer,
        wanted=0.6,
        peer='torch_float32',
        where=HALF,
    ),
    _frame(
        '(d) frame, 100,000 places, 512-d, half width: seconds',
        n=100_000,
        value=_seconds,
        wanted=0.1,
        where=HALF,
    ),
    _frame(
        '(e) frame, 20,000 places, raw 10,416-d: seconds',
        n=20_000,
        value=_seconds,
        wanted=MEASURED,
        dim=10_416,
        where=FLOAT,
    ),
    Mark(
        'GPU: distance matrix 20 x 2,000, 512-d, xi = 3: seconds',
        'cuda',
        'distance_matrix',
        2_000,
        _seconds,
        3e-4,
        where={'xi': (3,)},
    ),
    Mark('GPU: retrieval in 2,000 places: seconds', 'cuda', 'retrieval', 2_000, _seconds, 1e-4, dim=0),
    Mark(
        'GPU: frame, 1,000,000 places, 512-d, half width: seconds',
        'cuda',
        'online_frame',
        1_000_000,
        _seconds,
        5e-3,
        where=HALF,
    ),
)


def with_marks(records: Iterable[Record], marks: Sequence[Mark] = MARKS) -> list[Record]:
    """Return the records with the marks that each decides."""
    return [
        replace(record, marks=tuple(mark.judge(record) for mark in marks if mark.decided_by(record)))
        for record in records
    ]


def undecided(records: Sequence[Record], device: str, marks: Sequence[Mark] = MARKS) -> list[str]:
    """Return the marks of a device that no record decides."""
    return [
        mark.text
        for mark in marks
        if mark.device == device and not any(mark.decided_by(record) for record in records)
    ]
