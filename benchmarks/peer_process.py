# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The peers: their environment, created on first use, and the process in it that runs them."""

from collections.abc import Sequence
import hashlib
import json
import os
from pathlib import Path
import subprocess
import sys
import tempfile
from types import TracebackType
from typing import Any, Self

import numpy as np
from results import ROOT

FOLDER = Path(__file__).resolve().parent / 'peers'
ENVIRONMENT = ROOT / '.venv-peers'
# variables of another Python or ROS, removed for the peers
FOREIGN = ('PYTHONPATH', 'PYTHONHOME', 'VIRTUAL_ENV')


class PeersMissingError(Exception):
    """The peers' environment could not be created."""


def _clean() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name not in FOREIGN}


def make_environment(folder: Path = ENVIRONMENT) -> Path:
    """
    Create the environment, unless it exists with the packages that are pinned now.

    :returns: its Python.
    :raises PeersMissingError: the environment could not be created, or its packages not installed.
    """
    requirements = FOLDER / 'requirements.txt'
    digest = hashlib.sha256(requirements.read_bytes()).hexdigest()
    stamp, python = folder / 'requirements.sha256', folder / 'bin' / 'python3'
    if python.exists() and stamp.exists() and stamp.read_text() == digest:
        return python
    print(f'Creating {folder.name} with the peers (once) ...', flush=True)
    base = getattr(sys, '_base_executable', '') or sys.executable
    pip = [
        str(python),
        '-I',
        '-m',
        'pip',
        'install',
        '--quiet',
        '--no-input',
        '--disable-pip-version-check',
    ]
    for command in ([base, '-m', 'venv', '--clear', str(folder)], [*pip, '-r', str(requirements)]):
        try:
            done = subprocess.run(
                command, env=_clean(), capture_output=True, text=True, check=False
            )
        except OSError as error:
            raise PeersMissingError(str(error)) from error
        if done.returncode:
            last = (done.stderr.strip() or done.stdout.strip() or 'no output').splitlines()[-1]
            raise PeersMissingError(f'{" ".join(command[1:5])} failed: {last}')
    stamp.write_text(digest)
    return python


class Peers:
    """
    A process that aligns samples of starts with the peers; it sleeps while idle.

    :param command: of the runner; None creates the environment and uses the runner in it.
    :raises PeersMissingError: the runner does not start.
    """

    def __init__(self, command: Sequence[str] | None = None) -> None:
        command = command or [str(make_environment()), '-I', str(FOLDER / 'runner.py')]
        self._folder = tempfile.TemporaryDirectory()
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=_clean()
        )
        self.versions: dict[str, str] = self._reply()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        assert self._process.stdin
        self._process.stdin.close()
        self._process.wait()
        self._folder.cleanup()

    def _reply(self) -> dict[str, Any]:
        assert self._process.stdout
        line = self._process.stdout.readline()
        if not line:
            raise PeersMissingError(
                f'the peers exited with status {self._process.wait()}: see the output above'
            )
        return json.loads(line)

    def put(self, window: np.ndarray) -> Path:
        """Write a window, shape (l, n), to a file for the runner."""
        path = Path(self._folder.name) / 'window.npy'
        np.save(path, window)
        return path

    def run(self, peer: str, window: Path, starts: Sequence[int], k: int) -> dict[str, Any]:
        """Align the window with some starts; return ``seconds`` and ``ends`` (see the runner)."""
        request = {'peer': peer, 'window': str(window), 'starts': list(starts), 'columns': k}
        assert self._process.stdin
        self._process.stdin.write(json.dumps(request) + '\n')
        self._process.stdin.flush()
        return self._reply()
