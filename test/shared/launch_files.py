# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A stand-in of ``launch``, which cannot be installed by pip, that records what files describe."""

import importlib.util
import sys
from types import ModuleType, SimpleNamespace

GIVEN = {'cameras': 'front', 'run_path': 'run.csv'}  # required arguments
PACKAGES = {'nav2': 'nav2_lifecycle_manager', 'pose_graph': 'stavpr_slam'}  # that files need


class Recorded:
    """An action or substitution that keeps its arguments."""

    def __init__(self, *positional, **named):
        self.first = self.entities = self.name = positional[0] if positional else None
        self.__dict__.update(named)

    def perform(self, context):
        return context[self.first]


class StandIn(ModuleType):
    """A module in which every name is such a class."""

    def __getattr__(self, name):
        if name.startswith('__'):
            raise AttributeError(name)
        return vars(self).setdefault(name, type(name, (Recorded,), {}))


STAND_INS = [
    package + module
    for package in ('launch', 'launch_ros')
    for module in ('', '.actions', '.parameter_descriptions', '.substitutions')
]


class Context(dict):
    """Launch configurations, and the file that is launched."""

    def get_locals_as_dict(self):
        return {'current_launch_file_path': '/launch/file.launch.py'}


def describe(path):
    spec = importlib.util.spec_from_file_location('launch_file', path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.generate_launch_description()


def load_launch(path):
    """Return arguments, nodes and start of the description in a file."""
    entities = describe(path).entities

    def those(kind):
        return [entity for entity in entities if type(entity).__name__ == kind]

    declared = those('DeclareLaunchArgument')
    arguments = {argument.first: argument for argument in declared}
    assert len(arguments) == len(declared)

    def start(missing=(), **given):
        defaults = {n: getattr(a, 'default_value', None) for n, a in arguments.items()}
        shares = dict.fromkeys(PACKAGES.values(), '/share')
        context = Context(shares | defaults | GIVEN | given)
        for package in missing:
            del context[package]
        return [node for e in those('OpaqueFunction') for node in e.function(context) or ()]

    return SimpleNamespace(arguments=arguments, start=start, nodes=those('Node'))


def use_stand_ins(monkeypatch):
    """Let the launch files import the stand-ins."""
    for name in STAND_INS:
        monkeypatch.setitem(sys.modules, name, StandIn(name))
    monkeypatch.delitem(sys.modules, 'stavpr_ros.ros.launching', raising=False)


def words(value):
    """Spell a text with substitutions as `${name}`."""
    if isinstance(value, list):
        return ''.join(map(words, value))
    return f'${{{value.first}}}' if isinstance(value, Recorded) else value
