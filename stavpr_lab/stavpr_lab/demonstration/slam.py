# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The SLAM demonstration: the bag of a lap drive, and the errors and plot of the result."""

from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
import json
from pathlib import Path
from typing import Any

from nav_msgs.msg import Odometry
import numpy as np
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo
from stavpr_lab.demonstration.recordings import remove_earlier_bag, TOPIC
from stavpr_lab.demonstration.street.laps import intrinsics, LapDrive
from stavpr_lab.demonstration.street.traverses import SIZE
from stavpr_lab.style import titled_page
from stavpr_ros.errors import UnavailableError
from stavpr_ros.output_file import JSON, write_output
from stavpr_ros.palette import BLUE, GRAY, ORANGE, VERMILION
from stavpr_ros.progress import Progress
from stavpr_ros.ros.messages import pose_message, time_message
from stavpr_ros.sources.bag_writer import write_bag
from stavpr_ros.sources.frame import ImageRecord, MessageRecord
from stavpr_ros.units import SECOND
from stavpr_slam.pose_graph.files import TUM, tum_text
from stavpr_slam.pose_graph.transforms import planar_poses
from std_msgs.msg import Header

ODOMETRY, CAMERA_INFO = '/odom', '/camera_info'  # beside the topic of the node's images, /image
RPE_METERS = 50.0


def write_drive(drive: LapDrive, bag: Path) -> None:
    """
    Write the images, the intrinsics and the odometry of a drive into a bag.

    :raises SourceError: it cannot be written.
    """
    remove_earlier_bag(bag)
    kinds = {ODOMETRY: 'nav_msgs/msg/Odometry', CAMERA_INFO: 'sensor_msgs/msg/CameraInfo'}
    write_bag(bag, TOPIC, _records(drive), others=kinds)


def _records(drive: LapDrive) -> Iterator[ImageRecord | MessageRecord]:
    poses = planar_poses(drive.odometry)
    K = intrinsics()
    P = np.column_stack([K, np.zeros(3)])
    odometry = Odometry(header=Header(frame_id='odom'), child_frame_id='base_link')
    info = CameraInfo(
        header=Header(frame_id='camera'), width=SIZE[0], height=SIZE[1],
        distortion_model='plumb_bob', d=np.zeros(5), k=K.ravel(), r=np.eye(3).ravel(), p=P.ravel(),
    )  # fmt: skip
    for i in Progress(range(len(drive)), desc='three laps', unit='image'):
        stamp = int(drive.stamps[i])
        odometry.header.stamp = info.header.stamp = time_message(stamp)
        odometry.pose.pose = pose_message(poses[i])
        for topic, message in ((ODOMETRY, odometry), (CAMERA_INFO, info)):
            yield MessageRecord(stamp, topic, serialize_message(message))
        yield ImageRecord.of_image(drive.frame(i).image, stamp, frame_id='camera')


@dataclass(frozen=True, eq=False)
class SlamResult:
    """
    The corrected trajectory of a drive, and its errors.

    :param poses: corrected, aligned with the truth, shape (n, 7); ``before``: the odometry.
    :param truth: at the same stamps, shape (n, 7).
    :param in_map: the corrected trajectory as published, shape (n, 7).
    :param numbers: contents of the file ``slam.json``.
    """

    poses: np.ndarray
    before: np.ndarray
    truth: np.ndarray
    in_map: np.ndarray
    numbers: dict[str, Any]

    def summary(self) -> str:
        """Return the result in words, a line each."""
        n = self.numbers
        return (
            f'{n["closures"]} loop closures, {n["rejected"]} of them rejected, '
            f'{n["sessions"]} sessions\n'
            f'absolute trajectory error {n["ate_before"]:.2f} m -> {n["ate_after"]:.2f} m '
            f'(ratio {n["ate_ratio"]:.3f})\n'
            f'relative error over {RPE_METERS:g} m: {n["rpe_before"]:.2f} m -> '
            f'{n["rpe_after"]:.2f} m'
        )


def evaluate_drive(drive: LapDrive, trajectory: Path, values: dict[str, str]) -> SlamResult:
    """
    Compare a corrected trajectory with the truth.

    :param trajectory: a file in the TUM format.
    :param values: diagnostics of the pose graph.
    :raises UnavailableError: evo is not installed.
    """
    rows = [line.split() for line in trajectory.read_text().splitlines() if line[:1] != '#']
    stamps = np.array([int(row[0].replace('.', '')) for row in rows])
    poses_after = np.array([row[1:] for row in rows], float)
    at = np.searchsorted(drive.stamps, stamps).clip(max=len(drive) - 1)
    truth, before = planar_poses(drive.truth)[at], planar_poses(drive.odometry)[at]
    (ate_before, rpe_before, aligned_before), (ate_after, rpe_after, aligned_after) = (
        trajectory_errors(stamps, poses, truth) for poses in (before, poses_after)
    )
    numbers = {
        'ate_before': ate_before,
        'ate_after': ate_after,
        'ate_ratio': ate_after / ate_before,
        'rpe_before': rpe_before,
        'rpe_after': rpe_after,
        'images': len(drive),
        'nodes': len(rows),
        'closures': int(values['accepted_closures']) + int(values['rejected_closures']),
        'accepted': int(values['accepted_closures']),
        'rejected': int(values['rejected_closures']),
        'sessions': int(values['sessions']),
        'odometry_error_factor': float(values['odometry_error_factor']),
    }
    return SlamResult(aligned_after, aligned_before, truth, poses_after, numbers)


def require_evo() -> None:
    """Raise UnavailableError where evo is not installed."""
    if find_spec('evo') is None:
        raise UnavailableError(
            'the errors of trajectories require evo: pip install evo (the extra slam)'
        )


def trajectory_errors(
    stamps: np.ndarray, poses: np.ndarray, truth: np.ndarray
) -> tuple[float, float, np.ndarray]:
    """
    Return the absolute and the relative error of a trajectory by evo, and the aligned poses.

    :param stamps: ns, shape (n,).
    :param poses, truth: shape (n, 7).
    :returns: rms of positions after alignment, m; rms over :data:`RPE_METERS`, m; poses (n, 7).
    :raises UnavailableError: evo is not installed.
    """
    require_evo()
    from evo.core import metrics
    from evo.core.trajectory import PoseTrajectory3D

    seconds = (stamps - stamps[0]) / SECOND
    reference, estimate = (
        PoseTrajectory3D(trajectory[:, :3].copy(), trajectory[:, [6, 3, 4, 5]].copy(), seconds)
        for trajectory in (truth, poses)
    )
    estimate.align(reference)
    absolute = metrics.APE(metrics.PoseRelation.translation_part)
    absolute.process_data((reference, estimate))
    relative = metrics.RPE(
        metrics.PoseRelation.translation_part, RPE_METERS, metrics.Unit.meters, all_pairs=True
    )
    relative.process_data((reference, estimate))
    aligned_poses = np.column_stack(
        [estimate.positions_xyz, estimate.orientations_quat_wxyz[:, [1, 2, 3, 0]]]
    )
    errors = [
        float(metric.get_statistic(metrics.StatisticsType.rmse)) for metric in (absolute, relative)
    ]
    return errors[0], errors[1], aligned_poses


def write_result(
    result: SlamResult, drive: LapDrive, edges: list[np.ndarray], folder: Path
) -> Path:
    """
    Write ``slam.json``, the trajectories in the TUM format, and the plot; return its path.

    :param edges: ends of the accepted and of the rejected edges in the map, each (m, 2, 3).
    """
    text = json.dumps(result.numbers, indent=2) + '\n'
    write_output(folder / 'slam.json', text, JSON, True)
    for name, poses in (('truth', drive.truth), ('odometry', drive.odometry)):
        write_output(
            folder / f'{name}.tum', tum_text(drive.stamps, planar_poses(poses)), TUM, True
        )
    plot = folder / 'slam.png'
    title = 'Three laps of a synthetic street'
    with titled_page(plot, 12.5, 5.5, title, result.summary()) as figure:
        left, right = figure.subplots(1, 2)
        left.plot(*result.truth[:, :2].T, color=GRAY, label='truth', lw=5, alpha=0.5)
        left.plot(*result.before[:, :2].T, color=ORANGE, label='odometry', ls='--')
        left.plot(*result.poses[:, :2].T, color=BLUE, label='optimized')
        right.plot(*result.in_map[:, :2].T, color=GRAY)
        styles = ((BLUE, 'accepted', 1.0), (VERMILION, 'rejected', 3.0))
        for ends, (color, name, width) in zip(edges, styles, strict=True):
            for k, (a, b) in enumerate(ends[:, :, :2]):
                label = f'{len(ends)} {name}' if k == 0 else None
                right.plot(*zip(a, b, strict=True), color=color, lw=width, label=label)
        left.set_title('aligned with the truth')
        right.set_title('loop closures')
        for axes in (left, right):
            axes.set_aspect('equal', adjustable='datalim')
            axes.set(xlabel='x (m)', ylabel='y (m)')
            axes.legend(loc='upper right')
    return plot
