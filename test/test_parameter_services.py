# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of any name, type and value: each is set, or rejected with a reason."""

import math
import re

from hypothesis import given, HealthCheck, settings, strategies
import pytest
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
import rclpy
from robot import parameters_of
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


def test_nested_text_is_rejected_with_a_reason(make_node):
    node = make_node(map_path='')
    strange = Parameter(name='feature_settings', value=ParameterValue(type=4, string_value=NESTED))
    service = service_of(node, SetParameters)
    response = service.callback(
        SetParameters.Request(parameters=[strange]), SetParameters.Response()
    )
    assert 'expected a JSON object' in response.results[0].reason
    assert len(response.results[0].reason) < 1000


@pytest.mark.parametrize('value', ['a' * 20_000, 'a\nb', '\x1b[2J'])
def test_text_that_harms_a_log_is_rejected_by_name(make_node, value):
    node = make_node(map_path='')
    for name in ('save_path', 'robot_id'):
        (result,) = node.set_parameters([rclpy.Parameter(name, value=value)])
        assert re.match(
            f'{name} = .* expected at most 4096, none of them a control', result.reason
        )
        assert len(result.reason) < 300


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


def test_removed_parameter_is_named_with_a_remedy(make_node, capfd):
    for name, remedy in REMOVED.items():
        sentence = f'parameter {name!r} was removed in 1.0: {remedy}'
        node = make_node(**{name: 'package.module:name'})
        assert sentence in capfd.readouterr().err
        result = node.set_parameters(parameters_of({name: 1.0}))[0]
        assert (result.successful, result.reason) == (False, sentence)
        assert not node.has_parameter(name)
