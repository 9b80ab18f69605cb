# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
City-like graphs: a drive on a grid of streets, three short closures a node, some of them false.

False closures are drawn as in ``graph_files.py``. Prints recall, the false closures that are
accepted, the absolute trajectory error after rigid alignment, processor time and memory.
"""

from itertools import product
import resource
import time

from graph_files import ate, false_closures, ours
import numpy as np
from results import commit, cpu_model, parser_of, table
from scipy.spatial import KDTree
from stavpr_ros.mapping.transforms import inverse, matrices
from stavpr_slam.pose_graph.g2o import Edge, OUT_OF_PLANE
from stavpr_slam.pose_graph.transforms import planar_poses

STREET = 8  # nodes between two crossings, 1 m apart
EACH, SHORT, LEAST = 3, 3.0, 20  # closures of a node, their meters at most, and nodes in between
DEVIATIONS = np.array([0.03, 0.03, 0.015])  # of all edges, m and rad


def streets(nodes: int, dice: np.random.Generator) -> np.ndarray:
    """Return poses in the plane on a square of streets, each visited five times, (nodes, 3)."""
    blocks = max(3, round((nodes / (10 * STREET)) ** 0.5))
    crossing, heading, poses = np.array([blocks // 2] * 2), 0, list[list[float]]()
    while len(poses) < nodes:
        for turn in (*dice.permutation([-1, 0, 1]), 2):
            way = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])[(heading + turn) % 4]
            if (crossing + way >= 0).all() and (crossing + way <= blocks).all():
                break
        heading += turn
        poses += [[*(STREET * crossing + k * way), heading * np.pi / 2] for k in range(STREET)]
        crossing = crossing + way
    return np.array(poses[:nodes])


def city(nodes: int, seed: int) -> tuple[np.ndarray, list[Edge], list[Edge]]:
    """Return the true poses in the plane, the odometry and the closures, with errors as stated."""
    dice = np.random.default_rng(seed)
    truth = streets(nodes, dice)
    pairs = [(i, i + 1) for i in range(nodes - 1)]
    tree, wanted = KDTree(truth[:, :2]), []
    for j, near in enumerate(tree.query_ball_point(truth[:, :2], SHORT)):
        earlier = [i for i in near if i <= j - LEAST]
        wanted += [(i, j) for i in dice.permutation(earlier)[:EACH].tolist()]
    ends = np.array(pairs + wanted)
    T = matrices(planar_poses(truth))
    errors = matrices(planar_poses(DEVIATIONS * dice.normal(size=(len(ends), 3))))
    motions = inverse(T[ends[:, 0]]) @ T[ends[:, 1]] @ errors
    information = np.diag([*DEVIATIONS[:2] ** -2.0, *[OUT_OF_PLANE] * 3, DEVIATIONS[2] ** -2.0])
    edges = [(i, j, Z, information) for (i, j), Z in zip(ends.tolist(), motions, strict=True)]
    return truth, edges[: nodes - 1], edges[nodes - 1 :]


def measure(nodes: int, kind: str, share: float, seed: int) -> list[str]:
    """Return a row of the table."""
    truth, odometry, right = city(nodes, seed)
    false = false_closures(right, nodes, share, kind, seed) if share else []
    began = time.process_time()
    found, taken, _ = ours([*odometry, *right, *false])
    seconds, own = time.process_time() - began, np.arange(len(right) + len(false)) < len(right)
    error = ate(found, np.column_stack([truth[:, :2], np.zeros(nodes)]))
    wrong = int((taken & ~own).sum())
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    counts = f'{len(right)}, {len(false)}', f'{taken[own].mean():.4f}', str(wrong)
    cells = str(nodes), f'{share:.0%} {kind}', str(seed), f'{error:.3f}', f'{seconds:.1f}'
    return [*cells[:3], *counts, *cells[3:], str(memory)]


def main() -> None:
    """Measure and print the table."""
    parser = parser_of(__doc__)
    parser.add_argument('--nodes', type=int, nargs='+', default=[1000, 3000, 10000])
    parser.add_argument('--kinds', nargs='+', default=['random', 'grouped'])
    parser.add_argument('--shares', type=float, nargs='+', default=[0.1, 0.3, 0.5])
    parser.add_argument('--seeds', type=int, nargs='+', default=[0, 1])
    options = parser.parse_args()
    print(f'{cpu_model()}, {commit()}', flush=True)
    head = ['nodes', 'false', 'draw', 'closures, false', 'recall', 'false accepted']
    head += ['ATE, m', 's', 'MB']
    print('\n'.join(table(head, [])[:2]), flush=True)
    for job in product(options.nodes, options.kinds, options.shares, options.seeds):
        print(*table(head, [measure(*job)])[2:], sep='\n', flush=True)


if __name__ == '__main__':
    main()
