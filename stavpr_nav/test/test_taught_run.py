# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The velocities of a taught run: from poses and from files, standing left out, bad input."""

from dataclasses import replace

import numpy as np
import pytest
from stavpr_nav.taught_run import positions, read_velocities, taught_places, taught_run
from stavpr_ros.errors import InputError
from stavpr_ros.features import FeatureSettings, LocalFeatures
from stavpr_ros.mapping import descriptor_map, merge_maps, select_places

SECOND = 10**9
HEAD = 'stamp,speed,turn\n'


def route(seconds, poses=None):
    """Return a map with one place at each of these times."""
    n = len(seconds)
    strips = np.random.default_rng(0).normal(size=(1, n, 8)).astype(np.float32)
    strips /= np.linalg.norm(strips, axis=2, keepdims=True)
    features = LocalFeatures(
        strips, np.ones((1, n), np.float32), FeatureSettings('gradient', None, 1)
    )
    stamps = np.round(np.asarray(seconds) * SECOND).astype(np.int64)
    return replace(descriptor_map(features, poses), stamps=stamps)


def arc(angles, radius=2.0):
    """Return poses on a circle to the left, which begins in the direction of x."""
    poses = np.zeros((len(angles), 7))
    poses[:, 0], poses[:, 1] = radius * np.sin(angles), radius * (1 - np.cos(angles))
    poses[:, 5], poses[:, 6] = np.sin(np.asarray(angles) / 2), np.cos(np.asarray(angles) / 2)
    return poses


def test_velocities_of_poses_on_an_arc():
    angles = np.arange(40) * 0.05
    run = taught_run(route(10 + np.arange(40) * 0.5, arc(angles)))
    np.testing.assert_allclose(run.speeds, 0.2, rtol=1e-3)
    np.testing.assert_allclose(run.turns, 0.1, rtol=1e-9)
    np.testing.assert_allclose(run.times, np.arange(40) * 0.5)
    assert run.distances[-1] == pytest.approx(39 * 0.1, rel=1e-3)


def test_standing_is_left_out_and_distances_remain():
    angles = np.concatenate([np.arange(10), np.full(20, 9), np.arange(9, 20)]) * 0.05
    seconds = 5 + np.arange(len(angles)) * 0.5
    poses, at = arc(angles), np.arange(0, 40, 0.1)
    moving = np.interp(at, seconds[:-1], np.diff(angles) > 0) > 0.5
    velocities = np.column_stack([at, 0.2 * moving, 0.1 * moving])
    for run in (taught_run(route(seconds, poses)), taught_run(route(seconds), velocities)):
        assert run.times[-1] == pytest.approx(19 * 0.5, abs=0.6)
        assert run.speeds.min() > 0.1
        assert run.distances[-1] == pytest.approx(19 * 0.1, abs=0.1)


def test_integrals_between_places_are_those_of_the_velocities():
    at = np.arange(0, 20, 0.05)
    velocities = np.column_stack([at, 0.5 + 0.4 * np.sin(at), 0.3 * np.cos(at)])
    run = taught_run(route(np.arange(1, 18) + 0.01), velocities)
    steps = np.diff(run.times)
    np.testing.assert_allclose(steps, 1, rtol=1e-6)
    expected = 0.5 - 0.4 * np.diff(np.cos(np.arange(1, 18)))
    np.testing.assert_allclose(run.speeds[:-1] * steps, expected, atol=0.02)
    np.testing.assert_allclose(
        run.turns[:-1] * steps, 0.3 * np.diff(np.sin(np.arange(1, 18))), atol=0.02
    )


def test_a_gap_of_the_velocities_counts_as_standing():
    velocities = np.array([[0, 1, 0], [1, 1, 0], [5, 1, 0], [6, 1, 0], [7, 1, 0.0]])
    run = taught_run(route([0, 1, 5, 6, 7]), velocities)
    assert run.times.tolist() == pytest.approx([0, 1, 1.001, 2.001, 3.001])


def test_files_are_read_without_a_torn_last_line(tmp_path):
    path = tmp_path / 'run.csv'
    for note, expected in (('', ''), ('# session: my yard\n', 'my yard')):
        for end in ('3.5,0.', '# session: torn'):
            path.write_text(f'{HEAD}1.5,0.2,0.1\n{note}2.5,0.3,-0.1\n{end}')
            velocities, session = read_velocities(path)
            np.testing.assert_array_equal(velocities, [[1.5, 0.2, 0.1], [2.5, 0.3, -0.1]])
            assert session == expected


def two_sessions(start=100):
    """Return two drives past 30 places; every third place of the second has no relation."""
    first, second = (
        route(at + np.arange(30) * 0.5, arc(np.arange(30) * 0.05)) for at in (0, start)
    )
    both = merge_maps([first, second], ['monday', 'tuesday'])
    same_as = np.arange(60, dtype=np.int32)
    same_as[30:] = np.where(np.arange(30) % 3 == 1, same_as[30:], np.arange(30))
    return replace(both, same_as=same_as)


def velocities_from(start):
    at = start + np.arange(0, 15, 0.1)
    return np.column_stack([at, np.full(len(at), 0.2), np.full(len(at), 0.1)])


@pytest.mark.parametrize(
    ('start', 'velocities', 'session', 'expected'),
    [
        (100, None, '', 0),
        (100, None, 'tuesday', 30),
        (100, velocities_from(100), '', 30),  # by the stamps
        (0, velocities_from(0), '', 0),  # of a simulation: all begin at 0
        (0, velocities_from(0), 'tuesday', 30),
    ],
)
def test_taught_run_is_of_one_session(start, velocities, session, expected):
    both = two_sessions(start)
    taught = taught_places(both, velocities, session)
    assert taught.tolist() == [*range(expected, expected + 30)]
    run = taught_run(both, velocities, taught)
    np.testing.assert_allclose(run.speeds, 0.2, rtol=0.05)
    assert run.seam is None
    at = positions(both, taught)
    assert at[taught].tolist() == [*range(30)]
    assert np.delete(at, taught)[1:-1].tolist() == [*range(1, 29)]
    detour = replace(both, same_as=np.arange(60, dtype=np.int32))
    assert (np.delete(positions(detour, taught), taught) == -1).all()


def test_session_that_an_update_has_divided_and_renewed_is_one_run():
    """Renewed places have the stamps of another drive."""
    both = two_sessions()
    both = replace(both, stamps=both.stamps + 10**9)
    stamps = both.stamps.copy()
    stamps[5:9] = np.arange(4) + 10**18
    divided = select_places(replace(both, stamps=stamps), np.delete(np.arange(60), range(14, 17)))
    monday, tuesday = both.sessions
    index = np.repeat(np.arange(3, dtype=np.int32), (14, 13, 30))
    sessions = monday, replace(monday, id='monday-2'), tuesday
    divided = replace(divided, sessions=sessions, session_index=index)
    for velocities in (None, velocities_from(1)):
        taught = taught_places(divided, velocities, 'monday')
        assert taught.tolist() == [*range(27)]
        run = taught_run(divided, velocities, taught)
        assert run.distances[-1] == pytest.approx(2.9, 0.05)
        np.testing.assert_allclose(np.diff(run.times[:14]), 0.5)


def test_session_that_the_map_lacks_is_named():
    with pytest.raises(InputError, match=r"no session 'friday' .* \['monday', 'tuesday'\]"):
        taught_places(two_sessions(), None, 'friday')
    with pytest.raises(InputError, match='take map and run of one drive'):
        taught_places(two_sessions(), velocities_from(1000))


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('', 'cannot be read as a taught run'),
        ('a,b\n1,2\n', 'the columns a,b'),
        (HEAD + '1,2,3\n', '1 lines'),
        (HEAD + '1,2,3\n2,x,3\n', 'expected numbers'),
        (HEAD + '1,2\n2,3,4\n', 'expected numbers'),
        (HEAD + '1,2,3\n2,nan,3\n', 'must be finite'),
        (HEAD + '2,2,3\n1,2,3\n', 'must not decrease'),
        ('\0' * 9, 'expected stamp,speed,turn'),
        (None, 'cannot be read as a taught run'),
    ],
)
def test_other_files_are_rejected(tmp_path, text, message):
    path = tmp_path / 'run.csv'
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_velocities(path)


def test_maps_that_are_no_run_are_rejected():
    seconds, still = np.arange(5.0), np.zeros((2, 3))
    still[:, 0] = 0, 9
    with pytest.raises(InputError, match='not all places of the map have a pose'):
        taught_run(route(seconds))
    with pytest.raises(InputError, match='increasing stamps'):
        taught_run(route(seconds[::-1]), still)
    with pytest.raises(InputError, match=r'of 0.0 to 9.0 s, the places of 100.0 to 104.0 s'):
        taught_run(route(seconds + 100), still)
    with pytest.raises(InputError, match='is at rest in the whole taught run'):
        taught_run(route(seconds), still)
