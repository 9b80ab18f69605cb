# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The SROS 2 policy allows the node exactly what it does, and others no more than they need."""

from policy import names_of, POLICY
import pytest
from rclpy.parameter import Parameter
from stavpr_ros.ros.node import PlaceRecognitionNode

BOTH_CAMERAS = {'/image', *(f'/image/{name}' for name in ('compressed', 'ffmpeg', 'foxglove'))}


@pytest.mark.parametrize('transport', ['raw', 'compressed'])
def test_policy_of_the_node_is_what_it_uses(context, transport):
    options = {'autostart': False, 'operation': 'mapping', 'image_transport': transport}
    overrides = [Parameter(name, value=value) for name, value in options.items()]
    node = PlaceRecognitionNode(context=context, parameter_overrides=overrides)
    try:
        assert node.trigger_configure() == node.trigger_activate()
        used = {
            'publish': node.get_publisher_names_and_types_by_node('stavpr', '/'),
            'subscribe': node.get_subscriber_names_and_types_by_node('stavpr', '/'),
            'reply': node.get_service_names_and_types_by_node('stavpr', '/'),
            'request': node.get_client_names_and_types_by_node('stavpr', '/'),
        }
    finally:
        node.destroy_node()
    names = {right: {name for name, _ in result} for right, result in used.items()}
    if names['subscribe'] & BOTH_CAMERAS:  # one of them at a time
        names['subscribe'] |= BOTH_CAMERAS
    names['subscribe'].add('/clock')  # with use_sim_time
    names['publish'] |= {'/tf', '/initialpose', '/bond'}  # with publish_tf, and for Nav2
    names['subscribe'].add('/bond')
    assert names == {'request': set(), **names_of('stavpr')}


def test_policy_of_the_others_fits_the_node():
    node, operator, reader, sensors = (
        names_of(name) for name in ('stavpr', 'stavpr_operator', 'stavpr_reader', 'stavpr_sensors')
    )
    for other in (operator, reader):
        names = {name.replace('/stavpr_operator/', '/stavpr/') for name in other['subscribe']}
        assert names <= node['publish'] | {'/clock'}
    assert operator['request'] <= node['reply']
    assert 'request' not in reader
    assert node['subscribe'] - {'/bond'} <= sensors['publish']


def test_policy_has_no_comment_that_sros2_takes_for_an_enclave():
    text = POLICY.read_text(encoding='utf-8')
    assert '<!--' not in text[text.index('<policy') :]
