"""Progress for the user: one line for each step, the noise in log files, the end of the log on failure."""

import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

LAST_LINES = 25
QUIET_SECONDS = 30.0  # without a terminal: how often a long step says that it is alive
REDRAW_SECONDS = 0.5  # on a terminal


class StepFailedError(Exception):
    """A step did not end well; the text says why and what to do."""


@dataclass(frozen=True)
class Step:
    """
    One step of the set-up.

    :param title: what is there after it.
    :param is_done: whether there is nothing to do.
    :param action: does it, or raises :class:`StepFailedError`.
    """

    title: str
    is_done: Callable[[], bool]
    action: Callable[[], None]


def last_line(log: Path, width: int = 70) -> str:
    """The newest line of a log, cut to ``width`` characters."""
    with log.open('rb') as stream:
        stream.seek(max(0, log.stat().st_size - 4096))
        lines = stream.read().decode(errors='replace').split('\n')
    text = next((line.strip() for line in reversed(lines) if line.strip()), '')
    return text[:width]


def run_logged(
    command: Sequence[str], log: Path, environment: Mapping[str, str], folder: Path, advice: str
) -> None:
    """
    Run a command with its output in a log file, and show that it goes on.

    :param log: the file, appended to: a step may be several commands.
    :param folder: where the command runs.
    :param advice: what the user can do if it fails.
    :raises StepFailedError: with the end of the log.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    on_terminal = sys.stdout.isatty()
    began = shown = time.monotonic()
    with log.open('ab') as stream:
        stream.write(('$ ' + ' '.join(command) + '\n').encode())
        stream.flush()
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=subprocess.STDOUT,
            env=dict(environment),
            cwd=folder,
        )
        try:
            while process.poll() is None:
                now = time.monotonic()
                if on_terminal and now - shown >= REDRAW_SECONDS:
                    # \x1b7, \x1b8: remember the place in the line and go back to it; \x1b[K: clear the rest.
                    print(f'\x1b7\x1b[K {now - began:.0f} s  {last_line(log, 40)}\x1b8', end='', flush=True)
                    shown = now
                elif not on_terminal and now - shown >= QUIET_SECONDS:
                    print(f'\n      {now - began:.0f} s: {last_line(log)}', end='', flush=True)
                    shown = now
                time.sleep(0.05)
        finally:
            if process.poll() is None:
                process.terminate()
                process.wait()
    if on_terminal:
        print('\x1b[K', end='')
    elif shown > began:
        print('\n     ', end='')  # the time of the step stands on a line of its own
    if process.returncode != 0:
        raise StepFailedError(failure_text(command, process.returncode, log, advice))


def failure_text(command: Sequence[str], status: int, log: Path, advice: str) -> str:
    """What failed, the end of its log, and what to do."""
    lines = log.read_text(encoding='utf-8', errors='replace').splitlines()[-LAST_LINES:]
    return '\n'.join(
        [
            f'`{" ".join(command)}` ended with status {status}. The end of {log}:',
            *(f'  | {line}' for line in lines),
            advice,
        ]
    )


def run_steps(steps: Sequence[Step]) -> None:
    """Do the steps that are not done, in order, with number, title and time on a line each."""
    for number, step in enumerate(steps, start=1):
        print(f'[{number}/{len(steps)}] {step.title} ...', end='', flush=True)
        if step.is_done():
            print(' is there')
            continue
        began = time.monotonic()
        try:
            step.action()
        except BaseException:
            print(f' failed after {time.monotonic() - began:.1f} s', flush=True)
            raise
        print(f' {time.monotonic() - began:.1f} s', flush=True)
