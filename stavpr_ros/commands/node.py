# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run stavpr_ros node``: the place-recognition node."""

import sys

from stavpr_ros.parameters import BY_NAME, PARAMETERS
from stavpr_ros.signals import run_until_signal
from stavpr_ros.threads import wait_passively

BLAS = 'scipy.linalg.cython_blas'  # numba imports it where SciPy is installed

HELP = """usage: node [--ros-args -p map_path:=FILE [-p NAME:=VALUE ...] [-r image:=TOPIC]]

A lifecycle node that configures and activates itself. It recognizes the places of the images on
the topic `image` (sensor_msgs/Image) on the route of a map (operation localization), records a map
(mapping), or recognizes places that the route has passed before (loop_closure), with poses from
`odom`.

It publishes one ~/match (stavpr_msgs/PlaceMatch) for every image received, with a status; for
accepted matches also ~/place_index, ~/distance, ~/pose and ~/loop_closure; ~/candidates,
~/match_image, ~/map_info and /diagnostics. Services: ~/load_map, ~/save_map, ~/reset,
~/relocalize, ~/set_operation.

Build a map with `build_map`. Without a map (in mode paper: or a threshold) the node publishes the
status NOT_READY with the reason; set them later by ~/load_map and the parameter threshold.

parameters:
{parameters}
exit codes: 0 stopped by a signal; 1 an invalid parameter, the backend is not available, or a
recorded map could not be saved at the end
"""


def _help() -> str:
    rows = []
    for row in PARAMETERS:
        unit = f' [{row.unit}]' if row.unit else ''
        rows.append(f'  {row.name} (default {row.default!r})\n      {row.sentence}{unit}\n')
    return HELP.format(parameters=''.join(rows))


def main(args: list[str] | None = None) -> int:
    """Run the node until it is stopped."""
    arguments = sys.argv[1:] if args is None else args
    if arguments[:1] in (['-h'], ['--help']):
        print(_help())
        return 0
    wait_passively()
    return run_until_signal(lambda: _run(args))


def _run(args: list[str] | None) -> int:
    _import_numba()
    from stavpr_ros.ros.node import PlaceRecognitionNode
    from stavpr_ros.ros.process import run_node

    return run_node(PlaceRecognitionNode, args, BY_NAME)


def _import_numba() -> None:
    """Import numba without SciPy's linear algebra (14 MB) for matrix products in kernels."""
    if BLAS not in sys.modules:
        sys.modules[BLAS] = None  # type: ignore[assignment]  # it cannot be imported
        import numba.np.arraymath  # noqa: F401

        del sys.modules[BLAS]
