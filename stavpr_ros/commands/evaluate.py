"""``ros2 run stavpr_ros evaluate``: how well a second drive is recognized on the map of a first one."""

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stavpr_ros.errors import SettingsError, SourceError, StavprError
from stavpr_ros.output_file import require_room
from stavpr_ros.signals import obey_signals
from stavpr_ros.threads import wait_passively

if TYPE_CHECKING:
    from stavpr_ros.commands.evaluate_sequences import Drives
    from stavpr_ros.evaluation.evaluate import Evaluation
    from stavpr_ros.evaluation.report import Report
    from stavpr_ros.recognition import RecognizerSettings

OUTPUT = 'evaluation_output'
WARPS = ('2x', '1.5x', '0.7x', '0.5x', 'vary', 'stop')

DESCRIPTION = """
Recognizes a second drive on the map of a first one, image by image as the node does it, and compares the
answers with the truth: precision over recall, F1, average precision, recall@k, recall at 100 % precision,
false alarms; for sequences and for single images. Writes JSON, CSV, pictures and a page of HTML.
"""

EPILOG = """
the truth:
  identity     image i of the query was taken at image i of the map (the default); --tolerance is 3 then
  poses        places within --meters and --degrees of the query's pose
  FILE         .csv: accepted pairs, query,place, from 0; .npy, .npz: a square array of loop closures, pairs,
               or a place a query; an image: white at row i, column j accepts place j for query i;
               --tolerance is 0 then

examples:
  evaluate --map summer/ --query winter/
  evaluate --map route.stavpr --query tuesday.bag --truth pairs.csv --mode robust --json result.json
  evaluate --map summer/ --query winter/ --crop-map 0.3 --crop-query 0.1 --warp vary
  evaluate --map monday/ --query tuesday/ --unknown another_town/ --output report/
  evaluate --query loop/ --loop-closure 50 --truth closures.png
  evaluate --dataset gardens_point=data/gardens_point --spatial vanilla

exit codes: 0 done, 1 something failed (the reason is printed), 2 usage, 130 interrupted
"""


def _parser() -> argparse.ArgumentParser:
    from stavpr_ros.commands.feature_options import add_feature_options

    parser = argparse.ArgumentParser(
        prog='evaluate',
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    drives = parser.add_argument_group('drives')
    drives.add_argument('--map', metavar='FOLDER|BAG|MAP', help='first drive: images, a bag or a saved map')
    drives.add_argument('--query', metavar='FOLDER|BAG|MAP', help='second drive: the same')
    drives.add_argument('--dataset', metavar='NAME=FOLDER', help='map, query, truth of a known data set')
    drives.add_argument('--topic', help='image topic of the bags, if they have several')
    drives.add_argument('--unknown', metavar='FOLDER|BAG|MAP', help='a drive elsewhere: for false alarms')
    drives.add_argument(
        '--loop-closure', type=int, metavar='N', help="the map is the query's past without its last N images"
    )
    drives.add_argument('--warp', choices=WARPS, help="change the query's speed")
    for name, side in (('map', 'right'), ('query', 'left')):
        drives.add_argument(
            f'--crop-{name}', type=float, default=0.0, metavar='X',
            help=f'cut this share off the {side} of every image of the {name} (%(default)g)',
        )  # fmt: skip
    _add_truth_options(parser)
    _add_method_options(parser)
    output = parser.add_argument_group('output')
    output.add_argument('--json', metavar='FILE', help='write the numbers')
    output.add_argument(
        '--output', metavar='FOLDER', help=f'write everything ({OUTPUT} if there is no --json either)'
    )
    output.add_argument('--window', type=int, metavar='I', help='draw the warping path around query image I')
    add_feature_options(parser)
    return parser


def _add_truth_options(parser: argparse.ArgumentParser) -> None:
    truth = parser.add_argument_group('truth')
    truth.add_argument('--truth', default='identity', metavar='identity|poses|FILE', help='see below')
    truth.add_argument('--tolerance', type=int, metavar='T', help='places that a right match may be off')
    truth.add_argument('--query-poses', metavar='CSV', help='x,y,z[,qx,qy,qz,qw] of every query image')
    truth.add_argument('--map-poses', metavar='CSV', help="the same of every place (those of the map's file)")
    truth.add_argument('--meters', type=float, default=5.0, help='with poses (%(default)g)')
    truth.add_argument('--degrees', type=float, help='with poses that have orientations (any)')


def _add_method_options(parser: argparse.ArgumentParser) -> None:
    from stavpr_ros.alignment.settings import STRATEGIES

    method = parser.add_argument_group('method')
    method.add_argument(
        '--mode', choices=('paper', 'robust'), default='paper',
        help='paper: as published; robust: also against hub places and other speeds (%(default)s)',
    )  # fmt: skip
    method.add_argument(
        '--length', type=int, default=20, metavar='L', help='images in a window (%(default)s)'
    )
    method.add_argument('--beta', type=float, default=2.0, help='places per image of a window (%(default)g)')
    method.add_argument(
        '--spatial', choices=STRATEGIES, default='adaptive', help='how two images are compared (%(default)s)'
    )
    method.add_argument('--sigma', type=float, default=1.0, help='of the adaptive weight (%(default)g)')
    method.add_argument('--xi', type=int, help='restricted alignment of strips (none)')
    method.add_argument(
        '--vertical', action='store_true', help='align the cells of two strips from top to bottom first'
    )
    method.add_argument('--backend', choices=('auto', 'cpu', 'cuda'), default='cpu', help='(%(default)s)')
    method.add_argument(
        '--precision', choices=('float32', 'float16'), default='float32', help='of the map (%(default)s)'
    )


def _check(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """Refuse options that do not go together."""
    loop, dataset = arguments.loop_closure is not None, arguments.dataset is not None
    if dataset and (arguments.map or arguments.query or arguments.truth != 'identity' or loop):
        parser.error(
            '--dataset brings map, query and truth: leave --map, --query, --truth, --loop-closure out'
        )
    if not dataset and arguments.query is None:
        parser.error('--query is needed')
    if not dataset and (arguments.map is None) != loop:
        parser.error('give --map or, for the query on its own past, --loop-closure')
    if loop and (arguments.warp or arguments.unknown):
        parser.error('--loop-closure: --warp and --unknown need a --map')
    cuda = arguments.backend != 'cpu' or arguments.precision != 'float32'
    if loop and (cuda or arguments.crop_map or arguments.map_poses):
        parser.error(
            '--loop-closure is computed on the CPU, in float32, on the query alone: leave --backend, '
            '--precision, --crop-map and --map-poses out'
        )
    if loop and arguments.truth == 'identity':
        parser.error('--loop-closure needs --truth FILE or poses')
    if loop and arguments.loop_closure < 1:
        parser.error(f'--loop-closure {arguments.loop_closure} must be at least 1')
    if arguments.tolerance is not None and arguments.tolerance < 0:
        parser.error(f'--tolerance {arguments.tolerance} must be at least 0')
    if arguments.truth != 'poses' and (arguments.query_poses or arguments.map_poses):
        parser.error('--query-poses and --map-poses go with --truth poses')


def recognition_settings(arguments: argparse.Namespace) -> 'RecognizerSettings':
    """
    Return the settings that the parsed options ask for; the threshold decides nothing here.

    :raises SettingsError: one is out of its range.
    """
    from stavpr_ros.alignment import SequenceSettings, SpatialSettings
    from stavpr_ros.recognition import RecognizerSettings

    return RecognizerSettings(
        threshold=1.0,
        spatial=SpatialSettings(arguments.spatial, arguments.sigma, arguments.xi, arguments.vertical),
        sequence=SequenceSettings(arguments.length, arguments.beta),
        mode=arguments.mode,
    )


def _default_threshold(mode: str) -> float | None:
    """Return the threshold that a mode has of its own; the paper publishes none."""
    from stavpr_ros.recognition.robust.options import THRESHOLD

    return THRESHOLD if mode == 'robust' else None


def _evaluate(
    arguments: argparse.Namespace, drives: 'Drives', settings: 'RecognizerSettings'
) -> 'Evaluation':
    from stavpr_ros.evaluation.evaluate import evaluate_loop_closures, evaluate_on_map

    shown = () if arguments.window is None else (arguments.window,)
    if drives.reference is None:
        return evaluate_loop_closures(
            drives.query.features, drives.truth, settings, arguments.loop_closure, shown, progress=True
        )
    return evaluate_on_map(
        drives.reference,
        drives.query.features,
        drives.truth,
        settings,
        drives.unknown.features if drives.unknown else None,
        shown,
        arguments.backend,
        arguments.precision,
        progress=True,
    )


def _settings_told(arguments: argparse.Namespace, drives: 'Drives') -> dict[str, Any]:
    """Return everything that decides the numbers."""
    from stavpr_ros.sources.folder import text_of

    names = [
        *('map', 'query', 'dataset', 'topic', 'unknown', 'loop_closure', 'warp', 'crop_map', 'crop_query'),
        *(('truth', 'query_poses', 'map_poses', 'meters', 'degrees') if drives.posed else ('truth',)),
        *('mode', 'length', 'beta', 'spatial', 'sigma', 'xi', 'vertical', 'backend', 'precision'),
    ]
    told: dict[str, Any] = {name: getattr(arguments, name) for name in names}
    told |= {name: text_of(value) for name, value in told.items() if isinstance(value, str)}
    return {**told, 'tolerance': drives.tolerance, 'features': drives.query.settings.to_json()}


def _report(arguments: argparse.Namespace) -> 'Report':
    from stavpr_ros.commands.evaluate_sequences import load_drives
    from stavpr_ros.evaluation.metrics import import_sklearn
    from stavpr_ros.evaluation.report import Report

    began = time.perf_counter()
    import_sklearn()  # before the work, not after it
    settings = recognition_settings(arguments)
    drives = load_drives(arguments)
    loaded = time.perf_counter()
    evaluation = _evaluate(arguments, drives, settings)
    ended = time.perf_counter()
    milliseconds = evaluation.results.seconds * 1e3
    times = {
        **drives.times,
        'drives_s': loaded - began,
        'recognition_s': ended - loaded,
        'recognition_median_ms': float(sorted(milliseconds)[len(milliseconds) // 2]),
        'total_s': ended - began,
    }
    return Report(
        evaluation=evaluation,
        query=drives.query,
        reference=drives.reference or drives.query,
        truth=drives.truth,
        title=drives.title,
        settings=_settings_told(arguments, drives),
        times=times,
        default_threshold=_default_threshold(arguments.mode),
        window=arguments.window,
    )


def _tell(report: 'Report') -> None:
    """Print the numbers as a table."""
    names = ('sequence', 'sequence_without_ends', 'single', 'single_without_ends')
    print(report.title)
    print(f'{"":28}{"sequences":>12}{"no ends":>12}{"single":>12}{"no ends":>12}')
    numbers = [getattr(report.evaluation, name).to_json() for name in names]
    rows = ('f1', 'threshold', 'average_precision', 'recall_at_1', 'recall_at_5', 'recall_at_10')
    for row in (*rows, 'recall_at_20', 'recall_at_100_precision'):
        print(f'{row.replace("_", " "):28}' + ''.join(f'{number[row]:12.4f}' for number in numbers))
    alarms = [report.evaluation.false_alarm_rate(kind) for kind in ('sequence', 'single')]
    if alarms[0] is not None:
        print(f'{"false alarm rate":28}{alarms[0]:12.4f}{"":12}{alarms[1]:12.4f}')
    print(
        f'{report.times["recognition_median_ms"]:.2f} ms an image for recognition (median), '
        f'{report.times["total_s"]:.1f} s in all'
    )


def _run(arguments: argparse.Namespace) -> None:
    from stavpr_ros.evaluation.report import chosen_view, write_folder, write_json

    folder = arguments.output or (None if arguments.json else OUTPUT)
    if arguments.json:
        require_room(arguments.json)
    if folder and Path(folder).is_file():
        raise SourceError(f'{folder} is a file: --output takes a folder')
    report = _report(arguments)
    chosen_view(report.evaluation, arguments.window)  # an image without a window is refused before writing
    _tell(report)
    if arguments.json:
        write_json(report, Path(arguments.json))
        print(f'numbers: {arguments.json}')
    if folder:
        print(f'report: {write_folder(report, Path(folder))[0]}')


def main(args: list[str] | None = None) -> int:
    """Run the command."""
    obey_signals()
    wait_passively()
    try:
        parser = _parser()
        # what decides a saved map's features must not be mistaken for a wish: None = not given
        given = argparse.Namespace(features=None, strips=None, seed=None)
        arguments = parser.parse_args(args, given)
        _check(parser, arguments)
        _run(arguments)
    except StavprError as error:
        print(f'evaluate: {error}', file=sys.stderr)
        return 2 if isinstance(error, SettingsError) else 1
    except KeyboardInterrupt:
        print('evaluate: interrupted', file=sys.stderr)
        return 130
    return 0


if __name__ == '__main__':
    sys.exit(main())
