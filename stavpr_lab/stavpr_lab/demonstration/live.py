# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Runs the node, a replay and recorders as processes of their own: recognition as on a robot."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, ExitStack, suppress
from functools import partial
import json
import math
import os
from pathlib import Path
import random
import signal
import socket
import subprocess
import time
from typing import Any

from ament_index_python.packages import get_package_prefix, PackageNotFoundError
from stavpr_lab.demonstration.recordings import Recording
from stavpr_ros.errors import StavprError, UnavailableError
from stavpr_ros.signals import signals_deferred

START_TIMEOUT = 180.0  # seconds for the node to load the map and to compile
END_TIMEOUT = 20.0  # seconds for a process to end, or for the next record
POLL_SECONDS = 0.05
# Of DDS: the port at which the first participant of domain 0 is discovered, and ports of a domain
FIRST_PORT, PORTS, DOMAINS = 7410, 250, range(1, 102)
SETTINGS_OF_ROS = 'ROS_', 'RMW_', 'RCUTILS_', 'FASTRTPS_', 'FASTDDS_', 'CYCLONEDDS_', 'ZENOH_'
SAFE = 'ROS_DISTRO', 'ROS_VERSION', 'ROS_PYTHON_VERSION', 'ROS_LOG_DIR', 'ROS_HOME'
REFUSAL = 'cannot configure: '  # in the log of the node

Process = subprocess.Popen[bytes]
Records = list[dict[str, Any]]


def executable(name: str, package: str = 'stavpr_ros') -> str:
    """
    Return the file that ``ros2 run PACKAGE NAME`` runs.

    :raises UnavailableError: the package is not installed, or its environment is not sourced.
    """
    try:
        return str(Path(get_package_prefix(package)) / 'lib' / package / name)
    except PackageNotFoundError as error:
        raise UnavailableError(
            f'the package {package} is not found: build it with colcon and '
            'source install/setup.bash'
        ) from error


def free_domain() -> int:
    """Return a ROS domain in which this machine has no DDS participant."""
    for domain in random.sample(DOMAINS, 20):
        with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(('', FIRST_PORT + PORTS * domain))
            break
    return domain


def private_domain() -> dict[str, str]:
    """Return an environment with a ROS domain of its own, without the user's settings of ROS."""
    names = [name for name in os.environ if name in SAFE or not name.startswith(SETTINGS_OF_ROS)]
    own = {'ROS_DOMAIN_ID': str(free_domain()), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    return {name: os.environ[name] for name in names} | own


def run_live(
    node_parameters: dict[str, Any],
    query: Recording,
    images: int,
    folder: Path,
    others: Mapping[str, list[str]] | None = None,
    replay_options: Sequence[str] = (),
    at_end: Callable[[Records], None] = lambda closures: None,
) -> tuple[Records, Records]:
    """
    Replay a query losslessly into a node and return its records.

    :param node_parameters: parameters of the node, name to value.
    :param query: the recording to replay.
    :param images: number of its images.
    :param folder: for the logs, ``matches.jsonl``, and in operation loop_closure
        ``loop_closures.jsonl``.
    :param others: commands of further processes by their names.
    :param replay_options: further options of the command ``replay``.
    :param at_end: called with the loop closures, in the ROS domain of all, while everything still
        runs.
    :returns: one match per image, and the loop closures; see the command ``record``.
    :raises StavprError: a process failed; names its log.
    """
    environment = private_domain()
    print(f'   the ROS domain of this demonstration is {environment["ROS_DOMAIN_ID"]}', flush=True)
    parameters = [f'{name}:={value}' for name, value in node_parameters.items()]
    node = [executable('node'), '--ros-args', *(word for p in parameters for word in ('-p', p))]
    replay = [executable('replay'), query.path, '--lossless', '--wait', '120', *replay_options]
    for option, value in (('topic', query.topic), ('camera', query.camera), ('fps', query.fps)):
        replay += [] if value is None else [f'--{option}', str(value)]
    record = [executable('record'), '--output']
    matches, closures = folder / 'matches.jsonl', folder / 'loop_closures.jsonl'
    recorders = {'record': [*record, str(matches)]}
    if node_parameters.get('operation') == 'loop_closure':
        recorders['record_loop_closures'] = [*record, str(closures), '--loop-closures']
    for file in (matches, closures):
        file.unlink(missing_ok=True)

    def complete() -> bool:
        """Return whether all images have a match, and accepted ones their loop closure."""
        records = _records(matches)
        accepted = sum(match['status'] == 'MATCH' for match in records)
        enough = len(recorders) == 1 or len(_records(closures)) >= accepted
        return len(records) >= images and enough

    def size() -> int:
        return sum(file.stat().st_size for file in (matches, closures) if file.exists())

    with ExitStack() as stack:
        processes: dict[str, Process] = {}
        for name, command in {'node': node, **(others or {}), **recorders}.items():
            running = _running(command, folder / f'{name}.log', environment)
            with signals_deferred():  # a process that is being started would outlive this one
                processes[name] = stack.enter_context(running)

        def wait_until(condition: Callable[[], bool], seconds: float, event: str) -> None:
            _wait_until(condition, processes, folder, seconds, event)

        for name in recorders:
            log = folder / f'{name}.log'
            wait_until(partial(_is_recording, log), START_TIMEOUT, 'the node')
        with ExitStack() as replaying:
            with signals_deferred():
                player = replaying.enter_context(_running(replay, None, environment))
            wait_until(lambda: player.poll() is not None, math.inf, 'the end of the replay')
        if player.returncode != 0:
            raise StavprError(
                f'the replay ended with {player.returncode}, see above and {folder}/node.log'
            )
        while not complete():  # a slow processor still completes loop closures
            has_grown = partial(lambda last_size: complete() or size() > last_size, size())
            wait_until(has_grown, END_TIMEOUT, 'the last record')
        with _apply_environment(environment):
            at_end(_records(closures))
    records = _records(matches)
    if len(records) != images:
        raise StavprError(f'{len(records)} matches of {images} images, see the logs in {folder}')
    return records, _records(closures)


@contextmanager
def _apply_environment(environment: dict[str, str]) -> Iterator[None]:
    """Give this process an environment while the block runs."""
    own = dict(os.environ)
    os.environ.clear()
    os.environ.update(environment)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(own)


@contextmanager
def _running(
    command: list[str], log: Path | None, environment: dict[str, str]
) -> Iterator[Process]:
    """Run a process, its output in a file or shown; interrupt it at the end, or kill it."""
    if log is None:
        process = subprocess.Popen(command, env=environment)
    else:
        with log.open('w') as output:
            process = subprocess.Popen(
                command, env=environment, stdout=output, stderr=subprocess.STDOUT
            )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        try:
            process.wait(END_TIMEOUT)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _wait_until(
    condition: Callable[[], bool],
    processes: dict[str, Process],
    folder: Path,
    seconds: float,
    event: str,
) -> None:
    """Wait for an event while the processes run."""
    end = time.monotonic() + seconds
    while not condition():
        for name, process in processes.items():
            if process.poll() is not None:
                raise StavprError(
                    f'{name} ended with {process.returncode}, see {folder / name}.log'
                )
        if reason := _refusal(folder / 'node.log'):
            raise StavprError(f'the node cannot start: {reason}')
        if time.monotonic() > end:
            raise StavprError(f'{event} did not come in {seconds:g} s, see the logs in {folder}')
        time.sleep(POLL_SECONDS)


def _refusal(log: Path) -> str:
    """Return why the node, which then waits for another try, could not be configured; or ''."""
    _, _, rest = log.read_text().partition(REFUSAL)
    return rest.partition('\n')[0] if '\n' in rest else ''


def _is_recording(log: Path) -> bool:
    """Return whether a recorder has logged that it misses no more messages."""
    return any(line.startswith('recording') for line in log.read_text().splitlines())


def _records(path: Path) -> Records:
    """Return the records in a file; a line that is still being written is left out."""
    lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    return [json.loads(line) for line in lines if line.endswith('\n')]
