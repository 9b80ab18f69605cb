# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run stavpr_lab build_descriptor_map``: make a map of arrays of another program."""

import argparse
from dataclasses import replace
import sys

from stavpr_ros.commands.feature_options import boolean
from stavpr_ros.commands.program import make_parser, run_program, say

EPILOG = """
examples:
  build_descriptor_map --input netvlad.mat:features --output route.stavpr \\
      --descriptors-source netvlad

exit codes: 0 the map is written; 1 it is not (the reason is printed); 2 usage
"""


def add_descriptor_options(parser: argparse.ArgumentParser) -> None:
    """Add the settings of descriptors; None = not given."""
    add = parser.add_argument_group('descriptors').add_argument
    source = 'what computed them, such as netvlad; the same for map and query'
    add('--descriptors-source', metavar='NAME', help=source)
    bits = 'true: arrays are uint8 with 8 bits a number, as of numpy.packbits'
    add('--descriptors-bits', type=boolean, metavar='true|false', help=bits)


def _parser() -> argparse.ArgumentParser:
    parser = make_parser(
        'build_descriptor_map',
        'Build a map of descriptors that another program computed: one place for each row.',
        EPILOG,
    )
    add = parser.add_argument
    arrays = '.npy .npz .csv .mat, or FILE:NAME for one of several: (n, D) or (n, W, D)'
    add('--input', required=True, metavar='ARRAY', help=arrays)
    add('--output', required=True, metavar='MAP', help='the file to write')
    add('--force', action='store_true', help='replace an existing map')
    poses = 'one line a row: x y z, x y z qx qy qz qw, TUM or KITTI (meters, quaternion)'
    add('--poses', metavar='CSV', help=poses)
    add_descriptor_options(parser)
    return parser


def _build(arguments: argparse.Namespace) -> None:
    from stavpr_lab.commands.evaluate_sequences import poses_of
    from stavpr_lab.features.descriptors import read_descriptors
    from stavpr_ros.maintenance.same_places import with_repeats
    from stavpr_ros.mapping import descriptor_map, save_map
    from stavpr_ros.output_file import MAP, require_replaceable
    from stavpr_ros.prepare.prepared_map import statistics_of_map

    require_replaceable(arguments.output, MAP, arguments.force)
    source, bits = arguments.descriptors_source or '', bool(arguments.descriptors_bits)
    place_map = descriptor_map(read_descriptors(arguments.input, source, bits))
    if arguments.poses is not None:
        poses = poses_of(arguments.poses, place_map, 'map', None)
        place_map = replace(place_map, poses=poses)
    place_map = with_repeats(place_map)
    statistics = statistics_of_map(place_map)
    save_map(place_map, arguments.output, force=arguments.force, statistics=statistics)
    shape = f'{place_map.settings.strips} strips of {place_map.dimension} dimensions'
    say(f'{arguments.output}: {len(place_map)} places, {shape}')


def main(args: list[str] | None = None) -> int:
    """Run the command."""
    return run_program('build_descriptor_map', lambda: _build(_parser().parse_args(args)))


if __name__ == '__main__':
    sys.exit(main())
