# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry against the paths of matches: look-alike corridors, drift, poses that are unknown."""

from dataclasses import replace

import numpy as np
from pipelines import localizing, message, process
from places import features_of, map_of, route_strips
import pytest
from scipy.stats import chi2
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.mapping import save_map
from stavpr_ros.mapping.place_map import Session
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings, Status
from stavpr_ros.method.loop_closer import LoopCloser
from stavpr_ros.method.relative_motion import agreement

pytestmark = pytest.mark.usefixtures('one_thread')
N, LENGTH, CORNER = 90, 10, 45
MIDDLE = (LENGTH - 1) // 2


def track(turn=0.0, corner=CORNER, count=N, step=1.0, start=0.0):
    """Return positions of a corridor that turns by so many degrees at a place, (count, 2)."""
    headings = np.radians(start + turn * (np.arange(1, count) >= corner))
    steps = step * np.column_stack([np.cos(headings), np.sin(headings)])
    return np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])


def poses_of(positions):
    rest = np.tile([0.0, 0, 0, 0, 1], (len(positions), 1))
    return np.hstack([positions, rest])


def corridor(seed=0, noise=0.5):
    """Return features of places, and of the same places another time, (W, N, d) each."""
    rng = np.random.default_rng(seed)
    places = rng.standard_normal((7, N, 32))
    both = places, places + noise * rng.standard_normal(places.shape)
    return [features_of(strips) for strips in both]


def driven_map(features, positions, **parts):
    return map_of(features, None if positions is None else poses_of(positions), **parts)


def settings_of(**changes):
    return RecognizerSettings(
        sequence=SequenceSettings(LENGTH), nms_radius=5, mode='robust', **changes
    )


def drive(recognizer, features, positions=None):
    poses = [None] * len(features) if positions is None else poses_of(positions)
    return [recognizer.update(features[i : i + 1], pose=poses[i]) for i in range(len(features))]


def test_agreement_of_another_length_is_the_tail_of_chi_squared():
    """Five images after the middle one drive 8 m, where the path is 5 places of 1 m long."""
    driven = track(count=LENGTH, step=1.6)
    result = agreement(track(), (40, 45), driven, MIDDLE, 0.1)
    assert result == pytest.approx(chi2.sf(3**2 / (1 + 0.8**2), 3))
    assert agreement(track(), (40, 45), track(count=LENGTH), MIDDLE, 0.1) == 1


def test_agreement_of_another_shape_is_the_tail_of_chi_squared():
    """Five images: 1 m ahead, then 1 m to the side, on a straight track."""
    driven = np.array([[-1.0, 0], [0, 0], [0, 1]])
    # less mean and rotation: a triangle on a line of three points
    mine, line = driven @ (1, 1j), np.array([-1, 0, 1])
    mine = (mine - mine.mean()) * np.exp(-1j * np.pi / 4)
    rest = np.abs(line - mine) ** 2 / (0.25 + np.array([0.1, 0, 0.1]) ** 2)
    result = agreement(track(), (40, 41), driven, 1, 0.1)
    assert result == pytest.approx(chi2.sf(2 * rest.mean(), 3))


@pytest.mark.parametrize('turn', [90, -90])
def test_agreement_of_turns_is_independent_of_frames(turn):
    places = CORNER - 1, CORNER + 4
    own = track(turn, 5, LENGTH, start=70) + np.array([100, -30])
    other = track(-turn, 5, LENGTH)
    assert agreement(track(turn), places, own, MIDDLE, 0.1) > 0.99
    assert agreement(track(turn), places, other, MIDDLE, 0.1) < 1e-3
    assert agreement(track(), places, own, MIDDLE, 0.1) < 0.05


def test_agreement_without_poses_is_unknown():
    driven, unknown = track(count=LENGTH), np.full(2, np.nan)
    for hole, rows in (('driven', (MIDDLE, LENGTH - 1)), ('track', (40, 45))):
        for row in rows:
            arrays = {'track': track(), 'driven': driven.copy()}
            arrays[hole][row] = unknown
            result = agreement(arrays['track'], (40, 45), arrays['driven'], MIDDLE, 0.1)
            assert np.isnan(result), (hole, row)
    others = driven.copy()
    others[[0, 7]] = unknown  # of other images: the rest is compared
    assert agreement(track(), (40, 45), others, MIDDLE, 0.1) == 1
    assert np.isnan(agreement(np.zeros((N, 2)), (40, 45), driven, MIDDLE, 0.1))  # it stood
    assert np.isnan(agreement(track(), (40, 45), np.full((LENGTH, 2), np.nan), MIDDLE, 0.1))


def test_look_alike_corridors_are_distinguished_by_their_turns():
    """Equal images; matched until the corner is in the window, and long not after it."""
    places, query = corridor()
    place_map = driven_map(places, track(90))
    by_images = drive(PlaceRecognizer(place_map, settings_of()), query)
    assert all(match.accepted for match in by_images[LENGTH:])
    matches = drive(PlaceRecognizer(place_map, settings_of()), query, track(-90))
    accepted = np.array([match.accepted for match in matches])
    assert accepted[LENGTH : CORNER - 1].all()
    assert not accepted[CORNER + 6 : CORNER + 3 * LENGTH].any()
    last = matches[CORNER + LENGTH]
    assert last.status is Status.NO_MATCH
    assert last.reason.endswith('not above 0.500: odometry disagrees with its path')
    assert last.distance == 1 - last.probability > 0.5
    assert last.path.place == by_images[CORNER + LENGTH].path.place  # the place stays the best


def test_the_same_corridor_is_matched_in_spite_of_drift():
    places, query = corridor()
    rng = np.random.default_rng(1)
    steps = np.diff(track(90), axis=0) @ (1, 1j) * (1.03 + 0.02 * rng.standard_normal(N - 1))
    steps *= np.exp(1j * np.cumsum(np.radians(0.3) * rng.standard_normal(N - 1)))
    driven = np.concatenate([[0], np.cumsum(steps)])
    driven = np.column_stack([driven.real, driven.imag])
    place_map = driven_map(places, track(90))
    plain = drive(PlaceRecognizer(place_map, settings_of()), query)
    matches = drive(PlaceRecognizer(place_map, settings_of()), query, driven)
    assert [match.probability for match in matches[LENGTH:]] == [
        match.probability for match in plain[LENGTH:]
    ]


@pytest.mark.parametrize(
    ('positions', 'driven', 'changes'),
    [
        (track(90), None, {}),
        (None, track(-90), {}),
        (track(90), track(-90), {'odometry_error': 0.0}),
        (track(90), track(-90), {'mode': 'paper'}),
    ],
    ids=['no odometry', 'no poses of places', 'switched off', 'mode paper'],
)
def test_absence_of_odometry_or_poses_changes_nothing(positions, driven, changes):
    places, query = corridor()
    settings = replace(settings_of(), **changes)
    expected = drive(PlaceRecognizer(driven_map(places, None), settings), query)
    result = drive(PlaceRecognizer(driven_map(places, positions), settings), query, driven)
    assert [repr(one.path) for one in result] == [repr(one.path) for one in expected]
    assert [one.reason for one in result] == [one.reason for one in expected]


def test_session_of_a_match_ends_its_track():
    """The second session begins elsewhere: what lies between is no driven."""
    places, query = corridor()
    positions = track(90)
    positions[CORNER:] += (1000.0, 0)
    sessions = Session('a'), Session('b')
    index = (np.arange(N) >= CORNER).astype(np.int32)
    place_map = driven_map(places, positions, sessions=sessions, session_index=index)
    driven = np.vstack([track(90)[:CORNER], track(90)[CORNER:]])
    matches = drive(PlaceRecognizer(place_map, settings_of()), query, driven)
    assert all(match.accepted for match in matches[LENGTH : CORNER - 6])
    assert all(match.accepted for match in matches[CORNER + LENGTH :])


def test_early_matches_are_compared_since_the_first_of_them():
    """The robot was carried 30 m before it came back: what no match is of does not count."""
    route, elsewhere = route_strips(3, 200, 32), route_strips(11, 24, 32)
    strips = np.concatenate([route[:, :70], elsewhere, route[:, 110:190]], axis=1)
    driven = track(count=174) + (np.arange(174) >= 94)[:, None] * (0, 30)
    one = PlaceRecognizer(
        driven_map(features_of(route, 0.1, 1), track(count=200)), RecognizerSettings()
    )
    matches = drive(one, features_of(strips, 0.1, 2), driven)
    assert min(len(match.path.pairs) for match in matches[97:105]) < len(
        matches[-1].path.pairs
    )  # early ones
    assert all(match.accepted for match in matches[98:])


def test_loop_closure_compares_the_way_with_its_route():
    """The second lap turns left where the first turned right; evicted places change nothing."""
    first, second = corridor()
    both = features_of(np.concatenate([first.strips, second.strips], 1))
    results = []
    for turn in (-90, 90):
        closer = LoopCloser(settings_of(), 20, first.settings, limit=150)
        ways = track(-90, 60), track(turn, 60)
        matches = drive(closer, both, np.concatenate(ways))
        results.append(np.array([match.accepted for match in matches[N:]]))
    same, other = results
    assert same[LENGTH:].all()
    assert other[LENGTH:60].all()
    assert not other[60 + 8 :].any()


def test_pipeline_compares_the_pose_of_each_image(small_map, route, tmp_path):
    turned = replace(small_map, poses=poses_of(track(90, 14, len(small_map), step=2.0)))
    save_map(turned, tmp_path / 'turned.stavpr')
    pipeline = localizing(str(tmp_path / 'turned.stavpr'))
    images = route[5:25]
    assert process(pipeline, images)[-1].match.accepted
    pipeline.operation.reset()
    match = None
    for i, image in enumerate(images):
        pose = poses_of(track(-90, 9, 20, step=2.0))[i]
        match = pipeline.operation.process(message(image), (i + 1) * 10**9, pose).match
    assert match.status is Status.NO_MATCH
    assert 'odometry disagrees' in match.reason


def test_invalid_settings_and_poses_are_rejected():
    places, query = corridor()
    with pytest.raises(SettingsError, match='odometry_error = 1\\.5 must be 0 to 1'):
        settings_of(odometry_error=1.5)
    one = PlaceRecognizer(driven_map(places, track()), settings_of())
    with pytest.raises(InputError, match=r'pose, x y z .*: shape'):
        one.update(query[:1], pose=np.zeros(3))
    assert one.window_fill == 0
