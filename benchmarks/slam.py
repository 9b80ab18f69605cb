# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Loop closures as edges of a pose graph: worlds of the demonstration, offline, without ROS.

Each drive is recognized from its images with the odometry of its draw, the edges are estimated,
and the graph is solved. Writes benchmarks/results/slam.md.
"""

from collections.abc import Iterator
from concurrent.futures import as_completed, ProcessPoolExecutor
from dataclasses import replace
import json
import multiprocessing
import os
from pathlib import Path
import tempfile
import time
from typing import Any

import numpy as np
from results import environment, parser_of, RESULTS, write_lines
from scipy.spatial.transform import Rotation
from slam_page import markdown, NEAR
from slam_pairs import CAMERA, Found, measured, recognized, SharedViews, with_edges
from stavpr_lab.demonstration.false_places import FalsePlaces
from stavpr_lab.demonstration.slam import trajectory_errors
from stavpr_lab.demonstration.street.laps import CARRIED, drive_laps, LapDrive
from stavpr_ros.mapping.transforms import inverse, matrices
from stavpr_ros.progress import Progress
from stavpr_ros.relative_pose.estimator import EdgeEstimator
from stavpr_ros.relative_pose.pair import Source
from stavpr_slam.pose_graph import Closure, optimize, PoseGraph
from stavpr_slam.pose_graph.transforms import planar_poses

DRIFTS = {'large': 1.0, 'small': 0.06}  # factors on the errors of the odometry
FALSE = {'random 30': (0.3, False), 'coherent 30': (0.3, True), 'coherent 50': (0.5, True)}
WRONG_PAIRS = 200  # of each world
FAR = 30.0  # meters: a pair of wrong places
PASSES = 4.0  # meters: images of two laps whose relative position is compared
ONLINE = 60  # images after the first closure behind a break that are watched
MIN_ATE = 2.5  # meters: of a carried robot
OTHER_DRAWS = 2  # of each world, with two sessions and with a carried robot


def render(seed: int, folder: Path) -> np.ndarray:
    """Return the images of the laps of a world, rendered once, shape (N, height, width, 3)."""
    path = folder / f'{seed}.npy'
    if not path.exists():
        drive = drive_laps(seed)
        images = np.stack([drive.frame(i).image for i in range(len(drive))])
        part = path.with_suffix(f'.{os.getpid()}.npy')
        np.save(part, images)
        part.replace(path)
    return np.load(path, mmap_mode='r')


def falsified(drive: LapDrive, pairs: list[Found], kind: str, seed: int) -> list[Closure]:
    """Return the closures with a share of wrong places."""
    false, used, result = FalsePlaces(*FALSE[kind], seed), set[int](), []
    for match in pairs:
        used |= {match.query, match.place}
        place = false.place(match.place, used)
        if match.closure is not None:
            result.append(replace(match.closure, place_stamp=int(drive.stamps[place])))
    return result


def relative(truth: np.ndarray, query: int, place: int) -> np.ndarray:
    """Return the transform of one image in another, (4, 4), of planar poses (N, 3)."""
    T = matrices(planar_poses(truth[[place, query]]))
    return inverse(T[0]) @ T[1]


def ate(drive: LapDrive, poses: np.ndarray, count: int | None = None) -> float:
    """Return the absolute trajectory error of poses (N, 7) of the first images, m."""
    is_known = np.isfinite(poses[:count, 0])
    stamps, truth = drive.stamps[:count][is_known], planar_poses(drive.truth[:count])[is_known]
    return trajectory_errors(stamps, poses[:count][is_known], truth)[0]


def pass_errors(drive: LapDrive, poses: np.ndarray) -> np.ndarray:
    """Return the errors of relative positions between nearby images of two laps, m."""
    later = np.flatnonzero(drive.images[:, 0] > 0)
    errors = []
    T, truth = matrices(poses), matrices(planar_poses(drive.truth))
    for q in later.tolist():
        earlier = np.flatnonzero(drive.images[:, 0] < drive.images[q, 0])
        away = np.linalg.norm(drive.truth[earlier, :2] - drive.truth[q, :2], axis=1)
        if away.min() < PASSES:
            p = earlier[np.argmin(away)]
            off = (inverse(T[p]) @ T[q] - inverse(truth[p]) @ truth[q])[:3, 3]
            errors.append(np.linalg.norm(off))
    return np.array(errors)


def edge_errors(drive: LapDrive, pairs: list[Found]) -> dict[str, list[list[float]]]:
    """
    Return all edges that are published, by source, 5 numbers each.

    The errors along, across (m) and of the heading (rad), the NEES, and how far across the query
    truly is (m).
    """
    rows: dict[str, list[list[float]]] = {'PNP': [], 'ALIGNED': []}
    for match in pairs:
        true = relative(drive.truth, match.query, match.place)
        if not match.edge.has_pose:
            continue
        pose, i = match.edge.pose, [0, 1, 5]
        yaw = Rotation.from_quat(pose[3:]).as_euler('ZYX')[0] - np.arctan2(true[1, 0], true[0, 0])
        off = np.array([*(pose[:2] - true[:2, 3]), (yaw + np.pi) % (2 * np.pi) - np.pi])
        nees = off @ np.linalg.solve(match.edge.covariance[np.ix_(i, i)], off)
        rows[match.edge.source.name].append([*off.tolist(), float(nees), float(true[1, 3])])
    return rows


def biases(drive: LapDrive, pairs: list[Found]) -> dict[str, list[float]]:
    """Return along the track, on the same lane, what the edge and the place are off, in places."""
    rows: dict[str, list[float]] = {'edge': [], 'place_index': [], 'late': []}
    for match in pairs:
        laps = drive.images[[match.query, match.place], 0].tolist()
        true = relative(drive.truth, match.query, match.place)
        if laps != [2, 0] or np.hypot(*true[:2, 3]) > NEAR or abs(true[1, 3]) > 1:
            continue
        spacing = match.pair.spacing
        rows['late' if match.is_late else 'place_index'].append(float(-true[0, 3] / spacing))
        if match.edge.has_pose:
            rows['edge'].append(float((match.edge.pose[0] - true[0, 3]) / spacing))
    return rows


def wrong_pairs(drive: LapDrive, pairs: list[Found], seed: int) -> list[int]:
    """Return which queries PnP accepts with places elsewhere, 0 or 1 each."""
    dice, estimator = np.random.default_rng(seed), EdgeEstimator('pnp')
    accepted: list[int] = []
    while len(accepted) < WRONG_PAIRS:
        a, b = (pairs[i] for i in dice.integers(len(pairs), size=2))
        if np.linalg.norm(drive.truth[a.query, :2] - drive.truth[b.place, :2]) < FAR:
            continue
        pair = replace(b.pair, query=a.pair.query, query_poses=a.pair.query_poses)
        accepted.append(int(estimator.estimate(pair, CAMERA, CAMERA).source is Source.PNP))
    return accepted


def measure_drift(drive: LapDrive, pairs: list[Found], seed: int) -> dict[str, Any]:
    """Return the errors of a drive, without and with false closures."""
    odometry = planar_poses(drive.odometry)
    began = time.thread_time()
    poses, graph = optimize(drive.stamps, odometry, measured(pairs))
    before = ate(drive, odometry)
    right = [
        np.hypot(*relative(drive.truth, match.query, match.place)[:2, 3]) < NEAR for match in pairs
    ]
    row = {
        'before': before,
        'after': ate(drive, poses),
        'seconds': time.thread_time() - began,
        'closures': len(pairs),
        'right': int(np.sum(right)),
        'rejected': graph.rejected,
        'scale': graph.scale,
        'passes': pass_errors(drive, poses).tolist(),
        'edges': edge_errors(drive, pairs),
        'biases': biases(drive, pairs),
        'pnp': sum(
            match.edge.source is Source.PNP for match, ok in zip(pairs, right, strict=True) if ok
        ),
    }
    for kind in FALSE:
        closures = falsified(drive, pairs, kind, seed)
        poses, graph = optimize(drive.stamps, odometry, closures)
        row[kind] = {'after': ate(drive, poses), 'accepted': graph.accepted}
    return row


def measure_sessions(drive: LapDrive, pairs: list[Found], seed: int) -> dict[str, Any]:
    """Return the error of two sessions, without and with false closures."""
    odometry, row = planar_poses(drive.odometry), {}
    for kind in ('', 'random 30', 'coherent 30'):
        closures = falsified(drive, pairs, kind, seed) if kind else measured(pairs)
        poses, _ = optimize(drive.stamps, odometry, closures)
        row[kind or 'after'] = ate(drive, poses)
    return row


def measure_carried(drive: LapDrive, pairs: list[Found]) -> dict[str, Any]:
    """Return the error of a carried robot, and how soon it was small."""
    odometry = planar_poses(drive.odometry)
    poses, final = optimize(drive.stamps, odometry, measured(pairs))
    behind = [
        match.known
        for match in pairs
        if match.query >= CARRIED.start
        and np.hypot(*relative(drive.truth, match.query, match.place)[:2, 3]) < NEAR
    ]
    graph, waiting, first, errors = PoseGraph(), list(pairs), min(behind), []
    for i in range(first + ONLINE + 1):
        graph.add_odometry(int(drive.stamps[i]), odometry[i])
        while waiting and waiting[0].known <= i:
            if (closure := waiting.pop(0).closure) is not None:
                graph.add_closure(closure)
        if i >= first or i % 20 == 0:
            graph.update()
        if i >= first:
            poses_now = [graph.at(stamp) for stamp in drive.stamps[: i + 1].tolist()]
            missing = np.full(7, np.nan)
            now = np.array([missing if pose is None else pose for pose in poses_now])
            errors.append(ate(drive, now, i + 1))
    above = np.flatnonzero(np.array(errors) > MIN_ATE)
    return {
        'before': ate(drive, odometry),
        'after': ate(drive, poses),
        'splits': final.splits,
        'images': int(above[-1] + 1) if len(above) else 0,
        'at 50': errors[50],
    }


def measure(seed: int, draw: int, folder: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Measure a draw of a world, row by row."""
    images = render(seed, folder)

    def found(drive: LapDrive, name: str, timed: bool = False) -> list[Found]:
        pairs = recognized(drive, images, folder / f'pairs-{seed}-{draw}-{name}.pkl')
        return with_edges(drive, pairs, EdgeEstimator() if timed else SharedViews())

    for name, drift in DRIFTS.items():
        drive = drive_laps(seed, draw, drift)
        closures = found(drive, name, draw == 0)
        row = measure_drift(drive, closures, 100 * seed + draw)
        if draw == 0:
            row['pnp_ms'] = [closure.seconds * 1e3 for closure in closures]
            row['wrong'] = wrong_pairs(drive, closures, seed) if name == 'small' else []
        yield name, row
    if draw >= OTHER_DRAWS:
        return
    drive = drive_laps(seed, draw, DRIFTS['large'], sessions=2)
    yield 'sessions', measure_sessions(drive, found(drive, 'sessions'), 100 * seed + draw)
    for name, drift in DRIFTS.items():
        drive = drive_laps(seed, draw, drift, carried=True)
        kind = f'carried {name}'
        yield kind, measure_carried(drive, found(drive, kind.replace(' ', '-')))


def measure_world(seed: int, draws: int, folder: Path, parts: Path) -> int:
    """Measure a world into one file for each draw; draws that have a file are left out."""
    import cv2

    cv2.setNumThreads(1)
    for draw in range(draws):
        part = parts / f'slam-{seed}-{draw}.json'
        if not part.exists():
            rows = dict(measure(seed, draw, folder))
            part.write_text(json.dumps({'seed': seed, 'draw': draw, **rows}))
            print(part.name, flush=True)
    SharedViews.views.clear()
    return seed


def main() -> None:
    """Measure and write the page."""
    parser = parser_of(__doc__)
    parser.add_argument('--seeds', type=int, nargs='+', default=[41, 42, 43, 44, 45])
    parser.add_argument('--draws', type=int, default=5, help='of the odometry (%(default)s)')
    parser.add_argument('--jobs', type=int, default=1, help='processes (%(default)s)')
    parser.add_argument(
        '--folder', type=Path, help='keeps images, pairs and finished draws: a run continues there'
    )
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.folder or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        context = multiprocessing.get_context('spawn')
        with ProcessPoolExecutor(options.jobs, context) as pool:
            running = [
                pool.submit(measure_world, seed, options.draws, folder, folder)
                for seed in options.seeds
            ]
            for future in Progress(as_completed(running), total=len(running), unit='world'):
                future.result()
        rows = [
            json.loads((folder / f'slam-{seed}-{draw}.json').read_text())
            for seed in options.seeds
            for draw in range(options.draws)
        ]
    page = markdown(environment(), rows)
    write_lines(RESULTS / 'slam.md', page)
    print('\n'.join(page))


if __name__ == '__main__':
    main()
