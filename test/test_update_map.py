# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameter update_map: drives of a node in localization become part of the file of its map."""

from pathlib import Path
import re

import pytest
from stavpr_msgs.srv import SaveMap
from stavpr_ros.mapping import load_map, save_map
from stavpr_ros.mapping.versions import current_version
from test_upkeep import built, OTHER, ROUTE

REBUILT = [*ROUTE[:80], *OTHER[:60], *ROUTE[140:]]


@pytest.fixture(scope='module')
def first():
    return built(ROUTE)


@pytest.fixture
def path(first, tmp_path):
    path = tmp_path / 'route.stavpr'
    save_map(first, path)
    return str(path)


def test_drives_update_the_file_by_save_map_and_at_the_end(robot, start, path):
    start(map_path=path, update_map=True, sequence_length=20)
    robot.drive(REBUILT)
    response = robot.does(SaveMap, 'save_map')
    assert response.places == len(load_map(path)) == 2 * len(ROUTE)
    assert 'which load_map reads' in response.message
    learned = current_version(path)
    assert learned.map_id == load_map(path).map_id
    assert re.fullmatch(r'drive 20\d\d-.*', learned.drive)  # its stamps are not dated
    assert 'stays as it is' in robot.refuses(SaveMap, 'save_map')  # nothing was driven since
    robot.drive(ROUTE[:150])
    assert robot.transition('deactivate')
    robot.until_logged(f'updates {path}')
    assert current_version(path).map_id == load_map(path).map_id
    assert current_version(path).parent == learned.map_id
    assert len(load_map(path)) == 2 * len(ROUTE) + 150


def test_drive_on_another_route_leaves_the_file_as_it_is(robot, start, path):
    before = Path(path).read_bytes()
    start(map_path=path, update_map=True, sequence_length=20)
    robot.drive(OTHER)
    assert 'stays as it is' in robot.refuses(SaveMap, 'save_map')
    robot.until_logged(f'does not update {path}')
    assert Path(path).read_bytes() == before


@pytest.mark.parametrize('updates', [False, True])
def test_images_of_drives_are_kept_up_to_max_places(robot, start, path, updates):
    node = start(map_path=path, update_map=updates, max_places=100)
    robot.drive(ROUTE[:110])
    assert [len(each) for each in node.runtime.pipeline.operation.take_drives()] == [100] * updates
