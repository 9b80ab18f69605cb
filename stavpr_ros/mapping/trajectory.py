"""Where the robot was, and when: poses by their time, with an answer for the moments between them."""

from bisect import bisect_left
from math import isfinite
from threading import Lock

import numpy as np

from stavpr_ros.errors import InputError, SettingsError

SECOND = 1_000_000_000
GAP = 5.0  # seconds: over a longer silence of the odometry a straight line would be an invention
NEARLY_PARALLEL = 0.9995  # cosine from which the sines of slerp are too small to divide by


def checked_pose(pose: np.ndarray) -> np.ndarray:
    """
    Return a pose of our own memory whose quaternion has the norm 1.

    :param pose: x y z (meters) and quaternion x y z w, shape (7,).
    :returns: the same, float64.
    :raises InputError: another shape, values that are not finite, or a quaternion of zeros.
    """
    own = np.array(pose, np.float64)
    if own.shape != (7,):
        raise InputError(f'pose has shape {own.shape}: expected 7 numbers, x y z and quaternion x y z w')
    norm = float(np.linalg.norm(own[3:]))
    if not np.isfinite(own).all() or not isfinite(norm):
        raise InputError(f'pose {own.tolist()} is not finite: expected meters and a quaternion')
    if norm == 0:
        raise InputError(f'pose {own.tolist()} has a quaternion of zeros: expected 0 0 0 1 for no rotation')
    own[3:] /= norm
    return own


def distance(a: np.ndarray, b: np.ndarray) -> float:
    """Return the meters between two poses, each of shape (7,)."""
    return float(np.linalg.norm(a[:3] - b[:3]))


def rotation(a: np.ndarray, b: np.ndarray) -> float:
    """Return the angle by which one pose is turned against another, degrees, 0 to 180; shape (7,) each."""
    # q and -q are the same rotation; unlike the arc cosine of their product, this is exact for small angles
    apart, together = np.linalg.norm(a[3:] - b[3:]), np.linalg.norm(a[3:] + b[3:])
    return float(np.degrees(4 * np.arctan2(min(apart, together), max(apart, together))))


def interpolate(a: np.ndarray, b: np.ndarray, part: float) -> np.ndarray:
    """
    Return the pose between two: positions on a line, rotations on the shorter arc, at an even speed.

    :param a: shape (7,), the quaternion of norm 1; so is b's.
    :param part: 0 (a) to 1 (b).
    """
    pose = (1 - part) * a + part * b
    p, q = a[3:], b[3:]
    cosine = float(p @ q)
    if cosine < 0:
        q, cosine = -q, -cosine
    if cosine > NEARLY_PARALLEL:
        turned = (1 - part) * p + part * q
    else:
        angle = np.arccos(cosine)
        turned = np.sin((1 - part) * angle) * p + np.sin(part * angle) * q
    pose[3:] = turned / np.linalg.norm(turned)
    return pose


class Trajectory:
    """
    The latest poses by their stamps; one thread may add while another asks.

    :param patience: seconds for which the newest pose still holds, and by which poses may come in the wrong
        order; a stamp that goes back further means that the clock jumped.
    :param capacity: most poses kept; when there are more, the oldest eighth is forgotten at once.
    :param gap: seconds between two poses up to which moments between them are interpolated.
    :raises SettingsError: a negative patience or gap, or no room for a pose.
    """

    def __init__(self, patience: float = 0.5, capacity: int = 10_000, gap: float = GAP) -> None:
        if not patience >= 0 or not isfinite(patience):
            raise SettingsError(f'patience = {patience} must be 0 seconds or more')
        if not gap >= 0:
            raise SettingsError(f'gap = {gap} must be 0 seconds or more')
        if capacity < 1:
            raise SettingsError(f'capacity = {capacity} must be at least 1 pose')
        self._patience, self._capacity, self._gap = round(patience * SECOND), capacity, gap * SECOND
        self._stamps: list[int] = []
        self._poses: list[np.ndarray] = []
        self._lock = Lock()

    @classmethod
    def from_arrays(cls, stamps: np.ndarray, poses: np.ndarray, patience: float = 0.5) -> 'Trajectory':
        """
        Make a trajectory of recorded poses; all are kept.

        :param stamps: nanoseconds, in order, shape (m,), int64.
        :param poses: shape (m, 7).
        :raises InputError: one of them is none.
        """
        trajectory = cls(patience, capacity=max(1, len(stamps)))
        for i, (stamp, pose) in enumerate(zip(stamps.tolist(), poses, strict=True)):
            try:
                trajectory.add(stamp, pose)
            except InputError as error:
                raise InputError(f'pose number {i}: {error}') from error
        return trajectory

    def __len__(self) -> int:
        with self._lock:
            return len(self._stamps)

    def add(self, stamp: int, pose: np.ndarray) -> None:
        """
        Take in a pose; one of the same stamp is replaced.

        :param stamp: nanoseconds, above 0.
        :param pose: x y z (meters) and quaternion x y z w, shape (7,).
        :raises InputError: no such pose, or no stamp; nothing is changed then.
        """
        if stamp <= 0:
            raise InputError(f'pose with stamp {stamp}: expected nanoseconds above 0')
        pose = checked_pose(pose)
        with self._lock:
            stamps, poses = self._stamps, self._poses
            if stamps and stamp < stamps[-1] - self._patience:
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
        Return the pose at a moment, shape (7,), float64; None where it is not known.

        :param stamp: nanoseconds; 0 = unknown.
        """
        with self._lock:
            stamps, poses = self._stamps, self._poses
            after = bisect_left(stamps, stamp)
            if after == len(stamps):
                held = bool(stamps) and stamp - stamps[-1] <= self._patience
                return poses[-1].copy() if held else None
            a, b = max(after - 1, 0), after
            start, end, first, last = stamps[a], stamps[b], poses[a], poses[b]
        if stamp == end:
            return last.copy()
        if stamp < start or a == b or end - start > self._gap:
            return None
        return interpolate(first, last, (stamp - start) / (end - start))

    def clear(self) -> None:
        """Forget everything."""
        with self._lock:
            self._stamps.clear()
            self._poses.clear()
