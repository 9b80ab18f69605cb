# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The benchmarks of pose graph papers with false closures, beside GNC and Cauchy of GTSAM, and PCM.

False closures are drawn with relative poses of right ones: at random nodes, in groups of 10
successive nodes, or in such groups at most 40 nodes apart. A run succeeds where its ATE against
the solution of the graph without them is at most 1 % of the diagonal of that solution. Files are
in the folder pose_graphs of STAVPR_DATA. Writes benchmarks/results/graph_files.json.
"""

import argparse
from collections.abc import Callable
from functools import partial
import json
import os
from pathlib import Path
import time
from typing import Any

import gtsam
import numpy as np
from results import environment, RESULTS
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from stavpr_ros.mapping.transforms import inverse
from stavpr_slam.pose_graph import PoseGraph
from stavpr_slam.pose_graph.g2o import Edge, graph_of, read_edges
from stavpr_slam.pose_graph.path_errors import path_errors
from stavpr_slam.pose_graph.transforms import adjoints, logarithms
from tqdm import tqdm

FILES = 'MIT', 'intel', 'manhattan', 'smallGrid3D', 'sphere2500', 'parking-garage'
KINDS = {'random': (1, 0), 'grouped': (10, 0), 'locally grouped': (10, 40)}
SHARES = 0.1, 0.3, 0.5
ORDER = [3, 4, 5, 0, 1, 2]  # rotation first


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


def ours(edges: list[Edge]) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the positions (N, 3) and which closures are accepted."""
    graph: PoseGraph = graph_of(edges)
    solved = graph.update(final=True)
    return solved[:, :3, 3], np.array([edge.accepted for edge in graph.edges])


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
            (inverse(Z[i])[None], path_errors(chain, np.full_like(place, start), place)),
            (away @ Z, covariance),
        )
        spread = covariance[i] + path_errors(chain, np.full_like(query, end), query)
        for motion, errors in parts:
            turn = adjoints(motion)
            spread = spread + turn @ errors @ turn.swapaxes(1, 2)
        off = logarithms(loop)
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


def of_gtsam(edges: list[Edge], method: str) -> tuple[np.ndarray, np.ndarray | None]:
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
        model = gtsam.noiseModel.Gaussian.Information(information[np.ix_(ORDER, ORDER)])
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
    return np.array([result.atPose3(i).translation() for i in range(values.size())]), weights


METHODS: dict[str, Callable[[list[Edge]], tuple[np.ndarray, np.ndarray | None]]] = {
    'this graph': ours,
    **{name: partial(of_gtsam, method=name) for name in ('GNC', 'Cauchy', 'PCM')},
}


def ate(found: np.ndarray, expected: np.ndarray) -> float:
    """Return the root mean square distance of positions (N, 3) after rigid alignment."""
    _, distance = Rotation.align_vectors(expected - expected.mean(0), found - found.mean(0))
    return float(distance / np.sqrt(len(found)))


def measure(name: str, method: str, seeds: int) -> list[dict[str, Any]]:
    """Return a row for each kind and share of false closures."""
    edges = read_edges(str(Path(os.environ['STAVPR_DATA']) / 'pose_graphs' / f'{name}.g2o'))
    odometry, right = divided(edges)
    expected, _ = ours(edges)
    diagonal = float(np.linalg.norm(np.ptp(expected, axis=0)))
    rows = []
    jobs = [(kind, share) for kind in KINDS for share in SHARES]
    for kind, share in tqdm(jobs, desc=f'{name}, {method}'):
        runs = []
        for seed in range(seeds):
            false = false_closures(right, len(odometry) + 1, share, kind, seed)
            began = time.process_time()
            try:
                found, taken = METHODS[method]([*odometry, *right, *false])
            except RuntimeError:  # of GTSAM: it is not solved
                runs.append((np.inf, 0.0, 0.0, time.process_time() - began))
                continue
            seconds = time.process_time() - began
            own = np.arange(len(right) + len(false)) < len(right)
            taken = own if taken is None else taken
            precision, recall = (taken & own).sum() / max(taken.sum(), 1), taken[own].mean()
            runs.append((ate(found, expected) / diagonal, precision, recall, seconds))
        error, precision, recall, seconds = np.array(runs).T
        rows.append({
            'file': name, 'method': method, 'kind': kind, 'share': share, 'runs': seeds,
            'success': float((error <= 0.01).mean()), 'precision': float(precision.mean()),
            'recall': float(recall.mean()), 'seconds': float(seconds.mean()),
        })  # fmt: skip
    return rows


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--files', nargs='*', default=FILES)
    parser.add_argument('--methods', nargs='*', default=list(METHODS))
    parser.add_argument('--seeds', type=int, default=3, help='runs of each kind and share')
    options = parser.parse_args()
    path = RESULTS / 'graph_files.json'
    rows = json.loads(path.read_text())['rows'] if path.exists() else []
    for name in options.files:
        for method in options.methods:
            rows = [row for row in rows if (row['file'], row['method']) != (name, method)]
            rows += measure(name, method, options.seeds)
            own = rows[-len(KINDS) * len(SHARES) :]
            keys = 'success', 'precision', 'recall', 'seconds'
            means = [f'{np.mean([row[key] for row in own]):.3g}' for key in keys]
            print(f'| {name} | {method} | ' + ' | '.join(means) + ' |', flush=True)
            text = json.dumps({'about': environment(), 'rows': rows}, indent=1)
            path.write_text(text + '\n')


if __name__ == '__main__':
    main()
