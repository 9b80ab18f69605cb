# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One command over many inputs: a job for each, in processes here or on a Ray cluster."""

import argparse
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed, ThreadPoolExecutor
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
import importlib
import io
import logging
import os
from pathlib import Path
import re
import subprocess
import sys

from stavpr_ros.commands.program import DONE, FAILED
from stavpr_ros.errors import SettingsError, UnavailableError

RETRIES = 3  # of a job whose process is killed, or whose machine is lost


@dataclass(frozen=True)
class Job:
    """
    One run of a command.

    :param name: of its input, unique.
    :param command: module in ``stavpr_ros.commands``.
    :param arguments: of its command line.
    :param is_new: none of its outputs was there before.
    """

    name: str
    command: str
    arguments: tuple[str, ...]
    is_new: bool = False

    def again(self) -> 'Job':
        """Return the job for another try; what is there now is its own, if it was new."""
        return replace(self, arguments=(*self.arguments, '--force')) if self.is_new else self


def add_job_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of where the jobs run."""
    group = parser.add_argument_group('several inputs').add_argument
    group('--processes', type=int, metavar='N', help='jobs at a time (one for each processor)')
    group(
        '--ray',
        metavar='ADDRESS',
        help='run them on a Ray cluster instead, such as auto or HOST:6379; its machines have '
        'this package, and the same files under the same paths',
    )


def job_names(inputs: Sequence[str]) -> list[str]:
    """
    Return the names of inputs: those of their files without suffix.

    :raises SettingsError: two have the same name.
    """
    names = [Path(re.sub(r'(\.\w+):\w+$', r'\1', one)).stem for one in inputs]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise SettingsError(f'two inputs have the name {name!r}: rename one, or run it alone')
    return names


def other_arguments(args: Sequence[str], *several: str) -> list[str]:
    """Return the arguments of a command line but these options, and those of the jobs."""
    parser = argparse.ArgumentParser(add_help=False)
    for option in several:
        parser.add_argument(option, nargs='+')
    for option in ('--output', '--processes', '--ray'):
        parser.add_argument(option)
    return parser.parse_known_args(args)[1]


def run_jobs(jobs: Sequence[Job], processes: int | None, ray: str | None) -> int:
    """
    Run jobs and print the output of each when it is done.

    :param processes: at a time; None = one for each processor.
    :param ray: address of a cluster, None = processes of this machine.
    :returns: exit code, that of the worst job.
    :raises SettingsError: invalid options.
    :raises UnavailableError: no Ray, or no cluster there.
    """
    if processes is not None and (processes < 1 or ray is not None):
        raise SettingsError(
            f'--processes {processes}, --ray {ray}: expected at least 1 process, or a cluster'
        )
    worst = DONE
    done = _on_ray(jobs, ray) if ray is not None else _in_processes(jobs, processes)
    for job, code, text in done:
        print(f'--- {job.name}: {"done" if code == DONE else f"failed, exit code {code}"}')
        print(text, end='', flush=True)
        worst = max(worst, code)
    return worst


def _in_processes(jobs: Sequence[Job], processes: int | None) -> Iterator[tuple[Job, int, str]]:
    cores = os.cpu_count() or 1
    count = min(processes or cores, len(jobs))
    threads = str(max(1, cores // count))
    environment = {'OMP_NUM_THREADS': threads, 'NUMBA_NUM_THREADS': threads} | os.environ

    def run(job: Job) -> tuple[int, str]:
        command = [sys.executable, '-m', f'stavpr_ros.commands.{job.command}']
        for attempt in range(1 + RETRIES):
            done = subprocess.run(
                [*command, *(job.again() if attempt else job).arguments],
                env=environment,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                check=False,
            )
            if done.returncode >= 0:  # not killed by a signal
                break
        return (done.returncode if done.returncode >= 0 else FAILED), _without_bars(done.stdout)

    with ThreadPoolExecutor(count) as pool:
        futures = {pool.submit(run, job): job for job in jobs}
        for future in as_completed(futures):
            yield futures[future], *future.result()


def _on_ray(jobs: Sequence[Job], address: str) -> Iterator[tuple[Job, int, str]]:
    try:
        import ray
    except ImportError as error:
        raise UnavailableError(f'--ray requires the package ray ({error}): pip install ray') from (
            error
        )
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except Exception as error:  # ConnectionError, ValueError, and others
        raise UnavailableError(f'--ray {address}: no cluster there: {error}') from error
    try:
        remote: Callable[..., object] = ray.remote(
            num_cpus=1, max_retries=0, retry_exceptions=False
        )(run_here).remote
        waiting = {remote(job): (job, 0) for job in jobs}
        while waiting:
            (future, *_), _ = ray.wait(list(waiting))
            job, retries = waiting.pop(future)
            try:
                yield job, *ray.get(future)
            except ray.exceptions.RayError as error:
                if retries < RETRIES:
                    waiting[remote(job.again())] = job, retries + 1
                else:
                    yield job, FAILED, f'{error}\n'
    finally:
        ray.shutdown()


def run_here(job: Job) -> tuple[int, str]:
    """Run a job in this process; return its exit code and output."""
    main = importlib.import_module(f'stavpr_ros.commands.{job.command}').main
    output = io.StringIO()
    with redirect_stdout(output), redirect_stderr(output):
        try:
            code = main(list(job.arguments))
        except SystemExit as end:  # of argparse
            code = end.code if isinstance(end.code, int) else FAILED
    return code, _without_bars(output.getvalue())


def _without_bars(text: str) -> str:
    """Return an output without progress bars."""
    lines = (line.rpartition('\r')[2] for line in text.splitlines())
    return ''.join(f'{line}\n' for line in lines if not re.search(r'\d+%\|', line))
