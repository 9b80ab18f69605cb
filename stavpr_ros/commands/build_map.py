"""``ros2 run stavpr_ros build_map``: make a reference map from a folder of images or a bag."""

import argparse
import sys
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from stavpr_ros.errors import ImageError, SettingsError, SourceError, StavprError
from stavpr_ros.signals import obey_signals
from stavpr_ros.threads import wait_passively

if TYPE_CHECKING:
    from stavpr_ros.mapping import PlaceMap

EPILOG = """
examples:
  build_map --input drive/ --output route.stavpr
  build_map --input drive.bag --topic /camera/image_raw --output route.stavpr
  build_map --input drive/ --output route.stavpr --projection 512 --features onnx \\
      --onnx-model squeezenet.onnx --onnx-layer fire6/concat_1

exit codes: 0 the map is written; 1 it is not (the reason is printed, a map that was there is untouched);
2 usage
"""


def _parser() -> argparse.ArgumentParser:
    from stavpr_ros.commands.feature_options import add_feature_options

    parser = argparse.ArgumentParser(
        prog='build_map',
        description='Make a reference map: one place for each image, in the order of the route.',
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        '--input', required=True, metavar='FOLDER|BAG', help='images, or a ROS 1 or ROS 2 bag'
    )
    parser.add_argument('--output', required=True, metavar='MAP', help='the file to write')
    parser.add_argument('--topic', help='image topic of the bag, if it has several')
    parser.add_argument(
        '--every', type=int, default=1, metavar='N', help='take every N-th image (%(default)s)'
    )
    parser.add_argument(
        '--poses', metavar='CSV', help='one line an image: x,y,z or x,y,z,qx,qy,qz,qw (metres, quaternion)'
    )
    parser.add_argument('--no-thumbnails', action='store_true', help='keep no small pictures of the places')
    parser.add_argument(
        '--skip-bad-images', action='store_true', help='go on after an image that cannot be read'
    )
    add_feature_options(parser)
    return parser


def _build(arguments: argparse.Namespace) -> 'PlaceMap':
    from stavpr_ros.commands.feature_options import make_describer
    from stavpr_ros.evaluation.truth_files import read_poses
    from stavpr_ros.mapping import build_map, save_map
    from stavpr_ros.sources import open_source

    skipped = []

    def skip(error: ImageError) -> None:
        skipped.append(error)
        print(f'skipped: {error}', file=sys.stderr)

    if arguments.every < 1:
        raise SettingsError(f'--every {arguments.every} must be at least 1')
    if arguments.poses and arguments.skip_bad_images:
        raise SettingsError('--poses and --skip-bad-images: a skipped image would shift the poses; give one')
    if not Path(arguments.output).absolute().parent.is_dir():
        raise SourceError(f'the folder of {arguments.output} does not exist: make it first')
    describer = make_describer(arguments)
    source = open_source(arguments.input, arguments.topic, skip if arguments.skip_bad_images else None)
    frames = source if arguments.every == 1 else islice(source, 0, None, arguments.every)
    poses = None
    if arguments.poses:
        poses, _ = read_poses(Path(arguments.poses))
        if len(poses) != len(source):
            raise SourceError(
                f'poses {arguments.poses} has {len(poses)} lines for {len(source)} images: give one each'
            )
        poses = poses[:: arguments.every]
    place_map = build_map(frames, describer, poses, thumbnails=not arguments.no_thumbnails)
    save_map(place_map, arguments.output)
    if skipped:
        print(f'{len(skipped)} images skipped', file=sys.stderr)
    return place_map


def _report(place_map: 'PlaceMap', output: str) -> None:
    from stavpr_ros.errors import InputError
    from stavpr_ros.evaluation.threshold import suggest_threshold

    megabytes = Path(output).stat().st_size / 1e6
    strips = place_map.features.strips
    shape = f'{strips.shape[0]} strips of {strips.shape[2]} dimensions'
    print(f'{output}: {len(place_map)} places, {shape}, {megabytes:.1f} MB')
    try:
        suggestion = suggest_threshold(place_map, progress=True)
    except InputError as error:
        print(f'no threshold is suggested for mode paper: {error}')
        return
    print(f'threshold to start with in mode paper: {suggestion.threshold:.3f} (mode robust needs none)')


def main(args: list[str] | None = None) -> int:
    """Run the command."""
    obey_signals()
    wait_passively()
    arguments = _parser().parse_args(args)
    try:
        place_map = _build(arguments)
        _report(place_map, arguments.output)
    except StavprError as error:
        print(f'build_map: {error}', file=sys.stderr)
        return 2 if isinstance(error, SettingsError) else 1
    except KeyboardInterrupt:
        print('build_map: interrupted, nothing was written', file=sys.stderr)
        return 130
    return 0


if __name__ == '__main__':
    sys.exit(main())
