# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run stavpr_lab evaluate``: matches of one traverse on the map of another, and metrics."""

import argparse
from dataclasses import replace
from pathlib import Path
import sys
import time
from typing import Any, TYPE_CHECKING

from stavpr_ros.commands.jobs import add_job_options, Job, job_names, other_arguments, run_jobs
from stavpr_ros.commands.program import (
    add_camera,
    add_fps,
    add_parameter,
    make_parser,
    require_modules,
    run_program,
    say,
)
from stavpr_ros.errors import SourceError
from stavpr_ros.output_file import HTML, JSON, require_replaceable
from stavpr_ros.parameters import default

if TYPE_CHECKING:
    from stavpr_lab.commands.evaluate_sequences import Sequences
    from stavpr_lab.evaluation.evaluate import Evaluation
    from stavpr_lab.evaluation.report import Report
    from stavpr_ros.method import RecognizerSettings

OUTPUT = 'evaluation_output'
EXCLUDE_PLACES = default('exclude_places')

DESCRIPTION = """
Recognizes a second traverse on the map of a first one, image by image as the node does, and writes
the matches, their probabilities and paths as JSON, CSV, plots and an HTML page with the images.
With --truth, also compares them with the ground truth: precision and recall, F1, average
precision, recall@k, recall at 100 % precision, calibration; for sequences and single images.
"""

EPILOG = """
traverses: images, a video, a bag, a saved map, or an array of descriptors that any program
computed, .npy .npz .csv .mat, or FILE:NAME for one of several: (n, D), one vector an image, or
(n, W, D)

ground truth (--truth), none by default:
  identity     image i of the query shows place i of the map; --tolerance is 3 then
  poses        places within --meters and --degrees of the query's pose
  FILE         .csv: accepted pairs, query,place, from 0, place -1: not in the map; images that a
               list does not name are not counted; .npy, .npz: a matrix, queries by places,
               pairs, or a place a query; an image: white at row i, column j accepts place j for
               query i; --tolerance is 0 then

formats (--export-format):
  arrays                  map.npy and query.npy, which --map and --query read
  vpr_methods_evaluation  database_descriptors.npy and queries_descriptors.npy, and the folders
                          database and queries: links @easting@northing@... to the images
  vpr_tutorial            S.npy, similarities of single images, and GT.npz: rows are places
  hloc                    pairs.txt: a line for each of the best places, query and reference

another drive (they combine; applied in the order speed, stop, reverse, drop):
  --remove-from-map 100:150   the map lacks the places 100 to 149: are images of them matched?
  --reverse                   the last image comes first
  --speed 3, 0.5, varying     images are left out or repeated; varying: 1/2 to 2
  --stop 60:100               the query stops at image 60 for 100 images more
  --drop 0.2                  each image is left out with probability 0.2

examples:
  evaluate --map summer/ --query winter/
  evaluate --map route.stavpr --query tuesday.bag --truth pairs.csv --mode paper --json result.json
  evaluate --map summer/ --query winter/ --truth identity --crop-map 0.3 --speed vary
  evaluate --map monday/ --query tuesday/ --unknown another_town/ --output report/
  evaluate --map monday/ --query tuesday/ --truth pairs.csv --remove-from-map 40:90
  evaluate --query loop/ --loop-closure --exclude-places 50 --truth closures.png
  evaluate --map summer.csv --query netvlad.mat:winter --truth identity --tolerance 2
  evaluate --map map.npy --query query.npy --truth identity --protocol
  evaluate --map route.stavpr --query tuesday/ --truth pairs.csv --calibrate
  evaluate --map summer/ --query winter/ --export arrays/
  evaluate --map summer/ --query winter/ --export pairs/ --export-format hloc
  evaluate --map summer/ --query drives/*.bag --output reports/ --processes 4
  evaluate --dataset gardens_point=data/gardens_point --strategy vanilla

exit codes: 0 done, 1 failed (the reason is printed), 2 usage, 130 interrupted
"""


def _parser() -> argparse.ArgumentParser:
    from stavpr_lab.commands.build_descriptor_map import add_descriptor_options
    from stavpr_lab.commands.evaluate_export import FORMATS
    from stavpr_ros.commands.feature_options import add_feature_options

    parser = make_parser('evaluate', DESCRIPTION, EPILOG)
    sequences = parser.add_argument_group('sequences')
    add = sequences.add_argument
    add('--map', metavar='FOLDER|VIDEO|BAG|MAP|ARRAY', help='first traverse, see below')
    query = 'second traverse: the same; several: each is evaluated'
    add('--query', nargs='+', metavar='FOLDER|VIDEO|BAG|MAP|ARRAY', help=query)
    add('--dataset', metavar='NAME=FOLDER', help='map, query and ground truth of a known data set')
    add('--topic', help='image topic of the bags, if they have several')
    add_camera(sequences)
    add_fps(sequences)
    unknown = 'a traverse of places that are not in the map, for the rate of false alarms'
    add('--unknown', metavar='FOLDER|VIDEO|BAG|MAP|ARRAY', help=unknown)
    add('--loop-closure', action='store_true', help="the map is the query's own past: no --map")
    exclude = f'the latest N images are not part of that map ({EXCLUDE_PLACES})'
    add('--exclude-places', type=int, metavar='N', help=exclude)
    late = 'count closures that are published late, too: see the message LoopClosure'
    add('--late-closures', action='store_true', help=late)
    odometry = 'poses of the query by odometry, as --query-poses: compared with paths'
    add('--odometry', metavar='CSV', help=odometry)
    for name, side in (('map', 'right'), ('query', 'left')):
        crop = f'crop this share of the {side} of every image of the {name} (%(default)g)'
        add(f'--crop-{name}', type=float, default=0.0, metavar='X', help=crop)
    _add_drive_options(parser)
    _add_ground_truth_options(parser)
    _add_method_options(parser)
    add = parser.add_argument_group('output').add_argument
    add('--json', metavar='FILE', help='write the numbers')
    add('--output', metavar='FOLDER', help=f'write a report ({OUTPUT} without --json)')
    export = 'write the features of map and query as map.npy and query.npy, or --export-format'
    add('--export', metavar='FOLDER', help=export)
    formats = 'format of --export: arrays, or files of another program, listed below (%(default)s)'
    add('--export-format', choices=tuple(FORMATS), default='arrays', help=formats)
    add('--force', action='store_true', help='replace earlier numbers, reports and arrays')
    protocol = (
        'instead of a report: recall@1 and recall at 100 %% precision, with 95 %% intervals, at '
        'tolerances 0, 1, 2, 10, of sequences of 1, 4, 5, 10, 20 images, in both modes and by '
        'plain sequence matching'
    )
    add('--protocol', action='store_const', const=True, help=protocol)
    calibrate = (
        'instead of a report: write the error rate of drives that are made of the query into the '
        'saved map, which --max-error is kept by; add: to those that it has'
    )
    add('--calibrate', nargs='?', const='new', choices=('new', 'add'), help=calibrate)
    add('--window', type=int, metavar='I', help='plot the warping path around query image I')
    add_job_options(parser)
    add_feature_options(parser)
    add_descriptor_options(parser)
    return parser


def _add_drive_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group('another drive').add_argument
    pairs: dict[str, Any] = {'type': _pair, 'action': 'append', 'default': []}
    removal = 'leave places FIRST .. LAST - 1 out of the map; may be repeated'
    add('--remove-from-map', metavar='FIRST:LAST', help=removal, **pairs)
    add('--reverse', action='store_true', help='drive the query in reverse order')
    speed = 'images of the query per image, varying, or stop (30 images in the middle)'
    add('--speed', '--warp', metavar='X', help=speed)
    stop = 'stop at image IMAGE of the query for COUNT images more; may be repeated'
    add('--stop', metavar='IMAGE:COUNT', help=stop, **pairs)
    drop = 'leave each image of the query out with this probability (%(default)g)'
    add('--drop', type=float, default=0.0, metavar='P', help=drop)
    seed = 'seed of --drop (%(default)s)'
    add('--drop-seed', type=int, default=0, metavar='N', help=seed)


def _pair(text: str) -> tuple[int, int]:
    numbers = text.split(':')
    if len(numbers) != 2 or not all(number.isdecimal() for number in numbers):
        raise argparse.ArgumentTypeError(f'{text!r}: expected two whole numbers, as 60:100')
    return int(numbers[0]), int(numbers[1])


def _add_ground_truth_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group('ground truth').add_argument
    add('--truth', metavar='identity|poses|FILE', help='see below')
    add('--tolerance', type=int, metavar='T', help='places that a correct match may be off')
    query_poses = 'x y z [qx qy qz qw], TUM or KITTI, of each query image'
    add('--query-poses', metavar='CSV', help=query_poses)
    add('--map-poses', metavar='CSV', help="the same of every place (the saved map's)")
    add('--meters', type=float, default=5.0, help='with poses: largest distance (%(default)g)')
    add('--degrees', type=float, help='with poses that have orientations: largest angle (any)')


def _add_method_options(parser: argparse.ArgumentParser) -> None:
    from stavpr_ros.alignment.settings import SequenceSettings, SpatialSettings, STRATEGIES

    group = parser.add_argument_group('method')
    mode = 'paper: as published; robust: with mitigations of failure modes (%(default)s)'
    add_parameter(group, 'mode', mode)
    probability = 'mode robust: matches have a greater probability (%(default)g)'
    add_parameter(group, 'min_probability', probability, metavar='P')
    rate = 'mode robust: rate of wrong matches that chooses --min-probability; 0 = off'
    add_parameter(group, 'max_error', rate, metavar='E')
    against = 'mode robust: both: the camera may move against the map (%(default)s)'
    add_parameter(group, 'direction', against)
    add_parameter(group, 'sequence_length', 'images in a window (%(default)s)', metavar='L')
    add, spatial = group.add_argument, SpatialSettings
    beta = 'mode paper: places per image of a window (%(default)g)'
    add('--beta', type=float, default=SequenceSettings.beta, help=beta)
    strategy = 'spatial alignment (on a map in mode robust: rigid, else adaptive)'
    add('--strategy', choices=STRATEGIES, help=strategy)
    sigma = 'width of the adaptive weight (%(default)g)'
    add('--sigma', type=float, default=spatial.sigma, help=sigma)
    add('--xi', type=int, help='strips this far apart are not aligned (none)')
    add('--vertical', action='store_true', help='align the cells of two strips vertically first')
    radius = 'other candidates are farther from the match than this (%(default)s)'
    add_parameter(group, 'nms_radius', radius, metavar='PLACES')
    add_parameter(group, 'backend', '(%(default)s)', default='cpu')
    add_parameter(group, 'precision', 'precision of the map (%(default)s)')


def _check(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """Choose the alignment, and reject options that contradict each other."""
    loop, dataset = arguments.loop_closure, arguments.dataset is not None
    if arguments.strategy is None:
        is_published = arguments.mode == 'paper' or loop or arguments.vertical
        arguments.strategy = 'adaptive' if is_published else 'rigid'
    if dataset and (arguments.map or arguments.query or arguments.truth or loop):
        parser.error(
            '--dataset has map, query and ground truth: leave --map, --query, --truth and '
            '--loop-closure out'
        )
    if dataset and arguments.odometry:
        parser.error('--odometry: the data set has no poses; give --map and --query')
    if not dataset and arguments.query is None:
        parser.error('--query is required')
    if not dataset and (arguments.map is None) != loop:
        parser.error('give --map or, for the query on its own past, --loop-closure')
    if (arguments.exclude_places is not None or arguments.late_closures) and not loop:
        parser.error('--exclude-places and --late-closures: each goes with --loop-closure')
    if loop and arguments.export_format != 'arrays':
        parser.error('--export-format: files of other programs need a --map')
    if loop:
        _check_loop_closure(parser, arguments)
    compares = arguments.tolerance is not None or arguments.unknown or arguments.mode == 'paper'
    if compares and not (dataset or arguments.truth):
        parser.error('--tolerance, --unknown and --mode paper need --truth identity|poses|FILE')
    if arguments.tolerance is not None and arguments.tolerance < 0:
        parser.error(f'--tolerance {arguments.tolerance} must be at least 0')
    of_map = arguments.map_poses and not arguments.odometry
    if arguments.truth != 'poses' and (arguments.query_poses or of_map):
        parser.error('--query-poses and --map-poses go with --truth poses (or --odometry)')


def _check_loop_closure(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    if arguments.exclude_places is None:
        arguments.exclude_places = EXCLUDE_PLACES
    names = ('unknown', 'remove_from_map', 'reverse', 'speed', 'stop', 'drop')
    for name in names:
        if getattr(arguments, name):
            parser.error(f'--loop-closure: --{name.replace("_", "-")} needs a --map')
    if arguments.crop_map or arguments.map_poses:
        parser.error(
            '--loop-closure is computed on the query alone: leave --crop-map and --map-poses out'
        )
    if arguments.truth == 'identity':
        parser.error('--loop-closure goes with --truth FILE or poses')
    if arguments.exclude_places < 1:
        parser.error(f'--exclude-places {arguments.exclude_places} must be at least 1')


def _evaluate(
    arguments: argparse.Namespace, sequences: 'Sequences', settings: 'RecognizerSettings'
) -> 'Evaluation':
    from stavpr_lab.evaluation.evaluate import evaluate_loop_closures, evaluate_on_map

    query, ground_truth = sequences.query.features, sequences.drive.truth
    common: dict[str, Any] = {
        'shown': () if arguments.window is None else (arguments.window,),
        'precision': arguments.precision,
        'progress': True,
        'odometry': sequences.odometry,
        'stamps': sequences.query.stamps,
    }
    if sequences.reference is None:
        exclude, late = arguments.exclude_places, arguments.late_closures
        return evaluate_loop_closures(query, ground_truth, settings, exclude, late=late, **common)
    unknown = sequences.unknown.features if sequences.unknown else None
    common['backend'] = arguments.backend
    return evaluate_on_map(sequences.reference, query, ground_truth, settings, unknown, **common)


def _report(arguments: argparse.Namespace) -> 'Report':
    from stavpr_lab.commands.evaluate_sequences import (
        load_sequences,
        recognizer_settings,
        settings_json,
    )
    from stavpr_lab.evaluation.report import Report
    from stavpr_ros.method.windows import time_note

    began = time.perf_counter()
    settings = recognizer_settings(arguments)
    sequences = load_sequences(arguments)
    if sequences.reference is not None:
        settings = replace(settings, error_risks=sequences.reference.error_risks)
        if note := time_note(sequences.reference):
            print(note)
    if settings.calibration_warning:
        print(settings.calibration_warning)
    truth = sequences.drive.truth.kind
    load_end = time.perf_counter()
    evaluation = _evaluate(arguments, sequences, settings)
    end = time.perf_counter()
    milliseconds = sorted(evaluation.results.seconds * 1e3)
    times = {
        **sequences.times,
        'drives_s': load_end - began,
        'recognition_s': end - load_end,
        'recognition_median_ms': float(milliseconds[len(milliseconds) // 2]),
        'total_s': end - began,
    }
    return Report(
        evaluation=evaluation,
        query=sequences.query,
        reference=sequences.reference or sequences.query,
        title=f'{sequences.title}, {_truth_text(truth, sequences.tolerance)}',
        settings=settings_json(arguments, sequences),
        times=times,
        drive=sequences.drive,
        default_threshold=settings.applied_threshold,
        window=arguments.window,
    )


def _truth_text(kind: str, tolerance: int) -> str:
    """Return the kind of a ground truth for the title."""
    around = f' +- {tolerance} places' if tolerance else ''
    return f'ground truth: {kind}{around}' if kind else 'no ground truth'


def _print_report(report: 'Report') -> None:
    from stavpr_lab.evaluation.verdict import verdict_of

    say(report.title)
    if report.has_truth:
        _print_metrics(report)
    decision = report.decision()
    wrong = f', {decision["wrongly_matched"]} of them wrongly' if report.has_truth else ''
    stated, images = decision.get('images_with_truth', 0), decision['images']
    if report.has_truth and stated < images:
        print(
            f'ground truth of {stated} of {images} images, which alone count; in a list, a place '
            'of -1 states that an image is not in the map'
        )
        wrong = f'; of {stated} with ground truth, {decision["matched_with_truth"]}{wrong}'
    if report.default_threshold is not None:
        print(f'matched above the probability {1 - report.default_threshold:.4g}')
    print(f'matched, {decision["rule"]}: {decision["matched"]} of {images} images{wrong}')
    if online := decision['online_matched']:
        first, early = decision['first_matched'], decision['early_matched']
        print(f'online, as in a node: {online} of {images} images, the first is image {first}')
        wrong = '; {early_wrong} of the {early_with_truth} with ground truth are wrong'
        wrong = wrong.format(**decision) if report.has_truth else ''
        print(f'early, before a window is full: {early} of the online matches{wrong}')
    if report.has_truth:
        from stavpr_lab.evaluation.protocol import text

        rate, recall = map(text, report.estimates)
        print(f'error rate {rate}, recall {recall}, with 95 % intervals')
    verdict = verdict_of(report)
    say(verdict.text)
    for sentence in verdict.advice:
        say(f'  {sentence}')
    print(
        f'{report.times["recognition_median_ms"]:.2f} ms an image for recognition (median), '
        f'{report.times["total_s"]:.1f} s in all'
    )


def _print_metrics(report: 'Report') -> None:
    from stavpr_lab.evaluation.report import METRICS

    print(f'{"":28}{"sequences":>12}{"no ends":>12}{"single":>12}{"no ends":>12}')
    numbers = [getattr(report.evaluation, name).to_json() for name in METRICS]
    rows = ('f1', 'threshold', 'average_precision', 'recall_at_1', 'recall_at_5', 'recall_at_10')
    for row in (*rows, 'recall_at_20', 'recall_at_100_precision'):
        print(
            f'{row.replace("_", " "):28}' + ''.join(f'{number[row]:12.4f}' for number in numbers)
        )
    if alarms := report.evaluation.false_alarm_rates:
        print(f'{"false alarm rate":28}{alarms["sequence"]:12.4f}{alarms["single"]:24.4f}')
    calibration = report.evaluation.calibration
    for stretch in report.unseen():
        print(
            f'without places {stretch["first"]} .. {stretch["last"] - 1}: {stretch["matched"]} of '
            f'{stretch["images"]} unseen images matched'
        )
    if calibration is not None:
        print(
            f'declared probability: expected calibration error {calibration.expected_error:.4f}, '
            f'recall at 100 precision {calibration.recall_at_full_precision:.4f}'
        )


def _run(arguments: argparse.Namespace) -> None:
    from stavpr_lab.commands.evaluate_export import export, require_exportable
    from stavpr_lab.commands.evaluate_sequences import recognizer_settings
    from stavpr_lab.evaluation.report import chosen_window
    from stavpr_lab.evaluation.report_files import PAGE, write_folder, write_json

    folder = arguments.output or (None if arguments.json else OUTPUT)
    if folder:
        require_modules('jinja2', 'matplotlib')
    if arguments.json:
        require_replaceable(arguments.json, JSON, arguments.force)
    if folder:
        if Path(folder).is_file():
            raise SourceError(f'{folder} is a file: --output takes a folder')
        if Path(folder).is_dir():
            require_replaceable(Path(folder) / PAGE, HTML, arguments.force)
    if arguments.export:
        require_exportable(arguments)
    report = _report(arguments)
    chosen_window(report.evaluation, arguments.window)  # an invalid image fails before writing
    _print_report(report)
    if arguments.export:
        export(arguments, report, recognizer_settings(arguments))
    if arguments.json:
        write_json(report, Path(arguments.json), arguments.force)
        say(f'numbers: {arguments.json}')
    if folder:
        say(f'report: {write_folder(report, Path(folder), arguments.force)}')


def _run_each(
    parser: argparse.ArgumentParser, arguments: argparse.Namespace, args: list[str]
) -> int:
    """Evaluate each query: a report and the numbers in a folder of its name; the exit code."""
    for option in ('json', 'export', 'window', 'dataset', 'query_poses', 'protocol', 'calibrate'):
        if getattr(arguments, option) is not None:
            parser.error(f'--{option.replace("_", "-")} goes with one --query')
    folder, others = Path(arguments.output or OUTPUT), other_arguments(args, '--query')
    jobs = []
    for name, query in zip(job_names(arguments.query), arguments.query, strict=True):
        own = folder / name
        outputs = ('--output', str(own), '--json', f'{own}.json')
        is_new = not (own.exists() or Path(f'{own}.json').exists())
        job_arguments = ('--query', query, *outputs, *others)
        jobs.append(Job(name, 'stavpr_lab.commands.evaluate', job_arguments, is_new))
    folder.mkdir(parents=True, exist_ok=True)
    return run_jobs(jobs, arguments.processes, arguments.ray)


def main(args: list[str] | None = None) -> int:
    """Run the command."""

    def work() -> int | None:
        parser = _parser()
        # None = not given: a saved map decides these then
        namespace = argparse.Namespace(features=None, strips=None, seed=None)
        arguments = parser.parse_args(args, namespace)
        if arguments.query is not None and len(arguments.query) > 1:
            return _run_each(parser, arguments, sys.argv[1:] if args is None else args)
        arguments.query = arguments.query[0] if arguments.query else None
        _check(parser, arguments)
        if arguments.truth:
            require_modules('sklearn')
        if arguments.protocol:
            from stavpr_lab.commands.evaluate_protocol import run_protocol

            run_protocol(parser, arguments)
        elif arguments.calibrate:
            from stavpr_lab.commands.evaluate_calibrate import run_calibrate

            run_calibrate(parser, arguments)
        else:
            _run(arguments)
        return None

    return run_program('evaluate', work)


if __name__ == '__main__':
    sys.exit(main())
