# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Arguments and node of the launch files, from the table of parameters; a light import."""

from collections.abc import Iterable, Mapping
import difflib
import os
import sys
from typing import Any

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare
from stavpr_ros.parameters import EXPECTED, PARAMETERS, REMOVED, RENAMED

PACKAGE = 'stavpr_ros'
PACKAGES = {PACKAGE, 'stavpr_nav'}  # with launch files that use this module
END_SECONDS = '600'  # for a node that saves, or updates, a map at its end; launch gives 5
END_TIMEOUTS = 'sigterm_timeout', 'sigkill_timeout'  # arguments that launch itself reads
TYPES: dict[str, type] = {row.name: type(row.default) for row in PARAMETERS} | {
    'use_sim_time': bool
}
TYPES |= {old: TYPES[new] for old, new in RENAMED.items()}
TYPES |= dict.fromkeys(REMOVED, str)  # given to the node, which warns
CAMERA = '{camera}'  # in a text, the name of each of several cameras


def remappings() -> list[tuple[str, Any]]:
    """Return the remappings of the topics that are arguments."""
    image = LaunchConfiguration('image')
    return [
        ('image', image),
        ('image/compressed', [image, '/compressed']),
        ('odom', LaunchConfiguration('odom')),
        ('camera_info', LaunchConfiguration('camera_info')),
    ]


def other_node(
    package: str,
    executable: str,
    name: str,
    table: Mapping[str, tuple[Any, str]] | None = None,
    fixed: Mapping[str, object] | None = None,
    renamed: Mapping[str, str] | None = None,
) -> list[Any]:
    """
    Describe a node beside the recognition node: its arguments, and the action that starts it.

    It has the topics, the ``params_file`` and ``use_sim_time`` of the recognition node, and the
    arguments that are parameters of both.

    :param table: default and sentence of each parameter, by the name of its argument.
    :param fixed: parameters that the launch file sets itself.
    :param renamed: parameters whose arguments have other names, since the recognition node has a
        parameter of this name: always given, whatever ``params_file`` has for that.
    """
    table, renamed = table or {}, renamed or {}
    types = {argument: type(default) for argument, (default, _) in table.items()}
    types['use_sim_time'] = bool

    def start(context: LaunchContext) -> list[Node]:
        texts = {argument: LaunchConfiguration(argument).perform(context) for argument in types}
        values = {renamed.get(n, n): value for n, value in _values(texts, types).items()}
        return [_node(package, executable, {**values, **(fixed or {})}, name=name)]

    arguments = [
        DeclareLaunchArgument(
            argument,
            default_value=str(default) if argument in renamed else '',
            description=sentence + '; empty: as set in params_file' * (argument not in renamed),
        )
        for argument, (default, sentence) in table.items()
        if argument not in TYPES
    ]
    return [*arguments, OpaqueFunction(function=start)]


def node_launch(
    *others: Any,
    cameras: LaunchConfiguration | None = None,
    image: str = 'image',
    odom: str = 'odom',
    needs: str = '',
    **fixed: object,
) -> LaunchDescription:
    """
    Describe the launch of the node; every parameter is an argument.

    :param others: further arguments, and actions after the node.
    :param cameras: names of cameras, separated by commas: one node each, in a namespace of this
        name; None = one node.
    :param image, odom: default topics.
    :param needs: package of the actions, '' = none; where it is missing, nothing is started.
    :param fixed: parameters that the launch file sets itself.
    """
    declarations = [other for other in others if isinstance(other, DeclareLaunchArgument)]
    arguments = [*declarations, *_arguments(image, odom, fixed)]
    actions = [other for other in others if other not in declarations]
    check = _check([argument.name for argument in arguments], needs)

    def start(context: LaunchContext) -> list[Node]:
        names = [''] if cameras is None else cameras.perform(context).replace(' ', '').split(',')
        texts = {n: LaunchConfiguration(n).perform(context) for n in TYPES if n not in fixed}
        end = LaunchConfiguration('sigkill_timeout', default=END_SECONDS)
        return [
            _node(
                PACKAGE, 'node', _values(texts, TYPES, camera) | fixed, camera, name='stavpr',
                sigkill_timeout=end,
            )
            for camera in names
        ]  # fmt: skip

    return LaunchDescription([*arguments, check, OpaqueFunction(function=start), *actions])


def unknown_arguments(words: Iterable[str], names: Iterable[str]) -> list[str]:
    """
    Return a sentence for each argument that no launch file declares; launch ignores them.

    :param words: words of the command line, arguments as ``NAME:=VALUE``.
    """
    problems = []
    for name, separator, _ in (word.partition(':=') for word in words):
        if separator and name not in names:
            near = difflib.get_close_matches(name, names, 1)
            hint = f'did you mean {near[0]}?' if near else 'see the option --show-args'
            problems.append(f'argument {name!r} is unknown: {hint}')
    return problems


def _values(texts: dict[str, str], types: dict[str, type], camera: str = '') -> dict[str, object]:
    """Return the values of arguments that are parameters, if they are not empty."""
    values: dict[str, object] = {}
    for name, text in ((n, text.replace(CAMERA, camera)) for n, text in texts.items() if text):
        kind = types[name]
        try:
            value = {'true': True, 'false': False}[text.lower()] if kind is bool else kind(text)
        except (KeyError, ValueError):
            raise RuntimeError(f'{name} = {text!r}: expected {EXPECTED[kind]}') from None
        values[name] = ParameterValue(value, value_type=kind)
    return values


def _check(names: list[str], needs: str) -> OpaqueFunction:
    """Reject unknown arguments, unless they are for another launch file, and a missing package."""

    def check(context: LaunchContext) -> None:
        file = context.get_locals_as_dict().get('current_launch_file_path')
        paths = (os.path.realpath(word) for word in sys.argv)
        is_ours = not PACKAGES.isdisjoint(sys.argv) or os.path.realpath(file or '') in paths
        if is_ours and (problems := unknown_arguments(sys.argv, [*names, *END_TIMEOUTS])):
            raise RuntimeError('; '.join(problems))
        if needs:
            try:
                FindPackageShare(needs).perform(context)
            except Exception as error:  # of any type; launch would leave a started node running
                raise RuntimeError(
                    f'the package {needs} is not installed, so that nothing is started: install '
                    'it, as ros-jazzy-NAME or in this workspace, or start stavpr.launch.py'
                ) from error

    return OpaqueFunction(function=check)


def _arguments(image: str, odom: str, fixed: dict[str, object]) -> list[DeclareLaunchArgument]:
    sentences = {row.name: row.sentence for row in PARAMETERS}
    sentences |= {old: f'Earlier name of {new}.' for old, new in RENAMED.items()}
    sentences |= {name: f'Removed in 1.0: {remedy}.' for name, remedy in REMOVED.items()}
    sentences['use_sim_time'] = 'Take the time from the topic /clock.'
    params_file = PathJoinSubstitution([FindPackageShare(PACKAGE), 'config', 'stavpr.yaml'])
    rows: dict[str, tuple[Any, str]] = {
        'image': (image, 'topic of the images'),
        'odom': (odom, 'topic of the odometry'),
        'camera_info': (
            'camera_info', 'topic of the intrinsics; camera_info: the one beside the images'
        ),
        'namespace': ('', 'namespace of node and topics'),
        'params_file': (params_file, 'file of the parameters of all nodes'),
    }  # fmt: skip
    parameters = (name for name in sentences if name not in fixed)
    rows |= {name: ('', f'{sentences[name]} Empty: as set in params_file.') for name in parameters}
    return [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in rows.items()
    ]


def _node(
    package: str, executable: str, values: dict[str, object], camera: str = '', **options: Any
) -> Node:
    namespace = LaunchConfiguration('namespace')
    return Node(
        package=package,
        executable=executable,
        namespace=[namespace, '/', camera] if camera else namespace,
        output='screen',
        remappings=remappings(),
        parameters=[LaunchConfiguration('params_file'), values],
        **options,
    )
