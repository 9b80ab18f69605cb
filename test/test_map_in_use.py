# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of maps that are overwritten, or damaged, while the node uses them."""

from pathlib import Path
import shutil

from diagnostic_msgs.msg import DiagnosticStatus
import pytest
from robot import LENGTH
from stavpr_msgs.msg import PlaceMatch
from stavpr_msgs.srv import LoadMap, SaveMap, SetOperation
from stavpr_ros.errors import MapFileError
from stavpr_ros.mapping import open_map, save_map, verify_map


@pytest.fixture
def other_map(small_map, tmp_path):
    """Return the file of a shorter map."""
    places = slice(40)
    other = small_map.__class__(
        small_map.features[places], small_map.projection, small_map.stamps[places], ('',) * 40
    )
    save_map(other, tmp_path / 'other.stavpr')
    return tmp_path / 'other.stavpr'


@pytest.fixture
def in_use(map_file, tmp_path):
    """Return a map file that may be changed."""
    return Path(shutil.copy(map_file, tmp_path / 'route.stavpr'))


def copied_over(other: Path, path: Path) -> None:
    """Write a file over another, as ``cp`` does: it stays the same file."""
    inode = path.stat().st_ino
    path.write_bytes(other.read_bytes())
    assert path.stat().st_ino == inode


def test_map_copied_over_the_one_in_use_is_reported_and_can_be_loaded(
    robot, start, route, in_use, other_map
):
    """Images are matched with the map in memory; nothing takes the file for its own."""
    start(map_path=str(in_use), geometric_check='orb')
    robot.drive(route[:6])
    copied_over(other_map, in_use)
    matches = robot.drive(route[6:12])
    assert [match.newest_index for match in matches] == list(range(6, 12))
    robot.until_diagnosed('map', DiagnosticStatus.WARN, 'has been overwritten since')
    message = robot.refuses(SetOperation, 'set_operation', operation='mapping')
    assert 'has been overwritten since' in message
    assert robot.refuses(SaveMap, 'save_map', path=str(in_use.parent / 'copy')) == message
    for path, places in ((other_map, 40), (in_use, 40)):
        assert robot.does(LoadMap, 'load_map', path=str(path)).map.places == places
    robot.until_diagnosed('map', DiagnosticStatus.OK, '40 places')
    assert robot.drive(route[:LENGTH])[-1].status == PlaceMatch.MATCH


def test_load_map_of_damaged_strips_is_reported_later_or_refused_with_verify(
    robot, start, route, in_use, tmp_path
):
    """A flipped bit in the features: the header, and all that is read at once, are intact."""
    part = open_map(in_use).features.file.parts['strips']
    content = bytearray(in_use.read_bytes())
    content[part.start + 100] ^= 1
    damaged = tmp_path / 'damaged.stavpr'
    damaged.write_bytes(content)
    start(map_path=str(in_use))
    message = robot.refuses(LoadMap, 'load_map', path=str(damaged), verify=True)
    assert f'bytes {part.start} to' in message
    assert 'of part strips, do not match their hash' in message
    assert robot.until_map(state='loaded').path == str(in_use)
    robot.does(LoadMap, 'load_map', path=str(in_use), verify=True)
    robot.does(LoadMap, 'load_map', path=str(damaged))
    robot.until_diagnosed('map', DiagnosticStatus.WARN, 'the map in use is not reliable')
    robot.until_logged('the map in use is not reliable')
    assert robot.drive(route[:LENGTH])[-1].status == PlaceMatch.MATCH
    robot.does(LoadMap, 'load_map', path=str(in_use))
    robot.until_diagnosed('map', DiagnosticStatus.OK, '60 places')


def test_stored_map_that_is_overwritten_is_never_read_as_its_own(in_use, small_map, tmp_path):
    """By a map of the same size, whose features are valid: no hash is compared on use."""
    places = open_map(in_use)
    copied_over(in_use, in_use)  # the content is the same; that is not known
    for read in (
        lambda: places.features[:3],
        lambda: places.features.strip(0),
        lambda: places.thumbnails[0],
        lambda: save_map(places, tmp_path / 'copy.stavpr'),
        lambda: verify_map(places),
    ):
        with pytest.raises(MapFileError, match='has been overwritten since it was opened: load'):
            read()
    assert places.thumbnail(0) is None
