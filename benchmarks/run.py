"""One run: what is measured is collected here, and gets its floors when the ceilings are known."""

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

from floors import STAGES, Ceilings, Part, Sizes, floor_seconds
from records import Record
from timing import Job, Timing, events_seconds, measure, synchronizer, timed
from tqdm import tqdm

PRODUCTS = ('product', 'image_distances', 'distance_matrix')  # their first part is a product with the map


@dataclass(frozen=True)
class Peer:
    """
    With whom a stage is compared.

    :param name: as it stands in the record.
    :param job: returns the seconds for the whole stage, a sample's scaled.
    :param extra: what to say of it: ``peer_note``, ``peer_sample``, ...
    """

    name: str
    job: Job
    extra: Mapping[str, Any] = field(default_factory=dict)


class Run:
    """
    Measures and collects.

    :param device: ``cpu`` or ``cuda``.
    :param seconds: how long to measure one stage and its peers.
    :param steps: how many stages are announced, for the progress bar; None for no bar.
    """

    def __init__(self, device: str, seconds: float = 0.5, steps: int | None = None) -> None:
        self.device = device
        self.seconds = seconds
        self._records: list[tuple[Record, Sequence[Part]]] = []
        self._bar = tqdm(total=steps, disable=steps is None, unit='stage', file=sys.stderr)

    def say(self, text: str) -> None:
        """Print a line without disturbing the progress bar."""
        self._bar.write(text, file=sys.stderr)

    def close(self) -> None:
        """End the progress bar."""
        self._bar.close()

    def measure(
        self,
        name: str,
        sizes: Sizes,
        dtype: str,
        call: Callable[[], Any],
        peers: Sequence[Peer] = (),
        dim: int | None = None,
        **extra: Any,
    ) -> Timing:
        """
        Measure a stage, interleaved with its peers: one record, and one more for each peer.

        :param name: a stage of :data:`floors.STAGES`.
        :param call: ours.
        :param dim: 0 for a stage that sees no features; ``sizes.d`` by default.
        :param extra: more to say in the record; a function is called with the median.
        """
        dim = sizes.d if dim is None else dim
        self._bar.set_description(f'{name} n={sizes.n:,} d={dim} {dtype}')
        jobs = {'': timed(call, synchronizer(self.device))} | {peer.name: peer.job for peer in peers}
        timings = measure(jobs, self.seconds)
        own = timings['']
        if self.device == 'cuda':
            extra['events_s'] = events_seconds(call)
        said = {key: value(own.median_s) if callable(value) else value for key, value in extra.items()}
        base = Record(
            name, sizes.n, dim, dtype, self.device, own.median_s, own.spread_s, own.runs, extra=said
        )
        parts = STAGES[name](sizes, dtype)
        self._records.append((base, parts))
        for peer in peers:
            timing = timings[peer.name]
            record = replace(
                base,
                peer=peer.name,
                peer_median_s=timing.median_s,
                peer_spread_s=timing.spread_s,
                extra=said | dict(peer.extra),
            )
            self._records.append((record, parts))
        self._bar.update()
        return own

    def skip(self, name: str, n: int, dim: int, dtype: str, reason: str, peer: str | None = None) -> None:
        """Record that something was not measured, and print why."""
        self.say(f'skipped: {name}, n = {n:,}, d = {dim}, {dtype}{f", {peer}" if peer else ""}: {reason}')
        self._records.append((Record(name, n, dim, dtype, self.device, peer=peer, skipped=reason), ()))

    @contextmanager
    def otherwise_skip(self, name: str, n: int, dim: int, dtype: str) -> Iterator[None]:
        """Skip what runs out of memory after all."""
        import torch

        try:
            yield
        except (MemoryError, torch.cuda.OutOfMemoryError) as error:
            self.skip(name, n, dim, dtype, f'out of memory: {str(error).splitlines()[0]}')

    def finished(self, ceilings: Ceilings) -> list[Record]:
        """Return the records with their floors, those of the ceilings first; a stage may raise a ceiling."""
        for record, parts in self._records:
            if parts and record.median_s and record.name in PRODUCTS:
                done = replace(parts[0], operations=sum(part.operations for part in parts))
                ceilings = ceilings.raised(done, record.median_s, f'{record.name}, n = {record.n:,}')
        return ceiling_records(ceilings, self.device) + [
            replace(record, floor_s=floor_seconds(parts, ceilings) if parts else None)
            for record, parts in self._records
        ]


def ceiling_records(ceilings: Ceilings, device: str) -> list[Record]:
    """Return what the machine can do, as records without times."""
    read = ceilings.sources.get('read', 'read')
    values = {'read_bandwidth': ('float32', {'bytes_per_s': ceilings.read_bytes_per_s, 'source': read})}
    if ceilings.read_one_core_bytes_per_s:
        value = {'bytes_per_s': ceilings.read_one_core_bytes_per_s, 'source': 'read'}
        values['read_bandwidth_one_core'] = ('float32', value)
    for dtype, peak in ceilings.operations_per_s.items():
        source = ceilings.sources.get(dtype, 'large matrix product')
        values[f'matrix_peak_{dtype}'] = (dtype, {'operations_per_s': peak, 'source': source})
    return [
        Record(f'ceiling_{name}', 0, 0, dtype, device, extra=extra) for name, (dtype, extra) in values.items()
    ]
