# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A camera that goes on over the seam of a closed route, from its last places to its first."""

from dataclasses import replace

import cv2
from fixtures import route_images
import numpy as np
from places import features_of, map_of, route_strips
import pytest
from stavpr_ros.commands import build_map
from stavpr_ros.commands import map as map_command
from stavpr_ros.errors import SettingsError
from stavpr_ros.maintenance.same_places import with_seam
from stavpr_ros.mapping import load_map, merge_maps, save_map, select_places
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.method.columns import ColumnLayout
from test_direction import recognize
from test_relative_motion import poses_of

pytestmark = pytest.mark.usefixtures('one_thread')
LAP, MORE = 120, 45  # places of a lap, and those that the map has beyond it
FORWARD, BOTH = RecognizerSettings(), RecognizerSettings(direction='both')


def laps(first, end, noise, seed):
    """Return the features of images of a closed route, from a place to a later one."""
    places = np.arange(first, end) % LAP
    return features_of(route_strips(0, LAP)[:, places], noise, seed)


@pytest.fixture(scope='module')
def open_map():
    return map_of(laps(0, LAP + MORE, 0.6, 1))


@pytest.fixture(scope='module')
def closed_map(open_map):
    return with_seam(open_map)


def test_end_of_a_closed_route_shows_its_start(closed_map):
    expected = np.append(np.arange(LAP), np.arange(MORE))
    assert np.abs(closed_map.same_as - expected).max() <= 2
    assert closed_map.same_as[-1] == MORE - 1


@pytest.mark.parametrize('end', [LAP, LAP // 2])
def test_other_routes_stay_as_they_are(end):
    place_map = map_of(laps(0, end, 0.6, 1))
    assert with_seam(place_map) is place_map


def test_route_may_be_stated_to_be_closed():
    closed = with_seam(map_of(laps(0, LAP, 0.6, 1)), is_closed=True)
    assert closed.same_as.tolist() == [*range(LAP - 1), 0]
    query = laps(60, LAP + 60, 0.8, 2)
    assert all(match.accepted for match in recognize(closed, query, FORWARD)[20:])


def test_routes_that_cannot_be_closed_are_rejected(open_map):
    for place_map in (map_of(laps(0, 59, 0.6, 1)), merge_maps([open_map, open_map], 'ab')):
        assert with_seam(place_map) is place_map
        with pytest.raises(SettingsError, match='one session and at least 60 places'):
            with_seam(place_map, is_closed=True)


def test_candidates_on_both_sides_of_the_seam_are_neighbors(closed_map):
    one, apart = PlaceRecognizer(closed_map, FORWARD), []
    query = laps(60, LAP + 30, 1.5, 2)
    for i in range(len(query)):
        one.update(query[i : i + 1])
        places = closed_map.same_as[[each.place for each in one.ranked(4)]]
        between = np.abs(np.subtract.outer(places, places))[~np.eye(len(places), dtype=bool)]
        apart += np.minimum(between, LAP - between).tolist()
    assert min(apart) > FORWARD.nms_radius


@pytest.mark.parametrize('against', [False, True])
def test_no_image_is_lost_at_the_seam(open_map, closed_map, against):
    """Three laps, also against the map: all images after the first window are matched."""
    query = laps(60, 60 + 3 * LAP, 0.8, 2)
    query, settings = (query[::-1], BOTH) if against else (query, FORWARD)
    places = np.arange(60, 60 + 3 * LAP)[:: -1 if against else 1]
    matches = recognize(closed_map, query, settings)
    for match, place in zip(matches[20:], places[20:] % LAP, strict=True):
        assert match.accepted
        apart = abs(closed_map.same_as[match.newest] - place)
        assert min(apart, LAP - apart) <= 2
    lost = [not match.accepted for match in recognize(open_map, query, settings)[20:]]
    assert sum(lost) >= 20


def test_device_equals_cpu_over_the_seam(closed_map, device):
    query = laps(60, 60 + 2 * LAP, 0.8, 2)
    on_device = recognize(closed_map, query, FORWARD, device)
    for expected, match in zip(recognize(closed_map, query, FORWARD), on_device, strict=True):
        assert match.status is expected.status
        if match.accepted:
            assert match.probability == pytest.approx(expected.probability, abs=1e-4)
            np.testing.assert_array_equal(match.path.pairs, expected.path.pairs)


@pytest.mark.parametrize('drift', [0.0, 3.0])
def test_odometry_is_not_compared_over_the_seam(open_map, drift):
    """The poses of a map end beside its start: they have drifted."""
    angles = np.arange(LAP + 60 + 2 * LAP) * 2 * np.pi / LAP
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1) * LAP / (2 * np.pi)
    places = circle[: len(open_map)] + np.linspace(0, drift, len(open_map))[:, None]
    place_map = with_seam(replace(open_map, poses=poses_of(places)))
    query = laps(60, 60 + 2 * LAP, 0.8, 2)
    matches = recognize(place_map, query, FORWARD, poses=poses_of(circle[60 : 60 + len(query)]))
    assert all(match.accepted for match in matches[20:])


def test_columns_repeat_the_first_places():
    same_as = np.append(np.arange(20), np.arange(4))
    layout = ColumnLayout(same_as=same_as, nms_radius=1, against=True, repeated=6)
    assert layout.lap == 20
    names = layout.names_of(layout.columns).tolist()
    assert names[:30] == [*range(24), *range(4, 10)]
    assert names[30:] == [*range(23, -1, -1), *range(19, 13, -1)]
    along, against = np.arange(24, 28), layout.columns[54:58]
    assert layout.repeated(along) == slice(24, 30)
    assert layout.repeated(against) == slice(61, 67)  # 7 columns are between
    assert layout.repeated(along - 1) == layout.repeated(against - 1) == slice(0, 0)
    near = layout.around(0, 1).tolist()  # places 19, 0, 1, 20, 21, in both directions
    assert [layout.names_of(np.arange(*each)).tolist() for each in near] == [
        [0, 1], [19, 20, 21], [21, 20, 19], [1, 0, 19]
    ]  # fmt: skip


def test_commands_find_the_seam_or_state_it(tmp_path, capsys):
    """Of images of a lap and more; `map close` of the lap alone."""
    images, more = route_images(61, size=(64, 96)), 42
    for i in range(len(images) + more):
        cv2.imwrite(str(tmp_path / f'{i:03}.png'), images[i % len(images)][..., ::-1])
    lap, closed = tmp_path / 'lap.stavpr', tmp_path / 'closed.stavpr'
    build = ['--input', str(tmp_path), '--output', str(lap), '--features', 'gradient']
    assert build_map.main(build) == 0
    kept = load_map(lap)
    shown = int(kept.same_as[-1])
    assert abs(shown - (more - 1)) <= 2
    assert f'the route is closed: its last place shows place {shown}\n' in capsys.readouterr().out
    assert PlaceRecognizer(kept, FORWARD)._window.layout.lap == len(images) + more - 1 - shown
    several = merge_maps([kept, kept], 'ab')
    assert PlaceRecognizer(several, FORWARD)._window.layout.lap == 0
    # a session of several, whose places are related to themselves or their neighbors
    own = np.arange(len(kept), dtype=np.int32)
    for same_as in (own, np.minimum(own, len(kept) - 2)):
        assert replace(kept, same_as=same_as).seam is None
    save_map(select_places(replace(kept, same_as=None), np.arange(len(images))), lap, force=True)
    assert map_command.main(['close', str(lap), str(closed)]) == 0
    assert load_map(closed).same_as[-1] == 0
    assert map_command.main(['info', str(closed)]) == 0
    assert 'closed: its last place shows place 0' in capsys.readouterr().out
