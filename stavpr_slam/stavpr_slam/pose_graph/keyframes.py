# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes of the odometry, and the sessions between its breaks."""

from bisect import bisect_right
from copy import copy
from dataclasses import dataclass

import numpy as np
from stavpr_ros.errors import InputError
from stavpr_ros.mapping.trajectory import normalize_pose
from stavpr_ros.mapping.transforms import inverse, matrices
from stavpr_ros.units import SECOND
from stavpr_slam.pose_graph.path_errors import LEAST, message_growth, OdometryNoise, step_errors
from stavpr_slam.pose_graph.track import OdometryTrack
from stavpr_slam.pose_graph.transforms import adjoints


@dataclass(frozen=True)
class ChainSettings:
    """
    Limits at which the odometry becomes a keyframe, and at which it breaks.

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

    Arrays of N nodes: ``stamps`` (ns), ``transforms`` in the odometry of its session, or in the
    map, (N, 4, 4), ``travelled`` (m), ``session`` (negative = fixed), ``recording`` (the session
    before splits), ``previous`` (the node before in its session, -1 = none), ``robot`` (number in
    ``robots``), and for :meth:`path_errors` ``origin`` (3,) and ``spread`` (6, 6): the sum of the
    covariances of the steps, in the axes of the odometry at ``origin``.
    """

    FIXED = -1

    def __init__(self, settings: ChainSettings, noise: OdometryNoise) -> None:
        self._settings, self._noise = settings, noise
        self._nodes = np.zeros(1024, [
            ('stamps', np.int64), ('transforms', np.float64, (4, 4)), ('travelled', np.float64),
            ('session', np.int32), ('recording', np.int32), ('previous', np.int64),
            ('origin', np.float64, 3), ('spread', np.float64, (6, 6)),
            ('robot', np.int32),
        ])  # fmt: skip
        self._count = 0
        self._tracks: list[OdometryTrack] = []  # of each recording
        self._current: dict[str, OdometryTrack] = {}  # of each robot
        self.robots: list[str] = []
        self.sessions = 0
        self._fixed: dict[tuple[str, int], int] = {}
        self.splits: dict[int, int] = {}  # first nodes behind them, and the nodes before
        self.breaks: list[tuple[str, str]] = []  # robot and reason

    def __len__(self) -> int:
        return self._count

    def __getattr__(self, name: str) -> np.ndarray:
        if name.startswith('_') or name not in (self._nodes.dtype.names or ()):
            raise AttributeError(name)
        return self._nodes[name][: self._count]

    def until(self, count: int) -> 'KeyframeChain':
        """Return the first nodes alone, which share their arrays with these."""
        part = copy(self)
        part._count = count
        return part

    def newest(self, robot: str = '') -> int:
        """Return the newest keyframe of a robot; -1 = none."""
        return self._current[robot].nodes[-1] if robot in self._current else -1

    def add(
        self, stamp: int, pose: np.ndarray, robot: str = '', covariance: np.ndarray | None = None
    ) -> bool:
        """
        Add the odometry of a robot; return whether it is a new keyframe.

        :param stamp: ns.
        :param pose: of the base in the frame of the odometry, shape (7,).
        :param covariance: as in ``geometry_msgs/PoseWithCovariance``, shape (6, 6). Where it does
            not grow between keyframes, the errors of the settings apply.
        :raises InputError: an invalid pose or stamp; nothing is changed.
        """
        pose = normalize_pose(pose)
        if stamp <= 0:
            raise InputError(f'odometry with stamp {stamp}: expected nanoseconds above 0')
        current, is_keyframe = self._current.get(robot), True
        cause = '' if current is None else self._break(current, stamp, pose)
        if current is None or cause:
            if current is not None:
                self.breaks.append((robot, cause))
            else:
                self.robots.append(robot)
            current = OdometryTrack(self._settings.distance, self._settings.angle, robot)
            self._current[robot] = current
            self._tracks.append(current)
            self.sessions += 1
        elif stamp <= current.newest[0]:
            return False
        else:
            step = inverse(self.transforms[current.nodes[-1]]) @ matrices(pose)
            near = np.linalg.norm(step[:3, 3]) < self._settings.distance
            turns = (np.trace(step[:3, :3]) - 1) / 2 < np.cos(self._settings.angle)
            is_keyframe = bool(turns or not near)
        current.add(stamp, pose, is_keyframe)
        if is_keyframe:
            self._append(current, covariance)
        return is_keyframe

    def _break(self, current: OdometryTrack, stamp: int, pose: np.ndarray) -> str:
        """Return why a new session begins; empty = none does."""
        seconds = (stamp - current.newest[0]) / SECOND
        if seconds < -0.5:
            return f'the stamps jumped back by {-seconds:.3f} s'
        if seconds > self._settings.max_gap:
            return f'no odometry for {seconds:.1f} s'
        length = float(np.linalg.norm(pose[:3] - current.newest[1][:3]))
        if seconds >= 0 and length > max(2.0, self._settings.max_speed * seconds):
            return f'the odometry jumped by {length:.1f} m'
        return ''

    def _append(self, current: OdometryTrack, covariance: np.ndarray | None) -> None:
        (stamp, pose), transform = current.newest, matrices(current.newest[1])
        previous = current.nodes[-1] if current.nodes else -1
        node = self._extend(stamp, transform, self.sessions - 1, len(self._tracks) - 1)
        row, before = self._nodes[node], self._nodes[previous]
        row['previous'], row['origin'] = previous, pose[:3]
        row['robot'] = self.robots.index(current.robot)
        if previous >= 0:
            for name in ('session', 'recording', 'origin'):
                row[name] = before[name]
            local = np.array([before['transforms'], transform])
            local[:, :3, 3] -= row['origin']
            length = np.linalg.norm(local[1, :3, 3] - local[0, :3, 3])
            row['travelled'] = before['travelled'] + length
            growth = step_errors(local, self._noise)
            stated = message_growth(current.spread, covariance, local)
            if stated is not None:
                growth = LEAST * growth + stated
            row['spread'] = before['spread'] + growth
        current.spread = covariance
        current.nodes.append(node)
        current.begins.append(stamp)

    def _extend(self, stamp: int, transform: np.ndarray, session: int, recording: int) -> int:
        if self._count == len(self._nodes):
            self._nodes = np.concatenate([self._nodes, np.zeros_like(self._nodes)])
        row = self._nodes[self._count]
        row['stamps'], row['transforms'] = stamp, transform
        row['session'], row['recording'], row['previous'] = session, recording, -1
        self._count += 1
        return self._count - 1

    def path_errors(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """
        Return the errors of the motion between nodes of one session, in the axes of the start.

        :param start, end: n nodes, in any order.
        :returns: covariances, rotation first, (n, 6, 6).
        """
        local = self.transforms[start].copy()
        local[:, :3, 3] -= self.origin[start]
        turn = adjoints(inverse(local))
        sign = np.where(end >= start, 1.0, -1.0)[:, None, None]
        spread: np.ndarray = sign * (self.spread[end] - self.spread[start])
        return turn @ spread @ turn.swapaxes(-1, -2)

    def fixed(self, map_id: str, stamp: int, pose: np.ndarray) -> int:
        """Return the node of a place of a map, whose pose in the map is known, shape (7,)."""
        key = (map_id, stamp)
        if key not in self._fixed:
            transform = matrices(normalize_pose(pose))
            self._fixed[key] = self._extend(stamp, transform, self.FIXED, self.FIXED)
        return self._fixed[key]

    def find(self, stamp: int, robot: str = '') -> tuple[int, np.ndarray] | None:
        """
        Return the keyframe before a stamp, and the transform (4, 4) from it to the stamp.

        After a split it is the keyframe after the stamp, where that is on the same side. None
        = no odometry at this stamp; the latest recording counts where stamps repeat.
        """
        for track in reversed(self._tracks):
            if track.robot == robot and track.has(stamp):
                node = track.nodes[bisect_right(track.begins, stamp) - 1]
                return node, inverse(self.transforms[node]) @ matrices(track.at(stamp))
        return None

    def motion(self, start: int, end: int, robot: str = '') -> np.ndarray | None:
        """Return the odometry between two stamps (ns), shape (4, 4); None = it is unknown."""
        first, last = self.find(start, robot), self.find(end, robot)
        if first is None or last is None or self.session[first[0]] != self.session[last[0]]:
            return None
        before, after = (self.transforms[node] @ motion for node, motion in (first, last))
        return inverse(before) @ after

    def trajectory(
        self, solved: np.ndarray, robot: str = ''
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """
        Return the odometry of a robot that is kept, and where it is in the map, by its keyframes.

        :param solved: transforms of the first nodes in the map, shape (n, 4, 4).
        :returns: stamps (m,), ns; transforms of the odometry and in the map, (m, 4, 4) each.
        """
        rows = [(np.zeros(0, np.int64), np.zeros((0, 4, 4)), np.zeros(0, np.int64))]
        for track in self._tracks:
            if track.robot != robot:
                continue
            stamps, poses = track.kept
            nodes = np.array(track.nodes)[np.searchsorted(track.begins, stamps, 'right') - 1]
            is_solved = nodes < len(solved)
            rows.append((stamps[is_solved], matrices(poses[is_solved]), nodes[is_solved]))
        stamps, odometry, own = (np.concatenate(parts) for parts in zip(*rows, strict=True))
        return stamps, odometry, solved[own] @ inverse(self.transforms[own]) @ odometry

    def is_ahead(self, stamp: int, robot: str = '') -> bool:
        """Return whether odometry of this stamp may still arrive."""
        return robot not in self._current or stamp > self._current[robot].newest[0]

    def starts(self) -> np.ndarray:
        """Return the first nodes of the sessions, in order of arrival."""
        return np.flatnonzero((self.previous < 0) & (self.session >= 0))

    def before(self, node: int) -> int:
        """Return the last keyframe of a robot before the first one of a session; -1 = none."""
        if node in self.splits:
            return self.splits[node]
        number = self.recording[node]
        robot, earlier = self._tracks[number].robot, self._tracks[:number]
        return next((own.nodes[-1] for own in reversed(earlier) if own.robot == robot), -1)

    def split(self, node: int) -> None:
        """Begin a session at a node, its odometry in the middle of the time before."""
        later = (self.session == self.session[node]) & (np.arange(self._count) >= node)
        self.session[later] = self.sessions
        self.sessions += 1
        self.splits[node] = before = int(self.previous[node])
        self.previous[node] = -1
        self._begin(node, int(self.stamps[[before, node]].mean()))

    def merge_session(self, node: int) -> None:
        """Undo the split at a node."""
        end, before = self.session[node], self.splits.pop(node)
        self.session[self.session == end] = self.session[before]
        self.session[self.session > end] -= 1
        self.sessions -= 1
        self.previous[node] = before
        self._begin(node, int(self.stamps[node]))

    def _begin(self, node: int, stamp: int) -> None:
        track = self._tracks[self.recording[node]]
        track.begins[track.nodes.index(node)] = stamp
