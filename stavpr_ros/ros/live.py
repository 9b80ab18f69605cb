"""The node, a replay and a listener, each a process of its own: recognition as a robot would have it."""

import json
import math
import os
import random
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ament_index_python.packages import PackageNotFoundError, get_package_prefix

from stavpr_ros.errors import StavprError, UnavailableError

START_PATIENCE = 180.0  # seconds for the node to load the map and to compile
PATIENCE = 20.0  # seconds for a process to end, or for a last answer to be written


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


def _is_recording(folder: Path) -> bool:
    """Tell whether the listener has said that it misses nothing any more."""
    return any(line.startswith('recording') for line in _lines(folder / 'record.log'))


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
    environment = private_domain()
    matches = folder / 'matches.jsonl'
    matches.unlink(missing_ok=True)
    parameters = [word for name, value in node_parameters.items() for word in ('-p', f'{name}:={value}')]
    node = [executable('node'), '--ros-args', *parameters]
    replay = [executable('replay'), query, '--lossless', '--wait', '120']
    if topic is not None:
        replay += ['--topic', topic]
    record = [executable('record'), '--output', str(matches)]
    with (
        _running(node, folder / 'node.log', environment) as node_process,
        _running(record, folder / 'record.log', environment) as record_process,
    ):
        both = {'node': node_process, 'record': record_process}
        _wait_until(lambda: _is_recording(folder), both, folder, START_PATIENCE, 'the node')
        with _running(replay, None, environment) as replay_process:
            _wait_until(lambda: replay_process.poll() is not None, both, folder, math.inf, 'the end')
        if replay_process.returncode != 0:
            raise StavprError(
                f'the replay ended with {replay_process.returncode}, see also {folder}/node.log'
            )
        _wait_until(lambda: len(_lines(matches)) >= images, both, folder, PATIENCE, 'the last answer')
    records = [json.loads(line) for line in _lines(matches)]
    if len(records) != images:
        raise StavprError(f'{len(records)} answers to {images} images were heard, see the logs in {folder}')
    return records
