# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Results of a run: rows, the machine that they were measured on, JSON and Markdown."""

import argparse
from collections.abc import Sequence
import contextlib
from dataclasses import dataclass, field
import datetime
import importlib.metadata
import json
import os
from pathlib import Path
import platform
import re
import subprocess
import textwrap
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / 'benchmarks' / 'results'
PACKAGES = ('numpy', 'torch', 'numba', 'opencv-python-headless', 'onnxruntime')
# flags that decide how fast the kernels and torch's products are
INSTRUCTION_SETS = re.compile(r'sse4_2|avx\w*|fma|f16c|amx_\w+|asimd\w*|sve\w*|bf16|fphp')
READING = 'reading the map'  # a peer
UNITS = ((1.0, 's'), (1e-3, 'ms'), (1e-6, 'µs'))


@dataclass(frozen=True)
class Row:
    """
    One measurement.

    :param stage: name, see benchmarks/README.md.
    :param mode: ``robust``, ``paper``, or empty for a stage of both modes.
    :param n: places.
    :param d: dimensions of a local feature; 0 for a stage that reads no features.
    :param precision: type of the map, or of the arithmetic.
    :param median_s, spread_s: median and interquartile range, seconds.
    :param runs: number of runs.
    :param lower_bound_s: minimum time on this machine; 0 = none known.
    :param peers: the fields of each :class:`run.Peer` but its job, its median_s and spread_s from
        the same interleaved run, and the ratio of its median to the stage's.
    :param extra: further values by name.
    """

    stage: str
    mode: str
    n: int
    d: int
    precision: str
    median_s: float
    spread_s: float
    runs: int
    lower_bound_s: float = 0.0
    peers: tuple[dict[str, Any], ...] = ()
    extra: dict[str, Any] = field(default_factory=dict)

    @property
    def ratio(self) -> float | None:
        """Median over the lower bound."""
        return self.median_s / self.lower_bound_s if self.lower_bound_s else None


def commit() -> str:
    """Return the commit of the checkout, followed by ``+`` after changes; or ``unknown``."""
    # the results themselves change nothing that is measured
    status = 'git status --porcelain -- . :!benchmarks/results'
    try:
        short, changed = (
            subprocess.check_output(words.split(), cwd=ROOT, text=True).strip()
            for words in ('git rev-parse --short HEAD', status)
        )
    except (OSError, subprocess.CalledProcessError):
        return 'unknown'
    return short + ('+' if changed else '')


def _cpu_info(pattern: str) -> str:
    match = re.search(pattern, Path('/proc/cpuinfo').read_text(), re.MULTILINE)
    return match[1].strip() if match else ''


def cpu_model() -> str:
    """Return the name of the processor."""
    return _cpu_info(r'^model name\s*: (.*)$') or platform.machine()


def versions() -> dict[str, str]:
    """Return the versions of Python, of this package and of the packages that it computes with."""
    from stavpr_ros import __version__

    packages = {'python': platform.python_version(), 'stavpr_ros': __version__}
    for package in PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            packages[package] = importlib.metadata.version(package)
    return packages


def environment(named_commit: str = '') -> dict[str, Any]:
    """Return machine, versions, commit and date of a run, for a call before it begins."""
    import numba
    from stavpr_ros.simd import LANES
    import torch

    flags = _cpu_info(r'^(?:flags|Features)\s*: (.*)$').split()
    machine: dict[str, Any] = {
        'cpu': cpu_model(),
        'architecture': platform.machine(),
        'instruction_sets': [flag for flag in flags if INSTRUCTION_SETS.fullmatch(flag)],
        'vector_bits': 32 * LANES,  # of the kernels; less than there are by NUMBA_CPU_FEATURES
        'cores': len(os.sched_getaffinity(0)),
        'torch_threads': torch.get_num_threads(),
        'numba_threads': numba.get_num_threads(),
        'omp_wait_policy': os.environ.get('OMP_WAIT_POLICY', ''),
        'load_before': round(os.getloadavg()[0], 2),
    }
    return {
        'commit': named_commit or commit(),
        'date': datetime.datetime.now(datetime.UTC).isoformat(timespec='seconds'),
        'machine': machine,
        'versions': versions(),
    }


def heading(title: str, command: str, about: dict[str, Any]) -> list[str]:
    """Return the lines that open a page, with the command that writes it."""
    sets = ' '.join(about['machine']['instruction_sets'])
    machine = {
        name.replace('_', ' '): value
        for name, value in (about['machine'] | {'instruction_sets': sets}).items()
        if value != ''
    }
    hardware, software = (
        ', '.join(f'{name} {value}' for name, value in of.items())
        for of in (machine, about['versions'])
    )
    return [
        f'# {title}',
        '',
        f'Written by `{command}`; benchmarks/README.md describes the method.',
        f'Commit {about["commit"]}, {about["date"]}.',
        *textwrap.wrap(f'Machine: {hardware}.', 120),
        *textwrap.wrap(f'Versions: {software}.', 120),
        '',
    ]


def file_name(machine: dict[str, Any]) -> str:
    """Return the name of a machine for file names, with the vectors of the kernels."""
    name = '{cpu} {cores} cores {vector_bits} bit'.format(**machine)
    return re.sub(r'[^a-z0-9]+', '-', name.lower()).strip('-')


def parser_of(document: str | None) -> argparse.ArgumentParser:
    """Return a parser whose help begins with the docstring of a program."""
    formatter = argparse.RawDescriptionHelpFormatter
    return argparse.ArgumentParser(description=document, formatter_class=formatter)


def options_parser(document: str | None, quick: str) -> argparse.ArgumentParser:
    """Return a parser with the common options of the commands that write a report."""
    parser = parser_of(document)
    add = parser.add_argument
    add('--quick', action='store_true', help=quick)
    add('--commit', default='', help='name of the measured commit, outside a git checkout')
    add('--output', type=Path, default=RESULTS, help='folder of the results (%(default)s)')
    return parser


def write_json(path: Path, document: Any) -> None:
    """Write a document, and the folders of its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document, indent=1, allow_nan=False) + '\n', encoding='utf-8')


def write_lines(path: Path, lines: Sequence[str]) -> None:
    """Write a text that ends with one line break."""
    path.write_text('\n'.join(lines).rstrip() + '\n', encoding='utf-8')


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table, followed by an empty one."""
    lines = ['| ' + ' | '.join(cells) + ' |' for cells in (head, *rows)]
    return [lines[0], '|' + ' --- |' * len(head), *lines[1:], '']


def seconds_text(seconds: float | None) -> str:
    """Return a duration with three digits and a unit."""
    if not seconds:
        return '-'
    scale, unit = next(((s, u) for s, u in UNITS if seconds >= s), UNITS[-1])
    return f'{number_text(seconds / scale)} {unit}'


def number_text(value: float | None) -> str:
    """Return a number with three digits, without an exponent above 1."""
    if value is None:
        return '-'
    return f'{value:,.0f}' if value >= 100 else f'{value:.3g}'
