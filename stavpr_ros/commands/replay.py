# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``replay``: publish the images of a bag or folder, at a pace or each after the last result."""

import argparse
from collections.abc import Callable, Iterator, Sequence
import math
import sys
import time

import rclpy
from stavpr_ros.commands.program import DONE, FAILED, make_parser, run_program
from stavpr_ros.errors import ImageError, StavprError
from stavpr_ros.ros.process import own_arguments, prepare_transport, ros_node
from stavpr_ros.ros.replay import NoResultError, NoSubscriberError, Replayer
from stavpr_ros.sources import open_source
from stavpr_ros.sources.folder import FolderSource
from stavpr_ros.sources.frame import ImageRecord
from tqdm import tqdm

NO_SUBSCRIBER, NO_RESULT = 3, 4  # exit codes, besides those of every command
FOLDER_RATE = 10.0

EPILOG = """\
examples:
  ros2 run stavpr_ros replay traverse.bag
        a ROS 1 bag with one image topic, at its recorded pace, on the topic image
  ros2 run stavpr_ros replay traverse --topic /camera/image_raw --rate 2
        a ROS 2 bag, twice as fast
  ros2 run stavpr_ros replay traverse.mcap --lossless
        each image after the result of the last one on /stavpr/match; nothing is dropped
  ros2 run stavpr_ros replay photos --rate 5 --ros-args -r image:=/camera/image
        a folder of images, 5 per second, on another topic

exit codes:
  0    all images were published; the last line names how many of them the node received
  1    the bag or folder cannot be read, or none of its images
  2    wrong usage
  3    no subscriber within --wait seconds
  4    no result for an image (--lossless), or no acknowledgment
  130  interrupted
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """
    Run the command.

    :param arguments: without the program's name; the process's own if None.
    :returns: exit code, see ``--help``.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    codes: dict[type[StavprError], int] = {
        NoSubscriberError: NO_SUBSCRIBER,
        NoResultError: NO_RESULT,
    }
    return run_program(
        'replay', lambda: _run(_parser().parse_args(own_arguments(given)), given), codes=codes
    )


def _run(options: argparse.Namespace, ros_arguments: list[str]) -> int:
    skipped: list[ImageError] = []

    def skip(error: ImageError) -> None:
        skipped.append(error)
        notify(f'skipped: {error}')
        bar.update()

    def notify(text: str) -> None:
        tqdm.write(f'replay: {text}', file=sys.stderr)

    source = open_source(options.bag, options.topic, skip)
    if isinstance(source, FolderSource):
        records, rate = source.records(options.rate or FOLDER_RATE), 1.0
    else:
        records, rate = source.records(), options.rate or 1.0
    # no bar without a terminal
    with tqdm(total=len(source), unit='image', desc='replay', disable=None) as bar:
        prepare_transport()
        with ros_node(lambda: rclpy.create_node('stavpr_replay'), ros_arguments) as node:
            replayer = Replayer(
                node, notify, rate, options.lossless, options.timeout, options.wait
            )
            try:
                report = _replay(replayer, records, bar.update)
            finally:
                replayer.close()
    print(f'{report}, {len(skipped)} skipped')
    return FAILED if len(skipped) == len(source) else DONE


def _replay(
    replayer: Replayer, records: Iterator[ImageRecord], count: Callable[[], object]
) -> str:
    """Publish the records; return a summary."""
    replayer.wait_for_subscribers()
    began = time.monotonic()
    for record in records:
        replayer.send(record)
        count()
    seconds = time.monotonic() - began
    replayer.finish()
    rate = replayer.published / max(seconds, 1e-9)
    summary = (
        f'{replayer.published} images published on {replayer.publisher.topic_name} '
        f'in {seconds:.1f} s ({rate:.1f} per second)'
    )
    if replayer.lossless:
        summary += f', {replayer.resent} sent again, {replayer.dropped} dropped'
    elif report := replayer.receipts.report():
        summary += f', {report}'
    return summary


def _parser() -> argparse.ArgumentParser:
    parser = make_parser('replay', __doc__.partition(': ')[2], EPILOG)
    parser.add_argument(
        'bag',
        metavar='BAG',
        help='a ROS 2 bag (folder, .db3 or .mcap file), a ROS 1 .bag, or a folder of images',
    )
    parser.add_argument('--topic', help='image topic in the bag; needed if it has several')
    pace = parser.add_mutually_exclusive_group()
    pace.add_argument(
        '--rate',
        type=_positive,
        metavar='R',
        help=f'factor on the recorded pace (1); for a folder images per second ({FOLDER_RATE:g})',
    )
    pace.add_argument(
        '--lossless', action='store_true', help='send each image after the result of the last one'
    )
    parser.add_argument(
        '--timeout',
        type=_positive,
        default=20.0,
        metavar='S',
        help='seconds without a result until an image is sent again; 3 tries (%(default)g)',
    )
    parser.add_argument(
        '--wait', type=_positive, metavar='S', help='seconds to wait for a subscriber'
    )
    return parser


def _positive(text: str) -> float:
    value = float(text)
    if not (value > 0 and math.isfinite(value)):
        raise argparse.ArgumentTypeError(f'{text}: expected a number above 0')
    return value


if __name__ == '__main__':
    sys.exit(main())
