# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``replay``: publish images of a bag, video or folder, at a pace or after the last result."""

import argparse
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import closing, ExitStack
from dataclasses import fields
import heapq
import math
import sys
import time

import rclpy
from stavpr_ros.commands.program import (
    add_camera,
    DONE,
    FAILED,
    make_parser,
    positive,
    run_program,
    say,
)
from stavpr_ros.commands.record import Recorder
from stavpr_ros.errors import ImageError, left_out, SourceError, StavprError, UnavailableError
from stavpr_ros.output_file import atomic_output, RECORDING
from stavpr_ros.progress import shows_bars
from stavpr_ros.ros.messages import message_class
from stavpr_ros.ros.process import own_arguments, prepare_transport, ros_node
from stavpr_ros.ros.replay import (
    NoResultError,
    NoSubscriberError,
    Replayer,
    ReplayOptions,
)
from stavpr_ros.sources import open_source, Source
from stavpr_ros.sources.bag import BagSource, ODOMETRY
from stavpr_ros.sources.bag_messages import list_topics, read_messages
from stavpr_ros.sources.folder import FolderSource
from stavpr_ros.sources.frame import ImageRecord, MessageRecord, RecordedTopic
from tqdm import tqdm

NO_SUBSCRIBER, NO_RESULT = 3, 4  # exit codes, besides the ones that all commands have
FOLDER_FPS = 10.0
CLOCK_RATE = 40.0  # Hz, as `ros2 bag play`
ONLY = ''  # --odometry without a topic

EPILOG = """\
examples:
  ros2 run stavpr_ros replay traverse.bag
        a ROS 1 bag with one image topic, at its recorded pace, on the topic image
  ros2 run stavpr_ros replay traverse --topic /camera/image_raw --rate 2
        a ROS 2 bag, twice as fast
  ros2 run stavpr_ros replay traverse.mcap --lossless --record matches.jsonl
        each image after the result of the last one on /stavpr/match; nothing is dropped, and the
        file has the matches of all
  ros2 run stavpr_ros replay traverse --odometry --also /tf /tf_static --clock
        the bag's odometry on the topic odom, two more topics, and /clock for use_sim_time
  ros2 run stavpr_ros replay photos --fps 5 --ros-args -r image:=/camera/image
        a folder of images, 5 per second, on another topic
  ros2 run stavpr_ros replay phone.mp4 --lossless
        a video, 5 images of each second

The services ~/pause, ~/resume, ~/toggle_paused and ~/play_next (std_srvs/Trigger), as of
`ros2 bag play`, control it: the last one publishes the next image while it is paused.

exit codes:
  0    all images were published; the last line names how many of them the node received
  1    the input cannot be read, or none of its images
  2    wrong usage
  3    no subscriber within --wait seconds
  4    no result for an image (--lossless), or no acknowledgment
  130  interrupted
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    args = list(sys.argv[1:] if arguments is None else arguments)
    codes: dict[type[StavprError], int] = {
        NoSubscriberError: NO_SUBSCRIBER,
        NoResultError: NO_RESULT,
    }
    return run_program(
        'replay', lambda: _run(_parser().parse_args(own_arguments(args)), args), codes=codes
    )


def _run(options: argparse.Namespace, ros_arguments: list[str]) -> int:
    skipped: Counter[str] = Counter()

    def skip(error: ImageError) -> None:
        skipped[error.kind] += 1
        notify(f'skipped: {error}')
        bar.update()

    def notify(text: str) -> None:
        tqdm.write(f'replay: {text}', file=sys.stderr)

    source = open_source(options.bag, options.topic, skip, options.fps, options.camera)
    others = _others(options, source, notify)
    whole = options.duration == math.inf and not (options.start_offset or options.loop)
    # no bar without a terminal
    with tqdm(
        total=len(source) if whole else None, unit='image', desc='replay', disable=not shows_bars()
    ) as bar:
        prepare_transport()
        with ros_node(lambda: rclpy.create_node('stavpr_replay'), ros_arguments) as node:
            names = (field.name for field in fields(ReplayOptions))
            how = ReplayOptions(**{name: getattr(options, name) for name in names})
            replayer = Replayer(node, notify, how, others)
            with closing(replayer), ExitStack() as stack:
                if options.record:
                    file = stack.enter_context(
                        atomic_output(options.record, RECORDING, options.force)
                    )
                    recorder = Recorder(file, options.record)
                    replayer.progress.on_match = recorder.write
                    stack.callback(recorder.finish)
                report = _replay(replayer, options, source, bar.update)
    if not (replayer.published or skipped):
        raise SourceError(
            f'{options.bag} has no image from second {options.start_offset:g} on, for '
            f'{options.duration:g} s: choose another --start-offset or --duration'
        )
    say(f'{report}, {skipped.total()} skipped')
    if unread := left_out(skipped, getattr(source, 'left_out', {})):
        notify(unread)
    return DONE if replayer.published else FAILED


def _others(
    options: argparse.Namespace, source: Source, notify: Callable[[str], None]
) -> dict[RecordedTopic, str]:
    """Return the topics to publish beside the images, and the names to publish them on."""
    if options.odometry is None and options.also is None:
        return {}
    if not isinstance(source, BagSource):
        raise SourceError(f'{source.path} is no bag, which --odometry and --also require')
    topics = list_topics(source.path)

    def find(name: str, of_type: str = '') -> RecordedTopic:
        matches = [
            topic
            for topic in topics.values()
            if of_type in {'', topic.message_type}
            and name.strip('/') in {'', topic.name.strip('/')}
        ]
        if len(matches) != 1:
            choices = ', '.join(
                f'{topic.name} ({topic.message_type})' for topic in topics.values()
            )
            raise SourceError(
                f'{len(matches)} topics {name} {of_type} with messages in {source.path}: expected '
                f'one of {choices}'
            )
        return matches[0]

    selection = [find(name) for name in options.also or ()]
    if options.also == []:
        for topic in topics.values():
            try:
                message_class(topic.message_type)
            except UnavailableError as error:
                notify(f'{topic.name} is left out: {error}')
            else:
                selection.append(topic)
    others = {topic: topic.name for topic in selection if topic.name != source.topic}
    if options.odometry is not None:
        others[find(options.odometry, ODOMETRY)] = 'odom'
    return others


def _replay(
    replayer: Replayer, options: argparse.Namespace, source: Source, count: Callable[[], object]
) -> str:
    """Publish the records; return a summary."""

    def count_images() -> Iterator[ImageRecord | MessageRecord]:
        for record in _records(options, source, replayer.topics):
            yield record
            if isinstance(record, ImageRecord):
                count()

    replayer.wait_for_subscribers()
    began = time.monotonic()
    replayer.play(count_images())
    while options.loop and replayer.published:
        replayer.play(count_images())
    seconds = time.monotonic() - began
    replayer.finish()
    rate = replayer.published / max(seconds, 1e-9)
    summary = (
        f'{replayer.published} images published on {replayer.publisher.topic_name} '
        f'in {seconds:.1f} s ({rate:.1f} per second)'
    )
    if options.lossless:
        summary += f', {replayer.resent} sent again, {replayer.dropped} dropped'
    elif report := replayer.progress.report():
        summary += f', {report}'
    return summary


def _records(
    options: argparse.Namespace, source: Source, topics: Collection[str]
) -> Iterator[ImageRecord | MessageRecord]:
    """Yield the images, and the messages of other topics, in the order of recording."""
    span = options.start_offset, options.duration
    if isinstance(source, FolderSource):
        return source.records(options.fps or FOLDER_FPS, *span)
    images = source.records(*span)
    if not topics:
        return images
    # of two of one time, the image is the later one: its odometry is there
    others = read_messages(source.path, topics, *span)
    return heapq.merge(others, images, key=lambda record: record.time_ns)


def _parser() -> argparse.ArgumentParser:
    parser = make_parser(
        'replay',
        'Publish images of a bag, video or folder, at a pace or after the last result.',
        EPILOG,
    )
    add = parser.add_argument
    text = 'a ROS 2 bag (folder, .db3 or .mcap file), a ROS 1 .bag, a video, or a folder of images'
    add('bag', metavar='BAG', help=text)
    add('--topic', help='image topic in the bag; needed if it has several')
    add_camera(parser)
    text = 'publish this topic of nav_msgs/Odometry, by default the only one, on odom'
    add('--odometry', nargs='?', const=ONLY, metavar='TOPIC', help=text)
    text = 'publish these topics under their names; without a name: all (cameras, tf, ...)'
    add('--also', nargs='*', metavar='TOPIC', help=text)
    add_pace = parser.add_mutually_exclusive_group().add_argument
    text = 'factor on the recorded pace (1)'
    add_pace('--rate', type=positive, default=1.0, metavar='R', help=text)
    text = 'send each image after the result of the last one'
    add_pace('--lossless', action='store_true', help=text)
    text = f'images per second that a folder was recorded with ({FOLDER_FPS:g}), or to take from'
    add('--fps', type=positive, metavar='HZ', help=f'{text} a video (5)')
    text = 'write the matches, as `record`; --lossless misses none'
    add('--record', metavar='FILE', help=text)
    add('--force', action='store_true', help='replace an earlier --record FILE')
    add('--loop', action='store_true', help='start again at the end')
    text = 'start so many recorded seconds after the beginning'
    add('--start-offset', type=_not_negative, default=0.0, metavar='S', help=text)
    text = 'end after so many recorded seconds'
    add('--duration', type=positive, default=math.inf, metavar='S', help=text)
    text = f'publish the recorded time on /clock for use_sim_time ({CLOCK_RATE:g} Hz)'
    add(
        '--clock', nargs='?', type=positive, const=CLOCK_RATE, default=0.0, metavar='HZ', help=text
    )
    add('--start-paused', dest='paused', action='store_true', help='start paused')
    text = 'seconds without a result until an image is sent again; 3 tries (%(default)g)'
    add('--timeout', type=positive, default=20.0, metavar='S', help=text)
    add('--wait', type=positive, metavar='S', help='seconds to wait for a subscriber')
    return parser


def _not_negative(text: str) -> float:
    return 0.0 if float(text) == 0 else positive(text)


if __name__ == '__main__':
    sys.exit(main())
