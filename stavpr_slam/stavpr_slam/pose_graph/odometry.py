# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes of the odometry, the sessions between its breaks, and the growth of its errors."""

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
from stavpr_ros.errors import InputError
from stavpr_ros.mapping.trajectory import checked_pose, SECOND
from stavpr_ros.mapping.transforms import inverse, matrices
from stavpr_slam.pose_graph.track import OdometryTrack


@dataclass(frozen=True)
class OdometryNoise:
    """
    Errors of an odometry, as deviations that grow with the distance.

    :param translation: meters per square root of a meter.
    :param rotation: radians per square root of a meter.
    :param bias: of the rotation, radians per meter: as much as its random error after a kilometer.
    """

    translation: float = 0.05
    rotation: float = 0.012
    bias: float = 0.0004

    def scaled(self, factor: float) -> 'OdometryNoise':
        """Return errors that are so many times as large."""
        return OdometryNoise(self.translation * factor, self.rotation * factor, self.bias * factor)


@dataclass(frozen=True, eq=False)
class Ways:
    """
    Ways between one end and n others: an error of the heading on a way moves its end.

    :param length: m, negative where the other is before the end, shape (n,).
    :param moment: integral of the position relative to the end, in its axes, m^2, shape (n, 3);
        negative where the other is before it.
    :param second: integral of the position times itself, m^3, shape (n, 3, 3).
    """

    length: np.ndarray
    moment: np.ndarray
    second: np.ndarray

    @property
    def spread(self) -> np.ndarray:
        """Return the integral of the squared distance from the end, m^3, shape (n,)."""
        result: np.ndarray = np.trace(self.second, axis1=-2, axis2=-1)
        return result


@dataclass(frozen=True)
class ChainSettings:
    """
    When the odometry becomes a keyframe, and when it breaks.

    :param distance: meters between keyframes.
    :param angle: radians between keyframes.
    :param max_gap: seconds without odometry that begin a new session.
    :param max_speed: meters per second; a faster motion begins a new session.
    """

    distance: float = 1.0
    angle: float = 0.1
    max_gap: float = 5.0
    max_speed: float = 60.0


class KeyframeChain:
    """
    Keyframes of the odometry in sessions, and fixed places of a map; all are nodes of the graph.

    ``stamps`` (ns), ``transforms`` (in the odometry of its session, or in the map), ``travelled``
    (m), ``session`` (negative = fixed) are arrays of N nodes; ``recording`` is the session before
    splits.
    """

    FIXED = -1
    STILL = 0.05  # meters that a standing robot moves at most

    def __init__(self, settings: ChainSettings) -> None:
        self._settings = settings
        self._capacity = 1024
        self._arrays: dict[str, np.ndarray] = {
            'stamps': np.zeros(self._capacity, np.int64),
            'transforms': np.zeros((self._capacity, 4, 4)),
            'travelled': np.zeros(self._capacity),
            'session': np.zeros(self._capacity, np.int32),
            'previous': np.zeros(self._capacity, np.int64),
            'recording': np.zeros(self._capacity, np.int32),
            # longest time that the odometry stood before the node, and its middle
            'stood': np.zeros((self._capacity, 2), np.int64),
            # of the way to each node, about the start of its odometry: for `ways`
            'origin': np.zeros((self._capacity, 3)),
            'moment': np.zeros((self._capacity, 3)),
            'second': np.zeros((self._capacity, 3, 3)),
        }
        self._count = 0
        # stamps and nodes, split or not, and the odometry between them
        self._recorded: list[tuple[list[int], list[int], OdometryTrack]] = []
        self.sessions = 0
        self._tail: tuple[int, np.ndarray] | None = None  # stamp and pose of the newest odometry
        # the odometry that later ones have not moved from
        self._still: tuple[int, np.ndarray] | None = None
        self._stood = (0, 0)
        self._fixed: dict[tuple[str, int], int] = {}
        # first nodes after splits: the stamps, and the nodes before
        self._cuts: dict[int, tuple[int, int]] = {}
        self.breaks: list[str] = []

    def __len__(self) -> int:
        return self._count

    @property
    def stamps(self) -> np.ndarray:
        """Return the stamps of the nodes, (N,), int64, ns."""
        return self._arrays['stamps'][: self._count]

    @property
    def transforms(self) -> np.ndarray:
        """Return the transforms of the nodes, (N, 4, 4)."""
        return self._arrays['transforms'][: self._count]

    @property
    def travelled(self) -> np.ndarray:
        """Return the distance travelled up to each node, (N,), m."""
        return self._arrays['travelled'][: self._count]

    @property
    def session(self) -> np.ndarray:
        """Return the session of each node, (N,), int32; negative = a fixed place."""
        return self._arrays['session'][: self._count]

    @property
    def recording(self) -> np.ndarray:
        """Return the session of each node without splits, (N,), int32; negative = fixed."""
        return self._arrays['recording'][: self._count]

    @property
    def previous(self) -> np.ndarray:
        """Return the node before each one in its session, (N,), int64; -1 = none."""
        return self._arrays['previous'][: self._count]

    @property
    def stood(self) -> np.ndarray:
        """
        Return how long the odometry stood before each node, and when: in the middle, (N, 2), ns.

        It is the longest time since the node before.
        """
        return self._arrays['stood'][: self._count]

    @property
    def newest(self) -> int:
        """Return the newest keyframe; -1 = none."""
        return self._recorded[-1][1][-1] if self._recorded else -1

    def add(self, stamp: int, pose: np.ndarray) -> bool:
        """
        Add the odometry; return whether it is a new keyframe.

        :param stamp: ns.
        :param pose: of the base in the frame of the odometry, shape (7,).
        :raises InputError: an invalid pose or stamp; nothing is changed.
        """
        pose = checked_pose(pose)
        if stamp <= 0:
            raise InputError(f'odometry with stamp {stamp}: expected nanoseconds above 0')
        cause = self._break(stamp, pose)
        if cause == '':
            assert self._tail is not None
            if stamp <= self._tail[0]:
                return False
            node = self.newest
            step = inverse(self.transforms[node]) @ matrices(pose)
            near = np.linalg.norm(step[:3, 3]) < self._settings.distance
            turned = (np.trace(step[:3, :3]) - 1) / 2 < np.cos(self._settings.angle)
            self._tail = stamp, pose
            self._note_standing(stamp, pose)
            is_keyframe = bool(turned or not near)
            self._recorded[-1][2].add(stamp, pose, is_keyframe)
            if not is_keyframe:
                return False
            self._append(stamp, matrices(pose), node)
            return True
        if self._tail is not None:
            self.breaks.append(cause)
        self._tail = self._still = stamp, pose
        self._stood = (0, 0)
        track = OdometryTrack(self._settings.distance, self._settings.angle)
        track.add(stamp, pose, True)
        self._recorded.append(([], [], track))
        self.sessions += 1
        self._append(stamp, matrices(pose), -1)
        return True

    def _break(self, stamp: int, pose: np.ndarray) -> str:
        """Return why a new session begins; empty = none does."""
        if self._tail is None:
            return 'start'
        seconds = (stamp - self._tail[0]) / SECOND
        if seconds < -0.5:
            return f'the stamps jumped back by {-seconds:.3f} s'
        if seconds > self._settings.max_gap:
            return f'no odometry for {seconds:.1f} s'
        moved = float(np.linalg.norm(pose[:3] - self._tail[1][:3]))
        if seconds >= 0 and moved > max(2.0, self._settings.max_speed * seconds):
            return f'the odometry jumped by {moved:.1f} m'
        return ''

    def _note_standing(self, stamp: int, pose: np.ndarray) -> None:
        assert self._still is not None
        since, at = self._still
        if np.linalg.norm(pose[:3] - at[:3]) > self.STILL:
            self._still = stamp, pose
        elif stamp - since > self._stood[0]:
            self._stood = stamp - since, (stamp + since) // 2

    def _append(self, stamp: int, transform: np.ndarray, previous: int) -> None:
        travelled, session = 0.0, self.sessions - 1
        recording = len(self._recorded) - 1
        origin, moment, second = transform[:3, 3], np.zeros(3), np.zeros((3, 3))
        if previous >= 0:
            origin = self._arrays['origin'][previous]
            a, b = self.transforms[previous][:3, 3] - origin, transform[:3, 3] - origin
            length = float(np.linalg.norm(b - a))
            travelled = float(self.travelled[previous]) + length
            session = int(self.session[previous])
            moment = self._arrays['moment'][previous] + length * (a + b) / 2
            # Simpson's rule is exact for squares
            points = np.array([a, (a + b) / 2, b])
            second = points.T @ (points * np.array([[1.0], [4.0], [1.0]])) * length / 6
            second += self._arrays['second'][previous]
        node = self._extend(
            stamp, transform, travelled, session, previous, recording,
            np.array(self._stood), origin, moment, second,
        )  # fmt: skip
        self._stood = (0, 0)
        stamps, nodes, _ = self._recorded[-1]
        stamps.append(stamp)
        nodes.append(node)

    def _extend(
        self, stamp: int, transform: np.ndarray, travelled: float, session: int, previous: int,
        recording: int, *way: np.ndarray | float,
    ) -> int:  # fmt: skip
        if self._count == self._capacity:
            self._capacity *= 2
            for name, array in self._arrays.items():
                grown = np.zeros((self._capacity, *array.shape[1:]), array.dtype)
                grown[: self._count] = array
                self._arrays[name] = grown
        values = (stamp, transform, travelled, session, previous, recording, *way)
        for array, value in zip(self._arrays.values(), values, strict=False):
            array[self._count] = value
        self._count += 1
        return self._count - 1

    def fixed(self, map_id: str, stamp: int, pose: np.ndarray) -> int:
        """Return the node of a place of a map, whose pose in the map is known, shape (7,)."""
        key = (map_id, stamp)
        if key not in self._fixed:
            pose = checked_pose(pose)
            self._fixed[key] = self._extend(stamp, matrices(pose), 0.0, self.FIXED, -1, self.FIXED)
        return self._fixed[key]

    def find(self, stamp: int) -> tuple[int, np.ndarray] | None:
        """
        Return the keyframe before a stamp, and the transform (4, 4) from it to the stamp.

        After a split it is the keyframe after the stamp, where that is on the same side. None
        = no odometry at this stamp; the latest recording counts where stamps repeat.
        """
        for stamps, nodes, track in reversed(self._recorded):
            first, last = track.span
            if not first <= stamp <= last:
                continue
            i = bisect_right(stamps, stamp) - 1
            if stamps[i] == stamp:
                return nodes[i], np.eye(4)
            node = nodes[i]
            if i + 1 < len(nodes) and stamp >= self._cut(nodes[i + 1], stamps[i + 1]):
                node = nodes[i + 1]
            return node, inverse(self.transforms[node]) @ matrices(track.at(stamp))
        return None

    def _cut(self, node: int, stamp: int) -> int:
        """Return from which stamp on odometry belongs to a keyframe, which has the given one."""
        return self._cuts.get(node, (stamp, 0))[0]

    def trajectory(self, solved: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """
        Return the odometry that is kept, and where it is in the map: each with its keyframe.

        :param solved: transforms of the first nodes in the map, shape (n, 4, 4).
        :returns: stamps (m,), ns; transforms of the odometry and in the map, (m, 4, 4) each.
        """
        rows = []
        for keyframes, numbers, track in self._recorded:
            stamps, poses = track.kept
            nodes = np.array(numbers)
            i = np.searchsorted(keyframes, stamps, 'right') - 1
            for node, (cut, _) in self._cuts.items():
                if node in numbers:  # what follows the cut is of the session that it begins
                    at = numbers.index(node)
                    i[(i == at - 1) & (stamps >= cut)] = at
            known = nodes[i] < len(solved)
            rows.append((stamps[known], matrices(poses[known]), nodes[i[known]]))
        if not rows:
            return np.zeros(0, np.int64), np.zeros((0, 4, 4)), np.zeros((0, 4, 4))
        stamps, odometry, own = (np.concatenate(each) for each in zip(*rows, strict=True))
        return stamps, odometry, solved[own] @ inverse(self.transforms[own]) @ odometry

    def ways(self, node: int | np.ndarray, others: np.ndarray) -> Ways:
        """
        Return the ways from nodes to others of the same session.

        :param node: one for all others, or as many.
        :param others: shape (n,).
        """
        sums, T = self._arrays, self.transforms[node]
        away = T[..., :3, 3] - sums['origin'][node]
        length = self.travelled[others] - self.travelled[node]
        moment = sums['moment'][others] - sums['moment'][node]
        lever = moment[:, :, None] * away[..., None, :]
        second = sums['second'][others] - sums['second'][node] - lever - lever.swapaxes(1, 2)
        second += length[:, None, None] * (away[..., :, None] * away[..., None, :])
        second *= np.sign(length)[:, None, None]
        moment = moment - length[:, None] * away
        R = T[..., :3, :3]
        turned = np.swapaxes(R, -1, -2) @ second @ R
        return Ways(length, np.einsum('...ij,...i->...j', R, moment), turned)

    def is_ahead(self, stamp: int) -> bool:
        """Return whether odometry of this stamp may still arrive."""
        return self._tail is None or stamp > self._tail[0]

    def split(self, node: int, stamp: int) -> None:
        """
        Let a new session begin.

        :param node: its first keyframe.
        :param stamp: of its first odometry, ns, after the keyframe before.
        """
        self.session[:] = self.parted(node)
        self._cuts[node] = stamp, int(self.previous[node])
        self.previous[node] = -1
        self.sessions += 1

    def parted(self, node: int) -> np.ndarray:
        """Return the sessions of the nodes as they would be after a split at a node, (N,)."""
        later = (self.session == self.session[node]) & (np.arange(self._count) >= node)
        return np.where(later, self.sessions, self.session)

    @property
    def splits(self) -> list[int]:
        """Return the first nodes of sessions that began by a split."""
        return list(self._cuts)

    def unsplit(self, node: int) -> None:
        """Let a session that began by a split at a node be part of the one before again."""
        ended = self.session[node]
        self.session[:] = self.rejoined(node)
        self.session[self.session > ended] -= 1
        self.sessions -= 1
        _, self.previous[node] = self._cuts.pop(node)

    def rejoined(self, node: int) -> np.ndarray:
        """Return the sessions of the nodes as they would be without a split, (N,)."""
        before = self.session[self._cuts[node][1]]
        return np.where(self.session == self.session[node], before, self.session)
