# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The launch files of teach and repeat: arguments, and the nodes that they start."""

from pathlib import Path
import sys

from launch_files import load_launch, use_stand_ins, words
from processes import executable
import pytest
from stavpr_nav.parameters import REPEAT, TEACH

FOLDER = Path(__file__).parents[1] / 'launch'
CASES = {
    'teach': ('mapping', set(TEACH), {'odom': '${odom}'}),
    'repeat': (
        'localization',
        set(REPEAT) - {'match_topic'},
        {'image': '${image}', 'image/compressed': '${image}/compressed'},
    ),
}


@pytest.mark.parametrize('name', CASES)
def test_launch_file_starts_both_nodes_with_their_arguments(monkeypatch, name):
    operation, own, remappings = CASES[name]
    use_stand_ins(monkeypatch)
    launch = load_launch(FOLDER / f'{name}.launch.py')
    sys.modules.pop('stavpr_ros.ros.launching', None)
    assert own | {'image', 'odom', 'params_file'} <= set(launch.arguments)
    (recognizer,) = launch.start(map_path='route.stavpr')
    assert recognizer.parameters[1]['operation'] == operation
    assert recognizer.parameters[1]['map_path'].first == 'route.stavpr'
    (node,) = launch.nodes
    assert Path(executable(node.executable)).parent.name == node.package == 'stavpr_nav'
    assert {topic: words(to) for topic, to in node.remappings} == remappings
    assert words(node.namespace) == '${namespace}'
    (values,) = node.parameters
    assert set(values) == own
    for key, value in values.items():
        configuration = value if name == 'teach' else value.first  # of a ParameterValue
        assert words(configuration) == f'${{{key}}}'
