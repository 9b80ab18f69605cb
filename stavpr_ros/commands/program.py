# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The frame of the commands: parser, signals, exit codes."""

import argparse
from collections.abc import Callable
import sys

from stavpr_ros.errors import SettingsError, StavprError
from stavpr_ros.signals import obey_signals
from stavpr_ros.threads import wait_passively

DONE, FAILED, BAD_USAGE, INTERRUPTED = 0, 1, 2, 130


def make_parser(name: str, description: str, epilog: str) -> argparse.ArgumentParser:
    """Return a parser whose help shows both texts as they are written."""
    return argparse.ArgumentParser(
        prog=name,
        description=description,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def run_program(
    name: str, work: Callable[[], None], interruption: Callable[[], str] = lambda: 'interrupted'
) -> int:
    """
    Run the work of a command and print the reason if it fails or is interrupted.

    :param interruption: returns the text that is printed after an interrupt.
    :returns: the exit code: 0 done, 1 failed, 2 invalid settings, 130 interrupted.
    """
    obey_signals()
    wait_passively()
    try:
        work()
    except StavprError as error:
        print(f'{name}: {error}', file=sys.stderr)
        return BAD_USAGE if isinstance(error, SettingsError) else FAILED
    except KeyboardInterrupt:
        print(f'{name}: {interruption()}', file=sys.stderr)
        return INTERRUPTED
    return DONE
