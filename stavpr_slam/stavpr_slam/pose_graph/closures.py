# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Loop closures with a relative pose: the measurements of the graph."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from stavpr_ros.errors import InputError
from stavpr_ros.mapping.trajectory import normalize_pose
from stavpr_slam.pose_graph.path_errors import LARGEST_COVARIANCE

VARIANCES = 1e-10, 1e6  # m^2, rad^2: least and largest that the graph computes with


@dataclass(frozen=True, eq=False)
class Closure:
    """
    One measured relative pose of two stamps.

    :param query_stamp, place_stamp: ns.
    :param pose: of the query in the place's frame, shape (7,).
    :param covariance: x y z, rotations about the fixed axes of the place, shape (6, 6).
    :param is_independent: its error does not correlate with the edge before.
    :param map_id: of the map that the place is in, whose pose there is ``place_pose``, shape (7,);
        empty = the place is on the same drive.
    :param query_robot, place_robot: whose odometry the stamps are of.
    """

    query_stamp: int
    place_stamp: int
    pose: np.ndarray
    covariance: np.ndarray
    is_independent: bool = True
    map_id: str = ''
    place_pose: np.ndarray | None = None
    query_robot: str = ''
    place_robot: str = ''

    def checked(self) -> 'Closure':
        """
        Return this closure with unit quaternions and a covariance that can be inverted.

        :raises InputError: values that are not finite, or no covariance.
        """
        covariance = np.array(self.covariance, np.float64)
        if covariance.shape != (6, 6) or not (np.abs(covariance) <= LARGEST_COVARIANCE).all():
            raise InputError(
                'the covariance of a closure is not finite: expected 6 x 6 numbers up to '
                f'{LARGEST_COVARIANCE:g}'
            )
        values, axes = np.linalg.eigh((covariance + covariance.T) / 2)
        if values[0] <= 0:
            raise InputError(
                'the covariance of a closure is not positive definite: expected variances above 0'
            )
        limited = values.clip(*VARIANCES)
        if not np.array_equal(limited, values):
            covariance = (axes * limited) @ axes.T
        if self.query_stamp <= 0 or self.place_stamp <= 0:
            raise InputError('a closure has a stamp of 0: expected the stamps of the two images')
        if self.map_id and self.place_pose is None:
            raise InputError('a closure with a map has no pose of the place in the map')
        place = None if self.place_pose is None else normalize_pose(self.place_pose)
        pose = normalize_pose(self.pose)
        return replace(self, pose=pose, covariance=covariance, place_pose=place)


# A closure between two nodes: the transform of the query's node in the place's, its covariance in
# the axes of the query's node, rotation first, and whether its error is independent.
BETWEEN_NODES = np.dtype([
    ('query', np.int64), ('place', np.int64), ('transform', np.float64, (4, 4)),
    ('covariance', np.float64, (6, 6)), ('is_independent', np.bool_),
])  # fmt: skip
ClosureArrays = Any  # np.recarray of this type


def between_nodes(rows: Sequence[Any]) -> ClosureArrays:
    """Return closures as arrays, the fields of :data:`BETWEEN_NODES`."""
    return np.array(rows, BETWEEN_NODES).view(np.recarray)
