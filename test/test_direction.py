# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A camera that moves against the map: direction ``both``."""

from dataclasses import replace

import cv2
import numpy as np
from places import features_of, map_of, route_strips
import pytest
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.commands import build_map
from stavpr_ros.commands import map as map_command
from stavpr_ros.errors import SettingsError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import load_map, merge_maps
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings, Status
from stavpr_ros.method.columns import ColumnLayout
from stavpr_ros.method.settings import RobustOptions
from stavpr_ros.pipeline import PipelineSettings
from test_relative_motion import poses_of, track

pytestmark = pytest.mark.usefixtures('one_thread')
N, LENGTH = 90, 10
BOTH = RecognizerSettings(sequence=SequenceSettings(LENGTH), nms_radius=8, direction='both')
FORWARD = replace(BOTH, direction='forward')


def view(seed, noise, against=False):
    strips = route_strips(seed, N)
    return features_of(strips[:, ::-1] if against else strips, noise, seed + 1)


def recognize(place_map, query, settings=BOTH, backend='cpu', poses=None):
    one = PlaceRecognizer(place_map, settings, backend)
    poses = [None] * len(query) if poses is None else poses
    return [one.update(query[i : i + 1], i + 1, poses[i]) for i in range(len(query))]


@pytest.mark.parametrize('against', [False, True])
def test_camera_is_recognized_in_both_directions(against):
    place_map, query = map_of(view(0, 0.6)), features_of(route_strips(0, N), 0.8, 9)
    query = query[::-1] if against else query
    matches = recognize(place_map, query)[LENGTH:]
    assert all(match.accepted for match in matches)
    direction = -1 if against else 1
    for i, match in enumerate(matches, LENGTH):
        assert match.path.direction == direction
        assert (np.diff(match.path.pairs[:, 1]) * direction >= 0).all()
        assert abs(match.newest - (N - 1 - i if against else i)) <= 2
        path = match.path.first, match.path.place, match.path.last
        assert list(path) == sorted(path, reverse=against)
        assert abs(match.path.second_best - match.path.place) > 8
    one = PlaceRecognizer(place_map, BOTH)
    for i in range(30):
        newest = one.update(query[i : i + 1]).newest
    probabilities = one.place_probabilities()
    assert probabilities.shape == (N,)
    assert abs(probabilities.argmax() - newest) <= 1
    forward = recognize(place_map, query, FORWARD)[LENGTH:]
    assert [match.accepted for match in forward] == [not against] * len(forward)


@pytest.mark.parametrize('sessions', [1, 2])
def test_filter_is_that_of_a_map_with_each_session_reversed(sessions):
    """Whose features are twice in memory: the same probabilities, of half the distances."""
    maps = [map_of(view(seed, 0.6)) for seed in (0, 5)[:sessions]]
    there_and_back = [*maps, *(map_of(each.features[::-1]) for each in maps[::-1])]
    same_as = np.arange(sessions * N, dtype=np.int32)
    twice = replace(
        merge_maps(there_and_back, 'abcd'[: 2 * sessions]),
        same_as=np.append(same_as, same_as[::-1]),
    )
    strips = np.concatenate([route_strips(0, N)[:, 50:], route_strips(0, N)[:, :60:-1]], axis=1)
    query = features_of(strips, 1.0, 9)
    # statistics of other samples
    options = RobustOptions(mean_centering=False, whitening=False)
    settings, forward = (replace(each, mode=options) for each in (BOTH, FORWARD))
    both = recognize(merge_maps(maps, 'ab'[:sessions]), query, settings)
    for match, expected in zip(both, recognize(twice, query, forward), strict=True):
        assert match.status is expected.status
        if match.path.place < 0:
            continue
        assert match.probability == pytest.approx(expected.probability, abs=1e-4)
        if match.probability > 0.1:
            place = expected.path.place
            assert match.path.place == np.append(same_as, same_as[::-1])[place]
            assert match.path.direction == (-1 if place >= len(same_as) else 1)
    assert {match.path.direction for match in both if match.accepted} == {1, -1}


@pytest.mark.parametrize('camera', ['front', 'rear'])
@pytest.mark.parametrize('against', [False, True])
def test_map_of_two_cameras_names_the_one_that_saw_the_place(camera, against):
    """A drive with two cameras is searched as a whole, in both directions."""
    maps = map_of(view(0, 0.6)), map_of(view(5, 0.6))
    cameras = ('front', 0.0), ('rear', np.pi)
    place_map = merge_maps(maps, ['front', 'rear'], cameras)
    is_rear = camera == 'rear'
    query = features_of(route_strips(5 if is_rear else 0, N), 0.8, 9)
    for match in recognize(place_map, query[::-1] if against else query)[LENGTH:]:
        assert match.accepted
        session = place_map.session(match.place)
        assert (session.camera, session.yaw) == cameras[is_rear]
        assert match.path.direction == (-1 if against else 1)


def test_panoramic_camera_is_recognized_on_its_way_back(tmp_path):
    rng, n = np.random.default_rng(4), 40
    wide = rng.integers(0, 256, (n, 12, 48, 3), np.uint8)
    panoramas = [cv2.resize(image, (192, 48)) for image in wide]
    for i, image in enumerate(panoramas):
        cv2.imwrite(str(tmp_path / f'{i:03}.png'), image[:, :, ::-1])
    out, back, both = (str(tmp_path / f'{name}.stavpr') for name in ('out', 'back', 'both'))
    build = ['--features', 'gradient', '--input', str(tmp_path), '--output']
    assert build_map.main([*build, out]) == 0
    assert build_map.main([*build, back, '--panorama-yaw', '180', '--force']) == 0
    assert build_map.main([*build, back, '--panorama-yaw', '181', '--force']) == 2
    merge = ['merge', both, out, back, '--cameras', 'panorama:0', 'panorama:180']
    assert map_command.main(merge) == 0
    place_map = load_map(both)
    turned = [np.roll(image, 96, axis=1) for image in panoramas]  # of the robot
    features = FeatureExtractor('gradient').extract(turned[::-1])
    for i, match in list(enumerate(recognize(place_map, features)))[LENGTH:]:
        assert match.accepted
        assert place_map.session(match.place).yaw == pytest.approx(np.pi)
        assert match.path.direction == -1
        assert abs(match.newest - (2 * n - 1 - i)) <= 2
    # to the left by a quarter: what was at the left is ahead
    assert build_map.main([*build, back, '--panorama-yaw', '90', '--force']) == 0
    turned = np.roll(panoramas[0], 48, axis=1)
    expected = FeatureExtractor('gradient').extract([turned]).strips[:, 0]
    np.testing.assert_allclose(load_map(back).features.strips[:, 0], expected, atol=1e-3)


def test_changes_of_passes_are_to_the_passes_before():
    changes = np.array([[0.0, 1, 2, 3], [0, 0, 12, 13]])
    layout = ColumnLayout(same_as=np.arange(4), against=True)
    near, farther = layout.changes_of_passes(changes)
    assert (near[5:].tolist(), farther[6:].tolist()) == ([3, 2, 1], [13, 12])
    assert [layout.direction_of(column) for column in layout.columns] == [1] * 4 + [-1] * 4
    assert layout.names_of(layout.columns).tolist() == [0, 1, 2, 3, 3, 2, 1, 0]
    assert layout.around(1, 0).tolist() == layout.around(int(layout.columns[6]), 0).tolist()


def test_device_equals_cpu(device):
    place_map, query = map_of(view(0, 0.6)), features_of(route_strips(0, N)[:, ::-1], 0.8, 9)
    found = recognize(place_map, query, backend=device)
    for expected, match in zip(recognize(place_map, query), found, strict=True):
        assert match.status is expected.status
        if match.accepted:
            assert match.probability == pytest.approx(expected.probability, abs=1e-5)
            np.testing.assert_array_equal(match.path.pairs, expected.path.pairs)
    assert match.path.direction == -1


@pytest.mark.parametrize('turn', [90, -90])
def test_odometry_is_compared_with_the_map_backward(turn):
    """A map that turns left turns right on the way back."""
    place_map = map_of(view(0, 0.3), poses_of(track(90)))
    query = features_of(route_strips(0, N)[:, ::-1], 0.5, 9)
    matches = recognize(place_map, query, poses=poses_of(track(turn)))
    beyond = matches[N // 2 + 6 : N // 2 + 3 * LENGTH]
    assert {match.status for match in beyond} == {Status.MATCH if turn == -90 else Status.NO_MATCH}


def test_settings_without_directions_are_rejected():
    with pytest.raises(SettingsError, match='direction = both is of mode robust'):
        RecognizerSettings(0.5, mode='paper', direction='both')
    with pytest.raises(SettingsError, match='take one of forward, both'):
        RecognizerSettings(direction='sideways')
    for operation in ('mapping', 'loop_closure'):
        with pytest.raises(SettingsError, match=f'direction = both with operation {operation}'):
            PipelineSettings(direction='both').require_operation(operation)
