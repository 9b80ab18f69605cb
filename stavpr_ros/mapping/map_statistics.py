# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What recognition learns from the features of a map, kept in its file; docs/map_format.md."""

from dataclasses import dataclass

import numpy as np
from stavpr_ros.mapping.map_container import MapFile
from stavpr_ros.mapping.map_schema import record, SHA256, text
from stavpr_ros.mapping.map_version2 import features_key

STATISTICS = 'statistics'  # name of the section
DATA = record({'method': text(128), 'features': text(64, SHA256)})
CHANGES = 5  # places apart, at most, whose changes are kept
LIMITS = {  # of the values in each part; norms may be 1.01, see LONGEST
    'mean': (-1.01, 1.01),
    'directions': (-1.01, 1.01),
    'gains': (0.01, 1.01),
    'changes': (-0.05, 2.05),
}


@dataclass(frozen=True, eq=False)
class MapStatistics:
    """
    Statistics of the features of a map, strips (W, n, d), as they are in its file.

    :param method: names how they were computed.
    :param mean: shape (W, d), float32.
    :param directions: of the whitening, unit norm or zero, shape (W, r, d), float32.
    :param gains: of the directions, over 0, at most 1, shape (W, r), float64.
    :param changes: change of each place from the ones 1 to ``CHANGES`` places before, shape
        (``CHANGES``, n), float32.
    :param codes: the features, centered, whitened and rounded to int8, shape (W, n, d); None =
        not kept, or not read.
    """

    method: str
    mean: np.ndarray
    directions: np.ndarray
    gains: np.ndarray
    changes: np.ndarray
    codes: np.ndarray | None = None

    def parts(self) -> dict[str, np.ndarray]:
        """Return the arrays by the names of their parts in the file."""
        arrays = {name: getattr(self, name) for name in (*LIMITS, 'codes')}
        return {
            f'{STATISTICS}/{name}': array for name, array in arrays.items() if array is not None
        }


def statistics_of(file: MapFile, arrays: dict[str, np.ndarray]) -> MapStatistics | None:
    """
    Return the statistics in an opened map; None if they are of other features.

    :param arrays: parts by name, of the right types and shapes.
    :raises ValueError: names what is wrong with them.
    """
    data = file.manifest['sections'][STATISTICS]['data']
    DATA(data, f'section {STATISTICS}')
    values = []
    for name, (least, most) in LIMITS.items():
        part = f'{STATISTICS}/{name}'
        if part not in arrays:
            raise ValueError(f'part {part} is missing')
        array = arrays[part]
        if array.size and not (array.min() >= least and array.max() <= most):  # NaN included
            raise ValueError(f'part {part} is not between {least} and {most}')
        values.append(array)
    is_present = data['features'] == features_key(file.parts['strips'].hashes)
    return MapStatistics(data['method'], *values) if is_present else None
