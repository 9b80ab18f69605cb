# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The frame of the commands: parser, signals, exit codes."""

import argparse
from collections.abc import Callable, Mapping
import sys
from types import MappingProxyType
from typing import Any

from stavpr_ros.errors import SettingsError, StavprError
from stavpr_ros.parameters import BY_NAME
from stavpr_ros.signals import interrupted, obey_signals
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


def add_parameter(group: Any, name: str, text: str, **changes: Any) -> None:
    """
    Add the option of a command that is a parameter of the node: its name, type and default.

    :param group: of options, or a parser.
    :param text: help of the option; ``%(default)s`` is its default.
    :param changes: other arguments of ``add_argument`` than those of the table.
    """
    row = BY_NAME[name]
    if isinstance(row.default, bool):
        own: dict[str, Any] = {'action': 'store_true'}
    else:
        own = {'type': type(row.default), 'default': row.default, 'choices': row.choices or None}
    group.add_argument(f'--{name.replace("_", "-")}', help=text, **own | changes)


def run_program(
    name: str,
    work: Callable[[], int | None],
    interruption: Callable[[], str] = lambda: 'interrupted',
    codes: Mapping[type[StavprError], int] = MappingProxyType({}),
) -> int:
    """
    Run the work of a command and print the reason if it fails or is interrupted.

    :param work: returns the exit code, None = 0.
    :param interruption: returns the text that is printed after an interrupt.
    :param codes: exit codes of types of errors, besides 2 for invalid settings.
    :returns: the exit code: 0 done, 1 failed, 2 invalid settings, 130 interrupted.
    """
    obey_signals()
    wait_passively()
    try:
        return work() or DONE
    except StavprError as error:
        print(f'{name}: {error}', file=sys.stderr)
        known: dict[type[StavprError], int] = {SettingsError: BAD_USAGE, **codes}
        return next((code for kind, code in known.items() if isinstance(error, kind)), FAILED)
    except BaseException as error:
        # an interrupt within a foreign library comes out as another exception
        if not (isinstance(error, KeyboardInterrupt) or interrupted()):
            raise
        print(f'{name}: {interruption()}', file=sys.stderr)
        return INTERRUPTED
