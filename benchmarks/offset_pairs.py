# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The shift of the distant scene between the two sides of the path, beside pairs marked by hand.

``python benchmarks/offset_pairs.py``: Gardens Point by day, carried by hand, left side as the map.
The farthest structure that both images show was marked; pairs without one are left out. Marks
are right within 10 pixels where it is far, 30 where it is a building across a yard.
"""

import sys

from data import data_folder
import numpy as np
from stavpr_ros.relative_pose.offset import describe_columns, OffsetFilter
from stavpr_ros.sources import open_source

PIXELS = 1024  # width that the shifts are of
# fmt: off
MARKED = {
    2: 3, 6: -28, 14: 31, 16: -40, 18: -45, 20: -90, 22: -115, 30: -25, 32: -24, 34: -4, 36: -66,
    38: -53, 40: -35, 50: 38, 58: -48, 62: -83, 64: -111, 66: -55, 70: -58, 74: -60, 90: -179,
    103: 38, 106: -56, 110: -158, 118: -6, 122: -67, 126: -60, 128: -107, 130: 50, 132: -127,
    134: 171, 136: -2, 138: 83, 142: -101, 146: -67, 148: -47, 150: -129, 158: -49, 160: -71,
    162: -107, 166: -162, 170: -11, 173: -95, 174: -80, 178: -51, 182: -41, 186: -102, 187: -73,
    190: -79, 194: 121,
}
# fmt: on
LEFT_OUT = (22, 90, 103, 128, 136, 173, 187)  # marked after the constants were chosen


def main() -> int:
    """Run the command."""
    left, right = (
        [describe_columns(frame.image) for frame in open_source(data_folder() / path)]
        for path in ('gardens_point/day_left', 'gardens_point/day_right')
    )
    for name, is_sequence in (('sequence', True), ('single images', False)):
        one, errors = OffsetFilter(), {}
        for i, (place, query) in enumerate(zip(left, right, strict=True)):
            if not is_sequence:
                one.reset()
            result = one.update(query, place)
            if i in MARKED and result.is_valid:
                errors[i] = abs(result.shift * PIXELS - MARKED[i])
        for marked in (MARKED, LEFT_OUT):
            size = np.array([errors[i] for i in marked if i in errors])
            print(
                f'{name}: {len(size)} of {len(marked)} valid, '
                f'RMS {np.sqrt(np.mean(size**2)):.0f}, median {np.median(size):.0f} pixels of '
                f'{PIXELS}, {np.mean(size > 40):.0%} above 40'
            )
    return 0


if __name__ == '__main__':
    sys.exit(main())
