# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Update time of a large pose graph: laps on a circle, a closure at 85 % of the keyframes.

Before the timed updates the graph grows in larger steps; the timed ones add one keyframe each.
"""

import argparse
import time

import numpy as np
from results import commit, cpu_model
from stavpr_lab.demonstration.simulated_odometry import add_drift
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_ros.units import SECOND
from stavpr_slam.pose_graph import Closure, PoseGraph
from stavpr_slam.pose_graph.transforms import planar_poses

LAP, STEP = 1000, 2.0  # keyframes, and meters between them
DELAY = 10  # keyframes until a closure is known
COVARIANCE = np.diag([0.5, 0.4, 0.4, 0.02, 0.02, 0.02]) ** 2


def measure(nodes: int, timed: int, drift: float, late: int) -> tuple[np.ndarray, PoseGraph]:
    """
    Return the processor time of each of the last updates, ms, and the graph.

    :param late: closures that come at once, when so many are there.
    """
    angle = np.arange(nodes) * 2 * np.pi / LAP
    radius = STEP * LAP / (2 * np.pi)
    truth = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), angle + np.pi / 2])
    dice = np.random.default_rng(1)
    odometry = planar_poses(add_drift(truth, np.ones(nodes, bool), dice, drift))
    T, graph, times, waiting = matrices(planar_poses(truth)), PoseGraph(), [], []
    for i in range(nodes):
        graph.add_odometry((i + 1) * SECOND, odometry[i])
        query = i - DELAY
        if query >= LAP and dice.random() < 0.85:
            Z = inverse(T[query - LAP]) @ T[query]
            Z[:2, 3] += dice.normal(size=2) * 0.12
            stamps = (query + 1) * SECOND, (query - LAP + 1) * SECOND
            waiting.append(Closure(*stamps, to_poses(Z), COVARIANCE, query % 5 == 0))
        if len(waiting) >= late:
            for closure in waiting:
                graph.add_closure(closure)
            waiting = []
        if i >= nodes - timed:
            began = time.process_time()
            graph.update()
            times.append((time.process_time() - began) * 1e3)
        elif i % 200 == 0:
            graph.update()
    return np.array(times), graph


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--nodes', type=int, nargs='+', default=[1000, 3000, 10000])
    parser.add_argument('--updates', type=int, default=200, help='that are timed (%(default)s)')
    parser.add_argument('--drift', type=float, default=0.06, help='of the odometry (%(default)s)')
    parser.add_argument('--late', type=int, default=1, help='closures that come at once')
    options = parser.parse_args()
    print(f'{cpu_model()}, {commit()}: processor time of an update in ms\n')
    print('| nodes | edges | median | 90 % | 99 % | most |')
    print('|---|---|---|---|---|---|')
    for nodes in options.nodes:
        times, graph = measure(nodes, options.updates, options.drift, options.late)
        p50, p90, p99, most = np.percentile(times, [50, 90, 99, 100])
        print(
            f'| {nodes} | {len(graph.used)} | {p50:.0f} | {p90:.0f} | {p99:.0f} | {most:.0f} |',
            flush=True,
        )


if __name__ == '__main__':
    main()
