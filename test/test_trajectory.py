# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Poses by their stamps: interpolation against formulas, clock jumps, odometry of bags."""

import math

from bags import SECOND, write_odometry, writing
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from stavpr_ros.errors import InputError, SourceError
from stavpr_ros.mapping import distance, rotation, Trajectory
from stavpr_ros.sources.bag import ODOMETRY, read_odometry


def passed(*stamps_and_x, **options):
    """Return a trajectory with a pose at each of these seconds and x."""
    trajectory = Trajectory(**options)
    for seconds, x in stamps_and_x:
        trajectory.add(round(seconds * SECOND), turned(0, x=x))
    return trajectory


def turned(degrees, x=0.0, axis=(0.0, 0.0, 1.0)):
    """Return a pose at x, turned about an axis."""
    half = math.radians(degrees) / 2
    return np.array([x, 0, 0, *(math.sin(half) * part for part in axis), math.cos(half)])


def test_trajectory_outside_its_poses_or_across_a_long_gap_returns_none():
    assert Trajectory().at(SECOND) is None
    trajectory = passed((2, 1), (3, 2), timeout=0.5)
    for stamp, x in ((0, None), (2 * SECOND - 1, None), (3_500_000_000, 2), (3_500_000_001, None)):
        pose = trajectory.at(stamp)
        assert (pose if pose is None else pose[0]) == x
    trajectory = passed((1, 1), (6, 6), (12, 12), timeout=0.5)
    assert (trajectory.at(2 * SECOND)[0], trajectory.at(12 * SECOND)[0]) == (2, 12)
    assert trajectory.at(7 * SECOND) is None


def test_trajectory_returns_copies():
    trajectory = Trajectory()
    pose = turned(0, x=1)
    trajectory.add(SECOND, pose)
    pose[:] = 7
    for stamp in (SECOND, SECOND + 1):
        trajectory.at(stamp)[:] = 9
    assert trajectory.at(SECOND)[0] == 1


def test_trajectory_sorts_late_and_replaces_equal_stamps():
    trajectory = passed((1.0, 0), (2.0, 10), (1.5, 8), (2.0, 12), timeout=0.5)
    assert len(trajectory) == 3
    assert (trajectory.at(1_250_000_000)[0], trajectory.at(1_750_000_000)[0]) == (4, 10)


def test_trajectory_after_clock_jump_starts_over():
    trajectory = passed((10, 0), (11, 0), (10.5, 0), timeout=0.5)
    assert len(trajectory) == 3
    trajectory.add(10_499_999_999, turned(0, x=5))
    assert len(trajectory) == 1
    assert trajectory.at(11 * SECOND) is None
    assert trajectory.at(10_500_000_000)[0] == 5


def test_trajectory_keeps_at_most_capacity():
    trajectory = Trajectory(capacity=16)
    for i in range(1, 1001):
        trajectory.add(i, turned(0, x=i))
        assert len(trajectory) <= 16
        assert len(trajectory) >= min(i, 14)
        assert trajectory.at(i)[0] == i
    assert trajectory.at(1000 - 17) is None
    one = passed((1, 0), (2, 2), capacity=1)
    assert (len(one), one.at(2 * SECOND)[0]) == (1, 2)


@pytest.mark.parametrize(
    ('pose', 'words'),
    [
        (np.zeros(6), 'shape'),
        ([0, 0, math.nan, 0, 0, 0, 1], 'finite'),
        ([0, math.inf, 0, 0, 0, 0, 1], 'finite'),
        ([0, 0, 0, 0, 0, 0, math.nan], 'finite'),
        (np.zeros(7), 'quaternion of norm 0'),
        ([0, 0, 0, 0, 0, 0, 1e7], 'quaternion of norm'),
    ],
)
def test_trajectory_with_invalid_pose_changes_nothing(pose, words):
    trajectory = Trajectory()
    trajectory.add(2 * SECOND, turned(0))
    with pytest.raises(InputError, match=words):
        trajectory.add(1, np.array(pose))  # so early that it would clear the trajectory
    assert len(trajectory) == 1
    assert trajectory.at(2 * SECOND) is not None
    with pytest.raises(InputError, match='stamp 0'):
        trajectory.add(0, turned(0))


def test_trajectory_normalizes_quaternions():
    trajectory = Trajectory()
    trajectory.add(1, np.array([0, 0, 0, 0, 0, 3.0, 4.0]))
    np.testing.assert_allclose(trajectory.at(1)[3:], [0, 0, 0.6, 0.8])


def test_distance_and_rotation_by_hand():
    a = np.array([1, 2, 3, 0, 0, 0, 1.0])
    assert distance(a, np.array([1, 5, 7, 0, 0, 0, 1.0])) == 5
    assert rotation(turned(10), turned(10)) == 0
    assert rotation(turned(10), -turned(10)) == 0  # the same rotation
    for angle in (1e-6, 0.5, 90, 179.999):
        assert rotation(turned(20), turned(20 + angle)) == pytest.approx(angle, rel=1e-6)
    assert rotation(turned(-100), turned(100)) == pytest.approx(160)


@given(
    first=st.floats(0, 360),
    angle=st.floats(-179, 179),
    part=st.floats(0, 1),
    flip=st.booleans(),
    axis=st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda axis: sum(x * x for x in axis) > 0.01),
)
def test_trajectory_turns_evenly_on_shorter_arc(first, angle, part, flip, axis):
    """After a part of the time between two poses, that part of the rotation."""
    axis = np.array(axis) / np.linalg.norm(axis)
    start = turned(first, x=-4, axis=(0.6, 0, 0.8))

    def after(degrees):
        turn = Rotation.from_rotvec(degrees * axis, degrees=True)
        return Rotation.from_quat(start[3:]) * turn

    end = np.array([6, 0, 0, *(-1 if flip else 1) * after(angle).as_quat()])
    trajectory = Trajectory()
    trajectory.add(SECOND, start)
    trajectory.add(2 * SECOND, end)
    stamp = SECOND + round(part * SECOND)
    part = (stamp - SECOND) / SECOND
    pose = trajectory.at(stamp)
    assert pose[0] == pytest.approx(-4 + 10 * part)
    off = Rotation.from_quat(pose[3:]).inv() * after(angle * part)
    assert off.magnitude() < 1e-11
    assert np.linalg.norm(pose[3:]) == pytest.approx(1, abs=1e-12)
    assert rotation(start, end) == pytest.approx(abs(angle), abs=1e-6)


@pytest.mark.parametrize('ros1', [False, True])
def test_read_odometry_returns_sorted_poses(tmp_path, ros1):
    # the third came late, the last has no stamp of its own
    stamps = [5 * SECOND, 5 * SECOND + 7, 5 * SECOND + 3, 0]
    path = write_odometry(tmp_path / 'drive.bag', stamps, ros1=ros1)
    when, poses = read_odometry(path, 'odom')
    assert when.tolist() == [5 * SECOND, 5 * SECOND + 3, 5 * SECOND + 7, 103 * SECOND]
    assert poses.tolist() == [[i, 2, 3, 0, 0, 0.6, 0.8] for i in (0, 2, 1, 3)]
    assert Trajectory.from_arrays(when, poses).at(5 * SECOND + 5)[0] == pytest.approx(1.5)


@pytest.mark.parametrize(
    ('stamps', 'name', 'topic', 'sentence'),
    [
        ([1], 'bag', '/other', r"'/other' is not in .*: expected one of /odom"),
        ([1], 'bag', '/text', r'std_msgs/msg/String in .*: expected one of /odom'),
        ([], 'bag', '/odom', 'no messages'),
        ([1], 'missing', '/odom', r'cannot be read: .*No such file'),
        ([9, 10, 3, 4], 'bag', '/odom', r'back by 7\.0 s at message 2'),
    ],
)
def test_read_odometry_of_what_is_no_odometry_fails(tmp_path, stamps, name, topic, sentence):
    write_odometry(tmp_path / 'bag', [stamp * SECOND for stamp in stamps])
    with pytest.raises(SourceError, match=sentence):
        read_odometry(tmp_path / name, topic)


def test_from_arrays_counts_invalid_poses_unless_all_are():
    poses = np.array([np.zeros(7), turned(0), np.full(7, np.nan), turned(90)])
    trajectory = Trajectory.from_arrays(np.array([1, 2, 3, 4]), poses)
    assert (len(trajectory), trajectory.rejected) == (2, 2)
    with pytest.raises(InputError, match='pose number 0 and all before: pose'):
        Trajectory.from_arrays(np.array([1]), poses[:1])


@pytest.mark.parametrize('wrong', [5 * SECOND, 9000 * SECOND])
def test_read_odometry_of_one_stamp_of_another_time_returns_no_pose_for_it(tmp_path, wrong):
    stamps = [50 * SECOND, 51 * SECOND, wrong, 52 * SECOND, 53 * SECOND]
    when, poses = read_odometry(write_odometry(tmp_path / 'bag', stamps), '/odom')
    assert np.isnan(poses).any(axis=1).tolist() == [False, False, True, False, False]
    trajectory = Trajectory.from_arrays(when, poses)
    assert trajectory.rejected == 1
    assert trajectory.at(51 * SECOND + SECOND // 2)[0] == pytest.approx(2)


def test_read_odometry_of_a_damaged_message_returns_no_pose_for_it(tmp_path):
    with writing(tmp_path / 'bag') as bag:
        for i in range(3):
            bag.write_bytes('/odom', ODOMETRY, i + 1, b'\0\1\0\0damaged')
    assert np.isnan(read_odometry(tmp_path / 'bag', '/odom')[1]).all()
