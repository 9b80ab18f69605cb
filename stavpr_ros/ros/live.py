# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Runs the node, a replay and recorders as processes of their own: recognition as on a robot."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, ExitStack
from dataclasses import dataclass
from functools import partial
import json
import math
import os
from pathlib import Path
import random
import signal
import subprocess
import time
from typing import Any

from ament_index_python.packages import get_package_prefix, PackageNotFoundError
from stavpr_ros.errors import StavprError, UnavailableError

START_TIMEOUT = 180.0  # seconds for the node to load the map and to compile
END_TIMEOUT = 20.0  # seconds for a process to end, or for the last record
POLL_SECONDS = 0.05

Process = subprocess.Popen[bytes]


@dataclass(frozen=True)
class _Recorder:
    """A ``record`` process: its name, its options, and the file of its records."""

    name: str
    file: str
    options: tuple[str, ...] = ()


MATCHES = _Recorder('record', 'matches.jsonl')
LOOP_CLOSURES = _Recorder('record_loop_closures', 'loop_closures.jsonl', ('--loop-closures',))


def executable(name: str) -> str:
    """
    Return the file that ``ros2 run stavpr_ros NAME`` runs.

    :raises UnavailableError: the package is not installed, or its environment is not sourced.
    """
    try:
        return str(Path(get_package_prefix('stavpr_ros')) / 'lib' / 'stavpr_ros' / name)
    except PackageNotFoundError as error:
        raise UnavailableError(
            'the package stavpr_ros is not found: build it with colcon and '
            'source install/setup.bash'
        ) from error


def private_domain() -> dict[str, str]:
    """Return an environment with a ROS domain of its own, unless the user has chosen one."""
    environment = dict(os.environ)
    environment.setdefault('ROS_DOMAIN_ID', str(random.randrange(1, 100)))
    environment.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    return environment


def run_live(
    node_parameters: dict[str, Any],
    query: str,
    images: int,
    folder: Path,
    topic: str | None = None,
) -> list[dict[str, Any]]:
    """
    Replay a query losslessly into a node and return the recorded matches.

    :param node_parameters: of the node, name to value.
    :param query: the bag or folder of images to replay.
    :param images: number of its images.
    :param folder: for the logs and ``matches.jsonl``.
    :param topic: image topic of the bag; None = its only one.
    :returns: one record per image, see the command ``record``.
    :raises StavprError: a process failed; names its log.
    """
    return _replay_into_node(node_parameters, query, images, folder, topic, (MATCHES,))


def run_loop_closure(
    node_parameters: dict[str, Any],
    query: str,
    images: int,
    folder: Path,
    topic: str | None = None,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """
    Replay a traverse losslessly into a node in operation loop_closure.

    ``matches.jsonl`` and ``loop_closures.jsonl`` are written into the folder. The parameters are
    those of :func:`run_live`.

    :returns: one match per image, and the loop closures; see the command ``record``.
    :raises StavprError: a process failed; names its log.
    """
    parameters = node_parameters | {'operation': 'loop_closure'}
    recorders = (MATCHES, LOOP_CLOSURES)
    matches = _replay_into_node(parameters, query, images, folder, topic, recorders)
    return matches, _records(folder / LOOP_CLOSURES.file)


def _replay_into_node(
    node_parameters: dict[str, Any],
    query: str,
    images: int,
    folder: Path,
    topic: str | None,
    recorders: tuple[_Recorder, ...],
) -> list[dict[str, Any]]:
    """Run all processes; return the matches."""
    environment = private_domain()
    parameters = [f'{name}:={value}' for name, value in node_parameters.items()]
    node = [executable('node'), '--ros-args', *(word for p in parameters for word in ('-p', p))]
    replay = [executable('replay'), query, '--lossless', '--wait', '120']
    replay += [] if topic is None else ['--topic', topic]
    with ExitStack() as stack:
        processes: dict[str, Process] = {}

        def start(name: str, command: list[str]) -> None:
            log = folder / f'{name}.log'
            processes[name] = stack.enter_context(_running(command, log, environment))

        def wait_until(done: Callable[[], bool], seconds: float, event: str) -> None:
            _wait_until(done, processes, folder, seconds, event)

        start('node', node)
        for recorder in recorders:
            file = folder / recorder.file
            file.unlink(missing_ok=True)
            command = [executable('record'), '--output', str(file), *recorder.options]
            start(recorder.name, command)
        for recorder in recorders:
            log = folder / f'{recorder.name}.log'
            wait_until(partial(_is_recording, log), START_TIMEOUT, 'the node')
        with _running(replay, None, environment) as player:
            wait_until(lambda: player.poll() is not None, math.inf, 'the end of the replay')
        if player.returncode != 0:
            raise StavprError(f'the replay ended with {player.returncode}, see {folder}/node.log')
        wait_until(lambda: _complete(folder, images, recorders), END_TIMEOUT, 'the last record')
    matches = _records(folder / MATCHES.file)
    if len(matches) != images:
        raise StavprError(f'{len(matches)} matches of {images} images, see the logs in {folder}')
    return matches


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
    done: Callable[[], bool],
    processes: dict[str, Process],
    folder: Path,
    seconds: float,
    event: str,
) -> None:
    """Wait for an event while the processes run."""
    end = time.monotonic() + seconds
    while not done():
        for name, process in processes.items():
            if process.poll() is not None:
                raise StavprError(
                    f'{name} ended with {process.returncode}, see {folder / name}.log'
                )
        if time.monotonic() > end:
            raise StavprError(f'{event} did not come in {seconds:g} s, see the logs in {folder}')
        time.sleep(POLL_SECONDS)


def _is_recording(log: Path) -> bool:
    """Return whether a recorder has logged that it misses no more messages."""
    return any(line.startswith('recording') for line in _lines(log))


def _complete(folder: Path, images: int, recorders: tuple[_Recorder, ...]) -> bool:
    """Return whether every image has its match, and every accepted match its loop closure."""
    if len(_lines(folder / MATCHES.file)) < images:
        return False
    if LOOP_CLOSURES not in recorders:
        return True
    accepted = sum(record['status'] == 'MATCH' for record in _records(folder / MATCHES.file))
    return len(_lines(folder / LOOP_CLOSURES.file)) >= accepted


def _lines(path: Path) -> list[str]:
    return path.read_text().splitlines() if path.exists() else []


def _records(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in _lines(path)]
