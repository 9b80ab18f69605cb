# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command record: earlier recordings stay until there is something to replace them by."""

import json
import os
import resource

from processes import Process
import pytest
from stavpr_msgs.msg import PlaceMatch

OLD = '{"stamp": 1, "frame_id": "old"}\n'


@pytest.fixture
def record(robot, tmp_path):
    """Start the command over an old recording; it is ended with the test."""
    started = []
    (tmp_path / 'old.jsonl').write_text(OLD)

    def start(*options):
        path = str(tmp_path / 'old.jsonl')
        started.append(Process(tmp_path / 'log', 'record', '--output', path, *options))
        return started[-1]

    yield start
    for process in started:
        process.end()


@pytest.fixture
def publisher(robot):
    publisher = robot.node.create_publisher(PlaceMatch, '/stavpr/match', 10)
    yield publisher
    robot.node.destroy_publisher(publisher)


def recording(robot, process):
    robot.until(lambda: '\nrecording' in process.output(), 'the recorder')


def test_record_over_an_old_recording_is_refused_without_force(record, tmp_path):
    process = record()
    assert process.wait() == 1
    assert 'exists already: choose another name, or replace it by --force' in process.output()
    assert (tmp_path / 'old.jsonl').read_text() == OLD


def test_record_replaces_an_old_recording_at_the_first_message(record, robot, publisher, tmp_path):
    path = tmp_path / 'old.jsonl'
    process = record('--force')
    recording(robot, process)
    assert path.read_text() == OLD
    assert process.stop() == 0  # without a message
    assert path.read_text() == OLD

    process = record('--force')
    recording(robot, process)
    for index in range(3):
        publisher.publish(PlaceMatch(place_index=index))
    robot.until(lambda: path.read_text().count('\n') == 3, 'three records')
    process.popen.kill()  # what is written is there
    process.wait()
    assert [json.loads(line)['place_index'] for line in path.open()] == [0, 1, 2]
    assert sorted(os.listdir(tmp_path)) == ['log', 'old.jsonl']


def test_record_on_a_full_disk_ends_with_whole_lines(record, robot, publisher, tmp_path):
    """The limit of the size of a file has the effect of a full disk."""
    path = tmp_path / 'old.jsonl'
    process = record('--force')
    recording(robot, process)
    resource.prlimit(process.popen.pid, resource.RLIMIT_FSIZE, (10_000, 10_000))

    def ended():
        publisher.publish(PlaceMatch(reason='x' * 200))
        return process.popen.poll() is not None

    robot.until(ended, 'the end')
    lines = path.read_text().splitlines(keepends=True)
    assert len(lines) > 3
    assert all(json.loads(line)['reason'] == 'x' * 200 for line in lines)
    assert f'it has {len(lines)} matches, all of them whole: free space' in process.output()
    assert 'untouched' not in process.output()
    assert process.wait() == 1
