# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What each rule of the pose graph earns, beside other robust methods on the same drives.

The drives are KITTI's with an appearance detector's closures, most of them false, and worlds of
the demonstration with edges from their images, a share of them false. A value is the absolute
trajectory error divided by that with the right closures alone; of each kind of drive the worst
counts. Writes benchmarks/results/graph_methods.json, and prints the table.
"""

import argparse
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise, product
import json
import multiprocessing
import os
from pathlib import Path
import tempfile
import time
from typing import Any
from unittest.mock import patch

import gtsam
import numpy as np
from results import environment, RESULTS, write_json
from slam import render
from slam_pairs import recognized, SharedViews, with_edges
from stavpr_lab.demonstration import false_places
from stavpr_lab.demonstration.slam import trajectory_errors
from stavpr_lab.demonstration.street.laps import drive_laps
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_ros.progress import Progress
from stavpr_slam.pose_graph import Closure, OdometryNoise, optimize, PoseGraph, tuning
from stavpr_slam.pose_graph.transforms import body_covariance, planar_poses

SAME = np.array([0, 0, 0, 0, 0, 0, 1.0])
NEARBY = np.diag([3.0] * 3 + [np.radians(20)] * 3) ** 2  # of KITTI's closures
RIGHT = {'kitti': 10.0, 'world': 6.0}  # meters between the images of a right closure
KITTI = ('00', '05', '06', '08', '09')
GROUPS = (1, 3, 10, 50, 100, 900)  # closures between two updates
# of a world: factor on the errors of the odometry, and what is special
DRIVES: dict[str, tuple[float, dict[str, Any]]] = {
    'large drift': (1.0, {}), 'small drift': (0.06, {}),
    'sessions': (1.0, {'sessions': 2}), 'carried': (1.0, {'carried': True}),
}  # fmt: skip
FALSE = {  # share, in runs, images of a run
    '': (0.0, False, 20), '30 % alone': (0.3, False, 20), '30 % in runs': (0.3, True, 20),
    '50 % in runs': (0.5, True, 20), '30 % in runs of 60': (0.3, True, 60),
}  # fmt: skip
TRIED = {  # of each kind of drive
    'large drift': list(FALSE), 'small drift': ['', '50 % in runs'],
    'sessions': ['', '30 % in runs'], 'carried': [name for name in FALSE if 'alone' not in name],
}  # fmt: skip
SIGMAS = OdometryNoise()
MEASURED = np.diag([0.3] * 3 + [0.02] * 3) ** 2  # of the closures on a circle
ODOMETRIES = {  # twists: deviation per square root of a meter, and bias per meter
    'wheels': ([0, 0, 0.0087, 0.03, 0.01, 0], [0, 0, 0.00035, -0.01, 0, 0]),
    'stereo': ([0.004, 0.004, 0.004, 0.03, 0.03, 0.03], [0, 0.0002, 0, 0, 0, 0]),
    'legs': ([0.004, 0.004, 0.012, 0.06, 0.04, 0.03], [0, 0, 0, -0.03, 0, 0]),
}
FALSE_RUNS = (8, 40), (4, 60)  # added to KITTI: runs, and closures of each
FACTORS, FALSE_IN_RUNS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0), (0.0, 0.3, 0.5, 1.0)


@dataclass(frozen=True, eq=False)
class Drive:
    """A drive: planar truth (N, 3), odometry (N, 7), closures, and which of them are right."""

    kind: str
    name: str
    stamps: np.ndarray
    truth: np.ndarray
    odometry: np.ndarray
    closures: list[Closure]
    right: np.ndarray

    def error(self, poses: np.ndarray) -> float:
        """Return the absolute trajectory error of poses (N, 7), m."""
        is_known = np.isfinite(poses[:, 0])
        truth = planar_poses(self.truth)[is_known]
        return float(trajectory_errors(self.stamps[is_known], poses[is_known], truth)[0])

    def only_right(self) -> 'Drive':
        """Return the drive with its right closures alone."""
        pairs = zip(self.closures, self.right, strict=True)
        return replace(self, closures=[c for c, is_right in pairs if is_right])


def kitti(name: str, alpha: str) -> Drive:
    """Return a drive of the folder kitti_graphs of STAVPR_DATA."""
    folder = Path(os.environ['STAVPR_DATA']) / 'kitti_graphs' / name
    odometry, truth = (
        np.loadtxt(folder / f'{file}.csv', delimiter=',', skiprows=1)
        for file in ('odometry', 'truth')
    )
    pairs = np.loadtxt(folder / f'closures_alpha_{alpha}.csv', int, delimiter=',', skiprows=1)
    stamps = (np.arange(len(odometry), dtype=np.int64) + 10) * 10**8
    away = np.linalg.norm(truth[pairs[:, 0], :2] - truth[pairs[:, 1], :2], axis=1)
    closures = [
        Closure(int(stamps[query]), int(stamps[place]), SAME, NEARBY) for query, place in pairs
    ]
    right = away < RIGHT['kitti']
    return Drive(
        'KITTI', f'{name} {alpha}', stamps, truth, planar_poses(odometry), closures, right
    )


def backwards(drive: Drive) -> Drive:
    """Return a drive from its end to its start."""
    T = matrices(drive.odometry)[::-1]
    mirrored = dict(zip(drive.stamps.tolist(), drive.stamps[::-1].tolist(), strict=True))
    closures = [
        replace(closure, query_stamp=mirrored[closure.place_stamp],
                place_stamp=mirrored[closure.query_stamp])
        for closure in drive.closures
    ]  # fmt: skip
    odometry = to_poses(inverse(T[:1]) @ T)
    name = f'{drive.name} backwards'
    return replace(drive, name=name, truth=drive.truth[::-1], odometry=odometry, closures=closures)


def with_false_runs(drive: Drive, runs: int, length: int, seed: int) -> Drive:
    """Return a drive with runs of false closures of each second image, each at one wrong place."""
    dice, closures = np.random.default_rng(seed), list(drive.closures)
    count = len(drive.stamps)
    for _ in range(runs):
        query = int(dice.integers(400, count - 5 * length))
        place = int(dice.integers(0, query - 300))
        step = 2 if dice.random() < 0.7 else -2
        for k in range(length):
            ends = query + 2 * k, place + step * k
            if 0 <= ends[1] < ends[0] - 100:
                stamps = int(drive.stamps[ends[0]]), int(drive.stamps[ends[1]])
                closures.append(Closure(*stamps, SAME, NEARBY))
    right = np.append(drive.right, np.zeros(len(closures) - len(drive.closures), bool))
    name = f'{drive.name}, {runs} false runs of {length}, draw {seed}'
    return replace(drive, name=name, closures=closures, right=right)


def worlds(seed: int, draw: int, folder: Path) -> Iterator[Drive]:
    """Return the drives of a world: recognized, with edges, and made false."""
    images = render(seed, folder)
    for name, (drift, special) in DRIVES.items():
        drive = drive_laps(seed, draw, drift, **special)
        path = folder / f'pairs-{seed}-{draw}-{name.replace(" ", "-")}.pkl'
        pairs = with_edges(drive, recognized(drive, images, path), SharedViews())
        for false in TRIED[name]:
            share, coherent, images_of_run = FALSE[false]
            with patch.object(false_places, 'RUN', images_of_run):
                places = false_places.FalsePlaces(share, coherent, 100 * seed + draw)
                used: set[int] = set()
                closures, ends = [], []
                edges = ((each, each.closure) for each in pairs if each.closure is not None)
                for match, closure in edges:
                    used |= {match.query, match.place}
                    place = places.place(match.place, used)
                    closures.append(replace(closure, place_stamp=int(drive.stamps[place])))
                    ends.append((match.query, place, match.place))
            query, place, measured = np.array(ends).T
            away = np.linalg.norm(drive.truth[query, :2] - drive.truth[place, :2], axis=1)
            right = (away < RIGHT['world']) & (np.abs(place - measured) < 3)
            yield Drive(
                name, f'{seed}/{draw} {false}', drive.stamps, drive.truth,
                planar_poses(drive.odometry), closures, right,
            )  # fmt: skip
    SharedViews.views.clear()


def ours(drive: Drive, *replaced: Any) -> np.ndarray:
    """Return the poses by this graph, perhaps with a part replaced, (N, 7)."""
    if replaced:
        with patch.object(*replaced):
            return ours(drive)
    return optimize(drive.stamps, drive.odometry, drive.closures)[0]


def circle(kind: str, factor: float, share: float) -> Drive:
    """
    Return four laps of a circle of 200 m with an odometry of wheels, stereo or legs.

    :param factor: on its errors.
    :param share: of the closures, false in runs of 20.
    """
    lap, dice = 100, np.random.default_rng(9)
    angle = np.arange(4 * lap) * 2 * np.pi / lap
    truth = np.column_stack(
        [2 * lap / (2 * np.pi) * np.array([np.cos(angle), np.sin(angle)]).T, angle + np.pi / 2]
    )
    T, (deviation, bias) = matrices(planar_poses(truth)), ODOMETRIES[kind]
    steps = inverse(T[:-1]) @ T[1:]
    length = np.linalg.norm(steps[:, :3, 3], axis=1)[:, None]
    errors = np.sqrt(length) * deviation * dice.normal(size=(len(steps), 6)) + length * bias
    poses = [np.eye(4)]
    for step, error in zip(steps, factor * errors, strict=True):
        poses.append(poses[-1] @ step @ gtsam.Pose3.Expmap(error).matrix())
    stamps, closures, right = (np.arange(len(T), dtype=np.int64) + 1) * 10**9, [], []
    for number, query in enumerate(range(lap, len(T), 2)):
        if number % 20 == 0:
            shift = int(dice.integers(31, 70)) * (dice.random() < share)
        motion = inverse(T[query % lap]) @ T[query]
        motion[:2, 3] += 0.1 * dice.normal(size=2)
        ends = int(stamps[query]), int(stamps[(query + shift) % lap])
        closures.append(Closure(*ends, to_poses(motion), MEASURED, query % 3 == 0))
        right.append(shift == 0)
    odometry = to_poses(np.array(poses))
    name = f'{kind} x {factor:g}, {share:.0%} false'
    return Drive('circle', name, stamps, truth, odometry, closures, np.array(right))


def driven(drive: Drive, group: int) -> dict[str, Any]:
    """
    Return the errors of a drive as a robot drives it: an update after each group of closures.

    ``above`` is by how much the path so far is at most worse than the odometry so far, m; ``ms``
    the processor time of an update, median and 90 %.
    """
    graph, at, above, times = PoseGraph(), 0, 0.0, []
    closures = sorted(drive.closures, key=lambda closure: closure.query_stamp)
    for number, first in enumerate(range(0, len(closures), group)):
        for closure in closures[first : first + group]:
            while at < len(drive.stamps) and drive.stamps[at] <= closure.query_stamp:
                graph.add_odometry(int(drive.stamps[at]), drive.odometry[at])
                at += 1
            graph.add_closure(closure)
        began = time.process_time()
        graph.update()
        times.append((time.process_time() - began) * 1e3)
        if number % 10 == 9 or group >= 50:
            after, before = _errors(drive, graph)
            above = max(above, after - before)
    for stamp, pose in zip(drive.stamps[at:].tolist(), drive.odometry[at:], strict=True):
        graph.add_odometry(stamp, pose)
    graph.update(final=True)
    found = np.array([graph.at(t) for t in drive.stamps.tolist()])
    odometry, error = drive.error(drive.odometry), drive.error(found)
    return {'kind': drive.kind, 'drive': drive.name, 'group': group,
            'odometry': round(odometry, 2), 'error': round(error, 2), 'above': round(above, 2),
            'ms': np.percentile(times, [50, 90]).round().tolist()}  # fmt: skip


def _errors(drive: Drive, graph: PoseGraph) -> list[float]:
    """Return the errors of the path so far and of its odometry at the keyframes, m."""
    stamps = graph.chain.stamps
    truth = planar_poses(drive.truth[np.searchsorted(drive.stamps, stamps)])
    return [
        float(trajectory_errors(stamps, to_poses(nodes), truth)[0])
        for nodes in (graph.solved, graph.chain.transforms)
    ]


def plain(drive: Drive, kernel: Any = None, gnc: bool = False) -> np.ndarray:
    """Return the poses by Levenberg-Marquardt on all images, with a robust kernel or GNC."""
    T, index = matrices(drive.odometry), {int(t): i for i, t in enumerate(drive.stamps)}
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    tight = gtsam.noiseModel.Diagonal.Sigmas(np.full(6, 1e-4))
    poses = [gtsam.Pose3(pose) for pose in T]
    graph.add(gtsam.PriorFactorPose3(0, poses[0], tight))
    for i, pose in enumerate(poses):
        values.insert(i, pose)
    deviations = np.repeat([SIGMAS.rotation, SIGMAS.translation], 3)
    for i, (a, b) in enumerate(pairwise(poses)):
        length = max(float(np.linalg.norm(T[i + 1, :3, 3] - T[i, :3, 3])), 0.05)
        spread = deviations * np.sqrt(length)
        model: gtsam.noiseModel.Base = gtsam.noiseModel.Diagonal.Sigmas(spread)
        graph.add(gtsam.BetweenFactorPose3(i, i + 1, a.between(b), model))
    indices = list(range(graph.size()))
    for closure in drive.closures:
        Z = matrices(closure.pose)
        model = gtsam.noiseModel.Gaussian.Covariance(body_covariance(closure.covariance, Z))
        if kernel is not None:
            model = gtsam.noiseModel.Robust.Create(kernel, model)
        ends = index[closure.place_stamp], index[closure.query_stamp]
        graph.add(gtsam.BetweenFactorPose3(*ends, gtsam.Pose3(Z), model))
    if gnc:
        options = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
        options.setLossType(gtsam.GncLossType.TLS)
        options.setKnownInliers(indices)
        solved = gtsam.GncLMOptimizer(graph, values, options).optimize()
    else:
        solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return to_poses(np.array([solved.atPose3(i).matrix() for i in range(len(T))]))


ESTIMATORS = gtsam.noiseModel.mEstimator


Method = Callable[[Drive], np.ndarray]
METHODS: dict[str, Method] = {
    'this graph': ours,
    'GNC (GTSAM, odometry as known inliers)': lambda drive: plain(drive, gnc=True),
    'Cauchy kernel': lambda drive: plain(drive, ESTIMATORS.Cauchy.Create(1.0)),
    'dynamic covariance scaling': lambda drive: plain(drive, ESTIMATORS.DCS.Create(1.0)),
    'uncertain closures as well': lambda drive: ours(drive, tuning, 'CERTAIN', 0.0),
    'each closure is an event': lambda drive: ours(drive, tuning, 'GAP', -1.0),
    'a tight odometry only': lambda drive: ours(drive, tuning, 'SCALES', tuning.SCALES[:1]),
    'an odometry of the default errors': lambda drive: ours(drive, tuning, 'TIGHT', 1.0),
    'all closures in one block': lambda drive: ours(drive, tuning, 'PARTS', 1),
    'without breaks': lambda drive: ours(drive, tuning, 'SUPPORT', 10**6),
    'twenty blocks': lambda drive: ours(drive, tuning, 'PARTS', 20),
    'every keyframe a variable': lambda drive: ours(drive, tuning, 'LONGEST', 1),
}  # fmt: skip


def measure(job: tuple[Drive, str]) -> dict[str, Any]:
    """Return the error of a method on a drive."""
    drive, method = job
    began = time.process_time()
    try:
        error = drive.error(METHODS[method](drive))
    except RuntimeError:  # of GTSAM: it is not solved
        error = float('inf')
    return {'kind': drive.kind, 'drive': drive.name, 'method': method, 'error': error,
            'seconds': time.process_time() - began}  # fmt: skip


def reference(drive: Drive) -> dict[str, Any]:
    """Return the errors of the odometry, and with the right closures alone."""
    right = drive.only_right()
    return {'kind': drive.kind, 'drive': drive.name, 'odometry': drive.error(drive.odometry),
            'closures': len(drive.closures), 'right': len(right.closures),
            'this graph': drive.error(ours(right)),
            'least squares': drive.error(plain(right))}  # fmt: skip


def table(rows: list[dict[str, Any]], right: list[dict[str, Any]]) -> list[str]:
    """Return the worst ratio of each method and kind of drive as lines of Markdown."""
    floor = {}
    for row in right:
        best = [row['this graph']] + [row['least squares']] * (row['kind'] == 'KITTI')
        floor[row['kind'], row['drive']] = min(best)
    kinds = list(dict.fromkeys(row['kind'] for row in rows))
    lines = ['| | ' + ' | '.join(kinds) + ' | seconds |', '|---|' + '---|' * (len(kinds) + 1)]
    for method in dict.fromkeys(row['method'] for row in rows):
        own = [row for row in rows if row['method'] == method]
        ratios = [
            [e['error'] / floor[e['kind'], e['drive']] for e in own if e['kind'] == kind]
            for kind in kinds
        ]
        seconds = sum(row['seconds'] for row in own)
        cells = ' | '.join(f'{max(kind):.2f}' if kind else '' for kind in ratios)
        lines.append(f'| {method} | {cells} | {seconds:.0f} |')
    return lines


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, nargs='*', default=[60, 61, 62])
    parser.add_argument('--draws', type=int, default=1, help='of the odometry (%(default)s)')
    parser.add_argument('--jobs', type=int, default=1, help='processes (%(default)s)')
    parser.add_argument('--folder', type=Path, help='keeps images and pairs')
    parser.add_argument('--gnc', action='store_true', help='GNC on worlds as well: 20 s a drive')
    parser.add_argument('--drives', action='store_true', help='KITTI in groups alone')
    parser.add_argument('--runs', action='store_true', help='KITTI with false runs alone')
    parser.add_argument('--noise', action='store_true', help='odometries of other errors alone')
    options = parser.parse_args()
    if options.noise:
        cases = product(ODOMETRIES, FALSE_IN_RUNS, FACTORS)
        rows = [driven(circle(kind, factor, share), 10) for kind, share, factor in cases]
        write_json(RESULTS / 'graph_noise.json', {'about': environment(), 'rows': rows})
        print('\n'.join(f'{row["drive"]}: {row["odometry"]} -> {row["error"]}' for row in rows))
        print('most above the odometry on the way:', max(row['above'] for row in rows), 'm')
        return
    if options.drives:
        rows = []
        for name, alpha, group in product(KITTI, ('0.00', '0.30'), GROUPS):
            rows.append(driven(kitti(name, alpha), group))
            print(rows[-1], flush=True)
        write_json(RESULTS / 'graph_drives.json', {'about': environment(), 'rows': rows})
        return
    if options.runs:
        rows = []
        for name, (count, length), seed in product(KITTI, FALSE_RUNS, range(4)):
            for drive in (kitti(name, '0.00'), backwards(kitti(name, '0.00'))):
                rows.append(driven(with_false_runs(drive, count, length, seed), 10))
                print(rows[-1], flush=True)
        write_json(RESULTS / 'graph_runs.json', {'about': environment(), 'rows': rows})
        return
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.folder or Path(scratch)
        drives = [kitti(name, alpha) for name in KITTI for alpha in ('0.00', '0.30')]
        for seed in options.seeds:
            for draw in range(options.draws):
                drives += worlds(seed, draw, folder)
    slow = {drive.name for drive in drives if drive.kind != 'KITTI' and not options.gnc}
    jobs = [
        (drive, method)
        for method in METHODS
        for drive in drives
        if not (method.startswith('GNC') and drive.name in slow)
    ]
    context = multiprocessing.get_context('spawn')
    with ProcessPoolExecutor(options.jobs, context) as pool:
        right = list(Progress(pool.map(reference, drives), total=len(drives), unit='drive'))
        rows = list(Progress(pool.map(measure, jobs), total=len(jobs), unit='solution'))
    lines = table(rows, right)
    about = environment()
    result = {'about': about, 'table': lines, 'right closures alone': right, 'rows': rows}
    (RESULTS / 'graph_methods.json').write_text(json.dumps(result, indent=1) + '\n')
    print('\n'.join(lines))


if __name__ == '__main__':
    main()
