# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pose graphs as text: g2o, and trajectories in the formats of TUM and KITTI."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from stavpr_ros.errors import SettingsError
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_ros.output_file import FileKind, Force, write_output
from stavpr_ros.units import SECOND
from stavpr_slam.pose_graph.graph import PoseGraph
from stavpr_slam.pose_graph.path_errors import path_errors

TUM_HEADER = '# timestamp tx ty tz qx qy qz qw\n'
TUM = FileKind('trajectory', lambda head: head.startswith(TUM_HEADER.encode()))
KITTI = FileKind('trajectory', lambda head: len(head.split(b'\n')[0].split()) == 12)
G2O = FileKind('g2o file', lambda head: head.startswith((b'VERTEX_SE3:QUAT', b'# g2o')))


def tum_text(stamps: np.ndarray, poses: np.ndarray) -> str:
    """
    Return a trajectory in the TUM format.

    :param stamps: ns, shape (N,); poses of NaN are left out.
    :param poses: shape (N, 7).
    """
    lines = [
        f'{stamp // SECOND}.{stamp % SECOND:09d} ' + ' '.join(f'{value:.9g}' for value in pose)
        for stamp, pose in zip(stamps.tolist(), poses, strict=True)
        if np.isfinite(pose).all()
    ]
    return TUM_HEADER + '\n'.join(lines) + '\n'


def kitti_text(poses: np.ndarray) -> str:
    """
    Return a trajectory in the format of KITTI odometry: the rows of (3, 4) matrices.

    :param poses: of the base (x ahead, z up) in the frame of the graph, shape (N, 7). The poses of
        the benchmark are of its left camera (z ahead, y down) in the frame of the first one.
    """
    return '\n'.join(_numbers(row.ravel()) for row in matrices(poses)[:, :3]) + '\n'


def g2o_text(graph: PoseGraph) -> str:
    """Return the nodes as solved, the odometry and the accepted closures in the g2o format."""
    count = len(graph.solved)
    lines = ['# g2o: accepted closures only']
    poses = to_poses(graph.solved)
    lines += [f'VERTEX_SE3:QUAT {i} {_numbers(pose)}' for i, pose in enumerate(poses)]
    chain = graph.chain
    nodes = np.flatnonzero(chain.previous[:count] >= 0)
    before, T = chain.previous[nodes], chain.transforms
    spread, _ = path_errors(chain, nodes, before)
    motions, covariances = inverse(T[before]) @ T[nodes], graph.scale**2 * spread
    for row in zip(before.tolist(), nodes.tolist(), motions, covariances, strict=True):
        lines.append(_edge(*row))
    for edge in graph.used.values():
        lines.append(_edge(edge.place, edge.query, edge.transform, edge.covariance))
    return '\n'.join(lines) + '\n'


def _edge(start: int, end: int, transform: np.ndarray, covariance: np.ndarray) -> str:
    """Return an edge; g2o has the translation first, and half the rotation as a quaternion's."""
    order = [3, 4, 5, 0, 1, 2]
    information = np.linalg.inv(covariance)[np.ix_(order, order)]
    half = np.diag([1, 1, 1, 2, 2, 2])
    upper = (half @ information @ half)[np.triu_indices(6)]
    return f'EDGE_SE3:QUAT {start} {end} {_numbers(to_poses(transform))} {_numbers(upper)}'


def _numbers(values: np.ndarray) -> str:
    return ' '.join(f'{value:.9g}' for value in values)


def save_graph(graph: PoseGraph, path: str, force: Force = False) -> int:
    """
    Write the graph, ``.g2o``, or its trajectory; return the number of nodes.

    ``.tum`` and ``.kitti`` have the same poses, one of each odometry that is kept.

    :raises SettingsError: another suffix.
    :raises OutputError: it cannot be written, or exists.
    """
    suffix = Path(path).suffix
    kinds: dict[str, tuple[FileKind, Callable[[], str]]] = {
        '.g2o': (G2O, lambda: g2o_text(graph)),
        '.tum': (TUM, lambda: tum_text(*_trajectory(graph))),
        '.kitti': (KITTI, lambda: kitti_text(_trajectory(graph)[1])),
    }
    if suffix not in kinds:
        raise SettingsError(f'{path}: expected a name that ends in .kitti, .g2o or .tum')
    kind, text = kinds[suffix]
    write_output(path, text(), kind, force)
    return len(graph.solved)


def _trajectory(graph: PoseGraph) -> tuple[np.ndarray, np.ndarray]:
    stamps, _, corrected = graph.chain.trajectory(graph.solved)
    return stamps, to_poses(corrected)
