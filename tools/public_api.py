# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Write ``docs/public_api.txt``: every name that QUALITY_DECLARATION.md promises, one in each line.

Usage, in ``make shell`` with the extra ``slam``: ``python3 tools/public_api.py``
"""

import argparse
from collections.abc import Iterable, Iterator
from contextlib import redirect_stdout, suppress
from enum import Enum
import importlib
import inspect
from pathlib import Path
import re
import types
from typing import Any
from unittest import mock
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parent.parent
FILE = ROOT / 'docs' / 'public_api.txt'
COMMAND = 'python3 tools/public_api.py'
# Types of defaults with a stable repr, and of `no default`.
SIMPLE = (bool, int, float, str, tuple, types.NoneType, type)
USERS = ('stavpr_operator', 'stavpr_reader', 'stavpr_sensors')  # programs of users
ROLES = {'publish': 'publisher', 'subscribe': 'subscriber', 'reply': 'service'}
STANDARD = re.compile(r'parameter|transition|_states?$|type_description|/(rosout|clock)$')
PUBLIC = (
    'stavpr_ros', 'stavpr_ros.alignment', 'stavpr_ros.errors', 'stavpr_ros.features',
    'stavpr_ros.mapping', 'stavpr_ros.pipeline', 'stavpr_ros.method', 'stavpr_ros.sources',
    'stavpr_ros.sources.frame', 'stavpr_fleet', 'stavpr_slam.pose_graph',
    'stavpr_slam.ros.graph_messages', 'stavpr_lab.evaluation.evaluate',
    'stavpr_lab.evaluation.ground_truth', 'stavpr_lab.evaluation.metrics',
)  # fmt: skip

PARTS = {'.srv': ['/request', '/response'], '.action': ['/goal', '/result', '/feedback']}


def messages() -> Iterator[str]:
    """Yield every field and constant of the interfaces, without comments."""
    paths = (ROOT / 'stavpr_msgs').glob('*/*.*')
    for path in sorted(file for file in paths if file.suffix[1:] == file.parent.name):
        parts = iter(PARTS.get(path.suffix, ['']))
        part = next(parts)
        for line in path.read_text(encoding='utf-8').splitlines():
            text = ' '.join(line.partition('#')[0].split())
            if text == '---':
                part = next(parts)
            elif text:
                yield f'stavpr_msgs/{path.parent.name}/{path.stem}{part}: {text}'


def parameters() -> Iterator[str]:
    """Yield the parameters of the nodes."""
    from stavpr_nav.parameters import REPEAT, TEACH
    from stavpr_ros.parameters import PARAMETERS
    from stavpr_slam.commands.bridge import _class, TARGETS
    from stavpr_slam.ros import graph_node

    for row in PARAMETERS:
        limits = ', '.join(filter(None, [row.range, ' | '.join(row.choices), row.when]))
        yield f'node {row.name}: {type(row.default).__name__} = {row.default!r} ({limits})'
    tables = {'pose_graph': graph_node.PARAMETERS, 'teach': TEACH, 'repeat': REPEAT}
    tables |= {f'bridge {target}': _class(target).PARAMETERS for target in TARGETS}
    for program, table in tables.items():
        for name, (default, _) in table.items():
            yield f'{program} {name}: {type(default).__name__} = {default!r}'


def interfaces() -> Iterator[str]:
    """Yield the topics and services: types of both nodes, names of every program's policy."""
    import rclpy
    from rclpy.parameter import Parameter
    from stavpr_ros.ros.node import PlaceRecognitionNode
    from stavpr_slam.ros.graph_node import PoseGraphNode

    recording = {'operation': 'mapping', 'publish_initialpose': True}  # subscribes to all topics
    runs: dict[Any, dict[str, Any]] = {PlaceRecognitionNode: recording, PoseGraphNode: {}}
    context = rclpy.Context()
    rclpy.init(context=context)
    typed: dict[str, str] = {}
    for kind, values in runs.items():
        overrides = [Parameter(n, value=v) for n, v in (values | {'autostart': False}).items()]
        node = kind(context=context, parameter_overrides=overrides)
        node.trigger_configure()
        node.trigger_activate()
        for right, role in ROLES.items():
            names = getattr(node, f'get_{role}_names_and_types_by_node')(node.get_name(), '/')
            typed |= {f'{node.get_name()} {right} {name}': f': {t[0]}' for name, t in names}
        node.destroy_node()
    rclpy.shutdown(context=context)
    allowed = [
        f'{profile.get("node")} {right} {entry.text}'.replace('~', f'/{profile.get("node")}')
        for profile in ElementTree.parse(ROOT / 'config/sros2_policy.xml').iter('profile')
        for group in profile
        for right in group.attrib
        for entry in group
        if profile.get('node') not in USERS
    ]
    for line in {*typed, *allowed}:
        if not STANDARD.search(line):
            yield line + typed.get(line, '')


def options(parser: argparse.ArgumentParser, name: str) -> Iterator[str]:
    """Yield the arguments of a command and of its subcommands."""
    yield name
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for word, inner in action.choices.items():
                yield from options(inner, f'{name} {word}')
            continue
        choices = f' {{{",".join(map(str, action.choices))}}}' if action.choices else ''
        for word in action.option_strings or [str(action.metavar or action.dest)]:
            yield f'{name} {word}{choices}'


def commands() -> Iterator[str]:
    """Yield the commands with their options, and the launch files."""
    from stavpr_ros.commands.stavpr import all_commands
    from stavpr_ros.features.registry import kinds

    feature_option = re.compile(f' --({"|".join(kinds())})-')
    for name, command in sorted(all_commands().items()):
        patch = mock.patch.object(argparse.ArgumentParser, 'print_help', autospec=True)
        with patch as print_help, redirect_stdout(None), suppress(SystemExit):
            importlib.import_module(command.module).main(['--help'])
        yield name
        for call in print_help.call_args_list:
            lines = options(call.args[0], name)  # options of features are listed once
            yield from (x for x in lines if name == 'build_map' or not feature_option.search(x))
    yield from (path.name for path in (ROOT / 'launch').glob('*.launch.py'))


def signature(function: Any) -> str:
    """Return the parameters of a function or class, with defaults of simple types."""
    rows = [
        row.replace(
            annotation=row.empty, default=row.default if isinstance(row.default, SIMPLE) else ...
        )
        for row in inspect.signature(function).parameters.values()
        if row.name not in ('self', 'cls')
    ]
    return str(inspect.Signature(rows))


def is_of(value: Any, module: str) -> bool:
    """Return whether a function or class is defined in a module, or a module below it."""
    return callable(value) and getattr(value, '__module__', '').startswith(module)


def describe(name: str, value: Any) -> Iterator[str]:
    """Yield a function or constant, or a class with its public members."""
    if not inspect.isclass(value):
        yield name + (signature(value) if inspect.isfunction(value) else '')
        return
    if issubclass(value, Enum):
        yield from (f'{name}.{member.name} = {member.value!r}' for member in value)
        return
    classes = [kind for kind in value.__mro__ if is_of(kind, 'stavpr_')]
    has_init = any('__init__' in vars(kind) for kind in classes)
    head = signature(value) if has_init else ''
    yield name + head
    members = {word: member for kind in reversed(classes) for word, member in vars(kind).items()}
    for word, member in members.items():
        function = getattr(member, '__func__', member)  # of a class or static method
        if word.startswith('_') or re.search(rf'\b{word}\b', head):  # or a field
            continue
        yield f'{name}.{word}' + (signature(function) if inspect.isfunction(function) else '')


def library() -> Iterator[str]:
    """Yield the names of the public modules: names in ``__all__``, or else defined there."""
    for module in map(importlib.import_module, PUBLIC):
        own = [word for word, value in vars(module).items() if is_of(value, module.__name__)]
        for word in getattr(module, '__all__', own):
            if not word.startswith('_'):
                yield from describe(f'{module.__name__}.{word}', getattr(module, word))


def formats() -> Iterator[str]:
    """Yield the formats of files, and the groups of entry points."""
    from stavpr_ros import plugins
    from stavpr_ros.mapping import journal, map_version2

    yield from (f'{module.FORMAT} version {module.VERSION}' for module in (journal, map_version2))
    for group in (plugins.COMMANDS, plugins.MAP_TOOLS, plugins.FEATURES, plugins.STORES):
        yield f'entry points {group}'


def public_api() -> str:
    """Return the text of the file."""
    sections: dict[str, Iterable[str]] = {
        'messages and services': messages(),  # in the order of their fields
        'parameters': sorted(parameters()),
        'topics and services': sorted({*interfaces()}),
        'commands and launch files': sorted({*commands()}),
        'library': sorted(library()),
        'formats': sorted(formats()),
    }
    text = f'# The public API (QUALITY_DECLARATION.md), written by `{COMMAND}`.\n'
    for title, lines in sections.items():
        text += f'\n# {title}\n' + ''.join(f'{line}\n' for line in lines)
    return text


if __name__ == '__main__':
    FILE.write_text(public_api(), encoding='utf-8')
