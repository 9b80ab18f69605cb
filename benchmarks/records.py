"""The records of a run: their fields, the machine that they were made on, their file."""

import datetime
import importlib.metadata
import json
import os
import platform
import re
import subprocess
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ('numpy', 'torch', 'numba', 'numba-cuda')
REQUIRED = ('name', 'n', 'dim', 'dtype', 'device', 'median_s', 'spread_s', 'floor_s', 'ratio_to_floor')
COMPARISON = ('peer', 'peer_median_s', 'speedup')


@dataclass(frozen=True)
class Record:
    """
    One figure. Where something was not measured, it is None, and ``skipped`` says why.

    :param name: the stage, see benchmarks/README.md.
    :param n: places.
    :param dim: dimensions of a local feature; 0 for stages that see none.
    :param dtype: of the map, or of the arithmetic where there is no map.
    :param device: ``cpu`` or ``cuda``.
    :param median_s, spread_s: median and interquartile range, seconds.
    :param runs: how many runs they are made of.
    :param floor_s: seconds below which the stage cannot be done on this machine.
    :param peer: with whom it is compared, in the same, interleaved run.
    :param peer_median_s, peer_spread_s: the peer's, scaled to n where it did a sample.
    :param extra: what else there is to say of this stage, by name.
    :param marks: the project's marks that this record decides: mark, value, wanted, reached.
    :param skipped: why there is no figure.
    """

    name: str
    n: int
    dim: int
    dtype: str
    device: str
    median_s: float | None = None
    spread_s: float | None = None
    runs: int = 0
    floor_s: float | None = None
    peer: str | None = None
    peer_median_s: float | None = None
    peer_spread_s: float | None = None
    extra: dict[str, Any] = field(default_factory=dict)
    marks: tuple[dict[str, Any], ...] = ()
    skipped: str | None = None

    @property
    def ratio_to_floor(self) -> float | None:
        """The median over the floor."""
        return self.median_s / self.floor_s if self.median_s and self.floor_s else None

    @property
    def speedup(self) -> float | None:
        """The peer's median over ours: below 1 the peer wins."""
        return self.peer_median_s / self.median_s if self.median_s and self.peer_median_s else None

    def to_json(self) -> dict[str, Any]:
        """Return the fields: all required ones, a comparison's where there is a peer, ``extra`` in line."""
        fields = asdict(self) | {'ratio_to_floor': self.ratio_to_floor, 'speedup': self.speedup}
        extra = fields.pop('extra')
        names = REQUIRED + (COMPARISON if self.peer else ())
        kept = {name: fields.pop(name) for name in names}
        kept |= {name: value for name, value in fields.items() if value not in (None, (), 0)}
        clash = kept.keys() & extra.keys()
        if clash:
            raise ValueError(f'extra fields {sorted(clash)} of {self.name} are fields of every record')
        return kept | extra

    @classmethod
    def from_json(cls, fields: dict[str, Any]) -> 'Record':
        """Return the record of such fields; what is unknown becomes ``extra``."""
        missing = [name for name in REQUIRED if name not in fields]
        if missing:
            raise ValueError(f'record {fields.get("name")!r} lacks {", ".join(missing)}')
        known = {name for name in cls.__dataclass_fields__ if name != 'extra'}
        derived = {'ratio_to_floor', 'speedup'}
        own = {name: value for name, value in fields.items() if name in known}
        own['marks'] = tuple(own.get('marks', ()))
        extra = {name: value for name, value in fields.items() if name not in known | derived}
        return cls(**own, extra=extra)


def _output(*command: str) -> str:
    try:
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ''


def commit() -> str:
    """Return the commit that is checked out, ``+`` behind it if files were changed; or ``unknown``."""
    short = _output('git', 'rev-parse', '--short', 'HEAD')
    # results are what this very command writes: they change nothing that is measured
    changed = _output('git', 'status', '--porcelain', '--', '.', ':!benchmarks/results')
    return short + ('+' if changed else '') if short else 'unknown'


def cpu_model() -> str:
    """Return the processor's name."""
    try:
        text = Path('/proc/cpuinfo').read_text()
    except OSError:
        return platform.processor() or platform.machine()
    found = re.search(r'^model name\s*: (.*)$', text, re.MULTILINE)
    return found[1].strip() if found else platform.machine()


def versions() -> dict[str, str]:
    """Return the versions of Python, of this package and of what it computes with."""
    from stavpr_ros import __version__

    found = {'python': platform.python_version(), 'stavpr_ros': __version__}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def machine(device: str, named_commit: str = '') -> dict[str, Any]:
    """Return what every record says of the run: machine, versions, commit, date."""
    import numba
    import torch

    about: dict[str, Any] = {
        'cpu': cpu_model(),
        'architecture': platform.machine(),
        'cores': len(os.sched_getaffinity(0)),
        'torch_threads': torch.get_num_threads(),
        'numba_threads': numba.get_num_threads(),
        'omp_wait_policy': os.environ.get('OMP_WAIT_POLICY', ''),
        'load_before': round(os.getloadavg()[0], 2),
    }
    if device == 'cuda':
        about |= {'gpu': torch.cuda.get_device_name(), 'cuda': torch.version.cuda}
    return {
        'machine': about,
        'versions': versions(),
        'commit': named_commit or commit(),
        'date': datetime.datetime.now(datetime.UTC).isoformat(timespec='seconds'),
    }


def slug(about: dict[str, Any]) -> str:
    """Return the name of a machine for file names."""
    name = about.get('gpu') or f'{about["cpu"]} {about["cores"]} cores'
    return re.sub(r'[^a-z0-9]+', '-', name.lower()).strip('-')


def with_machine(records: Iterable[Record], about: dict[str, Any]) -> list[Record]:
    """Return the records with machine, versions, commit and date in each."""
    return [replace(record, extra=record.extra | about) for record in records]


def save(records: Iterable[Record], path: Path) -> None:
    """Write the records as a JSON list."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps([record.to_json() for record in records], indent=1, allow_nan=False)
    path.write_text(text + '\n', encoding='utf-8')


def load(path: Path) -> list[Record]:
    """Read what :func:`save` wrote."""
    return [Record.from_json(fields) for fields in json.loads(path.read_text(encoding='utf-8'))]
