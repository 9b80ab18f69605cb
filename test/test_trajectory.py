# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Poses: trajectories of odometry, and files as other programs write them."""

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
from stavpr_ros.sources.pose_file import read_poses


def trajectory_of(*stamps_and_x, **options):
    """Return a trajectory with a pose at each of these seconds and x."""
    trajectory = Trajectory(**options)
    for seconds, x in stamps_and_x:
        trajectory.add(round(seconds * SECOND), turn(0, x=x))
    return trajectory


def turn(degrees, x=0.0, axis=(0.0, 0.0, 1.0)):
    """Return a pose at x, turned about an axis."""
    half = math.radians(degrees) / 2
    return np.array([x, 0, 0, *(math.sin(half) * part for part in axis), math.cos(half)])


def test_trajectory_outside_its_poses_or_across_a_long_gap_returns_none():
    assert Trajectory().at(SECOND) is None
    trajectory = trajectory_of((2, 1), (3, 2), timeout=0.5)
    for stamp, x in ((0, None), (2 * SECOND - 1, None), (3_500_000_000, 2), (3_500_000_001, None)):
        pose = trajectory.at(stamp)
        assert (pose if pose is None else pose[0]) == x
    trajectory = trajectory_of((1, 1), (6, 6), (12, 12), timeout=0.5)
    assert (trajectory.at(2 * SECOND)[0], trajectory.at(12 * SECOND)[0]) == (2, 12)
    assert trajectory.at(7 * SECOND) is None


def test_trajectory_returns_copies():
    trajectory = Trajectory()
    pose = turn(0, x=1)
    trajectory.add(SECOND, pose)
    pose[:] = 7
    for stamp in (SECOND, SECOND + 1):
        trajectory.at(stamp)[:] = 9
    assert trajectory.at(SECOND)[0] == 1


def test_trajectory_sorts_late_and_replaces_equal_stamps():
    trajectory = trajectory_of((1.0, 0), (2.0, 10), (1.5, 8), (2.0, 12), timeout=0.5)
    assert len(trajectory) == 3
    assert (trajectory.at(1_250_000_000)[0], trajectory.at(1_750_000_000)[0]) == (4, 10)


def test_trajectory_after_clock_jump_starts_over():
    trajectory = trajectory_of((10, 0), (11, 0), (10.5, 0), timeout=0.5)
    assert len(trajectory) == 3
    trajectory.add(10_499_999_999, turn(0, x=5))
    assert len(trajectory) == 1
    assert trajectory.at(11 * SECOND) is None
    assert trajectory.at(10_500_000_000)[0] == 5


def test_trajectory_keeps_at_most_capacity():
    trajectory = Trajectory(capacity=16)
    for i in range(1, 1001):
        trajectory.add(i, turn(0, x=i))
        assert len(trajectory) <= 16
        assert len(trajectory) >= min(i, 14)
        assert trajectory.at(i)[0] == i
    assert trajectory.at(1000 - 17) is None
    one = trajectory_of((1, 0), (2, 2), capacity=1)
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
    trajectory.add(2 * SECOND, turn(0))
    with pytest.raises(InputError, match=words):
        trajectory.add(1, np.array(pose))  # so early that it would clear the trajectory
    assert len(trajectory) == 1
    assert trajectory.at(2 * SECOND) is not None
    with pytest.raises(InputError, match='stamp 0'):
        trajectory.add(0, turn(0))


def test_trajectory_normalizes_quaternions():
    trajectory = Trajectory()
    trajectory.add(1, np.array([0, 0, 0, 0, 0, 3.0, 4.0]))
    np.testing.assert_allclose(trajectory.at(1)[3:], [0, 0, 0.6, 0.8])


def test_distance_and_rotation_by_hand():
    a = np.array([1, 2, 3, 0, 0, 0, 1.0])
    assert distance(a, np.array([1, 5, 7, 0, 0, 0, 1.0])) == 5
    assert rotation(turn(10), turn(10)) == 0
    assert rotation(turn(10), -turn(10)) == 0  # the same rotation
    for angle in (1e-6, 0.5, 90, 179.999):
        assert rotation(turn(20), turn(20 + angle)) == pytest.approx(angle, rel=1e-6)
    assert rotation(turn(-100), turn(100)) == pytest.approx(160)


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
    start = turn(first, x=-4, axis=(0.6, 0, 0.8))

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
    poses = np.array([np.zeros(7), turn(0), np.full(7, np.nan), turn(90)])
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


# Files of poses, as other programs write them, and tables of numbers of the wrong kind

POSITIONS = [[0, 0, 0], [10, 0.5, -1.25]]
TURNED = [[0, 1, 0, 0, 0, 1, 0], [2, 1, 0, 0, 0, 0.6, 0.8]]  # half a turn, then less
TUM = '# timestamp tx ty tz qx qy qz qw\n5.5 0 1 0 0 0 1 0\n5.6 2 1 0 0 0 .6 .8\n'
KITTI = '-1 0 0 0 0 -1 0 1 0 0 1 0\n.28 -.96 0 2 .96 .28 0 1 0 0 1 0\n'
EUROC = (
    '#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], '
    'q_RS_z [], v_RS_R_x [m s^-1]\n1403636580838555648,0,1,0,0,0,0,1,9\n'
    '1403636580843555648,2,1,0,.8,0,0,.6,9\n'
)


@pytest.mark.parametrize(
    'text',
    [
        '# x,y,z\n0,0,0\n10,.5,-1.25\n',
        '\ufeffx,y,z\r\n0,0,0\r\n10,.5,-1.25\r\n',
        '0,0,0,\n  \n10,.5,-1.25,\n,,,\n',
        'sep=;\n0,0;0,0;0,0\n10,0;0,5;-1,25\n',
        '0,0\t0,0\t0,0\n10,0\t0,5\t-1,25\n',
        '  0  0 0\n 10 .5   -1.25',
        ',x,y,z\n0,0,0,0\n1,10,.5,-1.25\n',
        'name;z;y;x\na 1.png;0;0;0\na 2.png;-1.25;.5;10\n',
        ',0,1,2\n0,0,0,0\n1,10,.5,-1.25\n',
        '1700000000.1 0 0 0\n1700000000.2 10 .5 -1.25\n',
        '"position.x","position.y","position.z","linear.x"\n0,0,0,7\n10,.5,-1.25,7\n',
    ],
)
@pytest.mark.parametrize('encoding', ['utf-8', 'utf-16'])
def test_read_poses_of_positions(tmp_path, text, encoding):
    path = tmp_path / 'poses.csv'
    path.write_text(text, encoding)
    poses, has_rotations = read_poses(path)
    assert poses.tolist() == [[*row, 0, 0, 0, 1] for row in POSITIONS]
    assert not has_rotations


@pytest.mark.parametrize(
    'text', ['0,1,0,0,0,1,0\n2,1,0,0,0,.6,.8\n', TUM, TUM.partition('\n')[2], KITTI, EUROC]
)
def test_read_poses_with_rotations(tmp_path, text):
    path = tmp_path / 'poses.txt'
    path.write_text(text)
    poses, has_rotations = read_poses(path)
    np.testing.assert_allclose(poses, TURNED, atol=1e-9)
    assert has_rotations


def test_read_poses_of_kitti_on_a_straight_road(tmp_path):
    """The entries of the rotation hardly change, as degrees do."""
    path, angles = tmp_path / 'poses.txt', np.linspace(0, 0.01, 50)
    turns = Rotation.from_rotvec(angles[:, None] * [0, 0, 1])
    positions = angles[:, None] * [3000, 2, 0]
    np.savetxt(path, np.dstack([turns.as_matrix(), positions]).reshape(50, 12))
    poses, has_rotations = read_poses(path)
    np.testing.assert_allclose(poses, np.hstack([positions, turns.as_quat()]), atol=1e-9)
    assert has_rotations


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('0,1\n', '2 numbers in a line: expected a line an image, in meters: x y z; '),
        ('0,0,0\n\n0,0,0,0,0,0,1\n', 'line 3: the number of columns changed from 3 to 7'),
        ('', 'is empty: expected a line an image'),
        ('x,y,z\n', 'no line of numbers'),
        ('0,0,0\n0,one,0\n', "line 2: could not convert string 'one' to float64: expected a line"),
        ('0,0,0\n0,nan,0\n', 'line 2: a number is not finite'),
        ('.' + '1' * 200_000 + ',0\n', '2 numbers in a line'),
        ('0,0,0,10,20,30\n', '6 numbers in a line; angles must be a quaternion'),
        ('0,0,0,10,20,30,0\n', 'line 1: a quaternion of norm 37.4 instead of 1'),
        ('0 0 0 0 0 0 0 1 0 1 0 0\n', 'line 1: its 12 numbers have no rotation matrix'),
        ('5,0,0,0,0,0,0,1\n4,0,0,0,0,0,0,1\n', 'the first one falls and is no stamp'),
        ('1700000000,0,0\n1700000001,1,0\n', 'one of its positions is a stamp'),
        ('Latitude,Longitude,alt\n47.3,8.5,400\n', 'project latitudes and longitudes to meters'),
        ('x,y,yaw [deg]\n1,2,90\n', 'its columns are x, y, yaw: .*convert angles to a quaternion'),
        (None, 'cannot be read'),
    ],
)
def test_read_poses_of_an_invalid_file_raises(tmp_path, text, message):
    path = tmp_path / 'poses.csv'
    if text is not None:
        path.write_text(text)
    with pytest.raises(SourceError, match=f'poses {path}.*{message}'):
        read_poses(path)


def test_read_poses_of_degrees_raises(tmp_path):
    """A drive of 200 m at 47.3 degrees north and 8.5 degrees east."""
    path, meters = tmp_path / 'poses.csv', np.linspace(0, 200, 40)[:, None] * [1, 0.2, 0]
    np.savetxt(
        path, np.array([47.3, 8.5, 400]) + meters / [111e3, 75e3, 1], delimiter=',', fmt='%.7f'
    )
    with pytest.raises(SourceError, match='fractions of a millimeter an image, as latitudes'):
        read_poses(path)
    np.savetxt(path, np.array([47.3, 8.5, 400]) + meters)
    assert len(read_poses(path)[0]) == 40
    np.savetxt(path, [(0, 1, 2), (3, 4, 5)], '%d', ',')
    assert read_poses(path)[0][:, :3].tolist() == [[0, 1, 2], [3, 4, 5]]


IMAGES = [f'b/{i:04d}.jpg' for i in range(1, 13)]
STAMPS = [f'rgb/{1305031102.175304 + i / 30:.6f}.png' for i in range(12)]


def lines(form, numbers=range(1, 13)):
    """Return a line for each number, the last image first."""
    return ''.join(form.format(i, x=(i - 1) / 2) for i in reversed(numbers))


@pytest.mark.parametrize(('text', 'images', 'others'), [
    ('name,x,y,z\n' + lines('{:04d}.jpg,{x},0,0\n'), IMAGES, 0),
    (lines('{x} 0 0 a/b/{:04d}.jpg\n'), IMAGES, 0),
    (lines('{:04d} {x} 0 0\n'), IMAGES, 0),
    (lines('b/{:04d}.jpg {x} 0 0\n', range(-3, 20)), IMAGES, 11),
    (''.join(f'{n[4:-4]} {i / 2} 0 0 0 0 0 1\n' for i, n in enumerate(STAMPS)), STAMPS, 0),
    # no names of images: in the order of lines
    (''.join(f'{i},{i / 2},0,0\n' for i in range(12)), IMAGES, 0),
])  # fmt: skip
def test_poses_are_of_the_images_that_the_table_names(tmp_path, text, images, others, caplog):
    path = tmp_path / 'poses.csv'
    path.write_text(text)
    assert read_poses(path, images)[0][:, 0].tolist() == [i / 2 for i in range(12)]
    assert (f'{others} lines are of no image' in caplog.text) == bool(others)


def test_poses_that_lack_an_image_name_it(tmp_path):
    path = tmp_path / 'poses.csv'
    path.write_text('name,x,y,z\n' + lines('{:04d}.jpg,{x},0,0\n'))
    for images, reason in (
        ([*IMAGES, 'b/9998.jpg', 'b/9999.jpg'], '2 images not, b/9998.jpg, b/9999.jpg'),
        (['a.jpg'], '1 images not, a.jpg'),
    ):
        with pytest.raises(SourceError, match=f'it names 0012.jpg, .*, but {reason}'):
            read_poses(path, images)


TURN = np.linspace(0.1, 2, 20)
CIRCLE = [9 * np.sin(TURN), -9 * np.cos(TURN)]


@pytest.mark.parametrize(('rows', 'doubt'), [
    ([(500 * i, 0, 0) for i in range(20)], '500 m an image: are they in another unit'),
    ([(48.1, 11.5, 520)] * 20, 'all positions are equal'),
    (np.transpose([*CIRCLE, 57.3 * TURN]), 'yaw in degrees'),
    ([(i, 0, 0, 0.995, 0, 0, 0.0998) for i in range(20)], 'are they w x y z?'),
    ([(i, 0, 0, 0, 0, 0.0998, 0.995) for i in range(20)], ''),
])  # fmt: skip
def test_poses_of_another_unit_are_named_in_one_line(tmp_path, rows, doubt, caplog):
    np.savetxt(tmp_path / 'poses.csv', rows, delimiter=',', fmt='%.12g')
    assert len(read_poses(tmp_path / 'poses.csv')[0]) == 20
    assert [doubt in record.getMessage() for record in caplog.records] == [True] * bool(doubt)
