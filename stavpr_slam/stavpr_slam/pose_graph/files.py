# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of a pose graph: g2o, and trajectories in the formats of TUM and KITTI."""

from pathlib import Path

import numpy as np
from stavpr_ros.errors import SettingsError
from stavpr_ros.mapping.transforms import matrices, to_poses
from stavpr_ros.output_file import FileKind, Force, write_output
from stavpr_ros.units import SECOND
from stavpr_slam.pose_graph.g2o import g2o_text
from stavpr_slam.pose_graph.graph import PoseGraph

TUM_HEADER = '# timestamp tx ty tz qx qy qz qw\n'
TUM = FileKind('trajectory', lambda head: head.startswith(TUM_HEADER.encode()))
KITTI = FileKind('trajectory', lambda head: len(head.split(b'\n')[0].split()) == 12)
G2O = FileKind('g2o file', lambda head: head.startswith((b'VERTEX_SE3:QUAT', b'# g2o')))


def tum_text(stamps: np.ndarray, poses: np.ndarray) -> str:
    """
    Return a trajectory in the TUM format.

    :param stamps: ns, shape (N,).
    :param poses: shape (N, 7).
    """
    lines = [
        f'{stamp // SECOND}.{stamp % SECOND:09d} ' + ' '.join(f'{value:.9g}' for value in pose)
        for stamp, pose in zip(stamps.tolist(), poses, strict=True)
    ]
    return TUM_HEADER + '\n'.join(lines) + '\n'


def kitti_text(poses: np.ndarray) -> str:
    """
    Return a trajectory in the format of KITTI odometry: the rows of (3, 4) matrices.

    :param poses: of the base (x ahead, z up) in the frame of the graph, shape (N, 7). The poses of
        the benchmark are of its left camera (z ahead, y down) in the frame of the first one.
    """
    rows = matrices(poses)[:, :3].reshape(-1, 12)
    return '\n'.join(' '.join(f'{value:.9g}' for value in row) for row in rows) + '\n'


def save_graph(graph: PoseGraph, path: str, force: Force = False) -> int:
    """
    Write the graph, ``.g2o``, or its trajectory; return the number of nodes.

    ``.tum`` and ``.kitti`` have the same poses, one of each odometry that is kept.

    :raises SettingsError: another suffix.
    :raises OutputError: it cannot be written, or exists.
    """
    stamps, _, corrected = graph.chain.trajectory(graph.solved)
    match Path(path).suffix:
        case '.g2o':
            kind, text = G2O, g2o_text(graph)
        case '.tum':
            kind, text = TUM, tum_text(stamps, to_poses(corrected))
        case '.kitti':
            kind, text = KITTI, kitti_text(to_poses(corrected))
        case _:
            raise SettingsError(f'{path}: expected a name that ends in .kitti, .g2o or .tum')
    write_output(path, text, kind, force)
    return len(graph.solved)
