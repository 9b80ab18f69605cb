# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The installed executables as processes of their own."""

import os
from pathlib import Path
import signal
import subprocess
import sys

from ament_index_python.packages import get_package_prefix
from domain import DOMAIN
from stavpr_ros.commands.stavpr import PACKAGES

TIMEOUT = 180.0  # seconds until an expected event counts as missing
SECOND = 10**9


def executable(name: str) -> str:
    """Return the file that ``ros2 run`` runs."""
    package = PACKAGES.get(name, 'stavpr_ros')
    return str(Path(get_package_prefix(package)) / 'lib' / package / name)


def environment() -> dict[str, str]:
    """Return the environment of a process that shares the domain of the tests."""
    return os.environ | {
        'ROS_DOMAIN_ID': str(DOMAIN),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
    }


class Process:
    """One executable, started as `ros2 run` would, its output in a file."""

    def __init__(self, log: Path, name: str, *arguments: str) -> None:
        self.log = log
        with log.open('w') as output:
            self.popen = subprocess.Popen(
                [*command(name), *arguments],
                env=environment(),
                stdout=output,
                stderr=subprocess.STDOUT,
            )

    def output(self) -> str:
        return self.log.read_text()

    def wait(self, timeout: float = TIMEOUT) -> int:
        return self.popen.wait(timeout)

    def stop(self, number: int = signal.SIGINT) -> int:
        self.popen.send_signal(number)
        return self.wait()

    def end(self) -> None:
        """End the process, by force if an interrupt does not suffice."""
        if self.popen.poll() is None:
            self.popen.send_signal(signal.SIGINT)
        try:
            self.wait()
        except subprocess.TimeoutExpired:
            self.popen.kill()
            self.popen.wait()
        print(self.output())  # which pytest shows when the test has failed


def command(name: str) -> list[str]:
    """Return the command of an executable, or of the slow node beside this file."""
    slow = Path(__file__).with_name(f'{name}.py')
    return [sys.executable, str(slow)] if name == 'slow_node' else [executable(name)]


def node_process(log: Path, *options: str, slow: bool = False, **parameters: object) -> Process:
    """Start the node, or the slow one, with options of ROS and parameters."""
    parameters = {'features': 'gradient'} | parameters
    values = [word for name, value in parameters.items() for word in ('-p', f'{name}:={value}')]
    return Process(log, 'slow_node' if slow else 'node', '--ros-args', *options, *values)
