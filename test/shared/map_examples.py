# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Small maps with everything that a map may hold."""

import dataclasses
from pathlib import Path
from unittest.mock import patch

from fixtures import route_images
import numpy as np
from places import poses_at
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.features.gradient import GradientSettings
from stavpr_ros.mapping import build_map, Map, save_map, Session
from stavpr_ros.mapping.place_map import ErrorRisks
from stavpr_ros.prepare import prepared_map
from stavpr_ros.sources.frame import Frame

VERSION2 = Path(__file__).parents[1] / 'data' / 'version2'
PLACES = 24


def example_map(projection: int | None = None) -> Map:
    """Return a map of 24 places in two sessions, of 32 dimensions or projected."""
    extractor = FeatureExtractor(
        'gradient', GradientSettings(32, cell=8, orientations=4, logarithm=False), 2, projection
    )
    frames = [
        Frame(image, (i + 1) * 10**9, f'place {i}') for i, image in enumerate(route_images(PLACES))
    ]
    poses = poses_at(range(PLACES))
    place_map = build_map(frames, extractor, poses, progress=False, thumbnail_width=32)
    poses[3] = np.nan
    return dataclasses.replace(
        place_map,
        poses=poses,
        thumbnails=(b'', *place_map.thumbnails[1:]),
        sessions=(Session('a', 'morning', 'robot 1', 10**9), Session('b')),
        session_index=np.repeat(np.arange(2, dtype=np.int32), PLACES // 2),
    )


def example_files(folder: Path) -> list[bytes]:
    """Return the content of map files of both storages, with and without a projection."""
    save_map(example_map(), folder / 'float32')
    risks = ErrorRisks('robust', 3, (0.2, 0.9), (1.5, 0.0))
    projected = dataclasses.replace(example_map(projection=16), error_risks=risks)
    with patch.object(prepared_map, 'MIN_PLACES', 1):
        statistics = prepared_map.statistics_of_map(projected, 'float16')
        assert statistics is not None
        statistics = prepared_map.with_codes(statistics, projected, 'float16')
    save_map(projected, folder / 'projected', 'float16', statistics=statistics)
    return [(folder / name).read_bytes() for name in ('float32', 'projected')]
