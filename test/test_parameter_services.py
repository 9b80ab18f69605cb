# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of any name, type and value: each is set, or rejected with a reason."""

import math

from hypothesis import given, HealthCheck, settings, strategies
import pytest
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.lifecycle import TransitionCallbackReturn
from robot import parameters_of
from stavpr_ros.errors import SettingsError
from stavpr_ros.parameters import BY_NAME, PARAMETERS, REMOVED

NESTED = '[' * 2000
TEXTS = strategies.text(strategies.characters(exclude_characters='\0', codec='utf-8'), max_size=40)
VALUES = strategies.builds(
    ParameterValue,
    type=strategies.sampled_from([*range(10), 77, 255]),
    bool_value=strategies.booleans(),
    integer_value=strategies.integers(-(2**63), 2**63 - 1),
    double_value=strategies.floats(),
    string_value=strategies.sampled_from(['', NESTED, '{"a":' * 2000, '{}', '/dev/zero', '..'])
    | TEXTS,
    string_array_value=strategies.lists(TEXTS, max_size=3),
)
NAMES = strategies.sampled_from([row.name for row in PARAMETERS] + ['', 'use_sim_time', '/', 'é'])


def service_of(node, kind):
    return next(service for service in node.services if service.srv_type is kind)


def test_parameters_that_rclpy_cannot_read_get_a_response(robot, start):
    """Over ROS: an unknown type; those before it are set, those after it are not."""
    node = start(map_path='')
    right = Parameter(name='min_probability', value=ParameterValue(type=3, double_value=0.25))
    strange = Parameter(name='candidates', value=ParameterValue(type=77))
    later = Parameter(name='candidates', value=ParameterValue(type=2, integer_value=3))
    parameters = [right, strange, later]
    results = robot.call(SetParameters, 'set_parameters', parameters=parameters).results
    assert [result.successful for result in results] == [True, False, False]
    assert '77 is not a valid' in results[1].reason
    atomic = 'set_parameters_atomically'
    result = robot.call(SetParametersAtomically, atomic, parameters=parameters).result
    assert not result.successful
    assert '77 is not a valid' in result.reason
    values = [node.get_parameter(name).value for name in ('min_probability', 'candidates')]
    assert values == [0.25, 10]


# at the start, and of a node that localizes
WRONG_TYPES = [
    ('threshold', 'high', 'has the wrong type: expected a number'),
    ('queue_size', 4.5, 'has the wrong type: expected an integer'),
    ('publish_tf', 1, 'has the wrong type: expected true or false'),
    ('robot_id', 2, 'has the wrong type: expected text'),
]
NOT_DECLARED = {
    'sequence_lenght': 'is unknown: did you mean sequence_length?',
    'beta': 'is unknown: see `ros2 param list`',
} | {name: f'was removed in 1.0: {remedy}' for name, remedy in REMOVED.items()}
REJECTED = [
    *WRONG_TYPES,
    *((name, 'package.module:name', words) for name, words in NOT_DECLARED.items()),
    ('map_path', 'other.stavpr', 'call the service ~/load_map'),
    ('operation', 'mapping', 'call the service ~/set_operation'),
    ('nms_radius', 7, 'while the node is unconfigured'),
    ('threshold', 0.8, 'is of mode paper'),
    ('min_probability', 1.0, 'below 1'),
    ('save_path', '/missing/route.stavpr', 'save_path'),
    ('geometric_check', 'eye', 'take one of none'),
    ('save_path', 'a' * 20_000, 'expected at most 4096, none of them a control'),
    ('save_path', '\x1b[2J', 'none of them a control'),
    ('robot_id', 'a\nb', 'none of them a control'),
]


def test_parameters_that_are_rejected_by_name_change_nothing(make_node, map_file):
    node = make_node(map_path=map_file)
    assert node.trigger_configure() == TransitionCallbackReturn.SUCCESS
    before = node.settings
    for name, value, words in REJECTED:
        (result,) = node.set_parameters(parameters_of({name: value}))
        assert (result.successful, words in result.reason) == (False, True), result.reason
        assert name in result.reason
        assert len(result.reason) < 1000
        assert not node.has_parameter(name) or node.get_parameter(name).value != value
        assert node.settings is before
    together = parameters_of({'candidates': 3, 'min_probability': 1.0})
    assert not node.set_parameters_atomically(together).successful
    assert node.settings.pipeline.candidates == 10
    for values in ({'map_path': map_file}, {'candidates': 3}):  # the first one is the current one
        assert node.set_parameters(parameters_of(values))[0].successful
    assert node.runtime.pipeline.settings.candidates == 3


def test_parameters_of_the_start_are_rejected_or_logged_by_name(make_node, capfd):
    for name, value, words in WRONG_TYPES:
        with pytest.raises(SettingsError, match=f'{name} = {value!r} {words}'):
            make_node(**{name: value})
    node = make_node(**dict.fromkeys(NOT_DECLARED, 'package.module:name'))
    (result,) = node.set_parameters(parameters_of({'feature_settings': NESTED}))
    assert 'expected a JSON object' in result.reason
    assert len(result.reason) < 1000
    logged = capfd.readouterr().err
    assert all(f'parameter {name!r} {words}' in logged for name, words in NOT_DECLARED.items())


def test_integer_where_a_number_is_expected_is_converted(make_node):
    """As in `threshold: 1` of a parameter file, and in `ros2 param set NODE threshold 1`."""
    node = make_node(mode='paper', threshold=1)
    assert repr(node.settings.pipeline.threshold) == '1.0'
    assert node.set_parameters(parameters_of({'threshold': 2}))[0].successful
    assert repr(node.get_parameter('threshold').value) == '2.0'


def test_any_parameter_is_set_or_rejected_with_a_reason(make_node):
    node = make_node(map_path='')

    @settings(max_examples=300, suppress_health_check=list(HealthCheck))
    @given(strategies.lists(strategies.tuples(NAMES, VALUES), min_size=1, max_size=3))
    def check(pairs):
        parameters = [Parameter(name=name, value=value) for name, value in pairs]
        for kind in (SetParameters, SetParametersAtomically):
            request, response = kind.Request(parameters=parameters), kind.Response()
            service_of(node, kind).callback(request, response)
            results = response.results if kind is SetParameters else [response.result]
            assert len(results) == (len(pairs) if kind is SetParameters else 1)
            assert all(result.successful or result.reason for result in results)
        for name, row in BY_NAME.items():
            value = node.get_parameter(name).value
            assert type(value) is type(row.default)
            assert not (isinstance(value, float) and math.isnan(value))

    check()


def test_parameter_by_its_earlier_name_is_set_with_a_warning(make_node, capfd):
    node = make_node(keyframe_angle=5.0)
    assert node.get_parameter('keyframe_angle_deg').value == 5
    assert "parameter 'keyframe_angle' is keyframe_angle_deg now" in capfd.readouterr().err
    assert node.set_parameters(parameters_of({'keyframe_angle': 7}))[0].successful
    assert node.settings.pipeline.keyframes.angle == 7
    assert "parameter 'keyframe_angle' is keyframe_angle_deg now" in capfd.readouterr().err
    assert not node.has_parameter('keyframe_angle')
