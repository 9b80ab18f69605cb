"""Diagnostics of every state: levels, messages and values."""

import math
from dataclasses import replace

import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.serialization import deserialize_message, serialize_message

from stavpr_ros.pipeline.statistics import Counts, StageTime
from stavpr_ros.ros.diagnostics import diagnostic_array
from stavpr_ros.ros.health import Health

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
PARTS = ('input', 'map', 'recognition', 'processing')

COUNTS = Counts(
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
HEALTH = Health(
    counts=COUNTS,
    state='active',
    topic='/camera/image',
    transport='raw',
    publishers=1,
    queue=0,
    queue_size=4,
    window=20,
    length=20,
    operation='localization',
    mode='robust',
    map_path='route.map',
    map_state='loaded',
    places=1000,
    max_places=20000,
    features='gradient',
    backend='cpu',
    device='2 cores',
    precision='float32',
    threshold=1.0,
)


def status(part, health=HEALTH, **changes):
    """Return one status, and the levels of the others; changes are of the counts or the health."""
    fields = Counts.__dataclass_fields__
    counts = replace(health.counts, **{k: v for k, v in changes.items() if k in fields})
    changes = {k: v for k, v in changes.items() if k not in fields}
    health = replace(health, counts=counts, **changes)
    statuses = diagnostic_array(health, '/robot/stavpr', Time(sec=7, nanosec=8)).status
    levels = {s.name.split(': ')[1]: s.level for s in statuses}
    found = next(s for s in statuses if s.name == f'robot/stavpr: {part}')
    others = {name: level for name, level in levels.items() if name != part}
    return found, others


def check(part, level, message, *, others_are=OK, **changes):
    """Compare one status, and check that the change affects no other part."""
    found, others = status(part, **changes)
    assert (found.level, found.message) == (level, message)
    assert set(others.values()) == {others_are}, others


def values(part, **changes):
    return {value.key: value.value for value in status(part, **changes)[0].values}


def test_array_of_a_node_is_stamped_named_and_serializable():
    array = diagnostic_array(HEALTH, '/robot/stavpr', Time(sec=7, nanosec=8))
    assert (array.header.stamp.sec, array.header.stamp.nanosec) == (7, 8)
    assert [s.name for s in array.status] == [f'robot/stavpr: {part}' for part in PARTS]
    assert {s.hardware_id for s in array.status} == {'2 cores'}
    assert deserialize_message(serialize_message(array), DiagnosticArray) == array


def test_array_of_a_healthy_node_is_ok():
    check('input', OK, '30.0 images per second on /camera/image')
    check('map', OK, '1000 places of route.map')
    recent = '200 of 299 images matched in the last 10 s'
    check('recognition', OK, f'{recent}; last result: match, place 17, distance 0.422')
    check('processing', OK, '11.5 ms an image, 29.9 results per second')


def test_array_after_activation_is_ok():
    new = {
        'uptime': 1.9,
        'received': 0,
        'received_age': None,
        'rate_in': 0.0,
        'recent_statuses': {},
    }
    new |= {
        'status': '',
        'place': -1,
        'distance': math.nan,
        'work': None,
        'total': None,
        'stages': {},
    }
    check('input', OK, 'waiting for the first image on /camera/image', **new)
    check('processing', OK, 'no image in the last 10 s', **new)
    check('recognition', OK, 'warming up: 0 of 20 images', window=0, **new)
    check('recognition', OK, '0 of 0 images matched in the last 10 s', **new)


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
        check(part, OK, text, **wrong)
        check(part, OK, text, map_state='none', **wrong)


class TestInput:
    """Images that do not come, or not as they should."""

    def test_input_after_two_silent_seconds_is_a_warning(self):
        assert status('input', received_age=2.0)[0].level == OK
        assert status('input', received_age=2.1)[0].level == WARN

    def test_input_without_publisher_names_the_remedy(self):
        remedy = (
            "no publisher; find the camera's topic with 'ros2 topic list', remap to it "
            'with --ros-args -r image:=TOPIC'
        )
        never = {'received_age': None, 'received': 0, 'publishers': 0, 'uptime': 2.1}
        check('input', WARN, f'no image yet on /camera/image: {remedy}', **never)
        check(
            'input',
            WARN,
            f'no image for 12 s on /camera/image: {remedy}',
            received_age=12.3,
            publishers=0,
        )

    def test_input_of_a_silent_publisher_is_a_warning(self):
        rest = 'there, but silent; check for a paused bag or a camera that is off'
        check(
            'input',
            WARN,
            f'no image for 3 s on /camera/image: 1 publisher {rest}',
            received_age=3.0,
        )
        message = f'no image yet on /camera/image: 2 publishers {rest}'
        check('input', WARN, message, received_age=None, received=0, publishers=2)

    def test_input_of_an_incompatible_publisher_is_an_error(self):
        never = {'received_age': None, 'received': 0, 'incompatible': 1}
        message = 'no image yet on /camera/image: 1 publisher refused for QoS: set reliability'
        check('input', ERROR, message, remedy='set reliability', **never)
        assert "'ros2 topic info --verbose /camera/image'" in status('input', **never)[0].message

    def test_input_after_the_incompatible_publisher_has_gone_ignores_it(self):
        gone = {
            'received_age': 5.0,
            'incompatible': 1,
            'publishers': 0,
            'remedy': 'set reliability',
        }
        found, _ = status('input', **gone)
        assert found.level == WARN
        assert 'no publisher' in found.message
        check('input', OK, '30.0 images per second on /camera/image', incompatible=1, publishers=1)

    def test_input_of_compatible_and_incompatible_publishers_is_a_warning(self):
        message = '1 publisher refused for QoS, while images of others arrive: set reliability'
        check('input', WARN, message, incompatible=1, publishers=2, remedy='set reliability')

    def test_input_before_the_first_image_is_ok(self):
        young = {
            'received_age': None,
            'received': 0,
            'uptime': 1.0,
            'incompatible': 1,
            'publishers': 2,
        }
        check('input', OK, 'waiting for the first image on /camera/image', **young)

    def test_input_with_lost_images_names_the_remedy(self):
        message = (
            '1 image lost in transport in the last 10 s: give the publisher a bigger shared-memory '
            "segment (README, 'If images are lost')"
        )
        check('input', WARN, message, recent_drops={'lost in transport': 1})
        long_ago = {'drops': {'lost in transport': 9}}
        check('input', OK, '30.0 images per second on /camera/image', **long_ago)

    def test_input_with_invalid_images_counts_kinds(self):
        drops = {'invalid: size': 2, 'queue': 4, 'invalid: encoding': 1}
        message = '3 images in the last 10 s were invalid (size 2, encoding 1): see the log'
        check('input', WARN, message, recent_drops=drops)

    @pytest.mark.parametrize('valid', ['match', 'no match', 'warming up', 'mapped'])
    def test_input_with_one_valid_image_is_a_warning(self, valid):
        mixed = {'invalid image': 30, valid: 1}
        found, _ = status('input', recent_drops={'invalid: size': 30}, recent_statuses=mixed)
        assert found.level == WARN

    @pytest.mark.parametrize('other', ['invalid image', 'dropped', 'not ready', 'skipped'])
    def test_input_without_a_valid_image_is_an_error(self, other):
        message = (
            'all images in the last 10 s were invalid (depth 30): see the log, and '
            'docs/node.md for the supported encodings'
        )
        drops = {'invalid: depth': 30, 'max_rate': 5}
        check('input', ERROR, message, recent_drops=drops, recent_statuses={other: 30})
        standing = drops | {'not a keyframe': 5}
        assert status('input', recent_drops=standing, recent_statuses={other: 30})[0].level == WARN

    def test_input_without_odometry_is_a_warning(self):
        rest = 'start it, compare its topic and its stamps'
        message = f'odometry, required by a parameter, was never received: {rest}'
        check('input', WARN, message, odometry='never')
        message = f'odometry, required by a parameter, has stopped: {rest}'
        check('input', WARN, message, odometry='stale')
        check('input', OK, '30.0 images per second on /camera/image', odometry='fresh')

    def test_input_with_several_faults_lists_the_worst_first(self):
        drops = {'lost in transport': 1, 'invalid: size': 2}
        found, _ = status('input', recent_drops=drops, recent_statuses={}, odometry='stale')
        assert found.level == ERROR
        texts = found.message.split('; ')
        assert [text.split()[0] for text in texts] == ['all', '1', 'odometry,']


class TestMap:
    """The map, whatever the state of the node."""

    def test_map_with_a_problem_is_an_error_unless_one_is_in_use(self):
        problem = 'route.map: not there'
        for state in ('active', 'inactive', 'unconfigured'):
            check('map', ERROR, problem, problem=problem, state=state, map_state='none', places=0)
        message = f'{problem}; the map in use has 1000 places'
        check('map', WARN, message, problem=problem)

    def test_map_that_is_missing_is_a_warning_while_active(self):
        message = 'no map: set map_path or call ~/load_map'
        nothing = {'map_state': 'none', 'map_path': '', 'places': 0}
        check('map', WARN, message, **nothing)
        check('map', OK, message, state='inactive', **nothing)

    def test_map_during_loading_is_ok(self):
        check('map', OK, 'loading route.map', map_state='loading', places=0)
        message = 'loading route.map; the old map of 1000 places is used meanwhile'
        check('map', OK, message, map_state='loading')

    def test_map_that_is_full_is_a_warning(self):
        check('map', OK, 'growing: 1 place of at most 20000', map_state='growing', places=1)
        remedy = 'save it with ~/save_map, then raise max_places'
        message = f'full: mapping stopped at 20000 places (max_places); {remedy}'
        check('map', WARN, message, map_state='full', places=20000)
        check('map', OK, message, map_state='full', places=20000, state='inactive')

    def test_map_without_a_file_is_named_so(self):
        check('map', OK, '1000 places of a map without a file', map_path='')


class TestRecognition:
    """Whether there are answers, and which."""

    def test_recognition_without_a_threshold_is_a_warning(self):
        missing = "parameter 'threshold' is not set"
        check(
            'recognition',
            WARN,
            f'no match is possible: {missing}',
            missing=missing,
            threshold=None,
        )

    def test_recognition_while_the_first_map_is_loaded_is_ok(self):
        loading = {'map_state': 'loading', 'places': 0, 'missing': 'a map is being loaded'}
        check('recognition', OK, 'waiting for the map', **loading)
        old = {'map_state': 'loading', 'missing': "parameter 'threshold' is not set"}
        assert status('recognition', **old)[0].level == WARN

    def test_recognition_in_operation_mapping_is_ok(self):
        message = 'mapping: images become places, none is recognized'
        check('recognition', OK, message, operation='mapping', missing='threshold', window=0)

    def test_recognition_with_a_partial_window_is_ok(self):
        check('recognition', OK, 'warming up: 7 of 20 images', window=7)

    def test_recognition_after_a_rejection_gives_the_reason(self):
        message = '200 of 299 images matched in the last 10 s; last result: no match, distance 0.422 (too far)'
        check('recognition', OK, message, status='no match', place=-1, reason='too far')

    def test_recognition_counts_only_matches_and_rejections(self):
        statuses = {'match': 1, 'no match': 1, 'skipped': 90, 'warming up': 8}
        found, _ = status('recognition', recent_statuses=statuses)
        assert found.message.startswith('1 of 2 images matched')


FULL = {'queue full': 120}


class TestProcessing:
    """Whether the worker keeps up."""

    LOST = '120 images dropped in the last 10 s, the queue was full: 30.0 images per second arrive'

    def test_processing_below_the_rate_of_images_names_remedies(self):
        message = f'{self.LOST}, one takes 62.5 ms, so 16.0 per second are possible: '
        message += 'set max_rate or keyframe_*, '
        slow = {'recent_drops': FULL, 'work': StageTime(62.5, 80.0)}
        check('processing', WARN, f'{message}precision float16, a smaller map', **slow)
        check('processing', WARN, f'{message}a smaller map', precision='float16', **slow)

    def test_processing_with_internal_errors_is_an_error(self):
        message = '2 images failed in the last 10 s by an internal error: see the log'
        check('processing', ERROR, message, recent_drops=FULL | {'internal error': 2})
        assert status('processing', drops={'internal error': 2})[0].level == OK

    def test_processing_with_bursts_names_queue_size(self):
        message = (
            f'{self.LOST}, one takes 11.5 ms, which is fast enough: they arrive in bursts; '
            'raise queue_size'
        )
        check('processing', WARN, message, recent_drops=FULL)

    def test_processing_without_a_result_names_causes(self):
        message = f'{self.LOST}, none was finished; check for a map being loaded or a busy machine'
        check('processing', WARN, message, recent_drops=FULL, work=None, total=None)

    def test_processing_with_other_or_old_drops_is_ok(self):
        message = '11.5 ms an image, 29.9 results per second'
        wanted = {'max_rate': 90, 'not a keyframe': 5, 'not ready': 3}
        check('processing', OK, message, recent_drops=wanted, drops=wanted | {'queue full': 7})


def test_values_of_input_are_complete():
    drops = {'invalid: cut off': 3, 'lost in transport': 4, 'no odometry': 5, 'max_rate': 6}
    assert values(
        'input', drops=drops, recent_drops={'lost in transport': 1}, gaps=2, longest_gap=1.5
    ) == {
        'topic': '/camera/image',
        'transport': 'raw',
        'publishers': '1',
        'publishers_refused': '0',
        'received': '3000',
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
        'threshold': '1.000',
        'window': '20',
        'length': '20',
        'last_status': 'match',
        'last_reason': 'none',
        'last_place': '17',
        'last_distance': '0.422',
        'last_answer_age_s': 'none',
        'statuses_warming_up': '19',
        'statuses_no_match': '971',
        'statuses_match': '2000',
    }
    nothing = values('recognition', place=-1, distance=math.nan, threshold=None, status='')
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
        'device': '2 cores',
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
