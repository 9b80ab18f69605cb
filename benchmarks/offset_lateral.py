# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Heading and lateral offset of a camera that drives beside the taught path, against the truth.

``python benchmarks/offset_lateral.py``: 50 m of the synthetic street taught by day with
0.5 m between the images, and driven in parallel, by day, at dusk and in rain; the camera turns by
up to 3 degrees, and its distance from the path changes by 0.15 m. A second table has ``~/pose`` of
the same drives up to 0.4 m beside the path: its error across the path.
"""

from collections.abc import Iterator
from dataclasses import replace
import math
from typing import Any

import numpy as np
from results import parser_of
from stavpr_lab.demonstration.repeat import CONDITIONS, Taught, teach, View
from stavpr_lab.demonstration.street.laps import RingWorld
from stavpr_lab.demonstration.street.rendering import FOCAL
from stavpr_lab.demonstration.street.traverses import Conditions, EPOCH
from stavpr_ros import Localizer
from stavpr_ros.pipeline.result import ImageResult
from stavpr_ros.progress import Progress
from stavpr_ros.relative_pose.expansion import Expansion
from stavpr_ros.relative_pose.offset import describe_columns, OffsetFilter
from stavpr_ros.ros.messages import matched_pose_message, Outcome
from std_msgs.msg import Header

SEEDS = (7, 21, 33)
LEFT = (-1.0, -0.4, -0.2, 0.0, 0.2, 0.4, 1.0, 2.0)  # meters from the path
WITHIN, SWAY, MAX_ANGLE = range(10, 110), 0.15, math.radians(3)


Image = tuple[int, float, float, np.ndarray, np.ndarray]


def drive(taught: Taught, conditions: Conditions, left: float) -> Iterator[Image]:
    """Yield place, meters to the left, radians to the left, pose and image beside the path."""
    view = View(taught.world, conditions)
    for k in WITHIN:
        x, y, heading = taught.poses[k]
        beside, turn = left + SWAY * math.sin(k / 7), MAX_ANGLE * math.sin(k / 5)
        pose = x - beside * math.sin(heading), y + beside * math.cos(heading), heading + turn
        yield k, beside, turn, np.array(pose), view.image(np.array(pose), k)


def rows(taught: Taught, seed: int, progress: Any) -> list[str]:
    """Return the rows of a street."""
    lines = []
    images = [taught.place_map.thumbnail(k) for k in range(len(taught.poses))]
    columns = [describe_columns(image) for image in images if image is not None]
    expansion = Expansion(columns.__getitem__, taught.run.distances)
    for left in LEFT:
        results = []
        for conditions in CONDITIONS.values():
            estimator = OffsetFilter()
            for k, beside, turn, _, image in drive(taught, conditions, left):
                offset = estimator.update(describe_columns(image), columns[k])
                lateral, deviation = expansion.lateral(offset, k, FOCAL)
                if offset.is_valid:
                    error = math.degrees(offset.heading(FOCAL) - turn)
                    results.append((lateral, lateral - beside, deviation, error))
                progress.update()
        lateral, errors, deviations, headings = np.array(results).T
        lines.append(
            f'| {seed} | {left:+.1f} m | {len(results) / len(WITHIN) / len(CONDITIONS):.0%} | '
            f'{lateral.mean():+.2f} m | {np.sqrt(np.mean(errors**2)):.2f} m | '
            f'{np.mean(abs(errors) < 2 * deviations):.0%} | '
            f'{np.sqrt(np.mean(headings**2)):.2f} |'
        )
    return lines


def pose_row(taught: Taught, seed: int) -> str:
    """Return the row of ``~/pose`` of a street, on the drives up to 0.4 m beside the path."""
    half = taught.poses[:, 2] / 2
    poses = np.zeros((len(half), 7))
    poses[:, :2], poses[:, 5], poses[:, 6] = taught.poses[:, :2], np.sin(half), np.cos(half)
    places, results, count = replace(taught.place_map, poses=poses), [], 0
    for left in (meters for meters in LEFT if abs(meters) <= 0.4):
        for conditions in CONDITIONS.values():
            localizer = Localizer(places)
            for k, _, _, truth, image in drive(taught, conditions, left):
                match = localizer(image, EPOCH + k * 10**8)
                count += 1
                result = ImageResult(match)
                if message := matched_pose_message(Outcome(Header(), result, places)):
                    at, heading = message.pose.pose.position, taught.poses[k, 2]
                    across = np.array([-math.sin(heading), math.cos(heading)])
                    variance = across @ message.pose.covariance.reshape(6, 6)[:2, :2] @ across
                    error = across @ ([at.x, at.y] - truth[:2])
                    results.append((error, math.sqrt(variance)))
    errors, deviations = np.array(results).T
    return (
        f'| {seed} | {len(errors) / count:.0%} | {np.sqrt(np.mean(errors**2)):.2f} m | '
        f'{abs(errors).max():.2f} m | {deviations.min():.2f} m | '
        f'{np.mean(abs(errors) <= 2 * deviations):.1%} |'
    )


def main() -> None:
    """Run the command."""
    parser = parser_of(__doc__)
    parser.add_argument('seeds', type=int, nargs='*', default=SEEDS, help='of the streets')
    seeds = parser.parse_args().seeds
    total, lines, poses = len(seeds) * len(LEFT) * len(CONDITIONS) * len(WITHIN), [], []
    with Progress(total=total, unit='image') as progress:
        for seed in seeds:
            taught = teach(RingWorld(seed), 0.0, 60.0)
            lines += rows(taught, seed, progress)
            poses.append(pose_row(taught, seed))
    print('| street | left of the path | valid | mean | RMS | within 2 deviations | heading |')
    print('|---|---|---|---|---|---|---|')
    print('\n'.join(lines))
    print('\n| street | matched | RMS across the path | largest | deviation | within 2 |')
    print('|---|---|---|---|---|---|')
    print('\n'.join(poses))


if __name__ == '__main__':
    main()
