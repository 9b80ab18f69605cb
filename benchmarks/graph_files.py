# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The benchmarks of pose graph papers with false closures, beside GNC and Cauchy of GTSAM, and PCM.

False closures are drawn as by Vertigo, with relative poses of right ones: at random nodes, at most
40 nodes apart, in groups of 10 successive nodes, or in such groups at most 40 nodes apart. A run
succeeds where its ATE against the solution of the graph without them is at most 1 % of the
diagonal of that solution. Files are in the folder pose_graphs of STAVPR_DATA.

Writes each cell (file, method, kind, share) to benchmarks/results/graph_files.json as soon as it
is measured, and goes on where it was ended: cells of the present code are kept, others are
measured anew. The table names the cells that are missing or of other code.
"""

import argparse
from collections.abc import Callable
from functools import partial
import importlib.metadata
from itertools import groupby, product
import json
import os
from pathlib import Path
import subprocess
import time
from typing import Any
from unittest.mock import patch

import gtsam
import numpy as np
from results import environment, RESULTS, ROOT, table, write_json
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from stavpr_ros.mapping.transforms import inverse, to_poses
from stavpr_ros.progress import Progress
from stavpr_slam.pose_graph import g2o, PoseGraph
from stavpr_slam.pose_graph.g2o import Edge, graph_of, read_edges
from stavpr_slam.pose_graph.transforms import adjoints

FILES = 'MIT', 'intel', 'manhattan', 'smallGrid3D', 'sphere2500', 'parking-garage'
KINDS = {'random': (1, 0), 'local': (1, 40), 'grouped': (10, 0), 'locally grouped': (10, 40)}
SHARES = 0.1, 0.3, 0.5
ORDER = [3, 4, 5, 0, 1, 2]  # rotation first
CODE = 'stavpr_slam/stavpr_slam/pose_graph'
VALUES = 'success', 'precision', 'recall', 'seconds'
Own = tuple[np.ndarray, np.ndarray, list[float]]
Result = tuple[np.ndarray, np.ndarray | None, list[float]]


def divided(edges: list[Edge]) -> tuple[list[Edge], list[Edge]]:
    """Return the odometry and the closures."""
    odometry: dict[int, Edge] = {}
    closures = []
    for edge in edges:
        if edge[1] == edge[0] + 1 and edge[0] not in odometry:
            odometry[edge[0]] = edge
        else:
            closures.append(edge)
    return list(odometry.values()), closures


def false_closures(
    right: list[Edge], nodes: int, share: float, kind: str, seed: int
) -> list[Edge]:
    """Return closures at wrong places, a share of all."""
    dice, (group, near) = np.random.default_rng(seed), KINDS[kind]
    information = np.median([each[3] for each in right], axis=0)
    count, made = round(len(right) * share / (1 - share)), list[Edge]()
    while len(made) < count:
        i, j = dice.integers(0, nodes - group, 2).tolist()
        if near:
            j = int(np.clip(i + dice.integers(-near, near), 0, nodes - group - 1))
        if abs(i - j) < 3:
            continue
        motion = right[dice.integers(len(right))][2]
        for k in range(min(group, count - len(made))):
            made.append((i + k, j + k, motion, information))
    return made


def ours(edges: list[Edge]) -> Own:
    """Return the positions (N, 3), which closures are accepted, and times of updates (ms)."""
    graph: PoseGraph = graph_of(edges)
    solved = graph.update(final=True)
    return solved[:, :3, 3], np.array([edge.accepted for edge in graph.edges]), []


def one_at_a_time(edges: list[Edge], timed: int | None = None) -> Own:
    """
    Return the same where closures come with the later one of their nodes, each an update.

    :param timed: only the last so many do, the others at once.
    """
    given = graph_of(edges)
    with patch.object(g2o, 'PoseGraph') as made:
        graph_of(edges)
    closures = [call.args[0] for call in made.return_value.add_closure.call_args_list]
    graph, times = PoseGraph(given.settings), list[float]()
    poses = to_poses(given.chain.transforms)

    def advance(stamp: int) -> None:
        """Add the odometry up to a stamp, with the errors of the file."""
        until = int(np.searchsorted(given.chain.stamps, stamp, 'right'))
        for node in range(len(graph.chain), until):
            graph.add_odometry(int(given.chain.stamps[node]), poses[node])
            graph.chain.spread[node] = given.chain.spread[node]

    at = np.array([max(each.query_stamp, each.place_stamp) for each in closures])
    order = np.argsort(at, kind='stable')
    first = len(order) if timed is None else timed
    for waiting, number in zip(range(len(order) - 1, -1, -1), order, strict=True):
        advance(at[number])
        graph.add_closure(closures[number])
        if waiting > first:
            continue
        began = time.process_time()
        graph.update()
        times.append((time.process_time() - began) * 1e3)
    advance(given.chain.stamps[-1])
    solved, accepted = graph.update(final=True), np.zeros(len(order), bool)
    accepted[order] = [edge.accepted for edge in graph.edges]
    return solved[:, :3, 3], accepted, times if timed is None else times[1:]


def consistent(edges: list[Edge]) -> np.ndarray:
    """
    Return which closures PCM accepts: a large set of which each two agree by the odometry.

    As in Mangelson et al., *Pairwise Consistent Measurement Set Maximization*, ICRA 2018, with
    their threshold of 99 %, and the heuristic of Pattabiraman et al. for the clique.
    """
    odometry, closures = divided(edges)
    chain = graph_of(odometry).chain
    place, query = np.array([each[:2] for each in closures]).T - odometry[0][0]
    T, Z = chain.transforms, np.array([each[2] for each in closures])
    covariance = np.linalg.inv([each[3] for each in closures])[:, ORDER][:, :, ORDER]
    limit = chi2.ppf(0.99, 6 if np.ptp(T[:, 2, 3]) > 0 else 3)
    agree = np.zeros((len(closures),) * 2, bool)
    for i, (start, end) in enumerate(zip(place, query, strict=True)):
        away = inverse(Z[i]) @ inverse(T[start]) @ T[place]
        loop = away @ Z @ inverse(T[query]) @ T[end]
        parts = (
            (inverse(Z[i])[None], chain.path_errors(np.full_like(place, start), place)),
            (away @ Z, covariance),
        )
        spread = covariance[i] + chain.path_errors(np.full_like(query, end), query)
        for motion, errors in parts:
            turn = adjoints(motion)
            spread = spread + turn @ errors @ turn.swapaxes(1, 2)
        off = np.array([gtsam.Pose3.Logmap(gtsam.Pose3(each)) for each in loop])
        agree[i] = np.einsum('ni,nij,nj->n', off, np.linalg.inv(spread), off) < limit
    agree &= agree.T
    np.fill_diagonal(agree, False)
    best, degree = list[int](), agree.sum(axis=1)
    for first in np.argsort(-degree):
        clique, among = [first], agree[first].copy()
        while among.any() and len(clique) + among.sum() > len(best):
            clique.append(np.argmax(np.where(among, degree, -1)))
            among &= agree[clique[-1]]
        best = max(best, clique, key=len)
    return np.isin(np.arange(len(closures)), best)


def of_gtsam(edges: list[Edge], method: str) -> Result:
    """Return the same by GTSAM: GNC with the odometry as known inliers, Cauchy, or after PCM."""
    odometry, closures = divided(edges)
    weights, gnc = None, method == 'GNC'
    if method == 'PCM':
        weights = consistent(edges)
        closures = [each for each, right in zip(closures, weights, strict=True) if right]
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    pose = gtsam.Pose3()
    tight = gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)
    graph.add(gtsam.PriorFactorPose3(0, pose, tight))
    values.insert(0, pose)
    for number, (start, end, motion, information) in enumerate(odometry + closures):
        rotation_first = information[np.ix_(ORDER, ORDER)]
        model: gtsam.noiseModel.Base = gtsam.noiseModel.Gaussian.Information(rotation_first)
        if number >= len(odometry) and method == 'Cauchy':
            cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(1.0)
            model = gtsam.noiseModel.Robust.Create(cauchy, model)
        graph.add(gtsam.BetweenFactorPose3(start, end, gtsam.Pose3(motion), model))
        if number < len(odometry):
            pose = pose.compose(gtsam.Pose3(motion))
            values.insert(end, pose)
    if gnc:
        options = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
        options.setLossType(gtsam.GncLossType.TLS)
        options.setKnownInliers(list(range(len(odometry) + 1)))
        optimizer = gtsam.GncLMOptimizer(graph, values, options)
        result = optimizer.optimize()
        weights = np.array(optimizer.getWeights())[len(odometry) + 1 :] > 0.5
    else:
        result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    found = np.array([result.atPose3(i).translation() for i in range(values.size())])
    return found, weights, []


OWN: dict[str, Callable[[list[Edge]], Result]] = {
    'this graph': ours, 'one at a time': one_at_a_time,
}  # fmt: skip
METHODS: dict[str, Callable[[list[Edge]], Result]] = {
    **OWN,
    **{name: partial(of_gtsam, method=name) for name in ('GNC', 'Cauchy', 'PCM')},
}


def ate(found: np.ndarray, expected: np.ndarray) -> float:
    """Return the root mean square distance of positions (N, 3) after rigid alignment."""
    _, distance = Rotation.align_vectors(expected - expected.mean(0), found - found.mean(0))
    return float(distance / np.sqrt(len(found)))


def version(method: str) -> str:
    """Return what a method was computed by: the git tree of this graph, or GTSAM's version."""
    if method not in OWN:
        return f'gtsam {importlib.metadata.version("gtsam")}'
    words = f'git rev-parse --short HEAD:{CODE}', f'git status --porcelain -- {CODE}'
    tree, changed = (
        subprocess.check_output(each.split(), cwd=ROOT, text=True).strip() for each in words
    )
    return tree + '+' * bool(changed)


def measure(
    edges: list[Edge], expected: np.ndarray, method: str, kind: str, share: float, seeds: int
) -> dict[str, Any]:
    """Return the values of a cell, means of its runs."""
    odometry, right = divided(edges)
    diagonal = float(np.linalg.norm(np.ptp(expected, axis=0)))
    runs, times = [], list[float]()
    for seed in range(seeds):
        false = false_closures(right, len(odometry) + 1, share, kind, seed)
        began = time.process_time()
        try:
            found, taken, updates = METHODS[method]([*odometry, *right, *false])
        except RuntimeError:  # of GTSAM: it is not solved
            runs.append((False, 0.0, 0.0, time.process_time() - began))
            continue
        seconds = time.process_time() - began
        own = np.arange(len(right) + len(false)) < len(right)
        taken = own if taken is None else taken
        precision, recall = (taken & own).sum() / max(taken.sum(), 1), taken[own].mean()
        runs.append((ate(found, expected) <= 0.01 * diagonal, precision, recall, seconds))
        times += updates
    means = np.mean(np.array(runs, float), axis=0).round(4).tolist()
    row = dict(zip(VALUES, means, strict=True))
    if times:
        spread = [np.mean(times), *np.percentile(times, [50, 90, 100])]
        row['ms'] = np.round(spread, 1).tolist()  # mean, median, 90 %, most
    return row


def summary(rows: list[dict[str, Any]]) -> list[str]:
    """Return the means of each file and method as lines of Markdown."""
    lines = []
    for name, method in dict.fromkeys((row['file'], row['method']) for row in rows):
        own = [row for row in rows if (row['file'], row['method']) == (name, method)]
        other = sum(row.get('version') != version(method) for row in own)
        means = [f'{np.mean([row[key] for row in own]):.3g}' for key in VALUES]
        ms = np.array([row['ms'] for row in own if 'ms' in row]).reshape(-1, 4)
        times = [f'{ms[:, 0].mean():.0f}', f'{ms[:, 3].max():.0f}'] if len(ms) else ['', '']
        cells = f'{len(own)} of {len(KINDS) * len(SHARES)}' + f', {other} of other code' * (
            other > 0
        )
        lines.append([name, method, *means, *times, cells])
    head = 'file', 'method', *VALUES, 'mean update, ms', 'longest', 'cells'
    return table(head, lines)


def main() -> None:
    """Measure what is missing and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--files', nargs='*', default=FILES)
    parser.add_argument('--methods', nargs='*', default=list(METHODS))
    parser.add_argument('--kinds', nargs='*', default=list(KINDS))
    parser.add_argument('--shares', nargs='*', type=float, default=SHARES)
    parser.add_argument('--seeds', type=int, default=3, help='runs of each cell (%(default)s)')
    parser.add_argument('--output', type=Path, default=RESULTS / 'graph_files.json')
    options = parser.parse_args()
    path = options.output
    rows = json.loads(path.read_text())['rows'] if path.exists() else []
    jobs = product(options.files, options.methods, options.kinds, options.shares)
    for name, group in groupby(jobs, key=lambda job: job[0]):
        solved: list[tuple[list[Edge], np.ndarray]] = []
        for _, method, kind, share in Progress(list(group), desc=name):
            key = {'file': name, 'method': method, 'kind': kind, 'share': share}
            before: dict[str, Any] = next((row for row in rows if key.items() <= row.items()), {})
            code = version(method)
            if before.get('version') == code and before['runs'] >= options.seeds:
                continue
            if not solved:
                folder = Path(os.environ['STAVPR_DATA']) / 'pose_graphs'
                edges = read_edges(str(folder / f'{name}.g2o'))
                solved.append((edges, ours(edges)[0]))
            values = measure(*solved[0], method, kind, share, options.seeds)
            row = key | {'runs': options.seeds, 'version': code} | values
            rows = [*(each for each in rows if each is not before), row]
            write_json(path, {'about': environment(), 'rows': rows})
    print('\n'.join(summary(rows)))


if __name__ == '__main__':
    main()
