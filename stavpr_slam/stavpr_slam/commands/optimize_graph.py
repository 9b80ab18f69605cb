# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``stavpr optimize_graph``: reject the false closures of a g2o file, and solve the rest."""

import argparse
import math
import sys

from stavpr_ros.commands.program import make_parser, run_program

EPILOG = """Edges from a vertex to the next one are the odometry, which is right within its
information times a factor, and begins anew where it is interrupted; all others are loop
closures, each right or wrong on its own. Where the odometry is more probable than any correction,
it stays. Both dimensions: EDGE_SE2 and EDGE_SE3:QUAT.

example:
  optimize_graph manhattan.g2o --output solved.g2o

exit codes: 0 done; 1 failed; 2 usage error; 130 interrupted
"""


def main(arguments: list[str] | None = None) -> int:
    """Run the command."""
    parser = make_parser(
        'optimize_graph', 'Solve a pose graph, some closures of which are false.', EPILOG
    )
    parser.add_argument('graph', metavar='FILE.g2o', help='the graph')
    parser.add_argument(
        '--output', metavar='FILE', help='write the solution: a name in .g2o, .tum or .kitti'
    )
    parser.add_argument('--force', action='store_true', help='overwrite the output')
    args = sys.argv[1:] if arguments is None else arguments
    return run_program('optimize_graph', lambda: _run(parser.parse_args(args)))


def _run(args: argparse.Namespace) -> None:
    from stavpr_slam.pose_graph.files import save_graph
    from stavpr_slam.pose_graph.g2o import graph_of, read_edges

    graph = graph_of(read_edges(args.graph))
    graph.update(final=True)
    print(
        f'{len(graph.chain)} poses, {len(graph.edges)} closures: {graph.accepted} accepted, '
        f'{graph.rejected} rejected'
    )
    if graph.chain.sessions > 1:
        print(f'{graph.chain.sessions} sessions: the odometry is interrupted')
    if abs(math.log2(factor := graph.scales.max(initial=1.0))) >= 1:
        print(f'the errors are about {factor:.2g} times as large as the file states')
    if graph.edges and not graph.accepted:
        print('the odometry stays: no closures agree with it beyond chance')
    if args.output:
        save_graph(graph, args.output, args.force)
        print(f'written: {args.output}')
