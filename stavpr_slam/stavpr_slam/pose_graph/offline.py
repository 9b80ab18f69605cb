# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pose graph of a recorded drive: the same input gives the same trajectory."""

from collections.abc import Sequence

import numpy as np
from stavpr_ros.checks import require_shape
from stavpr_slam.pose_graph.closures import Closure
from stavpr_slam.pose_graph.graph import GraphSettings, PoseGraph


def optimize(
    stamps: np.ndarray,
    odometry: np.ndarray,
    closures: Sequence[Closure],
    settings: GraphSettings | None = None,
) -> tuple[np.ndarray, PoseGraph]:
    """
    Correct a drive by its loop closures.

    :param stamps: of the odometry, ns, shape (N,).
    :param odometry: poses, shape (N, 7).
    :returns: the corrected poses (N, 7), NaN where the graph has no odometry, and the graph.
    :raises InputError: other shapes.
    """
    require_shape('odometry', odometry, f'{len(stamps)} 7')
    graph = PoseGraph(settings)
    for stamp, pose in zip(stamps.tolist(), odometry, strict=True):
        graph.add_odometry(stamp, pose)
    for closure in closures:
        graph.add_closure(closure)
    graph.update(final=True)
    found = [graph.at(t, pose) for t, pose in zip(stamps.tolist(), odometry, strict=True)]
    missing = np.full(7, np.nan)
    return np.array([missing if pose is None else pose for pose in found]), graph
