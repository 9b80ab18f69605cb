# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The frame of the commands: parser, signals, exit codes."""

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
import difflib
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from io import TextIOWrapper
import math
import os
from pathlib import Path
import shutil
import sys
import textwrap
from types import MappingProxyType
from typing import Any, NoReturn, TextIO, TypeVar

from stavpr_ros.errors import printable, SettingsError, StavprError, UnavailableError
from stavpr_ros.parameters import BY_NAME
from stavpr_ros.signals import obey_signals, run_until_signal, was_interrupted
from stavpr_ros.threads import wait_passively

DONE, FAILED, BAD_USAGE, INTERRUPTED, UNREAD = 0, 1, 2, 130, 141

_SAME = 'av', 'evo', 'h5py', 'jinja2', 'matplotlib', 'onnx', 'onnxruntime', 'ray', 'torch'
OPTIONAL = {name: name for name in _SAME} | {
    'faiss': 'faiss-cpu',
    'pillow_heif': 'pillow-heif',
    'qdrant_client': 'qdrant-client',
    'qdrant_edge': 'qdrant-edge-py',
    'sklearn': 'scikit-learn',
}
"""Modules that only a part of the commands needs, and the packages of pip that have them."""

T = TypeVar('T')


class _Help(argparse.RawDescriptionHelpFormatter):
    """Texts as they are written, and a usage of the required arguments."""

    def add_usage(self, usage: Any, actions: Any, groups: Any, prefix: str | None = None) -> None:
        """Leave out the options; argparse takes an empty prefix for the names of subcommands."""
        if prefix != '':
            requirements = [row for row in actions if row.required or not row.option_strings]
            actions = [*requirements, argparse.Action((), 'option', '?', metavar='OPTION ...')]
        super().add_usage(usage, actions, (), prefix)


class _Parser(argparse.ArgumentParser):
    """Suggests the nearest option or subcommand where one is unknown."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Reject unknown options here, where a subcommand knows its own."""
        self._arguments: Sequence[str] = sys.argv[1:] if args is None else args
        result, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f'unrecognized arguments: {" ".join(unknown)}')
        return result, unknown

    def error(self, message: str) -> NoReturn:
        """Print the usage, the error and a suggestion, and exit."""
        options = [name for action in self._actions for name in action.option_strings]
        for word in self._arguments:
            name = word.partition('=')[0]
            if name.startswith('--') and not any(option.startswith(name) for option in options):
                message += suggestion(name, options)
            for action in self._actions:
                if f'invalid choice: {word!r}' in message:
                    message += suggestion(word, map(str, action.choices or ()))
        super().error(printable(f'{message} (options: {self.prog} --help)'))


def suggestion(word: str, names: Iterable[str]) -> str:
    """Return ``; did you mean NAME?`` with the name that is most similar, '' without one."""
    return ''.join(f'; did you mean {name}?' for name in difflib.get_close_matches(word, names, 1))


def called_name(name: str) -> str:
    """Return the words that called a command, by the program of this process."""
    program = Path(sys.argv[0])
    if program.stem == 'stavpr':
        return f'stavpr {name}'
    if program.name == name and program.parent.parent.name == 'lib' and shutil.which('ros2'):
        return f'ros2 run {program.parent.name} {name}'
    return name


def make_parser(name: str, description: str, epilog: str) -> argparse.ArgumentParser:
    """Return a parser that shows both texts as they are written, with the command as called."""
    program = called_name(name)
    epilog = epilog.replace(f'\n  {name} ', f'\n  {program} ')
    return _Parser(prog=program, description=description, epilog=epilog, formatter_class=_Help)


def add_parameter(group: Any, name: str, text: str, **changes: Any) -> None:
    """
    Add the option of a command that is a parameter of the node: its name, type and default.

    :param group: of options, or a parser.
    :param text: help of the option; ``%(default)s`` is its default.
    :param changes: arguments of ``add_argument`` that replace the table's.
    """
    row = BY_NAME[name]
    if isinstance(row.default, bool):
        base: dict[str, Any] = {'action': 'store_true'}
    else:
        base = {'type': type(row.default), 'default': row.default, 'choices': row.choices or None}
    group.add_argument(f'--{name.replace("_", "-")}', help=text, **base | changes)


def positive(text: str) -> float:
    """Return the number that an option names, above 0 and finite."""
    value = float(text)
    if not (value > 0 and math.isfinite(value)):
        raise argparse.ArgumentTypeError(f'{text}: expected a number above 0')
    return value


def add_fps(group: Any) -> None:
    """Add the option ``--fps`` of videos."""
    text = 'images per second to take from a video (5); the same for map and query'
    group.add_argument('--fps', type=positive, metavar='HZ', help=text)


def add_camera(group: Any) -> None:
    """Add the option ``--camera`` of folders of images."""
    text = 'camera to read, where a folder has images of several: cam0, image_2, left ...'
    group.add_argument('--camera', metavar='NAME', help=text)


def say(line: str, file: TextIO | None = None) -> None:
    """Print a line, whatever characters its names have."""
    print(printable(line), file=file)


def lacking(module: str) -> str:
    """Return that a command needs a module, and how to install it; '' = a module of its own."""
    package = OPTIONAL.get(module.partition('.')[0])
    return f'this needs {package}, which is not installed: pip install {package}' * bool(package)


def require_modules(*modules: str) -> None:
    """Raise UnavailableError if one of OPTIONAL is missing, before a command begins its work."""
    for module in modules:
        if find_spec(module) is None:
            raise UnavailableError(lacking(module))


def until_unread(work: Callable[[], T]) -> T | int:
    """Return what a function returns; 141 if no one reads its output any more, as of ``head``."""
    try:
        try:
            return work()
        finally:
            print(end='', flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes at its end
        return UNREAD


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
    :returns: the exit code: 0 done, 1 failed, 2 invalid settings, 130 interrupted, 141 unread.
    """
    obey_signals()
    wait_passively()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors='backslashreplace')  # a terminal may lack the letters
    try:
        return until_unread(work) or DONE
    except StavprError as error:
        say(f'{name}: {error}', sys.stderr)
        exit_codes: dict[type[StavprError], int] = {SettingsError: BAD_USAGE, **codes}
        return next((code for kind, code in exit_codes.items() if isinstance(error, kind)), FAILED)
    except ModuleNotFoundError as error:
        if not (text := lacking(error.name or '')):
            raise
        say(f'{name}: {text}', sys.stderr)
        return FAILED
    except BaseException as error:
        # an interrupt within a foreign library comes out as another exception
        if isinstance(error, KeyboardInterrupt) or was_interrupted():
            say(f'{name}: {interruption()}', sys.stderr)
            return INTERRUPTED
        if not isinstance(error, OSError):
            raise
        remedy = 'expected folders that can be written and have room: name others, TMPDIR for'
        say(f'{name}: {error}; {remedy} temporary files', sys.stderr)
        return FAILED


def run_node_program(text: str, module: str, node: str, args: list[str] | None) -> int:
    """
    Run a node until it is stopped, or print its help.

    :param text: the help, with ``{parameters}``.
    :param module: imported then; it has the class of the node, and ``PARAMETERS`` with default
        and sentence by name.
    :returns: the exit code.
    """
    arguments = sys.argv[1:] if args is None else args
    wrap = partial(textwrap.fill, width=99, initial_indent=' ' * 6, subsequent_indent=' ' * 6)
    wait_passively()

    def run() -> int:
        content = import_module(module)
        if arguments[:1] in (['-h'], ['--help']):
            rows = (
                f'  {name} (default {default!r})\n{wrap(sentence)}\n'
                for name, (default, sentence) in content.PARAMETERS.items()
            )
            print(text.format(parameters=''.join(rows)))
            return DONE
        from stavpr_ros.ros.process import run_node

        return run_node(getattr(content, node), args, content.PARAMETERS)

    return run_until_signal(run)
