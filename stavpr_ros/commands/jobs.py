# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One command over many inputs: a job for each, in processes here or on a Ray cluster."""

import argparse
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
import importlib
import io
import logging
import os
from pathlib import Path
import re
import subprocess
import sys

from stavpr_ros.commands.program import DONE, FAILED, say
from stavpr_ros.errors import SettingsError, UnavailableError

RETRIES = 3  # of a job whose process is killed, or whose machine is lost
Result = tuple[int, str]  # exit code and output


@dataclass(frozen=True)
class Job:
    """
    One run of a command.

    :param name: of its input, unique.
    :param command: full name of the module.
    :param arguments: of its command line.
    :param is_new: none of its outputs was there before.
    """

    name: str
    command: str
    arguments: tuple[str, ...]
    is_new: bool = False

    def again(self) -> 'Job':
        """Return the job for another try; outputs that were not there before are its own."""
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
    Return the names of inputs: their files' names without suffix.

    :raises SettingsError: two have the same name.
    """
    names = [Path(re.sub(r'(\.\w+):\w+$', r'\1', one)).stem for one in inputs]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise SettingsError(f'two inputs have the name {name!r}: rename one, or run it alone')
    return names


def other_arguments(args: Sequence[str], *several: str) -> list[str]:
    """Return the arguments of a command line except these options and the options of the jobs."""
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
    :returns: exit code of the worst job.
    :raises SettingsError: invalid options.
    :raises UnavailableError: no Ray, or no cluster there.
    """
    if processes is not None and (processes < 1 or ray is not None):
        raise SettingsError(
            f'--processes {processes}, --ray {ray}: expected at least 1 process, or a cluster'
        )
    count = min(processes or os.cpu_count() or 1, len(jobs))
    worst = DONE
    with _processes(count) if ray is None else _cluster(ray) as submit:
        waiting = {submit(job): (job, RETRIES) for job in jobs}
        while waiting:
            wait(waiting, return_when=FIRST_COMPLETED)
            future = next(filter(Future.done, waiting))
            job, retries = waiting.pop(future)
            error = future.exception()
            if error is not None and retries:
                waiting[submit(job.again())] = job, retries - 1
                continue
            code, text = future.result() if error is None else (FAILED, f'{error}\n')
            say(f'--- {job.name}: {"done" if code == DONE else f"failed, exit code {code}"}')
            print(text, end='', flush=True)
            worst = max(worst, code)
    return worst


@contextmanager
def _processes(count: int) -> Iterator[Callable[[Job], Future[Result]]]:
    """Yield a function that starts a job in a process of its own, so many at a time."""
    threads = str(max(1, (os.cpu_count() or 1) // count))
    environment = {'OMP_NUM_THREADS': threads, 'NUMBA_NUM_THREADS': threads} | os.environ

    def run(job: Job) -> Result:
        process = subprocess.run(
            [sys.executable, '-m', job.command, *job.arguments],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        if process.returncode < 0:
            raise ChildProcessError(f'{process.stdout}killed by signal {-process.returncode}')
        return process.returncode, process.stdout

    with ThreadPoolExecutor(count) as pool:
        yield lambda job: pool.submit(run, job)


@contextmanager
def _cluster(address: str) -> Iterator[Callable[[Job], Future[Result]]]:
    """Yield a function that starts a job on a Ray cluster."""
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
    remote = ray.remote(num_cpus=1, max_retries=0, retry_exceptions=False)(run_here).remote
    try:
        yield lambda job: remote(job).future()
    finally:
        ray.shutdown()


def run_here(job: Job) -> Result:
    """Run a job in this process; return its exit code and output."""
    main = importlib.import_module(job.command).main
    output = io.StringIO()
    with redirect_stdout(output), redirect_stderr(output):
        try:
            code = main(list(job.arguments))
        except SystemExit as end:  # of argparse
            code = end.code if isinstance(end.code, int) else FAILED
    return code, output.getvalue()
