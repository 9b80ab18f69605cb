# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The pose graph in a process of its own, since GTSAM holds the interpreter lock while it solves.

Nothing here imports ROS. Parent and child exchange a :class:`Request` and a :class:`Snapshot`.
"""

from collections.abc import Callable
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
from stavpr_ros.mapping.trajectory import checked_pose
from stavpr_ros.mapping.transforms import matrices, to_poses
from stavpr_ros.output_file import Force
from stavpr_slam.pose_graph import Closure, GraphSettings, PoseGraph
from stavpr_slam.pose_graph.files import save_graph

PERIOD = 1.0  # seconds between two requests without closures, and at least between two paths
PATH_RATE = 50_000  # poses of paths per second, at most
MAX_WAITING = 100_000  # odometry, and closures, that wait for the child
PR_SET_PDEATHSIG = 1  # of prctl(2)
STOP_SECONDS = 3.0  # for the thread to end once the child is killed

Odometry = tuple[str, int, list[float]]  # robot, stamp (ns), pose of 7 numbers
Between = tuple[Closure, str, str]  # closure, robot of the query, robot of the place


class Request(NamedTuple):
    """Input, and what to return; ``save`` is a file and whether to overwrite it, or None."""

    odometry: list[Odometry]
    closures: list[Between]
    with_paths: bool
    save: tuple[str, Force] | None


class Paths(NamedTuple):
    """Stamps (n,), ns, poses (n, 7), and x y z of the ends of the edges (m, 2, 3)."""

    stamps: np.ndarray
    odometry: np.ndarray
    corrected: np.ndarray
    accepted: np.ndarray
    rejected: np.ndarray


class Snapshot(NamedTuple):
    """
    The graph after a request.

    :param corrections: from the odometry's frame to the map, (4, 4), by robot.
    :param values: counts and estimates for the diagnostics.
    :param breaks: reasons why the odometry was interrupted, since the graph began.
    :param invalid: kind and reason of each rejected input.
    :param failure: why the solution or the file failed; empty = it did not.
    :param saved: nodes written.
    """

    corrections: dict[str, np.ndarray]
    values: dict[str, Any]
    breaks: list[str]
    invalid: list[tuple[str, str]]
    failure: str
    saved: int
    paths: Paths | None


class GraphServer:
    """
    The graph in the child.

    :param origins: from the odometry's frame to the map, (4, 4), by robot: where a graph that
        replaces a lost one begins.
    """

    def __init__(self, settings: GraphSettings, origins: dict[str, np.ndarray]) -> None:
        self._graph, self._origins = PoseGraph(settings), origins
        self._corrections = dict(origins)

    def serve(self, request: Request) -> Snapshot:
        """Add the input of a request, solve, and return the result."""
        graph, saved, failure, paths = self._graph, 0, '', None
        invalid: list[tuple[str, str]] = []
        for robot, stamp, pose in request.odometry:
            try:
                self._add_odometry(robot, stamp, np.array(pose))
            except InputError as error:
                invalid.append(('odometry', str(error)))
        for closure, _, _ in request.closures:
            try:
                graph.add_closure(closure)
            except InputError as error:
                invalid.append(('closures', str(error)))
        try:
            if request.odometry or request.closures:
                graph.update()
            if request.save:
                graph.update(final=True)
                if not len(graph.solved):
                    raise StavprError('the graph is empty: there was no odometry')
                saved = save_graph(graph, *request.save)
            for robot in {robot for robot, _, _ in request.odometry}:
                correction = matrices(graph.map_to_odom())
                self._corrections[robot] = correction @ self._origins.get(robot, np.eye(4))
            if request.with_paths and len(graph.solved):
                paths = self._paths()
        except StavprError as error:
            failure = str(error)
        except Exception as error:  # one solution failed: the next may succeed
            failure = f'{type(error).__name__}: {error}'
        return Snapshot(
            self._corrections, self._values(), graph.chain.breaks, invalid, failure, saved, paths
        )

    def _add_odometry(self, robot: str, stamp: int, pose: np.ndarray) -> None:
        if robot in self._origins:
            pose = to_poses(self._origins[robot] @ matrices(checked_pose(pose)))
        self._graph.add_odometry(stamp, pose)

    def _values(self) -> dict[str, Any]:
        graph = self._graph
        return {
            'nodes': len(graph.chain),
            'sessions': graph.chain.sessions,
            'breaks': '; '.join(graph.chain.breaks[-3:]),
            'breaks_by_closures': graph.splits,
            'accepted_closures': graph.accepted,
            'rejected_closures': graph.rejected,
            'waiting_closures': graph.pending,
            'closures_of_unknown_stamps': graph.counts['unknown stamp'],
            'odometry_error_factor': f'{graph.scale:.2f}',
        }

    def _paths(self) -> Paths:
        graph, solved = self._graph, self._graph.solved
        stamps, odometry, corrected = graph.chain.trajectory(solved)
        known = [e for e in graph.edges if max(e.query, e.place) < len(solved)]
        ends = np.array([(e.query, e.place) for e in known], int).reshape(-1, 2)
        taken = np.array([e.accepted for e in known], bool)
        points = solved[ends, :3, 3]
        return Paths(
            stamps, to_poses(odometry), to_poses(corrected), points[taken], points[~taken]
        )


def run_server(
    connection: Connection, parent: int, settings: GraphSettings, origins: dict[str, np.ndarray]
) -> None:
    """Serve requests until the parent has ended; in the child."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of the terminal, which the parent obeys
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if sys.platform == 'linux':  # GTSAM may solve for long before the end of the pipe is noticed
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, int(signal.SIGKILL))
    if os.getppid() != parent:
        return
    server = GraphServer(settings, origins)
    try:
        while True:
            connection.send(server.serve(connection.recv()))
    except (EOFError, OSError):
        return


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
        self._wake = threading.Condition()  # of the input, and of the child
        self._turn = threading.Lock()  # of requests
        self._odometry: list[Odometry] = []
        self._closures: list[Between] = []
        self._child: Any = None
        self._connection: Connection | None = None
        self._origins: dict[str, np.ndarray] = {}
        self._resetting = self._stopping = self._has_new_paths = False
        self._paths_due = 0.0
        self.dropped = 0  # input that waited for too long
        self._thread = threading.Thread(target=self._run, name='graph', daemon=True)
        self._thread.start()

    def add(self, odometry: Odometry | None = None, closure: Between | None = None) -> None:
        """Hand over odometry or a closure; the oldest is dropped if too much waits."""
        with self._wake:
            self._odometry += [odometry] if odometry else []
            self._closures += [closure] if closure else []
            for waiting in (self._odometry, self._closures):
                if len(waiting) > MAX_WAITING:
                    del waiting[0]
                    self.dropped += 1
            if closure:
                self._wake.notify()

    def save(self, path: str, force: Force) -> Snapshot:
        """
        Solve all at once and write a file; it takes as long as the solution.

        :raises UnavailableError: the child has ended meanwhile.
        """
        try:
            return self._request((path, force))
        except (EOFError, OSError):
            raise UnavailableError('the graph was reset or lost before it was saved') from None

    def reset(self) -> None:
        """Forget everything, even in the middle of a solution."""
        with self._wake:
            self._odometry, self._closures, self._resetting = [], [], True
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
        given = other, os.getpid(), self._settings, self._origins
        child = context.Process(target=run_server, args=given, daemon=True)
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
                if connection is None or self._resetting:
                    raise EOFError
                odometry, self._odometry = self._odometry, []
                closures, self._closures = self._closures, []
            self._has_new_paths |= bool(odometry or closures)
            is_due = self._has_new_paths and time.monotonic() >= self._paths_due
            connection.send(Request(odometry, closures, is_due or save is not None, save))
            snapshot: Snapshot = connection.recv()
            with self._wake:
                if self._is_ending:
                    raise EOFError
                self._origins = snapshot.corrections
            if snapshot.paths is not None:
                wait = max(PERIOD, len(snapshot.paths.stamps) / PATH_RATE)
                self._has_new_paths, self._paths_due = False, time.monotonic() + wait
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
                        self._wake.wait_for(lambda: self._closures or self._is_ending, PERIOD)
            except (EOFError, OSError) as error:
                problem = str(error)
            with self._wake:
                self._end()
                if self._is_ending:
                    continue
            if self._child is not None:
                self._child.join()
                problem = f'exit code {self._child.exitcode}'
            self._on_lost(
                f'the process of the pose graph has ended ({problem}; -9 = killed, as when memory '
                'runs out): the graph is lost and begins anew, ~/odometry goes on with the last '
                'correction; free memory, or raise keyframe_distance'
            )
            with self._wake:
                self._wake.wait_for(lambda: self._is_ending, PERIOD)
