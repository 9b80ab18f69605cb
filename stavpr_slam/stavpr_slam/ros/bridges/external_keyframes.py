# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The keyframes of another back end: its loop closures are between those, not between images."""

import numpy as np
from stavpr_ros.mapping.transforms import cross, inverse, matrices
from stavpr_ros.units import SECOND
from stavpr_slam.pose_graph.closures import Closure
from stavpr_slam.pose_graph.keyframes import ChainSettings, KeyframeChain
from stavpr_slam.pose_graph.path_errors import OdometryNoise


class ExternalKeyframes:
    """
    Keyframes by their stamps, and the odometry between them.

    ``numbers`` has the keyframes by stamp, ns.

    :param max_gap: seconds between an image and its keyframe at most.
    """

    def __init__(self, max_gap: float) -> None:
        self._max_gap = round(max_gap * SECOND)
        self.numbers: dict[int, int] = {}
        self.odometry = KeyframeChain(ChainSettings(), OdometryNoise())

    def near(self, stamp: int) -> tuple[int, np.ndarray] | None:
        """
        Return the nearest keyframe, and the transform (4, 4) from it to a stamp (ns).

        :returns: None without a keyframe that is near and whose motion to the stamp is known.
        """
        best = min(self.numbers, key=lambda own: abs(own - stamp), default=stamp)
        if best == stamp:
            return (self.numbers[stamp], np.eye(4)) if self.numbers else None
        motion = self.odometry.motion(best, stamp)
        if abs(best - stamp) > self._max_gap or motion is None:
            return None
        return self.numbers[best], motion


def keyframe_edge(
    closure: Closure, place: np.ndarray, query: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """
    Move a loop closure to the keyframes next to its images.

    :param place, query: transforms (4, 4) from the keyframe to the image, whose errors are left
        out.
    :returns: the pose of the query's keyframe in the frame of the place's, (4, 4), and its
        covariance: x y z, rotations about the fixed axes of the place's, (6, 6).
    """
    after, motion = inverse(query), matrices(closure.pose)
    # t' = A (t + R b): an error of the rotation R also moves the end of the motion b
    jacobian = np.eye(6)
    jacobian[:3, 3:] = -cross((motion[:3, :3] @ after[:3, 3])[None])[0]
    jacobian = np.kron(np.eye(2), place[:3, :3]) @ jacobian
    return place @ motion @ after, jacobian @ closure.covariance @ jacobian.T
