# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A node that is killed, or cannot save, loses no recorded place."""

import os
import random
import resource

from nav_msgs.msg import Odometry
from processes import node_process, SECOND
import pytest
from rclpy.lifecycle import TransitionCallbackReturn
from robot import image_message, PARAMETERS
from sensor_msgs.msg import Image
from stavpr_msgs.msg import PlaceMatch
from stavpr_ros.errors import OutputError
from stavpr_ros.mapping import load_map
from stavpr_ros.mapping.journal_map import journals, recover
from stavpr_ros.pipeline import saving

SUCCESS = TransitionCallbackReturn.SUCCESS


@pytest.fixture
def make(make_node, tmp_path):
    """Make and activate a node that records into the maps folder."""

    def make(**parameters):
        values = {'operation': 'mapping', 'maps_folder': str(tmp_path)}
        node = make_node(**values | parameters)
        assert node.trigger_configure() == node.trigger_activate() == SUCCESS
        return node

    return make


def record(node, images, first=0):
    """Show images to a node, and wait until they are processed."""
    for i, image in enumerate(images, first + 1):
        node.runtime.intake.images.on_image(image_message(image, i * SECOND))
        node.runtime.worker.run(lambda: None)
    while node.runtime.worker.waiting:
        node.runtime.worker.run(lambda: None)
    node.runtime.worker.run(lambda: None)


def end(node):
    node.destroy_node()
    return node.failed


def test_node_states_at_the_end_what_it_left_out(make, route, monkeypatch):
    logged, node = [], make()
    monkeypatch.setattr(node.get_logger(), 'warning', lambda text, **_: logged.append(text))
    node.runtime.intake.odometry._on_odometry(Odometry())
    node.runtime.intake.images.on_image(Image(encoding='rgb8'))
    record(node, route[:1])
    assert not end(node)
    expected = '1 images of a size that their encoding cannot have, 1 messages of odometry without'
    assert logged[-1] == f'left out: {expected} a valid pose'


def test_node_without_save_path_continues_its_recording_at_the_next_start(make, route, tmp_path):
    node = make()
    record(node, route[:12])
    assert not end(node)
    assert os.listdir(tmp_path) == ['recorded.stavpr.journal']
    node = make()
    assert node.runtime.map_info().path == str(tmp_path / 'recorded.stavpr')
    assert journals(tmp_path / 'recorded.stavpr') == []
    record(node, route[12:14], first=12)  # as a session of its own
    assert len(node.runtime.pipeline.places) == 14
    assert not end(node)
    node = make(operation='localization')  # recognizes what was recorded
    record(node, route[:12], first=20)
    assert len(node.runtime.pipeline.places) == 14
    assert node.runtime.pipeline.operation._last.match.newest == 11


def test_localization_on_another_map_names_the_journal_and_leaves_it(
    make, route, map_file, tmp_path, capfd
):
    node = make()
    record(node, route[:5])
    end(node)
    assert not end(make(operation='localization', map_path=map_file))
    assert os.listdir(tmp_path) == ['recorded.stavpr.journal']
    assert 'recorded.stavpr.journal has places of another recording' in capfd.readouterr().err
    assert len(make(operation='mapping').runtime.pipeline.places) == 5


def test_node_whose_last_save_fails_keeps_the_journal_and_reports_failure(
    make, route, tmp_path, monkeypatch
):
    path = tmp_path / 'route.stavpr'
    node = make(save_path=str(path))
    record(node, route[:5])
    with monkeypatch.context() as disk:

        def fail(*_):
            raise OutputError('the disk is full')

        disk.setattr(saving, 'save_map', fail)
        assert end(node)
    assert os.listdir(tmp_path) == ['route.stavpr.journal']
    make(save_path=str(path))
    assert len(load_map(path)) == 5


@pytest.mark.parametrize('operation', ['mapping', 'loop_closure'])
def test_node_that_ends_without_a_loss_deletes_the_journal(make, route, tmp_path, operation):
    """Its map is saved, or its route is not to be saved."""
    files = ['route.stavpr'] if operation == 'mapping' else []
    node = make(operation=operation, save_path=''.join(str(tmp_path / name) for name in files))
    record(node, route[:5])
    assert [name for name in os.listdir(tmp_path) if name.endswith('.journal')]
    assert not end(node)
    assert os.listdir(tmp_path) == files


def test_node_that_cannot_write_a_journal_records_all_the_same(make, route, tmp_path):
    (tmp_path / 'file').touch()
    node = make(maps_folder=str(tmp_path / 'file'))
    record(node, route[:5])
    assert len(node.runtime.pipeline.places) == 5


# -------------------------------------------------------------------------------------- processes


@pytest.fixture
def recording(robot, tmp_path):
    """Start a node process that records to a file; it ends with the test."""
    started = []

    def start():
        files = {'save_path': tmp_path / 'route.stavpr', 'maps_folder': tmp_path}
        given = PARAMETERS | {'operation': 'mapping', 'queue_size': 1000} | files
        started.append(node_process(tmp_path / 'log', **given))
        # a killed node stays in the graph for a while: wait for the log of the new one
        robot.until(lambda: 'backend' in started[-1].output(), 'the node')
        robot.wait_for_node()
        return started[-1]

    yield start
    for process in started:
        process.end()


def mapped(robot):
    """Return the stamps of the images that were published as places."""
    recorded = PlaceMatch.MAPPED, PlaceMatch.MATCH
    places = [match for match in robot.answers if match.status in recorded]
    return {match.header.stamp.sec * SECOND for match in places}


@pytest.mark.parametrize('kills', [2, pytest.param(20, marks=pytest.mark.long)])
def test_node_killed_at_a_random_moment_loses_no_published_place(
    recording, robot, route, tmp_path, kills
):
    """
    The next start makes a map of the journal, which the recording continues.

    A node that is killed before its first place leaves no journal: the next one begins a new map,
    which gets a numbered name.
    """
    path, random_ = tmp_path / 'route.stavpr', random.Random(0)
    published, begin = set(), robot.stamp
    for _ in range(kills):
        process, first = recording(), robot.stamp + SECOND
        published |= mapped(robot)  # of the killed node, received late
        robot.forget()
        for image in route[: random_.randrange(1, 20)]:
            robot.stamp += SECOND
            robot.publisher.publish(image_message(image, robot.stamp))
        count = random_.randrange(1, 1 + (robot.stamp - first) // SECOND + 1)
        robot.until(lambda count=count: len(mapped(robot)) >= count, 'some places')
        process.popen.kill()
        process.wait()
        published |= mapped(robot)
    assert sum(recover(journal).recorded for journal in journals(path)) > 0
    stamps = [load_map(file).stamps.tolist() for file in sorted(tmp_path.glob('route*.stavpr'))]
    assert {stamp for stamp in published if stamp > begin} <= set().union(*stamps)
    assert all(each == sorted(set(each)) for each in stamps)
    assert [name for name in os.listdir(tmp_path) if name.startswith('.')] == []


def test_node_on_a_full_disk_ends_with_an_error_and_names_the_journal(
    recording, robot, route, tmp_path
):
    path = tmp_path / 'route.stavpr'
    process = recording()
    robot.drive(route[:10])
    robot.until(lambda: bool(journals(path)), 'the journal')
    resource.prlimit(process.popen.pid, resource.RLIMIT_FSIZE, (40_000, resource.RLIM_INFINITY))
    robot.drive(route[10:15])
    assert process.stop() == 1
    output = process.output()
    assert 'the map is not saved: ' in output
    assert f'places that are in no map stay in {path}.journal' in output
    assert 10 <= recover(journals(path)[0]).places <= 15
