# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Recorded images arranged as laps: the hallway loop, and Gardens Point as laps of one road.

The images have no poses: lap 1 is laid on a closed curve, the images of the others where the
ground truth has them, and the odometry of each draw is made of that. No intrinsics are known, so
edges are aligned by odometry, or by appearance alone. Writes slam_data.png and its JSON to
benchmarks/results/.
"""

import argparse
from itertools import product
from pathlib import Path
from typing import Any

from data import data_folder
import numpy as np
from results import environment, RESULTS, table, write_json
from slam import ate, DRIFTS
from slam_pairs import measured, recognize, with_edges
from stavpr_lab.demonstration.simulated_odometry import drifted
from stavpr_lab.demonstration.slam import trajectory_errors
from stavpr_lab.demonstration.street.laps import LapDrive, RingWorld
from stavpr_lab.demonstration.street.traverses import LENGTH
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_lab.evaluation.plots import page
from stavpr_ros.progress import Progress
from stavpr_ros.relative_pose.estimator import EdgeEstimator
from stavpr_ros.sources import open_source
from stavpr_slam.pose_graph import optimize
from stavpr_slam.pose_graph.transforms import planar_poses

HALLWAY_LENGTH = 40.0  # meters of a lap; laps of Gardens Point get the length of the street
HALLWAY_EXCLUDED = 20  # latest images, as the ground truth has them
FIRST = 10**9  # ns, the first stamp


def images_of(folder: Path) -> list[np.ndarray]:
    """Return the images of a folder, RGB."""
    return [frame.image for frame in open_source(folder)]


def gardens_point(folder: Path) -> tuple[list[np.ndarray], np.ndarray, float]:
    """Return images, for each its lap and share of the lap (N, 2), and meters of a lap."""
    names = ('gardens_point/day_left', 'gardens_point/day_right')
    laps = [images_of(folder / name) for name in names]
    at = [(lap, i / len(images)) for lap, images in enumerate(laps) for i in range(len(images))]
    return [image for lap in laps for image in lap], np.array(at), LENGTH


def hallway(folder: Path) -> tuple[list[np.ndarray], np.ndarray, float]:
    """Return the same of the hallway loop; lap 2 is where the ground truth has it on lap 1."""
    images = images_of(folder / 'rtabmap_hallway_loop/samples')
    count = len(images)
    truth = GroundTruth.from_file(
        folder / 'rtabmap_hallway_loop/samples_GT.bmp', count, count, 0
    ).loop_closures(HALLWAY_EXCLUDED - 1)
    pairs = np.stack([truth.keys // count, truth.keys % count], axis=1)
    later = np.unique(pairs[:, 0])
    earlier = np.array([pairs[pairs[:, 0] == i, 1].mean() for i in later])
    start = int(later[0] - np.median(earlier[:1]))  # where lap 2 begins
    first = np.arange(count) / start
    second = np.interp(np.arange(start, count), later, np.maximum.accumulate(earlier)) / start
    at = [(0, share) for share in first[:start]] + [(1, share) for share in second]
    return images, np.array(at), HALLWAY_LENGTH


def drive_of(at: np.ndarray, length: float, seed: int, draw: int, drift: float) -> LapDrive:
    """Return the drive on a closed curve: its truth, and an odometry."""
    line = RingWorld(seed).center_line
    line = line * [length / LENGTH, length / LENGTH, 1.0]
    share = np.arange(len(line)) / (len(line) - 1)
    truth = np.column_stack([np.interp(at[:, 1] % 1, share, column) for column in line.T])
    truth[:, 2] = np.unwrap(truth[:, 2])
    lap = at[:, 0].astype(int)
    number = np.arange(len(at)) - np.searchsorted(lap, lap)
    stamps = FIRST + np.arange(len(at), dtype=np.int64) * 500_000_000
    dice = np.random.default_rng([seed, draw])
    odometry = drifted(truth, np.ones(len(at), bool), dice, drift)
    images = np.column_stack([lap, number])
    return LapDrive(truth, odometry, stamps, (), images, np.zeros(len(at), int))


def measure(
    images: list[np.ndarray], drive: LapDrive, exclude: int
) -> tuple[dict[str, Any], np.ndarray]:
    """Return the errors of a drive, and the optimized poses."""
    pairs = with_edges(
        drive, recognize(drive, images, None, exclude), EdgeEstimator(), camera=None
    )
    odometry = planar_poses(drive.odometry)
    poses, graph = optimize(drive.stamps, odometry, measured(pairs))
    before, after = ate(drive, odometry), ate(drive, poses)
    counts = {'closures': len(pairs), 'rejected': graph.rejected}
    return {'before': before, 'after': after, 'ratio': after / before, **counts}, poses


def main() -> None:
    """Measure, draw and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, nargs='+', default=[41, 42, 43, 44, 45])
    parser.add_argument('--draws', type=int, default=5, help='of the odometry (%(default)s)')
    options = parser.parse_args()
    folder = data_folder()
    sets = {
        'hallway': (hallway(folder), HALLWAY_EXCLUDED),
        'Gardens Point': (gardens_point(folder), 50),
    }
    rows: list[dict[str, Any]] = []
    drawn: dict[str, tuple[LapDrive, np.ndarray]] = {}
    cases = list(product(sets, DRIFTS, options.seeds, range(options.draws)))
    for name, drift, seed, draw in Progress(cases, unit='drive'):
        (images, at, length), exclude = sets[name]
        drive = drive_of(at, length, seed, draw, DRIFTS[drift])
        row, poses = measure(images, drive, exclude)
        rows.append({'set': name, 'drift': drift, 'seed': seed, 'draw': draw, **row})
        drawn.setdefault(f'{name}, {drift} drift', (drive, poses))
    lines = []
    for name in sets:
        for drift in DRIFTS:
            own = [row for row in rows if (row['set'], row['drift']) == (name, drift)]
            before, ratios = ([row[key] for row in own] for key in ('before', 'ratio'))
            closures = np.median([row['closures'] for row in own])
            cells = [f'{np.median(before):.2f}', f'{np.median(ratios):.3f}', f'{max(ratios):.3f}']
            lines.append([name, drift, f'{closures:.0f}', *cells])
    text = table(('images', 'drift', 'closures', 'ATE before, m', 'ratio', 'worst'), lines)
    write_json(RESULTS / 'slam_data.json', {'about': environment(), 'rows': rows})
    with page(RESULTS / 'slam_data.png', 12.5, 9.0) as figure:
        for axes, (title, (drive, poses)) in zip(
            figure.subplots(2, 2).flat, drawn.items(), strict=True
        ):
            axes.plot(*drive.truth[:, :2].T, color='black', lw=2.2, alpha=0.5, label='truth')
            odometry, truth = planar_poses(drive.odometry), planar_poses(drive.truth)
            trajectories = (odometry, '#c44', 'odometry'), (poses, '#07a', 'optimized')
            for trajectory, color, label in trajectories:
                aligned = trajectory_errors(drive.stamps, trajectory, truth)[2]
                axes.plot(*aligned[:, :2].T, color=color, lw=1.0, label=label)
            axes.set_aspect('equal', adjustable='datalim')
            axes.set_title(title)
            axes.legend(loc='upper right')
    print('\n'.join(text))


if __name__ == '__main__':
    main()
