# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Poses by their stamps, interpolated between them."""

from bisect import bisect_left
from threading import Lock

import numpy as np
from stavpr_ros.checks import require_shape
from stavpr_ros.errors import InputError
from stavpr_ros.units import SECOND

MAX_GAP = 5 * SECOND  # without odometry, across which interpolation would be a guess
MAX_COORDINATE = 1e8  # meters of a coordinate: farther from the origin is no place on Earth
NORMS = 1e-3, 1e3  # range of the norms of quaternions that are normalized


def normalize_pose(pose: np.ndarray) -> np.ndarray:
    """
    Return a copy of a pose whose quaternion has the norm 1.

    :param pose: x y z (meters) and quaternion x y z w, shape (7,).
    :returns: the same, float64.
    :raises InputError: another shape, values that are not finite or above ``MAX_COORDINATE``, or a
        quaternion of a norm outside ``NORMS``.
    """
    try:
        copy = np.array(pose, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(
            f'pose {pose!r:.200} is no array ({error}): expected 7 numbers'
        ) from error
    require_shape('pose, x y z and quaternion x y z w', copy, '7')
    if not (np.abs(copy) <= MAX_COORDINATE).all():  # NaN as well
        raise InputError(
            f'pose {copy.tolist()} is not finite: expected meters up to {MAX_COORDINATE:g} and a '
            'quaternion'
        )
    norm = float(np.linalg.norm(copy[3:]))
    if not NORMS[0] <= norm <= NORMS[1]:
        raise InputError(
            f'pose {copy.tolist()} has a quaternion of norm {norm:g}: expected one of norm 1, '
            '0 0 0 1 for no rotation'
        )
    copy[3:] /= norm
    return copy


def distance(a: np.ndarray, b: np.ndarray) -> float:
    """Return the distance between two poses, each of shape (7,), in meters."""
    return float(np.linalg.norm(a[:3] - b[:3]))


def rotation(a: np.ndarray, b: np.ndarray) -> float:
    """Return the angle between two poses, each of shape (7,), in degrees, 0 to 180."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_quat(a[3:]).inv() * Rotation.from_quat(b[3:])
    return float(np.degrees(turn.magnitude()))


def interpolate(a: np.ndarray, b: np.ndarray, part: float) -> np.ndarray:
    """
    Return the pose between two: positions on a line, rotations on the shorter arc.

    :param a: shape (7,), the quaternion of norm 1; so is b's.
    :param part: 0 (a) to 1 (b).
    """
    from scipy.spatial.transform import Rotation

    start, end = Rotation.from_quat(a[3:]), Rotation.from_quat(b[3:])
    turn = start * (start.inv() * end) ** part  # scipy's Slerp is three times as slow for two
    return np.concatenate([(1 - part) * a[:3] + part * b[:3], turn.as_quat()])


class Trajectory:
    """
    The latest poses by their stamps; one thread may add while another reads.

    :param timeout: seconds after the newest pose for which it is still returned, and by which
        poses may arrive out of order; an earlier stamp means that the clock jumped back.
    :param capacity: most poses kept; beyond it, the oldest eighth is evicted at once.
    """

    def __init__(self, timeout: float = 0.5, capacity: int = 10_000) -> None:
        self._timeout = round(timeout * SECOND)
        self._capacity = capacity
        self._stamps: list[int] = []
        self._poses: list[np.ndarray] = []
        self._lock = Lock()
        self.rejected = 0  # poses of :meth:`from_arrays`

    @classmethod
    def from_arrays(
        cls, stamps: np.ndarray, poses: np.ndarray, timeout: float = 0.5
    ) -> 'Trajectory':
        """
        Make a trajectory of recorded poses; invalid ones are counted in ``rejected``.

        :param stamps: nanoseconds, in order, shape (m,), int64.
        :param poses: shape (m, 7).
        :raises InputError: every pose is invalid.
        """
        trajectory = cls(timeout, capacity=max(1, len(stamps)))
        for i, (stamp, pose) in enumerate(zip(stamps.tolist(), poses, strict=True)):
            try:
                trajectory.add(stamp, pose)
            except InputError as error:
                trajectory.rejected += 1
                if trajectory.rejected == len(stamps):
                    raise InputError(f'pose number {i} and all before: {error}') from error
        return trajectory

    def __len__(self) -> int:
        with self._lock:
            return len(self._stamps)

    def add(self, stamp: int, pose: np.ndarray) -> None:
        """
        Add a pose; one of the same stamp is replaced.

        :param stamp: nanoseconds, above 0.
        :param pose: x y z (meters) and quaternion x y z w, shape (7,).
        :raises InputError: an invalid pose or stamp; nothing is changed.
        """
        if stamp <= 0:
            raise InputError(f'pose with stamp {stamp}: expected nanoseconds above 0')
        pose = normalize_pose(pose)
        with self._lock:
            stamps, poses = self._stamps, self._poses
            if stamps and stamp < stamps[-1] - self._timeout:
                stamps.clear()
                poses.clear()
            index = bisect_left(stamps, stamp)
            if index < len(stamps) and stamps[index] == stamp:
                poses[index] = pose
                return
            stamps.insert(index, stamp)
            poses.insert(index, pose)
            if len(stamps) > self._capacity:
                oldest = slice(0, max(1, self._capacity // 8))
                del stamps[oldest], poses[oldest]

    def at(self, stamp: int) -> np.ndarray | None:
        """
        Return the pose at a stamp, shape (7,), float64; None where it is unknown.

        :param stamp: nanoseconds; 0 = unknown.
        """
        with self._lock:
            stamps, poses = self._stamps, self._poses
            after = bisect_left(stamps, stamp)
            if after == len(stamps):
                recent = bool(stamps) and stamp - stamps[-1] <= self._timeout
                return poses[-1].copy() if recent else None
            a, b = max(after - 1, 0), after
            start, end, first, last = stamps[a], stamps[b], poses[a], poses[b]
        if stamp == end:
            return last.copy()
        if stamp < start or a == b or end - start > MAX_GAP:
            return None
        return interpolate(first, last, (stamp - start) / (end - start))

    def clear(self) -> None:
        """Remove all poses."""
        with self._lock:
            self._stamps.clear()
            self._poses.clear()
