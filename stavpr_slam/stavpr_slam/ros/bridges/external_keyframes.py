# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The keyframes of another back end: its loop closures are between those, not between images."""

from collections.abc import Mapping

import numpy as np
from stavpr_ros.mapping.transforms import cross, inverse, matrices
from stavpr_slam.pose_graph.closures import Closure
from stavpr_slam.pose_graph.keyframes import KeyframeChain


def nearest(
    keyframes: Mapping[int, int], odometry: KeyframeChain, max_gap: int, stamp: int
) -> tuple[int, np.ndarray] | None:
    """
    Return the nearest keyframe, and the transform (4, 4) from it to a stamp (ns).

    :param keyframes: their numbers by stamp.
    :param max_gap: ns between an image and its keyframe at most.
    :returns: None without a keyframe that is near and whose motion to the stamp is known.
    """
    if not keyframes:
        return None
    best = min(keyframes, key=lambda own: abs(own - stamp))
    motion = odometry.motion(best, stamp) if best != stamp else np.eye(4)
    if abs(best - stamp) > max_gap or motion is None:
        return None
    return keyframes[best], motion


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
