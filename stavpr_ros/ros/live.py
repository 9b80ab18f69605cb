"""The node, a replay and a listener, each a process of its own: recognition as a robot would have it."""

import json
import math
import os
import random
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from ament_index_python.packages import PackageNotFoundError, get_package_prefix

from stavpr_ros.errors import StavprError, UnavailableError

START_PATIENCE = 180.0  # seconds for the node to load the map and to compile
PATIENCE = 20.0  # seconds for a process to end, or for a last answer to be written
MATCHES, CLOSURES = 'matches.jsonl', 'loop_closures.jsonl'


def executable(name: str) -> str:
    """
    Return the file that ``ros2 run stavpr_ros NAME`` runs.

    :raises UnavailableError: the package is not installed, or its environment is not sourced.
    """
    try:
        return str(Path(get_package_prefix('stavpr_ros')) / 'lib' / 'stavpr_ros' / name)
    except PackageNotFoundError as error:
        raise UnavailableError(
            'the package stavpr_ros is not found: build it with colcon and source install/setup.bash'
        ) from error


def private_domain() -> dict[str, str]:
    """Return an environment in which only processes started with it meet, unless the user has chosen one."""
    environment = dict(os.environ)
    if 'ROS_DOMAIN_ID' not in environment:
        environment['ROS_DOMAIN_ID'] = str(random.randrange(1, 100))
    environment.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    return environment


@contextmanager
def _running(
    command: list[str], log: Path | None, environment: dict[str, str]
) -> Iterator[subprocess.Popen[bytes]]:
    """Run a process, its output in a file or shown; end it gently, and in any case, at the end."""
    if log is None:
        process = subprocess.Popen(command, env=environment)
    else:
        with log.open('w') as output:
            process = subprocess.Popen(command, env=environment, stdout=output, stderr=subprocess.STDOUT)
    try:
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        try:
            process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _wait_until(
    done: Callable[[], bool],
    processes: dict[str, subprocess.Popen[bytes]],
    folder: Path,
    seconds: float,
    what: str,
) -> None:
    """Wait for something while the processes live."""
    end = time.monotonic() + seconds
    while not done():
        for name, process in processes.items():
            if process.poll() is not None:
                raise StavprError(f'{name} ended with {process.returncode}, see {folder / name}.log')
        if time.monotonic() > end:
            raise StavprError(f'{what} did not come in {seconds:g} s, see the logs in {folder}')
        time.sleep(0.05)


def _is_recording(log: Path) -> bool:
    """Tell whether a listener has said that it misses nothing any more."""
    return any(line.startswith('recording') for line in _lines(log))


def _lines(path: Path) -> list[str]:
    return path.read_text().splitlines() if path.exists() else []


def run_live(
    node_parameters: dict[str, Any], query: str, images: int, folder: Path, topic: str | None = None
) -> list[dict[str, Any]]:
    """
    Replay a query, losslessly, into a node and return what a listener heard.

    :param node_parameters: of the node, name to value.
    :param query: the bag or folder of images to replay.
    :param images: how many images it holds.
    :param folder: where the logs and ``matches.jsonl`` are written.
    :returns: one record an image, see the command ``record``.
    :raises StavprError: a process failed; names its log.
    """
    matches = _replay_into_node(node_parameters, query, images, folder, topic, loops=False)
    if len(matches) != images:
        raise StavprError(f'{len(matches)} answers to {images} images were heard, see the logs in {folder}')
    return matches


def run_loop_closure(
    node_parameters: dict[str, Any], drive: str, images: int, folder: Path, topic: str | None = None
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """
    Replay a drive, losslessly, into a node that closes loops, and return what two listeners heard.

    ``matches.jsonl`` and ``loop_closures.jsonl`` are written into the folder.

    :returns: one answer an image, and the loop closures; see the command ``record``.
    :raises StavprError: a process failed; names its log.

    The others are as in :func:`run_live`.
    """
    parameters = node_parameters | {'operation': 'loop_closure'}
    matches = _replay_into_node(parameters, drive, images, folder, topic, loops=True)
    if len(matches) != images:
        raise StavprError(f'{len(matches)} answers to {images} images were heard, see the logs in {folder}')
    return matches, _records(folder / CLOSURES)


def _replay_into_node(
    node_parameters: dict[str, Any], query: str, images: int, folder: Path, topic: str | None, loops: bool
) -> list[dict[str, Any]]:
    """Run all the processes; return the answers."""
    environment = private_domain()
    parameters = [word for name, value in node_parameters.items() for word in ('-p', f'{name}:={value}')]
    node = [executable('node'), '--ros-args', *parameters]
    replay = [executable('replay'), query, '--lossless', '--wait', '120']
    if topic is not None:
        replay += ['--topic', topic]
    listeners: dict[str, tuple[str, list[str]]] = {'record': (MATCHES, [])}
    if loops:
        listeners['record_loop_closures'] = (CLOSURES, ['--loop-closures'])
    with ExitStack() as stack:
        processes = {'node': stack.enter_context(_running(node, folder / 'node.log', environment))}
        for name, (file, options) in listeners.items():
            (folder / file).unlink(missing_ok=True)
            log = folder / f'{name}.log'
            log.unlink(missing_ok=True)
            record = [executable('record'), '--output', str(folder / file), *options]
            processes[name] = stack.enter_context(_running(record, log, environment))
        for name in listeners:
            log = folder / f'{name}.log'
            _wait_until(partial(_is_recording, log), processes, folder, START_PATIENCE, 'the node')
        with _running(replay, None, environment) as replay_process:
            _wait_until(lambda: replay_process.poll() is not None, processes, folder, math.inf, 'the end')
        if replay_process.returncode != 0:
            raise StavprError(
                f'the replay ended with {replay_process.returncode}, see also {folder}/node.log'
            )
        _wait_until(
            partial(_all_heard, folder, images, loops), processes, folder, PATIENCE, 'the last answer'
        )
    return _records(folder / MATCHES)


def _all_heard(folder: Path, images: int, loops: bool) -> bool:
    """Tell whether every image is answered, and every match is there as a loop closure too."""
    if len(_lines(folder / MATCHES)) < images:
        return False
    if not loops:
        return True
    matches = sum(record['status'] == 'MATCH' for record in _records(folder / MATCHES))
    return len(_lines(folder / CLOSURES)) >= matches


def _records(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in _lines(path)]
