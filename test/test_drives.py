# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameter update_map: drives are on the disk until they are in the file of the map."""

from pathlib import Path
import re
import shutil
import signal
from unittest.mock import patch

from fixtures import route_images
from pipelines import localizing, Log, process
from processes import node_process
import pytest
from robot import PARAMETERS
from stavpr_msgs.srv import SaveMap
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.errors import OutputError
from stavpr_ros.mapping import load_map, save_map, versions
from stavpr_ros.mapping.versions import current_version
from stavpr_ros.pipeline import drives, read_map
from stavpr_ros.pipeline.saving import (
    save_recorded_map,
    take_up_earlier_drives,
    update_own_map,
)
from test_upkeep import build, OTHER, ROUTE

pytestmark = pytest.mark.usefixtures('one_thread')
DRIVES = [
    [*ROUTE[:first], *OTHER[first - 80 : first - 20], *ROUTE[first + 60 :]]
    for first in (80, 90, 100)
]
NAMES = [f'drive 2023-11-14 22-{minute}' for minute in ('13-21', '30-01', '46-41')]


class Killed(BaseException):
    """The end of a program at a point."""


@pytest.fixture(scope='module')
def recording(tmp_path_factory):
    """Return a map, and three drives of a pipeline on it."""
    path = tmp_path_factory.mktemp('recorded') / 'route.stavpr'
    save_map(build(ROUTE), path)
    pipeline = localizing(str(path), update_map=True, sequence=SequenceSettings(20))
    for number, drive in enumerate(DRIVES):
        process(pipeline, drive, first=1_700_000_000 + 1000 * number)
        pipeline.operation.reset()
    return path, pipeline.operation.take_drives()


@pytest.fixture
def path(recording, tmp_path):
    return str(shutil.copy(recording[0], tmp_path))


@pytest.fixture
def pipeline(path, recording):
    """Return a pipeline on the map, after the drives."""
    pipeline = localizing(path, update_map=True, sequence=SequenceSettings(20))
    pipeline.operation.return_drives([*recording[1]])
    return pipeline


def waiting(path):
    return sorted(file.stem for file in Path(f'{path}.history/drives').glob('[!.]*'))


def at_once(function):
    return function()


def is_updated(path):
    """Whether all drives are in the map, once."""
    version = current_version(path)
    assert version.map_id == load_map(path).map_id
    return (version.number, waiting(path)) == (3, [])


def fails_at(module, name, number, error):
    """Let the call of this number of a function fail, once, within the context."""
    function, calls = getattr(module, name), []

    def failing(*arguments, **options):
        calls.append(name)
        if len(calls) == number:
            raise error
        return function(*arguments, **options)

    return patch.object(module, name, failing)


def test_drive_that_cannot_be_written_stays_in_memory(pipeline, path):
    """So do the later ones; the earlier ones are on the disk."""
    log = Log()
    with fails_at(drives, 'save_map', 2, OutputError('no space')):
        assert not save_recorded_map(pipeline, at_once, '', log)
    assert 'no space' in log.of('error')
    assert waiting(path) == NAMES[:1]
    assert [len(drive) for drive in pipeline.operation.drives] == [*map(len, DRIVES[1:]), 0]
    assert update_own_map(pipeline, at_once, log)
    assert is_updated(path)


@pytest.mark.parametrize(
    ('module', 'name', 'number', 'error'),
    [
        (drives, 'update_file', 1, Killed()),
        (drives, 'update_file', 3, OutputError('no space')),
        (versions, 'write_output', 2, Killed()),
        (versions, '_copy', 3, Killed()),
        (Path, 'unlink', 1, Killed()),  # of a drive that is in the map
    ],
)
def test_next_call_or_start_takes_up_the_drives_once(pipeline, path, module, name, number, error):
    with fails_at(module, name, number, error), pytest.raises(type(error)):
        update_own_map(pipeline, at_once, Log())
    assert waiting(path)
    log = Log()
    if isinstance(error, Killed):
        take_up_earlier_drives(path, log)
    else:
        assert update_own_map(pipeline, at_once, log)
    assert not log.of('error')
    assert is_updated(path)


def test_drive_that_teaches_nothing_or_is_damaged_stops_no_other(pipeline, path):
    with fails_at(drives, 'update_file', 1, Killed()), pytest.raises(Killed):
        update_own_map(pipeline, at_once, Log())
    folder = Path(f'{path}.history/drives')
    (folder / 'drive 1.stavpr').write_bytes(b'cut off')
    save_map(build(OTHER), folder / 'drive 2.stavpr')
    log = Log()
    take_up_earlier_drives(path, log)
    assert 'drive 1 does not update' in log.of('error')
    assert 'drive 2 does not update' in log.of('warning')
    assert (current_version(path).number, waiting(path)) == (3, ['drive 1.stavpr'])


def test_drives_of_equal_times_have_names_of_their_own(pipeline, path):
    """Stamps of a simulation begin anew; a name in the history means that the drive is there."""
    assert update_own_map(pipeline, at_once, Log())
    for seed in (7, 8):
        drive = [*ROUTE[:80], *route_images(60, seed), *ROUTE[140:]]
        process(pipeline, drive, first=1_700_002_000)
        pipeline.operation.reset()
    assert update_own_map(pipeline, at_once, Log())
    assert (current_version(path).number, current_version(path).drive) == (5, f'{NAMES[2]}-3')


def test_load_map_keeps_the_drives_on_the_other_map(pipeline, path):
    other = read_map(shutil.copy(path, f'{path}.other'), pipeline.settings)
    full = fails_at(drives, 'save_map', 2, OutputError('no space'))
    with full, pytest.raises(OutputError, match='no space'):
        pipeline.change(loaded=other)
    assert pipeline.save_state.path == path
    pipeline.change(loaded=other)
    take_up_earlier_drives(path, Log())
    assert is_updated(path)


def test_busy_worker_at_the_end_is_no_silent_loss(pipeline):
    def busy(_):
        raise TimeoutError

    log = Log()
    assert not save_recorded_map(pipeline, busy, '', log)
    assert 'worker is still busy' in log.of('error')


def test_all_drives_are_in_the_map_after_a_kill_during_the_update(robot, path, tmp_path):
    values = PARAMETERS | {'sequence_length': 20, 'min_probability': 0.5, 'map_path': path}
    values |= {'update_map': True, 'maps_folder': tmp_path}
    node = again = node_process(tmp_path / 'log', **values)
    try:
        robot.wait_for_node()
        for images in DRIVES:
            robot.drive(images)
            robot.stamp -= 10_000 * 10**9  # the clock was set back: another drive
        node.popen.send_signal(signal.SIGINT)
        robot.until(lambda: 'with 3 drives' in node.output(), 'the update')
        node.popen.kill()
        node.wait()
        again = node_process(tmp_path / 'again', **values)
        robot.until(lambda: 'places, features' in again.output(), 'the map')
    finally:
        node.end()
        again.end()
    assert is_updated(path)


# Parameter update_map: drives of a node in localization become part of the file of its map

REBUILT = [*ROUTE[:80], *OTHER[:60], *ROUTE[140:]]


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
    assert [len(d) for d in node.runtime.pipeline.operation.take_drives()] == [100] * updates
