# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Diagnostics of every state: levels, messages and values."""

from collections import Counter
import math
from pathlib import Path

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from stavpr_msgs.msg import MapInfo
from stavpr_ros.parameters import PARAMETERS
from stavpr_ros.pipeline import node_settings
from stavpr_ros.pipeline.statistics import ImageCounts, Tally
from stavpr_ros.ros.diagnostics import diagnostic_array
from stavpr_ros.ros.health import Health
from stavpr_ros.ros.input import InputStatus
import yaml

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR

SETTINGS = {row.name: row.default for row in PARAMETERS} | {'backend': 'cpu'}
HEALTHY = {
    'state': 'active',
    'hardware_id': 'r2 /camera',
    'window': 20,
    'uptime': 100.0,
    'received': 3000,
    'rate': 30.0,
    'age': 0.02,
    'missing_images': 0,
    'drops': {},
    'recent_drops': {},
    'recent_edges': {},
    'statuses': {'no match': 990, 'match': 2000},
    'recent_statuses': {'no match': 99, 'match': 200},
    'status': 'match',
    'place': 17,
    'distance': 0.4217,
    'times': {'work': (11.5, 22.25), 'matching': (11.5, 22.25)},
    'map_path': 'route.map',
    'map_state': 'loaded',
    'places': 1000,
    'topic': '/camera/image',
    'publishers': 1,
    'loss_remedy': 'make the driver reliable',
    'reliability': 'reliable',
}


def statuses(changes):
    """Return the statuses by part after changes of the state of a healthy node."""
    state = HEALTHY | changes

    def chosen(kind):
        return {name: state[name] for name in kind.__dataclass_fields__ if name in state}

    counts = {
        'received': Tally(Counter({'': state['received']}), rate=state['rate'], age=state['age']),
        'missing': Tally(recent=Counter({'': state['missing_images']})),
        'dropped': Tally(Counter(state['drops']), Counter(state['recent_drops'])),
        'edges': Tally(Counter(state['recent_edges']), Counter(state['recent_edges'])),
        'answered': Tally(
            Counter(state['statuses']), Counter(state['recent_statuses']), rate=29.9, age=0.03
        ),
    }
    parts = {
        'counts': ImageCounts(**chosen(ImageCounts) | counts),
        'input': InputStatus(**chosen(InputStatus)),
        'settings': node_settings({name: state.get(name, SETTINGS[name]) for name in SETTINGS}),
        'map_info': MapInfo(
            path=state['map_path'],
            state=state['map_state'],
            places=state['places'],
            features='gradient',
        ),
    }
    fields = {name: value for name, value in chosen(Health).items() if name not in parts}
    array = diagnostic_array(Health(**fields, **parts), '/robot/stavpr', Time(sec=7, nanosec=8))
    assert (array.header.stamp.sec, array.header.stamp.nanosec) == (7, 8)
    assert deserialize_message(serialize_message(array), DiagnosticArray) == array
    assert {status.hardware_id for status in array.status} == {'r2 /camera'}
    assert all(status.name.startswith('robot/stavpr: ') for status in array.status)
    return {status.name.partition(': ')[2]: status for status in array.status}


def values(part, **changes):
    """Return the values of a part as words key=value."""
    return [f'{pair.key}={pair.value}' for pair in statuses(changes)[part].values]


NEVER = {'age': None}
NEW = NEVER | {'uptime': 1.9, 'rate': 0.0, 'recent_statuses': {}, 'status': '', 'times': {}}
STEADY = '30.0 images per second on /camera/image'
REFUSED = {'incompatible': 1, 'remedy': 'set reliability'}
NO_IMAGE = 'no image yet on /camera/image: '
ODOMETRY = {'odometry': 'stale', 'keyframe_distance': 1.0}
NO_MAP = {'map_state': 'none', 'map_path': '', 'places': 0}
FULL_MAP = {'map_state': 'full', 'places': 20000}
LOADING = {'map_state': 'loading', 'places': 0}
LOST = {'recent_drops': {'lost in transport': 1}}
FULL = {'recent_drops': {'queue full': 120}}
SLOW = FULL | {'times': {'work': (62.5, 80.0)}}
NO_MATCH = {'statuses': {'no match': 100}}
PAPER = {'mode': 'paper', 'threshold': 0.125, 'nearest': 0.5}

CASES = {
    'input': [
        (OK, STEADY, {}),
        (OK, 'waiting for the first image on /camera/image', NEW),
        (OK, STEADY, {'age': 2.0, 'publishers': 0}),
        (WARN, 'no image for 2 s on /camera/image: 1 publisher there, but silent', {'age': 2.1}),
        (WARN, f'{NO_IMAGE}no publisher; find', NEVER | {'publishers': 0, 'uptime': 2.1}),
        (ERROR, f'{NO_IMAGE}1 publisher refused for QoS: set reliability', NEVER | REFUSED),
        (ERROR, f'{NO_IMAGE}Pose is published there: compare', NEVER | {'mistyped': 'Pose'}),
        (OK, STEADY, REFUSED),
        (WARN, 'while images of others arrive: set reliability', REFUSED | {'publishers': 2}),
        (WARN, '1 image lost in transport in the last 10 s: make the driver reliable (', LOST),
        (OK, STEADY, {'drops': {'lost in transport': 9}}),
        (OK, STEADY, {'missing_images': 15}),
        (WARN, 'about 16 images missing by their stamps in the last 10 s', {'missing_images': 16}),
        (WARN, 'required by a parameter, has stopped: start it, compare its topic', ODOMETRY),
        (WARN, 'by a parameter, was never received', ODOMETRY | {'odometry': 'never'}),
        (OK, STEADY, {'odometry': 'never', 'operation': 'mapping'}),
        (WARN, 'for poses of the map, was never', {'odometry': 'never', 'odometry_fault': 'x'}),
        (WARN, '2 images without odometry at', {'recent_drops': {'no odometry': 2}}),
        (OK, STEADY, {'contrast': 3.0}),
        (WARN, 'the images show nothing (standard deviation 1.2 of 255): ', {'contrast': 1.25}),
    ],
    'map': [
        (OK, '1000 places of route.map', {}),
        (WARN, 'geometric_check requires thumbnails', {'geometric_check': 'orb'}),
        (WARN, 'pnp requires poses, relative_pose pnp requires', {'relative_pose': 'pnp'}),
        (WARN, 'publish_tf requires poses; record', {'publish_tf': True}),
        (OK, 'places of', {'relative_pose': 'pnp', 'operation': 'loop_closure'}),
        (WARN, 'defect; the map in use has 1000 places', {'problem': 'defect'}),
        (ERROR, 'defect', NO_MAP | {'problem': 'defect'}),
        (WARN, 'no map is loaded: set map_path, or call ~/load_map', NO_MAP),
        (OK, 'loading route.map', LOADING),
        (OK, 'growing: 1 place of at most 20000', {'map_state': 'growing', 'places': 1}),
        (WARN, 'full: mapping stopped at 20000 places (max_places); save it', FULL_MAP),
    ],
    'recognition': [
        (OK, '200 of 299 images matched in the last 10 s; last result: match, place 17', {}),
        (OK, 'warming up: 19 of 20 images', {'window': 19}),
        (OK, 'matched', {'sends_transform': True, 'localized': True}),
        (WARN, 'not localized: the transform on /tf is of the last', {'sends_transform': True}),
        (WARN, 'no match is possible: no threshold', {'missing': 'no threshold'}),
        (OK, 'waiting for the map', LOADING | {'missing': 'a map is being loaded'}),
        (WARN, 'no match is possible', {'map_state': 'loading', 'missing': 'no threshold'}),
        (OK, 'mapping: images become places', {'operation': 'mapping', 'missing': 'no threshold'}),
        (OK, 'matched', {'places': 20}),
        (WARN, 'the map has fewer places (19) than a window has images', {'places': 19}),
        (OK, 'matched', {'statuses': {'no match': 99}}),
        (OK, 'matched', NO_MATCH | {'operation': 'loop_closure'}),
        (WARN, 'none of 100 images was ever matched, the best had', NO_MATCH | {'nearest': 0.75}),
        (WARN, 'or raise threshold (0.125)', NO_MATCH | PAPER),
        (WARN, 'ever matched: the geometric check rejects all', NO_MATCH | {'nearest': 0.25}),
        (WARN, 'the geometric check', NO_MATCH | {'nearest': 0.75, 'applied_threshold': 0.8}),
    ],
    'processing': [
        (OK, '11.5 ms an image, 29.9 results per second', {}),
        (OK, 'no image in the last 10 s', NEW),
        (WARN, '120 images dropped in the last 10 s, the queue was full: 30.0 images per', SLOW),
        (WARN, 'or keyframe_*, precision int8, a smaller map', SLOW | {'precision': 'float32'}),
        (WARN, 'one takes 11.5 ms, which is fast enough: they arrive in bursts; raise', FULL),
        (WARN, 'none was finished; check for a map being loaded', FULL | {'times': {}}),
        (OK, 'ms an image', {'recent_edges': {'pnp': 5, 'refuted': 2}}),
        (
            WARN,
            '2 of 5 loop closures without a relative pose in the last 10 s: PnP is slower',
            {'recent_edges': {'pnp': 3, 'dropped': 2}},
        ),
        (ERROR, '2 images failed', {'recent_drops': {'queue full': 120, 'internal error': 2}}),
        (OK, 'ms an image', {'drops': {'internal error': 2, 'queue full': 7}}),
    ],
}


@pytest.mark.parametrize(
    ('part', 'level', 'phrase', 'changes'),
    [(part, *case) for part, cases in CASES.items() for case in cases],
)
def test_part_in_each_state_has_its_level_and_message(part, level, phrase, changes):
    result = statuses(changes)
    status = result.pop(part)
    assert (status.level, phrase in status.message) == (level, True), status.message
    assert {other.level for other in result.values()} == {OK}  # one cause, one finding


@pytest.mark.parametrize(
    ('state', 'remedy'),
    [
        ('unconfigured', "; run 'ros2 lifecycle set /robot/stavpr configure'"),
        ('inactive', "; run 'ros2 lifecycle set /robot/stavpr activate'"),
        ('finalized', ''),
        ('configuring', ''),
    ],
)
def test_parts_of_an_inactive_node_are_ok(state, remedy):
    """Whatever would be wrong with an active node."""
    wrong = NO_MAP | FULL | ODOMETRY | {'age': 60.0, 'publishers': 0, 'missing': 'threshold'}
    result = statuses(wrong | {'state': state})
    assert {status.level for status in result.values()} == {OK}
    del result['map']
    assert {status.message for status in result.values()} == {
        f'{state}: no image is processed{remedy}'
    }


@pytest.mark.parametrize(
    ('others', 'level'),
    [
        ({'recent_statuses': {'warming up': 1}}, WARN),
        ({'recent_statuses': {}}, ERROR),
        ({'recent_statuses': {}, 'recent_drops': {'max_rate': 5}}, ERROR),
        ({'recent_statuses': {}, 'recent_drops': {'not a keyframe': 5}}, WARN),
    ],
)
def test_input_without_an_image_that_could_be_decoded_is_an_error(others, level):
    drops = {'invalid: size': 2, 'invalid: encoding': 1} | others.get('recent_drops', {})
    status = statuses(others | {'recent_drops': drops})['input']
    start = 'all images' if level == ERROR else '3 images'
    assert status.message.startswith(f'{start} in the last 10 s were invalid (size 2, encoding 1)')
    assert status.level == level


def test_input_with_several_faults_lists_the_worst_first():
    drops = {'lost in transport': 1, 'invalid: size': 2}
    changes = {'recent_drops': drops, 'recent_statuses': {}, 'missing_images': 50}
    status = statuses(ODOMETRY | changes)['input']
    assert status.level == ERROR
    assert [text.split()[0] for text in status.message.split('; ')] == ['all', '1', 'odometry,']


DROPS = {'invalid: Cut off': 3, 'lost in transport': 4, 'no odometry': 5, 'max_rate': 6}
NOTHING = {'mode': 'paper', 'threshold': -1.0, 'place': -1, 'distance': math.nan, 'status': ''}
VALUES = [
    ('input', ODOMETRY, 'odometry=stale'),
    ('input', {'drops': DROPS}, 'dropped_invalid_cut_off=3'),
    ('input', {'drops': DROPS, 'recent_drops': {'no odometry': 1}}, 'dropped_no_odometry_10s=1'),
    ('recognition', {'applied_threshold': 0.25}, 'min_probability=0.750'),
    ('recognition', {'recent_edges': {'dropped': 2}}, 'edges_dropped_10s=2'),
    ('recognition', {}, 'statuses_no_match=990'),
    *(('recognition', NOTHING, f'{name}=none') for name in ('last_newest_index', 'threshold')),
    ('processing', {}, 'work_max_ms=22.250'),
]


@pytest.mark.parametrize(('part', 'changes', 'value'), VALUES)
def test_part_has_value(part, changes, value):
    assert value in values(part, **changes)


def test_statuses_are_in_the_group_of_the_aggregator():
    """Its GenericAnalyzer takes the names that contain one of these texts."""
    path = Path(__file__).parents[1] / 'config' / 'diagnostic_aggregator.yaml'
    (group,) = (
        analyzer
        for analyzer in yaml.safe_load(path.read_text())['analyzers']['ros__parameters'].values()
        if isinstance(analyzer, dict)
    )
    assert group['type'] == 'diagnostic_aggregator/GenericAnalyzer'
    names = [status.name for status in statuses({}).values()]
    assert all(any(text in name for text in group['contains']) for name in names)
