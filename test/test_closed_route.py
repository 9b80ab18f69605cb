# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A camera that moves against the map, or goes on over the seam of a closed route."""

from dataclasses import replace

import cv2
from fixtures import route_images
import numpy as np
from places import features_of, map_of, route_strips
import pytest
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.commands import build_map
from stavpr_ros.commands import map as map_command
from stavpr_ros.errors import SettingsError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.maintenance import same_places
from stavpr_ros.maintenance.same_places import with_laps, with_repeats, with_seam
from stavpr_ros.mapping import load_map, merge_maps, save_map, select_places
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings, Status
from stavpr_ros.method.settings import RobustOptions
from stavpr_ros.method.windows import layout_of
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
    there_and_back = [*maps, *(map_of(place_map.features[::-1]) for place_map in maps[::-1])]
    same_as = np.arange(sessions * N, dtype=np.int32)
    twice = replace(
        merge_maps(there_and_back, 'abcd'[: 2 * sessions]),
        same_as=np.append(same_as, same_as[::-1]),
    )
    strips = np.concatenate([route_strips(0, N)[:, 50:], route_strips(0, N)[:, :60:-1]], axis=1)
    query = features_of(strips, 1.0, 9)
    # statistics of other samples
    options = RobustOptions(mean_centering=False, whitening=False)
    settings, forward = (replace(settings, mode=options) for settings in (BOTH, FORWARD))
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


LAP, MORE = 120, 45  # places of a lap, and those that the map has beyond it
LAP_FORWARD, LAP_BOTH = RecognizerSettings(), RecognizerSettings(direction='both')


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


@pytest.mark.parametrize(
    ('end', 'bounds'), [(2 * LAP, [LAP]), (3 * LAP + 90, [LAP, 2 * LAP, 3 * LAP])]
)
def test_each_lap_of_a_recording_becomes_a_session(end, bounds):
    """The same images on a map of one session have two places each, and few are matched."""
    recording, query = map_of(laps(0, end, 0.6, 1)), laps(60, LAP + 60, 0.8, 2)
    divided = with_laps(recording)
    begins = np.flatnonzero(np.diff(divided.session_index)) + 1
    np.testing.assert_allclose(begins, bounds, atol=2)
    assert [session.name for session in divided.sessions][:2] == ['lap 1', 'lap 2']
    accepted = [
        sum(match.accepted for match in recognize(place_map, query, LAP_FORWARD))
        for place_map in (divided, recording)
    ]
    assert accepted[0] > 90 > 2 * accepted[1]


@pytest.mark.parametrize('repeats', ['nothing', 'a part', 'the start'])
def test_routes_without_laps_stay_as_they_are(repeats, open_map):
    strips = route_strips(3, 300)
    if repeats == 'a part':  # a street that the route passes twice
        strips[:, 230:280] = strips[:, 100:150]
    place_map = open_map if repeats == 'the start' else map_of(features_of(strips, 0.6, 1))
    assert with_laps(place_map) is place_map


def test_recordings_that_are_long_are_sought_for_laps_in_a_sample_or_not_at_all(set_constants):
    recording = map_of(laps(0, 3 * LAP, 0.6, 1))
    for constants, count in (({'PROBES': 2}, 3), ({'PROBES': 0}, 0), ({'MAX_PLACES': 359}, 0)):
        set_constants(same_places, **constants)
        assert len(with_repeats(recording).sessions) == count


def test_images_like_the_end_of_the_first_third_begin_no_lap(monkeypatch):
    """As in a street: they are matched with places near that end."""
    recognize_places = same_places.recognize_places

    def alike(reference, drive, images):
        is_alike = (len(reference) == 200) & (images > 265) & (images < 300)
        return np.where(is_alike, 190, recognize_places(reference, drive, images))

    monkeypatch.setattr(same_places, 'recognize_places', alike)
    divided = with_laps(map_of(features_of(np.tile(route_strips(0, 300), (1, 2, 1)), 0.6, 1)))
    assert abs(divided.session_index.tolist().index(1) - 300) <= 2


def test_lap_and_its_repeated_start_are_a_closed_route():
    assert with_laps(recording := map_of(laps(0, LAP + 75, 0.6, 1))).sessions
    assert with_repeats(recording).seam == 74


def test_laps_of_a_session_on_another_map_are_divided():
    maps = map_of(view(7, 0.6)), map_of(laps(0, 2 * LAP, 0.6, 1))
    divided = with_repeats(merge_maps(maps, ['street', 'recorded-1']))
    assert [session.id for session in divided.sessions] == ['street', 'recorded-1', 'recorded-1-2']
    related = divided.same_as[N + LAP : N + 2 * LAP] - N
    assert abs(related - np.arange(LAP)).mean() < 2
    assert with_repeats(divided) is divided


def test_route_may_be_stated_to_be_closed():
    closed = with_seam(map_of(laps(0, LAP, 0.6, 1)), is_closed=True)
    assert closed.same_as.tolist() == [*range(LAP - 1), 0]
    query = laps(60, LAP + 60, 0.8, 2)
    assert all(match.accepted for match in recognize(closed, query, LAP_FORWARD)[20:])


def test_routes_that_cannot_be_closed_are_rejected(open_map):
    for place_map in (map_of(laps(0, 59, 0.6, 1)), merge_maps([open_map, open_map], 'ab')):
        assert with_seam(place_map) is place_map
        with pytest.raises(SettingsError, match='one session and at least 60 places'):
            with_seam(place_map, is_closed=True)


def test_candidates_on_both_sides_of_the_seam_are_neighbors(closed_map):
    one, apart = PlaceRecognizer(closed_map, LAP_FORWARD), []
    query = laps(60, LAP + 30, 1.5, 2)
    for i in range(len(query)):
        one.update(query[i : i + 1])
        places = closed_map.same_as[[candidate.place for candidate in one.ranked(4)]]
        between = np.abs(np.subtract.outer(places, places))[~np.eye(len(places), dtype=bool)]
        apart += np.minimum(between, LAP - between).tolist()
    assert min(apart) > LAP_FORWARD.nms_radius


@pytest.mark.parametrize('against', [False, True])
def test_no_image_is_lost_at_the_seam(open_map, closed_map, against):
    """Three laps, also against the map: all images after the first window are matched."""
    query = laps(60, 60 + 3 * LAP, 0.8, 2)
    query, settings = (query[::-1], LAP_BOTH) if against else (query, LAP_FORWARD)
    places = np.arange(60, 60 + 3 * LAP)[:: -1 if against else 1]
    matches = recognize(closed_map, query, settings)
    for match, place in zip(matches[20:], places[20:] % LAP, strict=True):
        assert match.accepted
        apart = abs(closed_map.same_as[match.newest] - place)
        assert min(apart, LAP - apart) <= 2
    lost = [not match.accepted for match in recognize(open_map, query, settings)[20:]]
    assert sum(lost) >= 20


@pytest.mark.parametrize('against', [False, True])
def test_device_equals_cpu_over_the_seam_in_both_directions(closed_map, device, against):
    query = laps(60, 60 + 2 * LAP, 0.8, 2)[:: -1 if against else 1]
    on_device = recognize(closed_map, query, LAP_BOTH, device)
    for expected, match in zip(recognize(closed_map, query, LAP_BOTH), on_device, strict=True):
        assert match.status is expected.status
        if match.accepted:
            assert match.probability == pytest.approx(expected.probability, abs=1e-4)
            np.testing.assert_array_equal(match.path.pairs, expected.path.pairs)
    assert match.path.direction == (-1 if against else 1)


@pytest.mark.parametrize('drift', [0.0, 3.0])
def test_odometry_is_not_compared_over_the_seam(open_map, drift):
    """The poses of a map end beside its start: they have drifted."""
    angles = np.arange(LAP + 60 + 2 * LAP) * 2 * np.pi / LAP
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1) * LAP / (2 * np.pi)
    places = circle[: len(open_map)] + np.linspace(0, drift, len(open_map))[:, None]
    place_map = with_seam(replace(open_map, poses=poses_of(places)))
    query = laps(60, 60 + 2 * LAP, 0.8, 2)
    matches = recognize(
        place_map, query, LAP_FORWARD, poses=poses_of(circle[60 : 60 + len(query)])
    )
    assert all(match.accepted for match in matches[20:])


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
    assert layout_of(kept, 20, length=20).lap == len(images) + more - 1 - shown
    several = merge_maps([kept, kept], 'ab')
    assert layout_of(several, 20, length=20).lap == 0
    # a session of several, whose places are related to themselves or their neighbors
    own = np.arange(len(kept), dtype=np.int32)
    for same_as in (own, np.minimum(own, len(kept) - 2)):
        assert replace(kept, same_as=same_as).seam is None
    save_map(select_places(replace(kept, same_as=None), np.arange(len(images))), lap, force=True)
    assert map_command.main(['close', str(lap), str(closed)]) == 0
    assert load_map(closed).same_as[-1] == 0
    assert map_command.main(['info', str(closed)]) == 0
    assert 'closed: its last place shows place 0' in capsys.readouterr().out
