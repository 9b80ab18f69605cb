# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Heading and lateral offset of a camera that drives beside the taught path, against the truth.

``python benchmarks/offset_lateral.py [SEED ...]``: 50 m of the synthetic street taught by day with
0.5 m between the images, and driven in parallel, by day, at dusk and in rain; the camera turns by
up to 3 degrees, and its distance from the path changes by 0.15 m.
"""

import math
import sys
from typing import Any

import numpy as np
from stavpr_lab.demonstration.repeat import CONDITIONS, teach, View
from stavpr_lab.demonstration.street.laps import RingWorld
from stavpr_lab.demonstration.street.rendering import FOCAL
from stavpr_ros.progress import Progress
from stavpr_ros.relative_pose.expansion import Expansion
from stavpr_ros.relative_pose.offset import describe_columns, OffsetFilter

SEEDS = (7, 21, 33)
LEFT = (-1.0, -0.4, -0.2, 0.0, 0.2, 0.4, 1.0, 2.0)  # meters from the path
WITHIN, SWAY, TURNED = range(10, 110), 0.15, math.radians(3)


def rows(seed: int, progress: Any) -> list[str]:
    """Return the rows of a street."""
    taught, lines = teach(RingWorld(seed), 0.0, 60.0), []
    images = [taught.place_map.thumbnail(k) for k in range(len(taught.poses))]
    columns = [describe_columns(image) for image in images if image is not None]
    expansion = Expansion(columns.__getitem__, taught.run.distances)
    for left in LEFT:
        results = []
        for conditions in CONDITIONS.values():
            view, estimator = View(taught.world, conditions), OffsetFilter()
            for k in WITHIN:
                x, y, heading = taught.poses[k]
                beside, turn = left + SWAY * math.sin(k / 7), TURNED * math.sin(k / 5)
                pose = x - beside * math.sin(heading), y + beside * math.cos(heading)
                image = view.image(np.array([*pose, heading + turn]), k)
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


def main() -> int:
    """Run the command."""
    seeds = [int(each) for each in sys.argv[1:]] or SEEDS
    total = len(seeds) * len(LEFT) * len(CONDITIONS) * len(WITHIN)
    with Progress(total=total, unit='image') as progress:
        lines = [line for seed in seeds for line in rows(seed, progress)]
    print('| street | left of the path | valid | mean | RMS | within 2 deviations | heading |')
    print('|---|---|---|---|---|---|---|')
    print('\n'.join(lines))
    return 0


if __name__ == '__main__':
    sys.exit(main())
