# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run stavpr_ros build_map``: make a reference map from images, a video or a bag."""

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
import json
from pathlib import Path
import sys
from typing import TYPE_CHECKING

from stavpr_ros.commands.jobs import add_job_options, Job, job_names, other_arguments, run_jobs
from stavpr_ros.commands.program import add_camera, add_fps, make_parser, run_program, say
from stavpr_ros.errors import ImageError, left_out, SettingsError, SourceError
from stavpr_ros.features.registry import AUTO
from stavpr_ros.output_file import MAP, require_replaceable

if TYPE_CHECKING:
    import numpy as np
    from stavpr_ros.mapping import Map, Trajectory
    from stavpr_ros.sources import Source
    from stavpr_ros.sources.frame import Frame

RULES = {  # fields of KeyframeSettings
    'interval': ('S', 'seconds since the last place; for videos and bags'),
    'distance': ('M', 'meters from the last place; needs --odometry or --poses'),
    'angle': ('DEG', 'degrees from the last place; needs --odometry or --poses'),
    'change': ('C', 'change of the image, 0 to 2; a camera at rest stays below 0.004'),
}

EPILOG = """
examples:
  build_map --input drive/ --output route.stavpr
  build_map --input phone.mp4 --output route.stavpr
  build_map --input drive.bag --topic /camera/image_raw --output route.stavpr
  build_map --input drive.bag --output route.stavpr --odometry /odom \\
      --keyframe-distance 1 --keyframe-angle 15
  build_map --input drive/ --output route.stavpr --projection 512 --features onnx \\
      --onnx-model squeezenet.onnx --onnx-layer fire6/concat_1
  build_map --input drives/*.bag --output maps/ --processes 4

An interrupted command leaves MAP.journal, and the same command continues it, after an image that
cannot be read with --skip-bad-images.

exit codes: 0 the map is written; 1 it is not (the reason is printed, an earlier map is untouched);
2 usage; 130 interrupted (it prints whether the map is written)
"""


def _parser() -> argparse.ArgumentParser:
    from stavpr_ros.commands.feature_options import add_feature_options

    parser = make_parser(
        'build_map', 'Build a reference map: one place for each image or keyframe.', EPILOG
    )
    add = parser.add_argument
    text = 'images, a video, a ROS 1 or ROS 2 bag; each of several becomes a map'
    add('--input', required=True, nargs='+', metavar='FOLDER|VIDEO|BAG', help=text)
    text = 'the file to write; for several inputs the folder of the maps'
    add('--output', required=True, metavar='MAP', help=text)
    add('--force', action='store_true', help='replace an existing map')
    add('--topic', help='image topic of the bag, if it has several')
    add_camera(parser)
    add_fps(parser)
    text = 'take every N-th image (%(default)s)'
    add('--every', type=int, default=1, metavar='N', help=text)
    text = 'poses of the images, a line each, in their order or with their names: x y z, '
    text += 'x y z qx qy qz qw, TUM or KITTI (meters, quaternion)'
    add('--poses', metavar='CSV', help=text)
    text = 'take the poses of the places from this nav_msgs/Odometry of the bag'
    add('--odometry', metavar='TOPIC', help=text)
    add('--no-thumbnails', action='store_true', help='keep no thumbnails of the places')
    text = 'width of the thumbnails (192); larger ones do not help the geometric check'
    add('--thumbnail-width', type=int, metavar='PX', help=text)
    text = 'continue after an image that cannot be read'
    add('--skip-bad-images', action='store_true', help=text)
    text = 'turn 360-degree images to the left; 180: as the robot takes them on its return'
    add('--panorama-yaw', type=float, default=0.0, metavar='DEG', help=text)
    group = parser.add_argument_group(
        'keyframes',
        'Only images that differ enough from the last place become places. All rules must be\n'
        'met; distance and angle are one rule, met by either. 0: off.',
    )
    for name, (metavar, text) in RULES.items():
        group.add_argument(
            f'--keyframe-{name}', type=float, default=0.0, metavar=metavar, help=text
        )
    add_job_options(parser)
    add_feature_options(parser)
    return parser


class _Images:
    """Every N-th image of a source, turned to the left by a yaw, degrees; counts those read."""

    def __init__(self, source: 'Source', every: int, yaw: float) -> None:
        self.source, self._every, self._yaw = source, every, yaw
        self.read = 0

    def __len__(self) -> int:
        return (len(self.source) + self._every - 1) // self._every

    def __iter__(self) -> Iterator['Frame']:
        import numpy as np

        for frame in islice(self.source, 0, None, self._every):
            self.read += 1
            shift = round(self._yaw / 360 * frame.image.shape[1])
            yield replace(frame, image=np.roll(frame.image, shift, axis=1)) if shift else frame


def _check(arguments: argparse.Namespace) -> None:
    """Reject options that contradict each other, before anything is read."""
    from stavpr_ros.checks import require_at_least, require_between
    from stavpr_ros.sources.bag_path import is_bag
    from stavpr_ros.sources.video import is_video, require_video

    moving = arguments.keyframe_distance or arguments.keyframe_angle
    bag = is_bag(Path(arguments.input))
    require_at_least('--every', arguments.every, 1)
    require_between('--panorama-yaw', arguments.panorama_yaw, -180, 180)
    require_video(arguments.fps, [arguments.input])
    if arguments.poses and arguments.skip_bad_images:
        raise SettingsError(
            '--poses and --skip-bad-images: a skipped image would shift the poses; give one'
        )
    if arguments.poses and arguments.odometry:
        raise SettingsError('--poses and --odometry: both give the poses of the places; give one')
    if moving and not (arguments.poses or arguments.odometry):
        raise SettingsError('--keyframe-distance and --keyframe-angle need --odometry or --poses')
    if arguments.odometry and not bag:
        raise SettingsError(
            f'--odometry: {arguments.input} is no bag; give --poses with images and videos'
        )
    if arguments.keyframe_interval and not (bag or is_video(arguments.input)):
        raise SettingsError(
            f'--keyframe-interval: {arguments.input} is no bag or video, its images have no stamps'
        )
    if arguments.thumbnail_width is not None and arguments.no_thumbnails:
        raise SettingsError('--thumbnail-width and --no-thumbnails: give one')
    require_replaceable(arguments.output, MAP, arguments.force)


def _poses(arguments: argparse.Namespace, source: 'Source') -> 'np.ndarray | Trajectory | None':
    """Read the poses of all images of the source, or the odometry."""
    from stavpr_ros.mapping import Trajectory
    from stavpr_ros.sources.pose_file import read_poses
    from stavpr_ros.sources.video import is_video

    if arguments.odometry:
        from stavpr_ros.sources.bag import read_odometry  # loads rosbags

        return Trajectory.from_arrays(*read_odometry(arguments.input, arguments.odometry))
    if not arguments.poses:
        return None
    names, images = getattr(source, 'names', ()), len(source)
    poses, has_orientations = read_poses(Path(arguments.poses), names)
    if len(poses) != images and not is_video(arguments.input):  # whose number is an estimate
        raise SourceError(
            f'poses {arguments.poses} has {len(poses)} lines for {images} images: give one each'
        )
    if arguments.keyframe_angle and not has_orientations:
        raise SettingsError(
            f'--keyframe-angle: {arguments.poses} has no orientations, leave it out'
        )
    return poses[:: arguments.every]


def _build(arguments: argparse.Namespace) -> 'tuple[Map, Path]':
    """Return the map, and the journal that it is in."""
    from stavpr_ros.commands.feature_options import make_extractor
    from stavpr_ros.mapping import KeyframeSettings, Trajectory
    from stavpr_ros.mapping.builder import build_journal, fit_value_range
    from stavpr_ros.mapping.journal_map import journal_map
    from stavpr_ros.mapping.place_map import THUMBNAIL_WIDTH
    from stavpr_ros.sources import open_source

    skipped: Counter[str] = Counter()

    def bad_image(error: ImageError) -> None:
        if arguments.poses:
            raise error
        if not arguments.skip_bad_images:
            text = f'{error}; the same command with --skip-bad-images continues without it'
            raise ImageError(text, kind=error.kind)
        skipped[error.kind] += 1
        say(f'skipped: {error}', sys.stderr)

    _check(arguments)
    keyframes = KeyframeSettings(*(getattr(arguments, f'keyframe_{rule}') for rule in RULES))
    extractor = make_extractor(arguments)
    options = arguments.topic, bad_image, arguments.fps, arguments.camera
    source = open_source(arguments.input, *options)
    fit_value_range(source, extractor)
    images = _Images(source, arguments.every, arguments.panorama_yaw)
    width = THUMBNAIL_WIDTH if arguments.thumbnail_width is None else arguments.thumbnail_width
    poses = _poses(arguments, source)
    journal = build_journal(
        images,
        extractor,
        arguments.output,
        _source_of(arguments),
        poses,
        thumbnails=not arguments.no_thumbnails,
        keyframes=keyframes,
        thumbnail_width=width,
    )
    place_map = journal_map(journal)
    if arguments.odometry and not place_map.has_poses:
        raise SourceError(
            f'--odometry {arguments.odometry}: no image has a pose; are the stamps of both from '
            'one clock?'
        )
    if isinstance(poses, Trajectory):
        skipped['odometry'] += poses.rejected
    if unread := left_out(skipped, getattr(source, 'left_out', {})):
        say(unread, sys.stderr)
    count = sum(place_map.pose(place) is not None for place in range(len(place_map)))
    with_pose = f', {count} of them with a pose' if count else ''
    say(f'{len(place_map)} of {images.read} images became places{with_pose}')
    return place_map, journal


def _source_of(arguments: argparse.Namespace) -> str:
    """Describe the images and the options: only the same are continued after an interruption."""
    options = vars(arguments) | {'input': str(Path(arguments.input).resolve())}
    # places of a journal without skipped images are also the first ones with skipping
    decisive = options.keys() - {'output', 'force', 'skip_bad_images'}
    return json.dumps({name: options[name] for name in sorted(decisive)})


def _suggest_threshold(place_map: 'Map', arguments: argparse.Namespace) -> 'float | None':
    """Return the threshold of mode paper for a map; None where the map is too short for one."""
    from stavpr_ros.errors import InputError
    from stavpr_ros.maintenance.same_places import MAX_PLACES
    from stavpr_ros.maintenance.threshold import suggest_threshold

    if len(place_map) > MAX_PLACES:
        return None  # it would take the whole map into memory
    model = getattr(arguments, f'{place_map.settings.kind}_model', None) or ''
    try:
        return suggest_threshold(place_map, model)
    except InputError:  # the node names it in mode paper; other users need no threshold
        return None


def _report(place_map: 'Map', output: str) -> None:
    from stavpr_ros.maintenance.same_places import repeats_of

    megabytes = Path(output).stat().st_size / 1e6
    shape = f'{place_map.settings.strips} strips of {place_map.dimension} dimensions'
    say(f'{output}: {len(place_map)} places, {shape}, {megabytes:.1f} MB')
    if text := repeats_of(place_map):
        say(text)


def _build_each(arguments: argparse.Namespace, args: list[str]) -> int:
    """Build a map of each input; return the exit code."""
    from stavpr_ros.features.extractor import choose_kind

    folder = Path(arguments.output)
    if folder.is_file():
        raise SettingsError(f'--output {folder} is a file: give a folder for several maps')
    folder.mkdir(parents=True, exist_ok=True)
    others = other_arguments(args, '--input')
    if arguments.features == AUTO:  # one kind, also on the machines of a cluster
        kind, choice = choose_kind()
        others += ['--features', kind]
        say(choice, sys.stderr)
    jobs = []
    for name, one in zip(job_names(arguments.input), arguments.input, strict=True):
        output = Path(f'{folder / name}.stavpr')
        options = ('--input', one, '--output', str(output), *others)
        command = 'stavpr_ros.commands.build_map'
        jobs.append(Job(name, command, options, is_new=not output.exists()))
    return run_jobs(jobs, arguments.processes, arguments.ray)


def main(args: list[str] | None = None) -> int:
    """Run the command."""
    state = 'nothing was written'

    def work() -> int | None:
        nonlocal state
        arguments = _parser().parse_args(args)
        if len(arguments.input) > 1:
            return _build_each(arguments, sys.argv[1:] if args is None else args)
        arguments.input = arguments.input[0]
        from stavpr_ros.maintenance.same_places import with_repeats
        from stavpr_ros.mapping import save_map
        from stavpr_ros.prepare.prepared_map import statistics_of_map

        state = 'nothing was written; the same command continues the work'
        place_map, journal = _build(arguments)
        place_map = with_repeats(place_map)
        place_map = replace(place_map, threshold=_suggest_threshold(place_map, arguments))
        statistics = statistics_of_map(place_map)
        save_map(place_map, arguments.output, force=arguments.force, statistics=statistics)
        journal.unlink()
        state = f'{arguments.output} is written'
        _report(place_map, arguments.output)
        return None

    return run_program('build_map', work, lambda: f'interrupted, {state}')


if __name__ == '__main__':
    sys.exit(main())
