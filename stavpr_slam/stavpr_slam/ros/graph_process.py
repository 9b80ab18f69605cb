# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The pose graph in a process of its own, so that no odometry waits while it solves.

Nothing here imports ROS. The parent sends the arguments of :meth:`GraphServer.serve`, and the
child returns a :class:`Snapshot`.
"""

from collections import deque
from collections.abc import Callable
from contextlib import suppress
import ctypes
from multiprocessing import get_context
from multiprocessing.connection import Connection
import os
import signal
import sys
import threading
import time
from typing import Any, NamedTuple

import numpy as np
from stavpr_ros.errors import InputError, StavprError, UnavailableError
from stavpr_ros.mapping.trajectory import normalize_pose
from stavpr_ros.mapping.transforms import matrices, to_poses
from stavpr_ros.output_file import Force
from stavpr_slam.pose_graph import Closure, GraphSettings, PoseGraph
from stavpr_slam.pose_graph.files import save_graph

PERIOD = 1.0  # seconds between two requests without closures, and at least between two paths
MAX_WAITING = 100_000  # odometry and closures that wait for the child
PR_SET_PDEATHSIG = 1  # of prctl(2)
STOP_SECONDS = 3.0  # for the thread to end once the child is killed
Trajectory = tuple[np.ndarray, np.ndarray, np.ndarray]  # stamps, odometry, corrected poses


class RobotOdometry(NamedTuple):
    """
    The odometry of a robot at a stamp (ns).

    :param pose: x y z and quaternion x y z w.
    :param covariance: the 36 numbers of its message; None = not given.
    """

    robot: str
    stamp: int
    pose: list[float]
    covariance: list[float] | None


class Snapshot(NamedTuple):
    """
    The graph after a request.

    :param corrections: from the odometry's frame to the map, (4, 4), by robot.
    :param values: counts and estimates for the diagnostics.
    :param breaks: robot and reason of each interruption of the odometry, since the graph began.
    :param invalid: kind, ``odometry`` or ``closures``, and reason of each rejected input.
    :param failure: why the solution failed; empty = it did not.
    :param saved: nodes written, or why they were not.
    :param trajectories: (n,), ns, and (n, 7) each, by robot; empty where they are not requested.
    :param edges: x y z of the ends of accepted and of rejected edges, (m, 2, 3) each.
    """

    corrections: dict[str, np.ndarray]
    values: dict[str, Any]
    breaks: list[tuple[str, str]]
    invalid: list[tuple[str, str]]
    failure: str
    saved: int | str
    trajectories: dict[str, Trajectory]
    edges: list[np.ndarray]


class GraphServer:
    """
    The graph in the child.

    :param origins: from the odometry's frame to the map, (4, 4), by robot: where a graph that
        replaces a lost one begins.
    """

    def __init__(self, settings: GraphSettings, origins: dict[str, np.ndarray]) -> None:
        self._graph, self._origins = PoseGraph(settings), origins
        self._corrections = dict(origins)

    def serve(
        self,
        inputs: list[RobotOdometry | Closure],
        with_paths: bool,
        save: tuple[str, Force] | None,
    ) -> Snapshot:
        """
        Add input, solve, and return the result.

        :param save: file of the solution, and whether to overwrite it; None = no file.
        """
        graph, failure, invalid = self._graph, '', []
        trajectories, edges = dict[str, Trajectory](), list[np.ndarray]()
        saved: int | str = 0
        for item in inputs:
            try:
                self._add(item)
            except InputError as error:
                kind = 'closures' if isinstance(item, Closure) else 'odometry'
                invalid.append((kind, str(error)))
        try:
            if inputs:
                graph.update()
            if save:
                saved = self._save(*save)
            for robot, origin in self._origins.items():
                self._corrections[robot] = matrices(graph.map_to_odom(robot)) @ origin
            if with_paths and len(graph.solved):
                trajectories, edges = self._paths()
        except Exception as error:  # one solution failed: the next may succeed
            failure = saved = f'{type(error).__name__}: {error}'
        return Snapshot(
            self._corrections, self._values(), graph.chain.breaks, invalid, failure, saved,
            trajectories, edges,
        )  # fmt: skip

    def _add(self, item: RobotOdometry | Closure) -> None:
        if isinstance(item, Closure):
            self._graph.add_closure(item)
            return
        pose, covariance = matrices(normalize_pose(np.array(item.pose))), None
        origin = self._origins.setdefault(item.robot, np.eye(4))
        if item.covariance is not None:
            turn = np.kron(np.eye(2), origin[:3, :3])
            covariance = turn @ np.array(item.covariance).reshape(6, 6) @ turn.T
        self._graph.add_odometry(item.stamp, to_poses(origin @ pose), item.robot, covariance)

    def _save(self, path: str, force: Force) -> int | str:
        if not len(self._graph.update(final=True)):
            return 'the graph is empty: there was no odometry'
        if '' not in self._origins and not path.endswith('.g2o'):
            return f'{path}: expected a name that ends in .g2o, the file of several robots'
        try:
            return save_graph(self._graph, path, force)
        except StavprError as error:
            return str(error)

    def _values(self) -> dict[str, Any]:
        graph = self._graph
        return {
            'nodes': len(graph.chain),
            'sessions': graph.chain.sessions,
            'breaks': '; '.join(
                f'{robot} {reason}'.strip() for robot, reason in graph.chain.breaks[-3:]
            ),
            'breaks_by_closures': graph.splits,
            'accepted_closures': graph.accepted,
            'rejected_closures': graph.rejected,
            'waiting_closures': graph.pending,
            'closures_of_unknown_stamps': graph.counts['unknown stamp'],
            'closures_without_solution': graph.counts['failed'],
            'odometry_error_factor': f'{graph.scale:.2f}',
        }

    def _paths(self) -> tuple[dict[str, Trajectory], list[np.ndarray]]:
        graph, solved, trajectories = self._graph, self._graph.solved, {}
        for robot in self._origins:
            stamps, before, after = graph.chain.trajectory(solved, robot)
            trajectories[robot] = stamps, to_poses(before), to_poses(after)
        rows = np.array([(e.query, e.place, e.accepted) for e in graph.edges], int).reshape(-1, 3)
        points = solved[rows[:, :2], :3, 3]
        return trajectories, [points[rows[:, 2] == 1], points[rows[:, 2] == 0]]


def run_server(connection: Connection, parent: int, *arguments: Any) -> None:
    """Serve requests until the parent has ended; in the child."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of the terminal, which the parent obeys
    if sys.platform == 'linux':  # a solution may last long before the end of the pipe is noticed
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, int(signal.SIGKILL))
    if os.getppid() != parent:
        return
    server = GraphServer(*arguments)
    with suppress(EOFError, OSError):
        while True:
            connection.send(server.serve(*connection.recv()))


class GraphProcess:
    """
    Feeds the child from a thread, and starts another one when it has ended.

    A graph that replaces a lost one begins where the last correction leads to.

    :param on_snapshot: called with each result, one at a time.
    :param on_lost: called with the reason and the remedy when the child has ended.
    """

    def __init__(
        self,
        settings: GraphSettings,
        on_snapshot: Callable[[Snapshot], None],
        on_lost: Callable[[str], None],
    ) -> None:
        self._settings, self._on_snapshot, self._on_lost = settings, on_snapshot, on_lost
        self._wake = threading.Condition()  # of the inbox, and of the child
        self._turn = threading.Lock()  # of requests
        self._inbox: deque[RobotOdometry | Closure] = deque(maxlen=MAX_WAITING)
        self.dropped = 0  # input that waited for too long
        self._child: Any = None
        self._connection: Connection | None = None
        self._origins: dict[str, np.ndarray] = {}
        self._resetting = self._stopping = self._has_closures = self._has_changed = False
        self._paths_due = 0.0
        self._thread = threading.Thread(target=self._run, name='graph', daemon=True)
        self._thread.start()

    def add(self, item: RobotOdometry | Closure) -> None:
        """Hand over odometry or a closure; the oldest input is dropped if too much waits."""
        with self._wake:
            self.dropped += len(self._inbox) == MAX_WAITING
            self._inbox.append(item)
            if isinstance(item, Closure):
                self._has_closures = True
                self._wake.notify()

    def save(self, path: str, force: Force) -> int:
        """
        Solve all at once and write a file, which takes its time; return the number of nodes.

        :raises UnavailableError: it cannot be written, or the child has ended meanwhile.
        """
        try:
            saved = self._request((path, force)).saved
        except (EOFError, OSError):
            saved = 'the graph was reset or lost before it was saved'
        if isinstance(saved, str):
            raise UnavailableError(saved)
        return saved

    def reset(self) -> None:
        """Forget everything, even in the middle of a solution."""
        with self._wake:
            self._inbox.clear()
            self._resetting = True
            self._end()

    def stop(self) -> None:
        """End the child and the thread."""
        with self._wake:
            self._stopping = True
            self._end()
        self._thread.join(STOP_SECONDS)

    @property
    def _is_ending(self) -> bool:
        return self._stopping or self._resetting

    def _start(self) -> None:
        self._child, context = None, get_context('spawn')
        self._connection, other = context.Pipe()
        arguments = other, os.getpid(), self._settings, self._origins
        child = context.Process(target=run_server, args=arguments, daemon=True)
        child.start()
        other.close()
        self._child = child

    def _end(self) -> None:
        if self._child is not None:
            self._child.kill()
        self._wake.notify()

    def _request(self, save: tuple[str, Force] | None = None) -> Snapshot:
        """
        Exchange a request and its result.

        :raises EOFError, OSError: the child has ended.
        """
        with self._turn:
            with self._wake:
                connection = self._connection
                if connection is None or self._is_ending:
                    raise EOFError
                inputs, self._has_closures = [*self._inbox], False
                self._inbox.clear()
            self._has_changed |= bool(inputs)
            is_due = self._has_changed and time.monotonic() >= self._paths_due
            connection.send((inputs, is_due or save is not None, save))
            snapshot: Snapshot = connection.recv()
            with self._wake:
                if self._is_ending:
                    raise EOFError
                self._origins = snapshot.corrections
            if snapshot.trajectories:
                self._has_changed, self._paths_due = False, time.monotonic() + PERIOD
            self._on_snapshot(snapshot)
            return snapshot

    def _run(self) -> None:
        while True:
            try:
                with self._wake:
                    if self._stopping:
                        return
                    if self._resetting:
                        self._origins, self._resetting = {}, False
                    # from this thread: PR_SET_PDEATHSIG is of the thread that starts the child
                    self._start()
                while True:
                    self._request()
                    with self._wake:
                        self._wake.wait_for(lambda: self._has_closures or self._is_ending, PERIOD)
            except Exception as error:  # the end of the child, or of memory
                problem = f'{type(error).__name__}: {error}'
            with self._wake:
                self._end()
                if self._is_ending:
                    continue
            if self._child is not None:
                self._child.join()
                problem += f', exit code {self._child.exitcode}'
            self._on_lost(
                f'the process of the pose graph has ended ({problem}; -9 = killed, as when memory '
                'runs out): the graph is lost and begins anew, ~/odometry goes on with the last '
                'correction; free memory, or raise keyframe_distance'
            )
            with self._wake:
                self._wake.wait_for(lambda: self._is_ending, PERIOD)
