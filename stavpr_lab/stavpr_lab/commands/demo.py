# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run stavpr_lab demo``: from two traverses to matches, numbers and plots, over ROS."""

import argparse
import fcntl
from pathlib import Path
import shutil
import sys
import time
from typing import Any, TYPE_CHECKING

from stavpr_ros.commands.program import (
    add_camera,
    add_fps,
    add_parameter,
    make_parser,
    run_program,
)
from stavpr_ros.errors import InputError, SettingsError, SourceError, StavprError
from stavpr_ros.parameters import BY_NAME, default

if TYPE_CHECKING:
    from stavpr_lab.demonstration.recordings import LoopTraverse, TraversePair
    from stavpr_ros.mapping import Map

EXCLUDE_PLACES, GEOMETRIC_CHECK = default('exclude_places'), 'sift'  # defaults with --loop
SYNTHETIC = 'synthetic'
WRITTEN = '.demo'  # lists the files of a demonstration in its folder
DRIFT = 0.7  # odometry of about 20 m after three laps

DESCRIPTION = """
Without options: renders two traverses of a synthetic street (the second at dusk in the rain, on
the other lane, at a varying speed, with a detour that is not in the map), writes two bags, builds
the map from the first, starts the node, replays the second bag into it over ROS, records the
matches in a third process, and reports and plots the result. With --map and --query: the same with
your own folders of images, videos or bags.

With --loop: one traverse that passes places again is replayed into the node in operation
loop_closure, which compares it with its own past; 'synthetic' is the synthetic street, twice.

With --slam world: three laps on a closed street with a drifting odometry; the node pose_graph
corrects it by the loop closures of the node. Requires evo (the extra slam).
"""

EPILOG = """
examples:
  demo
  demo --map monday/ --query tuesday/ --truth identity --tolerance 3
  demo --map monday.mp4 --query tuesday.mp4 --fps 3
  demo --map monday.bag --query tuesday.bag --topic /camera/image_raw --min-probability 0.8
  demo --loop synthetic
  demo --loop round/ --truth closures.png --exclude-places 100
  demo --slam world --world 3 --drift 0.06 --false-closures 0.3

exit codes: 0 done, 1 something failed (the reason is printed), 2 usage, 130 interrupted
"""


def _parser() -> argparse.ArgumentParser:
    from stavpr_lab.demonstration import FEATURES
    from stavpr_ros.commands.feature_options import add_feature_options

    parser = make_parser('demo', DESCRIPTION, EPILOG)
    add = parser.add_argument
    output = 'output folder, where the files of an earlier demo are removed (%(default)s)'
    add('--output', default='demo_output', metavar='FOLDER', help=output)
    add('--map', metavar='FOLDER|VIDEO|BAG', help='first traverse: the map is built from it')
    add('--query', metavar='FOLDER|VIDEO|BAG', help='second traverse: it is replayed')
    loop = f'a traverse that passes places again ({SYNTHETIC})'
    add('--loop', nargs='?', const=SYNTHETIC, metavar='FOLDER|VIDEO|BAG|synthetic', help=loop)
    add('--slam', choices=('world',), help='three laps with a drifting odometry, and a pose graph')
    add('--topic', help='image topic of the bags, if they have several')
    add_camera(parser)
    add_fps(parser)
    truth = (
        'identity: image i of the query shows place i of the map; with --loop a FILE: pairs of '
        'images (.csv), or a square array (.npy) or black and white image of loop closures'
    )
    add('--truth', metavar='identity|FILE', help=truth)
    tolerance = 'places that a correct match may be off (%(default)s)'
    add('--tolerance', type=int, default=3, help=tolerance)
    add_parameter(parser, 'sequence_length', 'images in the window (%(default)s)', metavar='L')
    add_parameter(parser, 'mode', 'mode of the node (%(default)s)')
    probability = 'probability above which the node accepts a match (%(default)g)'
    add_parameter(parser, 'min_probability', probability, metavar='P')
    limit = 'limit of the node in mode paper (estimated from the first traverse)'
    add('--threshold', type=float, metavar='DISTANCE', help=limit)
    exclude = f'with --loop: the latest N places are not compared ({EXCLUDE_PLACES})'
    add('--exclude-places', type=int, metavar='N', help=exclude)
    check = f'with --loop: verification of matches by keypoints ({GEOMETRIC_CHECK})'
    checks = BY_NAME['geometric_check'].choices
    add('--geometric-check', choices=checks, help=check)
    add = parser.add_argument_group('options of --slam').add_argument
    add('--world', type=int, default=7, metavar='SEED', help='seed of the world (%(default)s)')
    add('--draw', type=int, default=0, help='seed of the errors of the odometry (%(default)s)')
    drift = 'factor on the errors of the odometry; 0.06: 2 m after three laps (%(default)s)'
    add('--drift', type=float, default=DRIFT, metavar='F', help=drift)
    wrong = 'share of loop closures that are made wrong (%(default)g)'
    add('--false-closures', type=float, default=0.0, metavar='P', help=wrong)
    add('--coherent', action='store_true', help='they are wrong in runs of 20 that agree')
    carried = 'the robot is carried over 60 images of lap 2, which the odometry misses'
    add('--carried', action='store_true', help=carried)
    sessions = '2: lap 3 is on the next day, its odometry starts anew'
    add('--sessions', type=int, default=1, choices=(1, 2), help=sessions)
    add_feature_options(parser)
    parser.set_defaults(features=FEATURES)
    return parser


def _check(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """Reject options that contradict each other."""
    _check_limits(parser, arguments)
    for name, minimum in (('tolerance', 0), ('exclude_places', 1), ('sequence_length', 2)):
        value = getattr(arguments, name)
        if value is not None and value < minimum:
            parser.error(f'--{name.replace("_", "-")} {value} must be at least {minimum}')
    truth = arguments.truth
    if arguments.slam is not None:
        _check_slam(parser, arguments)
        return
    if arguments.loop is not None:
        if arguments.map or arguments.query:
            parser.error('--loop is one traverse: leave --map and --query out')
        if truth == 'identity' or (truth and arguments.loop == SYNTHETIC):
            parser.error('--loop FOLDER takes a file as --truth; the synthetic street has its own')
        if arguments.mode == 'paper' and arguments.threshold is None:
            parser.error('--loop in mode paper needs --threshold')
        return
    if arguments.exclude_places is not None or arguments.geometric_check is not None:
        parser.error('--exclude-places and --geometric-check go with --loop')
    if (arguments.map is None) != (arguments.query is None):
        parser.error('--map and --query go together')
    if truth and arguments.map is None:
        parser.error('--truth goes with --map and --query')
    if truth not in (None, 'identity'):
        parser.error(f'--truth {truth}: expected identity; files are for --loop, and for evaluate')


def _check_slam(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    if arguments.loop or arguments.map or arguments.query or arguments.truth:
        parser.error('--slam has its own drive: leave --loop, --map, --query and --truth out')
    if not 0 <= arguments.false_closures <= 1:
        parser.error(f'--false-closures {arguments.false_closures} must be 0 to 1')
    if not 0 < arguments.drift <= 2:
        parser.error(f'--drift {arguments.drift} must be above 0 and at most 2')


def _check_limits(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    probability, threshold = arguments.min_probability, arguments.threshold
    if not 0 < probability < 1:
        parser.error(f'--min-probability {probability} must be above 0 and below 1')
    if threshold is None:
        return
    if arguments.mode != 'paper':
        parser.error('--threshold applies to mode paper: give --min-probability in mode robust')
    if not threshold > 0:
        parser.error(f'--threshold {threshold} must be above 0')


def _print(text: object) -> None:
    print(text, flush=True)


def _skip(error: StavprError) -> None:
    _print(f'   skipped: {error}')


def _require_all(place_map: 'Map', images: int) -> None:
    """Reject a ground truth by number where images were skipped."""
    if len(place_map) != images:
        raise SourceError(
            'images were skipped: the ground truth of the others is unknown; repair or remove them'
        )


def _run(arguments: argparse.Namespace) -> None:
    began = time.monotonic()
    folder = Path(arguments.output)
    for name in ('map', 'query', 'loop', 'truth'):
        input_path = getattr(arguments, name)
        if input_path and folder.resolve() in Path(input_path).resolve().parents:
            raise SettingsError(f'--{name} {input_path} is in {folder}: give another --output')
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = (folder / WRITTEN).open('a')
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        _remove_earlier(folder)
        others = set(folder.iterdir())
    except BlockingIOError as error:
        raise SettingsError(f'another demo writes to {folder}: give another --output') from error
    except OSError as error:
        raise SourceError(f'folder {folder} cannot be made or emptied: {error}') from error
    try:
        if arguments.slam is not None:
            _slam(arguments, folder)
        elif arguments.loop is None:
            _localization(arguments, folder)
        else:
            _loop_closure(arguments, folder)
    finally:
        names = sorted(path.name for path in set(folder.iterdir()) - others)
        (folder / WRITTEN).write_text('\n'.join(names))
        lock.close()
    _print(f'   {time.monotonic() - began:.0f} s in all')


def _remove_earlier(folder: Path) -> None:
    """Remove the files of an earlier demonstration, which it has listed, and no others."""
    manifest = folder / WRITTEN
    names = manifest.read_text().splitlines() if manifest.exists() else []
    for path in [path for path in folder.iterdir() if path.name in names]:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


def _traverse_pair(arguments: argparse.Namespace, folder: Path) -> 'TraversePair':
    from stavpr_lab.demonstration.recordings import own_pair, own_recordings, synthetic_pair

    if not arguments.map:
        _print('1. Two traverses of a synthetic street')
        return synthetic_pair(folder)
    _print(f'1. Your traverses: {arguments.map} is the map, {arguments.query} the query')
    identity = arguments.truth == 'identity'
    length = arguments.sequence_length
    paths = [arguments.map, arguments.query]
    reference, query = own_recordings(paths, arguments.topic, arguments.fps, arguments.camera)
    return own_pair(reference, query, identity, length)


def _limit(arguments: argparse.Namespace, threshold: float | None) -> dict[str, object]:
    """Return the node's parameters that limit matches."""
    if arguments.mode == 'robust':
        return {'mode': 'robust', 'min_probability': arguments.min_probability}
    return {'mode': 'paper', 'threshold': threshold}


def _threshold(place_map: 'Map', arguments: argparse.Namespace) -> float:
    """Return the distance below which a window is matched."""
    from stavpr_ros.maintenance.threshold import suggest_threshold

    if arguments.mode == 'robust':
        return 1 - arguments.min_probability
    if arguments.threshold is not None:
        return arguments.threshold
    try:
        threshold = suggest_threshold(place_map)
    except InputError as error:
        raise SettingsError(f'{error}; give --threshold') from error
    _print(f'   threshold {threshold:.3f}, estimated from the first traverse')
    return threshold


def _localization(arguments: argparse.Namespace, folder: Path) -> None:
    """Recognize the second traverse on a map of the first."""
    from stavpr_lab.demonstration.live import run_live
    from stavpr_lab.demonstration.plots import draw_result
    from stavpr_lab.evaluation.records import evaluate_records
    from stavpr_ros.commands.feature_options import make_extractor
    from stavpr_ros.maintenance.same_places import with_repeats
    from stavpr_ros.mapping import build_map, save_map

    pair = _traverse_pair(arguments, folder)
    length, map_path = arguments.sequence_length, folder / 'map.stavpr'
    _print(f'2. The map of the first traverse: {map_path}')
    place_map = with_repeats(build_map(pair.reference.open(_skip), make_extractor(arguments)))
    save_map(place_map, map_path, force=True)
    threshold = _threshold(place_map, arguments)

    _print('3. The second traverse through the node, over ROS, with a replay and a recorder')
    query = build_map(pair.query.open(_skip), place_map.extractor())
    if pair.true_places is not None:
        _require_all(query, len(pair.true_places))
    parameters = {
        'map_path': map_path,
        **_limit(arguments, threshold),
        'sequence_length': length,
        'keyframe_change': 0.0,  # every image is evaluated
    }
    records, _ = run_live(parameters, pair.query, len(query), folder)
    result = evaluate_records(records, length, threshold, pair.true_places, arguments.tolerance)
    plot = folder / 'demo.png'
    draw_result(result, query, place_map, threshold, pair.title, plot)
    _report('4', result.summary(), plot)


def _loop_traverse(arguments: argparse.Namespace, folder: Path, exclude: int) -> 'LoopTraverse':
    from stavpr_lab.demonstration.recordings import own_loop, own_recordings, synthetic_loop

    tolerance = arguments.tolerance
    if arguments.loop == SYNTHETIC:
        _print('1. One traverse twice along a synthetic street, then on the other lane and with '
               'a detour')  # fmt: skip
        return synthetic_loop(folder, exclude, tolerance)
    _print(f'1. Your traverse: {arguments.loop}')
    options = arguments.topic, arguments.fps, arguments.camera
    (recording,) = own_recordings([arguments.loop], *options)
    return own_loop(recording, arguments.truth, exclude, tolerance)


def _loop_closure(arguments: argparse.Namespace, folder: Path) -> None:
    """Find the loop closures of one traverse."""
    from stavpr_lab.demonstration.live import run_live
    from stavpr_lab.demonstration.loops import draw_loops, read_result
    from stavpr_ros.commands.feature_options import make_extractor
    from stavpr_ros.mapping import build_map

    exclude = arguments.exclude_places or EXCLUDE_PLACES
    length = arguments.sequence_length
    traverse = _loop_traverse(arguments, folder, exclude)
    recording = traverse.recording
    if exclude + length >= traverse.N:
        raise SettingsError(
            f'{recording.path} has {traverse.N} images: --exclude-places {exclude} leaves no '
            f'window of {length}'
        )
    extractor = make_extractor(arguments)
    place_map = build_map(recording.open(_skip), extractor)
    if traverse.ground_truth is not None:
        _require_all(place_map, traverse.N)
    features = folder / 'features.stavpr'
    recording.save_feature_settings(extractor, features)

    _print('2. The traverse through the node, over ROS, with a replay and recorders')
    parameters = {
        'operation': 'loop_closure',
        'map_path': features,
        **_limit(arguments, arguments.threshold),
        'sequence_length': length,
        'exclude_places': exclude,
        'geometric_check': arguments.geometric_check or GEOMETRIC_CHECK,
    }
    matches, closures = run_live(parameters, recording, len(place_map), folder)
    result = read_result(matches, closures, traverse.ground_truth, exclude)
    _report('3', result.summary(), draw_loops(result, place_map, traverse.title, folder))


def _slam(arguments: argparse.Namespace, folder: Path) -> None:
    """Correct the odometry of three laps by loop closures."""
    from stavpr_lab.demonstration import slam
    from stavpr_lab.demonstration.graph_client import fetch_graph
    from stavpr_lab.demonstration.live import executable, run_live
    from stavpr_lab.demonstration.recordings import Recording, TOPIC
    from stavpr_lab.demonstration.street.laps import CAMERA_IN_BASE, drive_laps
    from stavpr_ros.commands.feature_options import make_extractor

    slam.require_evo()
    _print('1. Three laps of a synthetic street, with a drifting odometry')
    drive = drive_laps(
        arguments.world, arguments.draw, arguments.drift, arguments.carried, arguments.sessions
    )
    bag, features = folder / 'laps', folder / 'features.stavpr'
    slam.write_drive(drive, bag)
    recording = Recording(str(bag), TOPIC)
    recording.save_feature_settings(make_extractor(arguments), features)

    _print('2. The drive through node and pose_graph, over ROS, with a replay and recorders')
    topic = 'stavpr/loop_closure'
    others = {}
    if arguments.false_closures:
        topic = 'false_closures/loop_closure'
        relay = [sys.executable, '-m', 'stavpr_lab.demonstration.false_closures']
        relay += ['--share', str(arguments.false_closures), '--seed', str(arguments.world)]
        others['false_closures'] = relay + ['--coherent'] * arguments.coherent
    graph = {'maps_folder': folder.absolute(), 'loop_closure_topics': [topic]}
    others['pose_graph'] = [
        executable('pose_graph', 'stavpr_slam'), '--ros-args',
        *(word for name, value in graph.items() for word in ('-p', f'{name}:={value}')),
    ]  # fmt: skip
    parameters = {
        'operation': 'loop_closure',
        'map_path': features,
        **_limit(arguments, arguments.threshold),
        'sequence_length': arguments.sequence_length,
        'keyframe_change': 0.0,
        'camera_transform': ' '.join(f'{value:g}' for value in CAMERA_IN_BASE),
    }
    result: list[Any] = []

    def fetch(closures: list[dict[str, Any]]) -> None:
        result.append(fetch_graph(['graph.g2o', 'optimized.tum'], len(closures)))

    run_live(
        parameters, recording, len(drive), folder, others,
        ['--odometry', '--also', slam.CAMERA_INFO, '--timeout', '120'], fetch,
    )  # fmt: skip
    values, edges = result[0]
    evaluation = slam.evaluate_drive(drive, folder / 'optimized.tum', values)
    _report('3', evaluation.summary(), slam.write_result(evaluation, drive, edges, folder))


def _report(number: str, summary: str, plot: Path) -> None:
    _print(f'\n{number}. Result')
    for line in summary.splitlines():
        _print(f'   {line}')
    _print(f'   plots and records are in {plot.parent}/; start with {plot}')


def main(args: list[str] | None = None) -> int:
    """Run the command."""

    def work() -> None:
        parser = _parser()
        arguments = parser.parse_args(args)
        _check(parser, arguments)
        _run(arguments)

    return run_program('demo', work)


if __name__ == '__main__':
    sys.exit(main())
