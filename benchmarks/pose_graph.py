# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Update time of a large pose graph: laps on a circle, a closure at 85 % of the keyframes.

Before the timed updates the graph grows in larger steps; the timed ones add one keyframe each.
With ``--plot``, also of city-like graphs (``graph_city.py``), 30 % of whose closures are false.
"""

from itertools import product
from pathlib import Path
import time

from graph_city import city
from graph_files import false_closures, one_at_a_time
import numpy as np
from results import commit, cpu_model, parser_of
from stavpr_lab.demonstration.simulated_odometry import add_drift
from stavpr_lab.style import DASHES, legend_above, page
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


def measure_city(nodes: int, timed: int) -> tuple[np.ndarray, int]:
    """Return the processor time of each of the last updates, ms, and the accepted closures."""
    _, odometry, right = city(nodes, 0)
    false = false_closures(right, nodes, 0.3, 'random', 0)
    _, accepted, times = one_at_a_time([*odometry, *right, *false], timed)
    return np.array(times), int(accepted.sum())


def draw(path: Path, times: dict[str, dict[int, np.ndarray]]) -> None:
    """Draw the median and the longest of the updates (ms) of each graph by its size."""
    with page(path, 7, 4) as figure:
        axes = figure.subplots()
        for label, by_size in times.items():
            medians, longest = np.array([(np.median(t), t.max()) for t in by_size.values()]).T
            (line,) = axes.loglog(list(by_size), medians, 'o-', label=f'{label}, median')
            color = line.get_color()
            axes.loglog(list(by_size), longest, 's', ls=DASHES, c=color, label=f'{label}, longest')
        sizes = sorted({size for by_size in times.values() for size in by_size})
        axes.set_xticks(sizes, [f'{size:,}' for size in sizes], minor=False)
        axes.minorticks_off()
        axes.set(xlabel='nodes', ylabel='processor time of an update, ms')
        legend_above(axes, 2)


def main() -> None:
    """Measure and print a table."""
    parser = parser_of(__doc__)
    parser.add_argument('--nodes', type=int, nargs='+', default=[1000, 3000, 10000])
    parser.add_argument('--updates', type=int, default=200, help='that are timed (%(default)s)')
    parser.add_argument('--drift', type=float, default=0.06, help='of the odometry (%(default)s)')
    parser.add_argument('--late', type=int, default=1, help='closures that come at once')
    parser.add_argument('--plot', type=Path, help='PNG of these and of city-like graphs')
    options, all_times = parser.parse_args(), dict[str, dict[int, np.ndarray]]()
    print(f'{cpu_model()}, {commit()}: processor time of an update in ms\n')
    print('| graph | nodes | accepted | median | 90 % | 99 % | most |')
    print('|---|---|---|---|---|---|---|')
    for name, nodes in product(('laps', 'city')[: 1 + bool(options.plot)], options.nodes):
        if name == 'laps':
            times, graph = measure(nodes, options.updates, options.drift, options.late)
            edges = len(graph.used)
        else:
            times, edges = measure_city(nodes, options.updates)
        if edges:
            all_times.setdefault(name, {})[nodes] = times
        p50, p90, p99, most = np.percentile(times, [50, 90, 99, 100])
        print(
            f'| {name} | {nodes} | {edges} | {p50:.0f} | {p90:.0f} | {p99:.0f} | {most:.0f} |',
            flush=True,
        )
    if options.plot:
        draw(options.plot, all_times)


if __name__ == '__main__':
    main()
