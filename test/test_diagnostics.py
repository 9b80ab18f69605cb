# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Diagnostics of every state: levels, messages and values."""

from dataclasses import replace
import math

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from stavpr_msgs.msg import MapInfo
from stavpr_ros.parameters import PARAMETERS
from stavpr_ros.pipeline import node_settings
from stavpr_ros.pipeline.statistics import ImageCounts, StageTime
from stavpr_ros.ros.diagnostics import diagnostic_array
from stavpr_ros.ros.health import Health
from stavpr_ros.ros.input import InputStatus

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
PARTS = ('input', 'map', 'recognition', 'processing')

COUNTS = ImageCounts(
    uptime=100.0,
    received=3000,
    answered=2990,
    rate_in=30.0,
    rate_out=29.9,
    received_age=0.02,
    answered_age=0.03,
    statuses={'warming up': 19, 'no match': 971, 'match': 2000},
    recent_statuses={'no match': 99, 'match': 200},
    status='match',
    place=17,
    distance=0.4217,
    stages={'waiting': StageTime(1.0, 2.0), 'matching': StageTime(11.5, 22.25)},
    total=StageTime(12.5, 24.0),
    work=StageTime(11.5, 22.25),
)
SETTINGS = {row.name: row.default for row in PARAMETERS} | {'backend': 'cpu'}
HEALTH = Health(
    state='active',
    hardware_id='r2 /camera',
    settings=node_settings(SETTINGS),
    counts=COUNTS,
    map_info=MapInfo(path='route.map', state='loaded', places=1000, features='gradient'),
    input=InputStatus(
        topic='/camera/image',
        publishers=1,
        loss_remedy='make the camera driver reliable',
        reliability='reliable, every publisher offers it',
    ),
    window=20,
)


def changed(health, changes):
    """Return the health with changes of its fields, or of its counts, map, input or settings."""
    parts = {
        'counts': replace(health.counts, **chosen(changes, ImageCounts.__dataclass_fields__)),
        'input': replace(health.input, **chosen(changes, InputStatus.__dataclass_fields__)),
        'map_info': MapInfo(
            path=changes.get('map_path', health.map_info.path),
            state=changes.get('map_state', health.map_info.state),
            places=changes.get('places', health.map_info.places),
            features=health.map_info.features,
        ),
        'settings': node_settings(SETTINGS | chosen(changes, SETTINGS)),
    }
    return replace(health, **parts, **chosen(changes, Health.__dataclass_fields__))


def chosen(changes, names):
    return {name: value for name, value in changes.items() if name in names}


def status(part, health=HEALTH, **changes):
    """Return one status, and the levels of the others, after changes of the health."""
    statuses = diagnostic_array(changed(health, changes), '/robot/stavpr', Time(sec=7, nanosec=8))
    levels = {s.name.split(': ')[1]: s.level for s in statuses.status}
    found = next(s for s in statuses.status if s.name == f'robot/stavpr: {part}')
    others = {name: level for name, level in levels.items() if name != part}
    return found, others


def require(part, level, message, others_are=OK, **changes):
    """Compare one status, and check that the changes affect no other part."""
    found, others = status(part, **changes)
    assert (found.level, found.message) == (level, message)
    assert set(others.values()) == {others_are}, others


def values(part, **changes):
    return {value.key: value.value for value in status(part, **changes)[0].values}


def test_array_is_stamped_named_and_serializable():
    array = diagnostic_array(HEALTH, '/robot/stavpr', Time(sec=7, nanosec=8))
    assert (array.header.stamp.sec, array.header.stamp.nanosec) == (7, 8)
    assert [s.name for s in array.status] == [f'robot/stavpr: {part}' for part in PARTS]
    assert {s.hardware_id for s in array.status} == {'r2 /camera'}
    assert deserialize_message(serialize_message(array), DiagnosticArray) == array


@pytest.mark.parametrize(
    ('state', 'message'),
    [
        ('unconfigured', "run 'ros2 lifecycle set /robot/stavpr configure'"),
        ('inactive', "run 'ros2 lifecycle set /robot/stavpr activate'"),
        ('finalized', ''),
        ('configuring', ''),
    ],
)
def test_array_of_an_inactive_node_is_ok(state, message):
    """Whatever would be wrong with an active node."""
    wrong = {'received_age': 60.0, 'publishers': 0, 'missing': 'threshold', 'odometry': 'never'}
    wrong |= {'recent_drops': {'queue full': 3, 'invalid: size': 2}, 'state': state}
    text = f'{state}: no image is processed' + (f'; {message}' if message else '')
    for part in ('input', 'recognition', 'processing'):
        require(part, OK, text, **wrong)
        require(part, OK, text, map_state='none', **wrong)


NEVER = {'received_age': None, 'received': 0}
NEW = NEVER | {'uptime': 1.9, 'rate_in': 0.0, 'recent_statuses': {}, 'status': '', 'place': -1}
NEW |= {'distance': math.nan, 'work': None, 'total': None, 'stages': {}}
STEADY = '30.0 images per second on /camera/image'
MISSING_PUBLISHER = (
    "no publisher; find the camera's topic with 'ros2 topic list', remap to it "
    'with --ros-args -r image:=TOPIC'
)
SILENT = 'there, but silent; check for a paused bag or a camera that is off'
INFO = "compare 'ros2 topic info --verbose /camera/image'"
LOST = (
    '1 image lost in transport in the last 10 s: make the camera driver reliable '
    '(docs/troubleshooting.md, images are lost)'
)
MISSING = (
    'about 16 images missing by their stamps in the last 10 s; none was lost in transport: check '
    'the camera driver, its cable and its exposure'
)
ODOMETRY = 'start it, compare its topic and its stamps'
REFUSED = {'incompatible': 1, 'remedy': 'set reliability'}
NO_MAP = {'map_state': 'none', 'map_path': '', 'places': 0}
FULL_MAP = (
    'full: mapping stopped at 20000 places (max_places); '
    'save it with ~/save_map, then raise max_places'
)
RESULTS = '200 of 299 images matched in the last 10 s; last result'
LOADING = {'map_state': 'loading', 'places': 0, 'missing': 'a map is being loaded'}
FULL = {'recent_drops': {'queue full': 120}}
DROPPED = '120 images dropped in the last 10 s, the queue was full: 30.0 images per second arrive'
SLOW = FULL | {'work': StageTime(62.5, 80.0)}
TOO_SLOW = (
    f'{DROPPED}, one takes 62.5 ms, so 16.0 per second are possible: set max_rate or keyframe_*'
)
FAST = '11.5 ms an image, 29.9 results per second'


CASES = {
    'input': [
        (OK, STEADY, {}),
        (OK, 'waiting for the first image on /camera/image', NEW),
        (OK, STEADY, {'received_age': 2.0}),
        (WARN, f'no image for 2 s on /camera/image: 1 publisher {SILENT}', {'received_age': 2.1}),
        (
            WARN,
            f'no image yet on /camera/image: {MISSING_PUBLISHER}',
            NEVER | {'publishers': 0, 'uptime': 2.1},
        ),
        (
            ERROR,
            'no image yet on /camera/image: 1 publisher refused for QoS: set reliability',
            NEVER | REFUSED,
        ),
        (
            ERROR,
            f'no image yet on /camera/image: 1 publisher refused for QoS: {INFO}',
            NEVER | {'incompatible': 1},
        ),
        (
            WARN,
            f'no image for 5 s on /camera/image: {MISSING_PUBLISHER}',
            REFUSED | {'received_age': 5.0, 'publishers': 0},
        ),
        (OK, STEADY, {'incompatible': 1, 'publishers': 1}),
        (
            WARN,
            '1 publisher refused for QoS, while images of others arrive: set reliability',
            REFUSED | {'publishers': 2},
        ),
        (
            OK,
            'waiting for the first image on /camera/image',
            NEVER | {'uptime': 1.0, 'incompatible': 1, 'publishers': 2},
        ),
        (
            ERROR,
            'no image yet on /camera/image: geometry_msgs/msg/Pose is published there: '
            'compare image_transport and the topic',
            NEVER | {'mistyped': 'geometry_msgs/msg/Pose'},
        ),
        (WARN, LOST, {'recent_drops': {'lost in transport': 1}}),
        (OK, STEADY, {'drops': {'lost in transport': 9}}),
        (OK, STEADY, {'recent_missing': 15}),
        (WARN, MISSING, {'recent_missing': 16}),
        (WARN, LOST, {'recent_missing': 16, 'recent_drops': {'lost in transport': 1}}),
        (
            WARN,
            '3 images in the last 10 s were invalid (size 2, encoding 1): see the log',
            {'recent_drops': {'invalid: size': 2, 'queue': 4, 'invalid: encoding': 1}},
        ),
        (
            WARN,
            f'odometry, required by a parameter, was never received: {ODOMETRY}',
            {'odometry': 'never', 'keyframe_distance': 1.0},
        ),
        (OK, STEADY, {'odometry': 'never', 'operation': 'mapping'}),
        (
            WARN,
            f'odometry, required by a parameter, has stopped: {ODOMETRY}',
            {'odometry': 'stale', 'keyframe_distance': 1.0},
        ),
        (OK, STEADY, {'odometry': 'fresh'}),
        (
            WARN,
            '2 images without odometry at their stamps in the last 10 s: compare both',
            {'odometry': 'fresh', 'recent_drops': {'no odometry': 2}},
        ),
    ],
    'map': [
        (OK, '1000 places of route.map', {}),
        (OK, '1000 places of a map without a file', {'map_path': ''}),
        (WARN, 'defect; the map in use has 1000 places', {'problem': 'defect'}),
        *[
            (ERROR, 'defect', NO_MAP | {'problem': 'defect', 'state': state})
            for state in ('active', 'inactive', 'unconfigured')
        ],
        (WARN, 'no map: set map_path or call ~/load_map', NO_MAP),
        (OK, 'no map: set map_path or call ~/load_map', NO_MAP | {'state': 'inactive'}),
        (OK, 'loading route.map', {'map_state': 'loading', 'places': 0}),
        (
            OK,
            'loading route.map; the old map of 1000 places is used meanwhile',
            {'map_state': 'loading'},
        ),
        (OK, 'growing: 1 place of at most 20000', {'map_state': 'growing', 'places': 1}),
        (WARN, FULL_MAP, {'map_state': 'full', 'places': 20000}),
        (OK, FULL_MAP, {'map_state': 'full', 'places': 20000, 'state': 'inactive'}),
    ],
    'recognition': [
        (OK, f'{RESULTS}: match, place 17, distance 0.422', {}),
        (
            OK,
            f'{RESULTS}: no match, distance 0.422 (too far)',
            {'status': 'no match', 'place': -1, 'reason': 'too far'},
        ),
        (OK, '0 of 0 images matched in the last 10 s', NEW),
        (OK, 'warming up: 0 of 20 images', NEW | {'window': 0}),
        (OK, 'warming up: 7 of 20 images', {'window': 7}),
        (WARN, 'no match is possible: no threshold', {'missing': 'no threshold'}),
        (OK, 'waiting for the map', LOADING),
        (
            WARN,
            'no match is possible: no threshold',
            {'map_state': 'loading', 'missing': 'no threshold'},
        ),
        (
            OK,
            'mapping: images become places, none is recognized',
            {'operation': 'mapping', 'missing': 'no threshold', 'window': 0},
        ),
    ],
    'processing': [
        (OK, FAST, {}),
        (OK, 'no image in the last 10 s', NEW),
        (WARN, f'{TOO_SLOW}, precision int8, a smaller map', SLOW),
        (WARN, f'{TOO_SLOW}, a smaller map', SLOW | {'precision': 'int8'}),
        (
            WARN,
            f'{DROPPED}, one takes 11.5 ms, which is fast enough: they arrive in bursts; '
            'raise queue_size',
            FULL,
        ),
        (
            WARN,
            f'{DROPPED}, none was finished; check for a map being loaded or a busy machine',
            FULL | {'work': None, 'total': None},
        ),
        (
            ERROR,
            '2 images failed in the last 10 s by an internal error: see the log',
            {'recent_drops': {'queue full': 120, 'internal error': 2}},
        ),
        (OK, FAST, {'drops': {'internal error': 2}}),
        (OK, FAST, {'recent_drops': {'max_rate': 90, 'not ready': 3}, 'drops': {'queue full': 7}}),
    ],
}


@pytest.mark.parametrize(
    ('part', 'level', 'message', 'changes'),
    [(part, *case) for part, cases in CASES.items() for case in cases],
)
def test_part_in_each_state_has_its_level_and_message(part, level, message, changes):
    require(part, level, message, **changes)


@pytest.mark.parametrize('valid', ['match', 'no match', 'warming up', 'mapped'])
def test_input_with_one_valid_image_is_a_warning(valid):
    mixed = {'invalid image': 30, valid: 1}
    found, _ = status('input', recent_drops={'invalid: size': 30}, recent_statuses=mixed)
    assert found.level == WARN


@pytest.mark.parametrize('other', ['invalid image', 'dropped', 'not ready', 'skipped'])
def test_input_without_a_valid_image_is_an_error(other):
    message = (
        'all images in the last 10 s were invalid (depth 30): see the log, '
        'and docs/node.md for the supported encodings'
    )
    drops = {'invalid: depth': 30, 'max_rate': 5}
    require('input', ERROR, message, recent_drops=drops, recent_statuses={other: 30})
    drops['not a keyframe'] = 5
    assert status('input', recent_drops=drops, recent_statuses={other: 30})[0].level == WARN


def test_input_with_several_faults_lists_the_worst_first():
    drops = {'lost in transport': 1, 'invalid: size': 2}
    changes = {'odometry': 'stale', 'keyframe_distance': 1.0}
    found, _ = status('input', recent_drops=drops, recent_statuses={}, **changes)
    assert found.level == ERROR
    assert [text.split()[0] for text in found.message.split('; ')] == ['all', '1', 'odometry,']


def test_recognition_counts_only_matches_and_rejections():
    statuses = {'match': 1, 'no match': 1, 'skipped': 90, 'warming up': 8}
    found, _ = status('recognition', recent_statuses=statuses)
    assert found.message.startswith('1 of 2 images matched')


@pytest.mark.parametrize(
    ('changes', 'value'),
    [
        ({}, 'not needed'),
        ({'odometry': 'fresh', 'operation': 'mapping'}, 'fresh, optional'),
        ({'odometry': 'stale', 'keyframe_angle': 1.0}, 'stale'),
    ],
)
def test_value_of_odometry_states_whether_it_is_used(changes, value):
    assert values('input', **changes)['odometry'] == value


@pytest.mark.parametrize(
    ('part', 'changes', 'message'),
    [
        ('input', {'contrast': 1.25}, 'the images show nothing (standard deviation 1.2 of 255): '),
        (
            'input',
            {'odometry': 'never', 'operation': 'mapping', 'odometry_fault': 'remap odom'},
            'odometry, for poses of the map, was never received: remap odom',
        ),
        (
            'input',
            {'odometry': 'stale', 'keyframe_distance': 1.0, 'odometry_fault': 'remap odom'},
            'odometry, required by a parameter, has stopped: remap odom',
        ),
        ('recognition', {'places': 19}, 'the map has fewer places (19) than a window has images '),
        (
            'recognition',
            {'statuses': {'no match': 100}, 'nearest': 0.75},
            'none of 100 images was ever matched, the best had probability 0.250: compare the '
            'route, the direction and the keyframe rules with those of the map, or lower '
            'min_probability (0.5)',
        ),
        (
            'recognition',
            {'mode': 'paper', 'threshold': 0.125, 'nearest': 0.5, 'statuses': {'no match': 100}},
            'none of 100 images was ever matched, the best had distance 0.500: compare the '
            'route, the direction and the keyframe rules with those of the map, or raise '
            'threshold (0.125)',
        ),
        (
            'recognition',
            {'statuses': {'no match': 100}, 'nearest': 0.25},
            'none of 100 images was ever matched: the geometric check rejects all, ',
        ),
    ],
)
def test_faults_of_the_setup_are_warnings_with_a_remedy(part, changes, message):
    found, others = status(part, **changes)
    assert (found.level, found.message[: len(message)]) == (WARN, message)
    assert set(others.values()) == {OK}


@pytest.mark.parametrize(
    ('part', 'changes'),
    [
        ('input', {'contrast': 3.0}),
        ('input', {'contrast': 1.0, 'rate_in': 0.0}),
        ('recognition', {'places': 20}),
        ('recognition', {'statuses': {'no match': 99}}),
        ('recognition', {'statuses': {'no match': 1000}, 'operation': 'loop_closure'}),
    ],
)
def test_setups_that_may_work_are_no_fault(part, changes):
    assert status(part, **changes)[0].level == OK


def test_values_of_input_are_complete():
    drops = {'invalid: cut off': 3, 'lost in transport': 4, 'no odometry': 5, 'max_rate': 6}
    assert values(
        'input', drops=drops, recent_drops={'lost in transport': 1}, gaps=2, longest_gap=1.5
    ) == {
        'topic': '/camera/image',
        'transport': 'raw',
        'publishers': '1',
        'publishers_refused': '0',
        'reliability': 'reliable, every publisher offers it',
        'received': '3000',
        'missing_by_stamps_estimate': '0',
        'missing_by_stamps_estimate_10s': '0',
        'rate_in_hz': '30.000',
        'last_image_age_s': '0.020',
        'gaps': '2',
        'longest_gap_s': '1.500',
        'jumps_back': '0',
        'longest_jump_back_s': '0.000',
        'odometry': 'not needed',
        'dropped_invalid_cut_off': '3',
        'dropped_invalid_cut_off_10s': '0',
        'dropped_lost_in_transport': '4',
        'dropped_lost_in_transport_10s': '1',
        'dropped_no_odometry': '5',
        'dropped_no_odometry_10s': '0',
    }


def test_values_of_map_are_complete():
    assert values('map', map_path='') == {
        'state': 'loaded',
        'path': 'none',
        'places': '1000',
        'max_places': '20000',
        'features': 'gradient',
    }


def test_values_of_recognition_are_complete():
    assert values('recognition', answered_age=None) == {
        'operation': 'localization',
        'mode': 'robust',
        'min_probability': '0.500',
        'window': '20',
        'length': '20',
        'last_status': 'match',
        'last_reason': 'none',
        'last_place': '17',
        'last_distance': '0.422',
        'last_answer_age_s': 'none',
        'camera': 'not needed',
        'last_edge_reason': 'none',
        'statuses_warming_up': '19',
        'statuses_no_match': '971',
        'statuses_match': '2000',
    }
    nothing = values(
        'recognition', mode='paper', threshold=-1.0, place=-1, distance=math.nan, status=''
    )
    assert {
        nothing[key] for key in ('last_place', 'last_distance', 'threshold', 'last_status')
    } == {'none'}


def test_values_of_processing_are_complete():
    found = values(
        'processing', drops={'queue full': 6, 'invalid: size': 1}, recent_drops={'queue full': 2}
    )
    assert found == {
        'state': 'active',
        'uptime_s': '100.000',
        'answered': '2990',
        'rate_out_hz': '29.900',
        'queue': '0',
        'queue_size': '4',
        'backend': 'cpu',
        'device': 'CPU',
        'precision': 'float32',
        'dropped_queue_full': '6',
        'dropped_queue_full_10s': '2',
        'total_mean_ms': '12.500',
        'work_mean_ms': '11.500',
        'waiting_mean_ms': '1.000',
        'matching_mean_ms': '11.500',
        'total_max_ms': '24.000',
        'work_max_ms': '22.250',
        'waiting_max_ms': '2.000',
        'matching_max_ms': '22.250',
    }
    assert not [
        key
        for key in values('processing', stages={}, total=None, work=None)
        if key.endswith('_ms')
    ]
