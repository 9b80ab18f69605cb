# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The SROS 2 policy allows each program what it publishes, subscribes to, serves and requests."""

from bags import SECOND, write_odometry
import numpy as np
from policy import names_of
from processes import Process
import pytest
from stavpr_msgs.msg import PlaceMatch
from stavpr_ros.sources.frame import ImageRecord

KINDS = {
    'publish': 'publisher', 'subscribe': 'subscriber', 'reply': 'service', 'request': 'client'
}  # fmt: skip
BY_OPTIONS_OR_DATA = {'/camera_info', '/clock', '/odom', '/tf', '/tf_static'}  # publishers


@pytest.mark.parametrize(
    ('node', 'command', 'last'),
    [
        ('stavpr_record', 'record --output FOLDER/x', 'publish /stavpr_record/recording'),
        ('stavpr_replay', 'replay FOLDER/bag', 'reply /stavpr_replay/pause'),
        ('stavpr_monitor', 'monitor --port 0', 'request /stavpr/reset'),
        ('pose_graph', 'pose_graph', 'subscribe /stavpr/loop_closure'),
        ('robot_localization_bridge', 'bridge robot_localization', 'publish /diagnostics'),
    ],
)
def test_policy_allows_what_a_program_uses(robot, tmp_path, node, command, last):
    stamps = [(i + 1) * SECOND for i in range(3)]
    image = np.zeros((8, 8, 3), np.uint8)
    images = [ImageRecord.of_image(image, stamp) for stamp in stamps]
    write_odometry(tmp_path / 'bag', stamps, images=images)
    arguments, (right_of_last, name) = command.replace('FOLDER', str(tmp_path)), last.split()
    # the recorder waits for one, and for the parameters of its node, of another name here
    robot.node.create_publisher(PlaceMatch, '/stavpr/match', 1)
    process = Process(tmp_path / 'log', *arguments.split())

    def names_in_use(right: str) -> set[str]:
        if (node, '/') not in robot.node.get_node_names_and_namespaces():
            return set()
        names = getattr(robot.node, f'get_{KINDS[right]}_names_and_types_by_node')(node, '/')
        return {name for name, _ in names}

    try:
        robot.until(
            lambda: (
                name in names_in_use(right_of_last)
                and names_of(node)['publish'] - names_in_use('publish') <= BY_OPTIONS_OR_DATA
            ),
            f'{last} and all publishers of {node}',
        )
        for right in KINDS:
            names = names_of(node).get(right, set())
            names_here = {name.replace('/robot/', '/stavpr/') for name in names_in_use(right)}
            assert names_here <= names, right
    finally:
        process.end()
