# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of poses: three or seven numbers a line."""

import pytest
from stavpr_ros.errors import SourceError
from stavpr_ros.sources.pose_file import read_poses


@pytest.mark.parametrize(
    ('text', 'rows', 'oriented'),
    [
        ('# x,y,z\n0,0,0\n10,0,0\n', [[0, 0, 0, 0, 0, 0, 1], [10, 0, 0, 0, 0, 0, 1]], False),
        ('0,1,0,0,0,1,0\n', [[0, 1, 0, 0, 0, 1, 0]], True),
    ],
)
def test_read_poses_of_three_or_seven_numbers(tmp_path, text, rows, oriented):
    path = tmp_path / 'poses.csv'
    path.write_text(text)
    poses, found = read_poses(path)
    assert (poses.tolist(), found) == (rows, oriented)


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('0,1\n', '3 or 7 numbers'),
        ('0,0,0\n0,0,0,0,0,0,1\n', '3 or 7 numbers'),
        ('', '3 or 7 numbers'),
        ('a,b,c\n', 'cannot be read'),
        ('0,nan,0\n', 'finite numbers'),
        (None, 'cannot be read'),
    ],
)
def test_read_poses_of_an_invalid_file_raises(tmp_path, text, message):
    path = tmp_path / 'poses.csv'
    if text is not None:
        path.write_text(text)
    with pytest.raises(SourceError, match=message):
        read_poses(path)
