# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The launch files: their arguments, and the node that they start."""

import ast
from pathlib import Path
import re
import sys

from launch_files import load_launch, PACKAGES, use_stand_ins, words
from processes import executable
import pytest
from stavpr_nav.parameters import REPEAT, TEACH
from stavpr_ros.parameters import BY_NAME, REMOVED, RENAMED
from stavpr_slam.ros.graph_node import PARAMETERS as GRAPH

ROOT = Path(__file__).resolve().parents[2]
FILES = {
    path.name.partition('.')[0]: path
    for folder in ('launch', 'stavpr_nav/launch')
    for path in sorted((ROOT / folder).glob('*.launch.py'))
}
NAMES = [*FILES]
FIXED = {
    'stavpr': {},
    'replay': {},
    'mapping': {'operation': 'mapping'},
    'loop_closure': {'operation': 'loop_closure'},
    'multi_camera': {},
    'nav2': {'autostart': False},
    'pose_graph': {'operation': 'loop_closure'},
    'teach': {'operation': 'mapping'},
    'repeat': {'operation': 'localization'},
}
TABLES = {  # of the parameters of each node
    'node': {row.name: row.default for row in BY_NAME.values()},
    'teach': {name: default for name, (default, _) in TEACH.items()},
    'repeat': {name: default for name, (default, _) in REPEAT.items()},
    'pose_graph': {name: default for name, (default, _) in GRAPH.items()},
    'lifecycle_manager': {},
}
NO_ARGUMENTS = {'match_topic', 'loop_closure_topics', 'robots'}
REQUIRED = {'bag', 'cameras', 'run_path'}
OTHER_NAMES = {  # parameters of the pose graph whose names the recognition node has, too
    'keyframe_distance': 'graph_keyframe_distance',
    'publish_tf': 'correct_tf',
}
COMMON = {'image', 'odom', 'camera_info', 'namespace', 'params_file', 'use_sim_time'}
TEXTS = {bool: ('true', True), int: ('3', 3), float: ('1', 1.0), str: ('2', '2')}

REPLAY = {'bag', 'topic', 'odometry', 'also', 'rate', 'fps', 'start_offset', 'duration'}
REPLAY |= {'record', 'lossless', 'loop', 'start_paused', 'shutdown'}


@pytest.fixture
def load(monkeypatch):
    """Return the description of a launch file, by the stand-in."""
    use_stand_ins(monkeypatch)
    yield lambda name: load_launch(FILES[name])
    sys.modules.pop('stavpr_ros.ros.launching', None)


def test_launch_files_are_those_tested_here():
    assert sorted(FIXED) == sorted(NAMES)


def test_launching_imports_nothing_heavy():
    """The Python of ``ros2 launch`` may have neither torch nor numba."""
    tree = ast.parse((ROOT / 'stavpr_ros' / 'ros' / 'launching.py').read_text())
    modules = {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
    modules |= {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
    own = {name for name in modules if name.startswith('stavpr_ros')}
    assert own == {'stavpr_ros.parameters'}  # see test_parameters
    foreign = {name.partition('.')[0] for name in modules - own}
    assert foreign - set(sys.stdlib_module_names) == {'launch', 'launch_ros'}


@pytest.mark.parametrize(('name', 'package'), PACKAGES.items())
def test_launch_file_without_a_package_that_it_needs_starts_nothing(load, name, package):
    """The check comes before the node in the description, and an error ends the launch."""
    with pytest.raises(RuntimeError, match=f'{package} is not installed, so that nothing'):
        load(name).start(missing=[package])


@pytest.mark.parametrize('name', NAMES)
def test_every_argument_reaches_every_node_that_has_the_parameter(load, name):
    """All are given at once; names and types are in the tables of the nodes."""
    launch, types = load(name), {}
    for node in launch.start():
        renamed = OTHER_NAMES if node.executable == 'pose_graph' else {}
        table = {renamed.get(n, n): d for n, d in TABLES.get(node.executable, {}).items()}
        types = {**table, **types, 'use_sim_time': False}
    options = {n: TEXTS[type(types[n])][0] for n in launch.arguments if n in types}
    own = {'replay': REPLAY, 'multi_camera': {'cameras'}}.get(name, set())
    expected = {*types, *RENAMED, *REMOVED, *COMMON, *own} - set(FIXED[name]) - NO_ARGUMENTS
    assert set(launch.arguments) == expected
    for argument in launch.arguments.values():
        assert len(argument.description) > 10
        assert hasattr(argument, 'default_value') or argument.first in REQUIRED
    reached = set()
    for node in launch.start(**options):
        if node.executable == 'replay':  # which publishes /clock instead
            continue
        file, values = node.parameters
        assert words(file) == '${params_file}'
        renamed = OTHER_NAMES if node.executable == 'pose_graph' else {}
        for parameter, default in {**TABLES[node.executable], 'use_sim_time': False}.items():
            argument = renamed.get(parameter, parameter)
            if argument in options:
                reached.add(argument)
                value, kind = values[parameter], type(default)
                text = repr(TEXTS[type(types[argument])][1])
                assert (repr(value.first), value.value_type) == (text, kind), argument
        assert {topic: words(to) for topic, to in node.remappings} == {
            **{topic: f'${{{topic}}}' for topic in ('image', 'odom', 'camera_info')},
            'image/compressed': '${image}/compressed',
        }
        assert words(node.namespace) == '${namespace}' + '/front' * (name == 'multi_camera')
    assert reached == set(options) - set(RENAMED)


def test_removed_parameters_reach_the_node_which_names_them(load):
    (node,) = load('stavpr').start(**dict.fromkeys(REMOVED, 'x:y'))
    assert {name: value.first for name, value in node.parameters[1].items()} == dict.fromkeys(
        REMOVED, 'x:y'
    )


@pytest.mark.parametrize('name', NAMES)
def test_launch_file_leaves_empty_arguments_to_the_parameter_file(load, name):
    node, *others = load(name).start()
    assert node.parameters[1:] == [FIXED[name]]
    assert (node.package, node.name) == ('stavpr_ros', 'stavpr')
    assert words(node.sigkill_timeout) == '${sigkill_timeout}'
    assert float(node.sigkill_timeout.default) > 300  # the update of several drives
    for other in [node, *others]:
        if other.package.startswith('stavpr'):
            assert Path(executable(other.executable)).exists()
        if other.executable in ('teach', 'repeat'):
            assert set(other.parameters[1]) <= {'run_path'}  # required


def test_launch_of_cameras_starts_a_node_for_each_with_its_name_in_paths(load):
    nodes = load('multi_camera').start(cameras='front, rear', map_path='maps/{camera}.stavpr')
    assert [words(node.namespace) for node in nodes] == ['${namespace}/front', '${namespace}/rear']
    paths = [node.parameters[1]['map_path'].first for node in nodes]
    assert paths == ['maps/front.stavpr', 'maps/rear.stavpr']


def test_launch_for_nav2_has_a_manager_with_a_bond(load):
    _, manager = load('nav2').start()
    assert manager.package == 'nav2_lifecycle_manager'
    assert manager.parameters[1] == {
        'autostart': True, 'node_names': ['stavpr'], 'bond_timeout': 4.0,
    }  # fmt: skip


def test_pose_graph_has_its_own_of_two_names_whatever_is_in_the_parameter_file(load):
    _, graph = load('pose_graph').start()
    values = {name: value.first for name, value in graph.parameters[1].items()}
    assert values == {'keyframe_distance': 1.0, 'publish_tf': False}


@pytest.mark.parametrize(
    ('file', 'name', 'value', 'expected'),
    [
        ('stavpr', 'threshold', 'high', "threshold = 'high': expected a number"),
        ('stavpr', 'queue_size', '4.5', "queue_size = '4.5': expected an integer"),
        ('stavpr', 'autostart', 'yes', "autostart = 'yes': expected true or false"),
        ('repeat', 'max_speed', 'fast', "max_speed = 'fast': expected a number"),
    ],
)
def test_launch_argument_of_the_wrong_type_is_rejected_by_name(load, file, name, value, expected):
    with pytest.raises(RuntimeError, match=re.escape(expected)):
        load(file).start(**{name: value})


@pytest.mark.parametrize(
    ('arguments', 'expected'),
    [
        (['max_rat:=3', 'image:=/camera'], "argument 'max_rat' is unknown: did you mean max_rate"),
        (['sigterm_timeout:=9', 'webcam:=/c'], "'webcam' is unknown: see the option --show-args"),
    ],
)
@pytest.mark.parametrize(
    'file',
    [['stavpr_ros', 'x.launch.py'], ['stavpr_nav', 'x.launch.py'], ['/launch/file.launch.py']],
)
def test_launch_argument_that_is_unknown_is_rejected(load, monkeypatch, file, arguments, expected):
    monkeypatch.setattr(sys, 'argv', ['ros2', 'launch', *file, *arguments])
    with pytest.raises(RuntimeError, match=re.escape(expected)):
        load('stavpr').start()


def test_launch_included_in_another_file_accepts_the_arguments_of_that(load, monkeypatch):
    monkeypatch.setattr(sys, 'argv', ['ros2', 'launch', 'my_robot', 'robot.launch.py', 'lidar:=1'])
    assert load('stavpr').start()


def test_launch_of_replay_shuts_down_with_it_on_request_only(load):
    launch = load('replay')
    _, replay = launch.start(bag='drive')
    assert replay.on_exit is None
    assert words(dict(replay.remappings)['image']) == '${image}'
    assert Path(executable(replay.executable)).exists()
    _, replay = launch.start(bag='drive', shutdown='true')
    assert type(replay.on_exit[0]).__name__ == 'Shutdown'


@pytest.mark.parametrize(
    ('given', 'expected'),
    [
        ({}, []),
        ({'topic': '/camera', 'lossless': 'true'}, ['--topic', '/camera', '--lossless']),
        ({'rate': '2', 'start_offset': '5'}, ['--rate', '2', '--start-offset', '5']),
        ({'also': '/tf /tf_static'}, ['--also', '/tf', '/tf_static']),
        ({'keyframe_distance': '0.5'}, ['--odometry']),
        ({'keyframe_angle_deg': '10'}, ['--odometry']),
        ({'keyframe_angle': '10'}, ['--odometry']),  # its earlier name
        ({'keyframe_distance': '0.5', 'odometry': '/wheels'}, ['--odometry', '/wheels']),
        ({'keyframe_distance': '0.0'}, []),
        ({'use_sim_time': 'true', 'loop': 'true'}, ['--loop', '--clock']),
        ({'use_sim_time': 'false', 'start_paused': 'true'}, ['--start-paused']),
    ],
)
def test_launch_of_replay_passes_its_options(load, given, expected):
    """Also those that the parameters of the node need."""
    _, replay = load('replay').start(bag='drive', **given)
    assert [words(word) for word in replay.arguments] == ['${bag}', *expected]


def test_documented_launch_arguments_exist(load):
    pages = [ROOT / 'README.md', *(ROOT / 'docs').rglob('*.md')]
    text = ' '.join(page.read_text() for page in pages).replace('\\\n', ' ')
    result = re.findall(r'^ros2 launch stavpr_(?:ros|nav) (\w+)\.launch\.py(.*)', text, re.M)
    assert {name for name, _ in result} >= {'stavpr', 'replay', 'multi_camera', 'teach', 'repeat'}
    for name, options in result:
        assert set(re.findall(r'(\w+):=', options)) <= set(load(name).arguments), (name, options)
