# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The end after a signal: its time is shared by all waits, and no thread holds it up."""

import subprocess
import sys

import pytest
from stavpr_ros import signals

ENDLESS = """
import atexit, os, signal, sys, threading
from stavpr_ros.signals import end_process, obey_signals
atexit.register(print, 'teardown')
obey_signals()
threading.Thread(target=threading.Event().wait).start()
try:
    os.kill(os.getpid(), signal.SIGINT)
    threading.Event().wait()
except KeyboardInterrupt:
    os.kill(os.getpid(), signal.SIGINT)
    print('interrupted once')
    end_process(7)
"""


@pytest.fixture
def interrupted_at(monkeypatch):
    """Return a function that sets the seconds since the first signal."""

    def at(seconds):
        monkeypatch.setattr(signals._State, 'received', True)
        monkeypatch.setattr(signals._State, 'time', 100.0)
        monkeypatch.setattr(signals.time, 'monotonic', lambda: 100.0 + seconds)

    return at


@pytest.mark.parametrize(
    ('seconds', 'most', 'least', 'left'),
    [
        (0.0, 30.0, 0.1, signals.END_SECONDS),
        (0.0, 2.0, 0.1, 2.0),
        (signals.END_SECONDS - 1, 2.0, 0.1, 1.0),
        (signals.END_SECONDS + 9, 2.0, 0.1, 0.1),
        (signals.END_SECONDS + 9, 2.0, 1.0, 1.0),
    ],
)
def test_time_left_after_a_signal_ends_with_the_time_of_all(
    interrupted_at, seconds, most, least, left
):
    assert signals.time_left(most, least) == most  # before the signal
    interrupted_at(seconds)
    assert signals.time_left(most, least) == pytest.approx(left)


def test_end_process_waits_for_no_thread_and_second_signal_is_ignored():
    done = subprocess.run(
        [sys.executable, '-c', ENDLESS], capture_output=True, text=True, timeout=180, check=False
    )
    assert (done.returncode, done.stdout) == (7, 'interrupted once\n')
