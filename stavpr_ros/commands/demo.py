"""``ros2 run stavpr_ros demo``: the whole way once, from two drives to matches, numbers and a picture."""

import argparse
import shutil
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stavpr_ros.errors import InputError, SettingsError, SourceError, StavprError
from stavpr_ros.signals import obey_signals
from stavpr_ros.threads import wait_passively

if TYPE_CHECKING:
    import numpy as np

    from stavpr_ros.demonstration.street import Drive
    from stavpr_ros.evaluation.records import TraverseEvaluation
    from stavpr_ros.features import FeatureExtractor
    from stavpr_ros.mapping import PlaceMap

TOPIC = '/camera/image_raw'
EXCLUDE, CHECK = 50, 'sift'  # of --loop, unless told otherwise

DESCRIPTION = """
Without options: makes a street, drives along it twice (the second time at dusk in the rain, from the other
lane, at another and varying speed, with a detour that the map has never seen), writes two bags, builds the
map from the first, starts the node, replays the second bag into it over ROS, listens from a third process,
and tells and draws what came out. With --map and --query: the same with your own folders of images or bags.

With --loop: one drive that comes back to where it was is replayed into the node in operation loop_closure,
which compares it with its own past; --loop without a value drives twice along a made-up street.
"""

EPILOG = """
examples:
  demo
  demo --map monday/ --query tuesday/ --truth identity --tolerance 3
  demo --map monday.bag --query tuesday.bag --topic /camera/image_raw --threshold 0.2
  demo --loop
  demo --loop round/ --truth closures.png --exclude 100

exit codes: 0 done, 1 something failed (the reason is printed), 2 usage, 130 interrupted
"""


@dataclass(frozen=True)
class Drives:
    """
    What the map is made from and what is replayed.

    :param topics: image topics of both; None where there is one only, or no bag.
    :param truth: true place of each query image, -1 = not in the map; None = unknown.
    """

    reference: str
    query: str
    topics: tuple[str | None, str | None]
    truth: 'np.ndarray | None'
    title: str


def _parser() -> argparse.ArgumentParser:
    from stavpr_ros.commands.feature_options import add_feature_options

    parser = argparse.ArgumentParser(
        prog='demo',
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        '--output', default='demo_output', metavar='FOLDER', help='where all is written (%(default)s)'
    )
    parser.add_argument('--map', metavar='FOLDER|BAG', help='first drive: the map is made from it')
    parser.add_argument('--query', metavar='FOLDER|BAG', help='second drive: it is replayed')
    parser.add_argument(
        '--loop', nargs='?', const='', metavar='FOLDER|BAG', help='a drive that closes loops; see above'
    )
    parser.add_argument(
        '--exclude',
        type=int,
        metavar='N',
        help=f'with --loop: the latest N images are not compared ({EXCLUDE})',
    )
    parser.add_argument(
        '--check',
        choices=('none', 'orb', 'sift'),
        help=f'with --loop: geometric check of the matches, by keypoints ({CHECK})',
    )
    parser.add_argument('--topic', help='image topic of the bags, if they have several')
    parser.add_argument(
        '--truth',
        metavar='identity|FILE',
        help='identity: image i of the query was taken at image i of the map; with --loop a FILE: pairs of '
        'images (.csv), or a square array (.npy) or black and white image of loop closures',
    )
    parser.add_argument(
        '--tolerance', type=int, default=3, help='places that a right match may be off (%(default)s)'
    )
    parser.add_argument(
        '--sequence-length', type=int, default=20, metavar='L', help='images in the window (%(default)s)'
    )
    parser.add_argument('--mode', default='robust', choices=('paper', 'robust'), help='of the node (robust)')
    parser.add_argument(
        '--threshold',
        type=float,
        help='of the node (robust: 1, with --loop 0.8; paper: found from the first drive alone)',
    )
    parser.add_argument(
        '--world-seed', type=int, default=7, help='another number, another street (%(default)s)'
    )
    add_feature_options(parser)
    return parser


def say(text: str) -> None:
    """Print a line at once."""
    print(text, flush=True)


def image_records(drive: 'Drive', name: str, epoch: int | None = None) -> Iterator[Any]:
    """
    Render a made-up drive.

    :param epoch: stamp of its first image, ns; None = the drive's own.
    """
    from tqdm import tqdm

    from stavpr_ros.sources.frame import ImageRecord

    later = 0 if epoch is None else epoch - int(drive.stamps[0])
    for frame in tqdm(drive, desc=name, unit='image', disable=None):
        yield ImageRecord.of_image(frame.image, frame.stamp + later, frame_id='camera')


def make_room(bag: Path) -> None:
    """
    Remove the bag that an earlier demonstration wrote.

    :raises SourceError: something else is there; it is left alone.
    """
    from stavpr_ros.sources.bag_file import METADATA

    try:
        if {file.name for file in bag.iterdir()} <= {METADATA, f'{bag.name}.db3'}:
            shutil.rmtree(bag)
            return
    except FileNotFoundError:
        return
    except OSError as error:
        raise SourceError(f'{bag} cannot be replaced: {error}; choose another --output') from error
    raise SourceError(
        f'{bag} is there already and no bag of an earlier demo: it is left alone; choose another --output'
    )


def _make_world(folder: Path, seed: int) -> Drives:
    """Drive twice through a made-up street and write a bag of each drive."""
    from stavpr_ros.demonstration.street import World, first_drive, ground_truth, second_drive
    from stavpr_ros.sources.bag_writer import write_bag

    say('1. Two drives through a made-up street')
    bags = folder / 'first_drive', folder / 'second_drive'
    for bag in bags:
        make_room(bag)
    world = World(seed)
    first, second = first_drive(world), second_drive(world)
    for drive, bag in zip((first, second), bags, strict=True):
        write_bag(bag, TOPIC, image_records(drive, bag.name.replace('_', ' ')))
    title = 'A made-up street, by day and in the rain at dusk'
    return Drives(str(bags[0]), str(bags[1]), (TOPIC, TOPIC), ground_truth(first, second), title)


def _users_drives(arguments: argparse.Namespace) -> Drives:
    import numpy as np

    from stavpr_ros.sources import open_source
    from stavpr_ros.sources.bag_file import is_bag

    say(f'1. Your drives: {arguments.map} is the map, {arguments.query} the query')
    paths = arguments.map, arguments.query
    first, second = (arguments.topic if is_bag(Path(path)) else None for path in paths)
    places, images = len(open_source(arguments.map, first)), len(open_source(arguments.query, second))
    if arguments.topic is not None and first is second is None:
        raise SettingsError(f'--topic {arguments.topic}: neither drive is a bag; leave it out')
    length = arguments.sequence_length
    if images < length:
        raise SettingsError(f'{arguments.query} has {images} images: the window alone needs {length}')
    truth = None
    if arguments.truth == 'identity':
        if images > places:
            raise SettingsError(f'--truth identity: {images} query images on a map of {places} places')
        truth = np.arange(images)
    title = f'{Path(arguments.query).name} recognized on the map of {Path(arguments.map).name}'
    return Drives(*paths, (first, second), truth, title)


def extract_map(path: str, topic: str | None, extractor: 'FeatureExtractor') -> 'PlaceMap':
    """Describe a drive; images that cannot be read are said and skipped, as the replay does."""
    from stavpr_ros.mapping import build_map
    from stavpr_ros.sources import open_source

    return build_map(open_source(path, topic, lambda error: say(f'   skipped: {error}')), extractor)


def _choose_threshold(place_map: 'PlaceMap', mode: str, given: float | None) -> float:
    from stavpr_ros.recognition.robust.options import THRESHOLD
    from stavpr_ros.recognition.threshold import suggest_threshold

    if given is not None:
        return given
    if mode == 'robust':
        return THRESHOLD
    try:
        threshold = suggest_threshold(place_map, progress=True).threshold
    except InputError as error:
        raise SettingsError(f'{error}; give --threshold') from error
    say(f'   threshold {threshold:.3f}, from the first drive alone')
    return threshold


def _tell(result: 'TraverseEvaluation', folder: Path) -> None:
    say('\n4. What came out')
    for line in result.summary().splitlines():
        say(f'   {line}')
    say(f'   pictures and records are in {folder}/; look at {folder / "demo.png"}')


def _run(arguments: argparse.Namespace) -> None:
    """Do what is asked for, in a folder."""
    began = time.monotonic()
    folder = Path(arguments.output)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SourceError(f'folder {folder} cannot be made: {error}') from error
    if arguments.loop is None:
        _two_drives(arguments, folder)
    else:
        from stavpr_ros.commands.loop_demo import close_loops

        close_loops(arguments, folder)
    say(f'   {time.monotonic() - began:.0f} s in all')


def _two_drives(arguments: argparse.Namespace, folder: Path) -> None:
    from stavpr_ros.commands.feature_options import make_extractor
    from stavpr_ros.demonstration.plots import draw_result
    from stavpr_ros.evaluation.records import evaluate_records
    from stavpr_ros.mapping import save_map
    from stavpr_ros.ros.live import run_live

    drives = _users_drives(arguments) if arguments.map else _make_world(folder, arguments.world_seed)

    map_path = folder / 'map.stavpr'
    say(f'2. The map of the first drive: {map_path}')
    place_map = extract_map(drives.reference, drives.topics[0], make_extractor(arguments))
    save_map(place_map, map_path)
    threshold = _choose_threshold(place_map, arguments.mode, arguments.threshold)

    say('3. The second drive through the node, over ROS, with replay and listener as processes of their own')
    query = extract_map(drives.query, drives.topics[1], place_map.extractor())
    if drives.truth is not None and len(query) != len(drives.truth):
        raise SourceError('images were skipped: the truth of the others is not known; repair or remove them')
    parameters = {
        'map_path': map_path,
        'mode': arguments.mode,
        'threshold': threshold,
        'sequence_length': arguments.sequence_length,
        'keyframe_change': 0.0,  # every image is judged
    }
    records = run_live(parameters, drives.query, len(query), folder, drives.topics[1])
    result = evaluate_records(records, arguments.sequence_length, threshold, drives.truth, arguments.tolerance)
    draw_result(result, query, place_map, threshold, drives.title, folder)
    _tell(result, folder)


def _refuse_wrong_usage(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    if arguments.threshold is not None and not arguments.threshold > 0:
        parser.error(f'--threshold {arguments.threshold} must be above 0')
    for name, least in (('tolerance', 0), ('exclude', 1), ('sequence_length', 2)):
        value = getattr(arguments, name)
        if value is not None and value < least:
            parser.error(f'--{name.replace("_", "-")} {value} must be at least {least}')
    if arguments.loop is not None:
        if arguments.map or arguments.query:
            parser.error('--loop is one drive: leave --map and --query out')
        if arguments.truth == 'identity' or (arguments.truth and not arguments.loop):
            parser.error('--loop FOLDER takes a file as --truth; the made-up street knows its own')
        if arguments.mode == 'paper' and arguments.threshold is None:
            parser.error('--loop in mode paper needs --threshold')
        return
    if arguments.exclude is not None or arguments.check is not None:
        parser.error('--exclude and --check go with --loop')
    if (arguments.map is None) != (arguments.query is None):
        parser.error('--map and --query go together')
    if arguments.truth and arguments.map is None:
        parser.error('--truth goes with --map and --query: the made-up street knows its own')
    if arguments.truth not in (None, 'identity'):
        parser.error(f'--truth {arguments.truth}: expected identity; files are for --loop, and for evaluate')


def main(args: list[str] | None = None) -> int:
    """Run the command."""
    obey_signals()
    wait_passively()
    try:
        parser = _parser()
        arguments = parser.parse_args(args)
        _refuse_wrong_usage(parser, arguments)
        _run(arguments)
    except StavprError as error:
        print(f'demo: {error}', file=sys.stderr)
        return 2 if isinstance(error, SettingsError) else 1
    except KeyboardInterrupt:
        print('demo: interrupted', file=sys.stderr)
        return 130
    return 0


if __name__ == '__main__':
    sys.exit(main())
