# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The unknown transform between two maps, by the places that both have."""

import math

import numpy as np
from stavpr_ros.errors import InputError
from stavpr_ros.units import SECOND
from stavpr_slam.pose_graph.closures import Closure
from stavpr_slam.pose_graph.graph import GraphSettings, optimize
from stavpr_slam.pose_graph.keyframes import ChainSettings

# Deviations of a closure by appearance alone: the query is taken to be where the place is.
# Measured on synthetic streets with two lanes: .9 m along, 2 m across.
APPEARANCE = np.diag([3.0, 3.0, 1.0, 0.18, 0.18, 0.18]) ** 2
IDENTITY = np.array([0, 0, 0, 0, 0, 0, 1.0])


def align_maps(reference: np.ndarray, poses: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """
    Return the transform of a map into the frame of another, by robust consensus.

    Each pair votes for a transform. Pairs that contradict the largest consistent set are left out,
    so most of a minority of wrong pairs have no influence. Both frames have z upwards.

    :param reference: poses of the places of the other map, shape (n, 7).
    :param poses: of the places of the map, in the order of the drive, shape (m, 7).
    :param pairs: place of the map, place of the other, shape (k, 2), int.
    :returns: shape (4, 4).
    :raises InputError: too few pairs agree.
    """
    keyframes = ChainSettings(distance=0.0, max_gap=math.inf, max_speed=math.inf)
    closures = [
        Closure((query + 1) * SECOND, place + 1, IDENTITY, APPEARANCE, False, 'reference',
                reference[place])
        for query, place in pairs.tolist()
    ]  # fmt: skip
    stamps = np.arange(1, len(poses) + 1) * SECOND
    _, graph = optimize(stamps, poses, closures, GraphSettings(keyframes))
    chosen = [(edge.query, edge.place) for edge in graph.edges if edge.accepted]
    if not len(graph.used):
        raise InputError(
            f'{len(chosen)} of {len(pairs)} recognized places agree on a transform: expected maps '
            'with a common stretch; leave --align out to keep both frames'
        )
    source, target = (graph.chain.transforms[nodes, :3, 3] for nodes in np.array(chosen).T)
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    yaw = math.atan2(cross.sum(), (a[:, :2] * b[:, :2]).sum())
    c, s = math.cos(yaw), math.sin(yaw)
    result = np.eye(4)
    result[:2, :2] = [[c, -s], [s, c]]
    result[:3, 3] = target.mean(axis=0) - result[:3, :3] @ source.mean(axis=0)
    return result
