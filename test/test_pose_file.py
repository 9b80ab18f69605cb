# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of poses, as other programs write them, and tables of numbers of the wrong kind."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from stavpr_ros.errors import SourceError
from stavpr_ros.sources.pose_file import read_poses

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
