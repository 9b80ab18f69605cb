# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``stavpr map merge --align``, found by its entry point."""

import numpy as np
from stavpr_ros.commands import map as map_command
from stavpr_ros.mapping import load_map, save_map


def test_map_merge_with_align_moves_poses_into_the_first_frame(small_map, tmp_path, map_file):
    shifted = load_map(map_file)
    shifted.poses[:, 1] += 5
    save_map(shifted, tmp_path / 'shifted')
    both = str(tmp_path / 'both')
    assert map_command.main(['merge', both, map_file, str(tmp_path / 'shifted'), '--align']) == 0
    poses = load_map(both).poses[60:]
    np.testing.assert_allclose(poses[:, :3], small_map.poses[:, :3], atol=0.5)
