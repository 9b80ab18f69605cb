# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run stavpr_lab experiments``: tables of the paper and of the field."""

import argparse
import json
from pathlib import Path
import sys
from typing import Any, TYPE_CHECKING

from stavpr_ros.commands.program import make_parser, run_program
from stavpr_ros.errors import SettingsError, SourceError
from stavpr_ros.output_file import JSON, require_replaceable, write_output

if TYPE_CHECKING:
    from stavpr_lab.evaluation.metrics import Metrics
    from stavpr_lab.evaluation.paper.datasets import Dataset
    from stavpr_lab.evaluation.paper.experiments import Configuration

EMPTY = '-'

DESCRIPTION = """
Runs one of the paper's experiments on several data sets with several kinds of features and prints
the table beside the published numbers (F1; the paper has no others); or, on the data sets of the
field, recall@1 at the tolerance of each.
"""

EPILOG = """
experiments:
  paper        SeqSLAM, NetVLAD, SAES, no alignment, VGG fc6, SSM-VPR, STA-VPR, STA-VPR with GRP
               and RA, on all data sets; below the table, why an entry is -
  ablation     no alignment, only spatial, only temporal, both
  strategies   sliding window, vanilla DTW, adaptive DTW
  fast         random projection (GRP) and restricted alignment (RA), off and on
  robust_options  the paper, mode robust, and robust without each of its options
  field        single images, and sequences in both modes, on the field's data sets: recall@1
  sweep        one of l, beta, xi, sigma, W (--parameter), all others at their defaults

data sets of the paper: nordland gardens_point gardens_point_night ua berlin_a100; of the field:
nordland_winter nordland_spring nordland_fall nordland_winter_1 msls_cph msls_sf st_lucia
st_lucia_small robotcar sfu utm (docs/datasets.md); synth_ before a name crops the images as
synth-Nord

examples:
  experiments paper --data folder_of_all --datasets nordland synth_nordland gardens_point
  experiments strategies --datasets gardens_point=data/gp --features onnx --onnx-model m.onnx \\
      --onnx-layer x
  experiments paper --data all --features onnx --onnx-model m.onnx --onnx-layer x \\
      --ssm-layers y x --descriptors netvlad=arrays/netvlad
  experiments field --data folder_of_all
  experiments sweep --parameter sigma --values 0 0.5 1 2 --data all

exit codes: 0 done, 1 failed (the reason is printed), 2 usage, 130 interrupted
"""


def _parser() -> argparse.ArgumentParser:
    from stavpr_lab.evaluation.paper.experiments import PRESETS, SWEEPS
    from stavpr_ros.commands.feature_options import add_feature_options

    parser = make_parser('experiments', DESCRIPTION, EPILOG)
    add = parser.add_argument
    add('experiment', choices=(*PRESETS, 'sweep'), help='see below')
    add('--data', metavar='FOLDER', help='the folder of all data sets')
    datasets = "data sets to run (the paper's, or the field's, in --data)"
    add('--datasets', nargs='+', metavar='NAME[=FOLDER]', help=datasets)
    add('--mode', choices=('paper', 'robust'), default='paper', help='(%(default)s)')
    add('--parameter', choices=tuple(SWEEPS), help='parameter of sweep (l)')
    add('--values', nargs='+', type=float, default=(), metavar='X', help='values of sweep')
    arrays = (
        'arrays for paper: FOLDER/DATASET/map.npy and query.npy (or .npz .csv .mat) for the '
        'column netvlad, saes or vgg_fc6; may be repeated'
    )
    add('--descriptors', action='append', default=[], metavar='COLUMN=FOLDER', help=arrays)
    layers = 'two layers of the network of --features, for SSM-VPR in paper, the coarser first'
    add('--ssm-layers', nargs=2, metavar=('FIRST', 'SECOND'), help=layers)
    add('--json', metavar='FILE', help='write all numbers')
    add('--force', action='store_true', help='replace an existing FILE')
    add_feature_options(parser)
    return parser


def _columns(arguments: argparse.Namespace) -> 'tuple[Configuration, ...]':
    from stavpr_lab.evaluation.paper.experiments import PRESETS, sweep_configurations

    if arguments.experiment == 'sweep':
        return sweep_configurations(arguments.parameter or 'l', arguments.values)
    if arguments.values or arguments.parameter:
        raise SettingsError('--parameter and --values go with the experiment sweep')
    return PRESETS[arguments.experiment]


def _datasets(arguments: argparse.Namespace) -> 'dict[str, Dataset | SourceError]':
    """Open the requested data sets, or all; of one that is not found, return why."""
    from stavpr_lab.evaluation.paper.datasets import FIELD, open_dataset
    from stavpr_lab.evaluation.paper.published import F1

    datasets: dict[str, Dataset | SourceError] = {}
    if arguments.datasets:
        for entry in arguments.datasets:
            name, _, folder = entry.partition('=')
            if not (folder or arguments.data):
                raise SettingsError(f'data set {name}: give NAME=FOLDER, or --data')
            datasets[name] = open_dataset(name, folder or arguments.data)
        return datasets
    if not arguments.data:
        raise SettingsError('give --data FOLDER, or --datasets NAME=FOLDER')
    names = FIELD if arguments.experiment == 'field' else tuple(F1)
    for name in names:
        try:
            datasets[name] = open_dataset(name, arguments.data)
        except SourceError as error:
            datasets[name] = error
    if all(isinstance(dataset, SourceError) for dataset in datasets.values()):
        raise SourceError(f'none of the data sets {", ".join(names)} is in {arguments.data}')
    return datasets


def _check(options: argparse.Namespace) -> dict[str, str]:
    """Reject options that contradict each other; return the folders of descriptors by column."""
    from stavpr_lab.evaluation.paper.experiments import PRESETS

    if options.strips is not None or options.projection is not None or options.seed:
        raise SettingsError(
            '--strips, --projection, --seed: the experiment sets them; leave them out'
        )
    if (options.descriptors or options.ssm_layers) and options.experiment != 'paper':
        raise SettingsError('--descriptors and --ssm-layers go with the experiment paper')
    if options.ssm_layers and options.features != 'onnx':
        raise SettingsError('--ssm-layers: give --features onnx')
    columns = [row.name for row in PRESETS['paper'] if row.baseline == 'descriptors']
    folders = {}
    for entry in options.descriptors:
        column, _, folder = entry.partition('=')
        if column not in columns or not folder or not Path(folder).is_dir():
            raise SettingsError(
                f'--descriptors {entry}: expected {" or ".join(columns)}, = and a folder'
            )
        folders[column] = folder
    return folders


def _arrays(folder: Path) -> tuple[str, str] | None:
    """Return the descriptors of map and query in a folder; None where one is missing."""
    from stavpr_lab.features.descriptors import is_descriptors

    places, queries = (
        [str(path) for path in sorted(folder.glob(f'{name}.*')) if is_descriptors(str(path))]
        for name in ('map', 'query')
    )
    return (places[0], queries[0]) if places and queries else None


def _run_row(
    dataset: 'Dataset',
    options: argparse.Namespace,
    columns: 'tuple[Configuration, ...]',
    name: str,
    folders: dict[str, str],
) -> 'dict[str, Metrics | None]':
    """Run all columns of a row; None where the data set is too short for one."""
    from stavpr_lab.evaluation.paper.experiments import BaselineInputs, DatasetExperiment
    from stavpr_ros.commands.feature_options import make_extractor

    features = make_extractor(options).settings
    arrays = {column: _arrays(Path(folder, name)) for column, folder in folders.items()}
    inputs = BaselineInputs(
        {column: both for column, both in arrays.items() if both is not None},
        tuple(options.ssm_layers) if options.ssm_layers else None,
    )
    experiment = DatasetExperiment(
        dataset, features.kind, features.backbone, options.mode, options.device, inputs
    )
    metrics: dict[str, Metrics | None] = {}
    title = f'{name}, {features.kind}'
    from stavpr_ros.progress import Progress

    for column in Progress(columns, desc=title, unit='column'):
        too_short = len(dataset.query) < column.sequence.length
        metrics[column.name] = None if too_short else experiment.evaluate(column)
    return metrics


def _reason(name: str, dataset: 'Dataset', column: 'Configuration') -> str:
    """Return why a data set has no number in a column."""
    if len(dataset.query) < column.sequence.length:
        return f'its {len(dataset.query)} images are fewer than a window has'
    if column.baseline == 'ssm_vpr':
        return 'give --features onnx and --ssm-layers'
    remedy = {
        'saes': 'from any program: SAES is a metric trained on SPED, without public weights',
        'netvlad': 'evaluate --export writes them, with --features netvlad',
        'vgg_fc6': 'evaluate --export writes them, with --features vgg16_fc6',
    }[column.name]
    return (
        f'give --descriptors {column.name}=FOLDER with FOLDER/{name}/map.npy and query.npy; '
        f'{remedy}'
    )


def _published_rows(
    dataset: str, columns: 'tuple[Configuration, ...]'
) -> dict[str, list[float | None]]:
    """Return the published F1 of the columns, by backbone; None where the paper has none."""
    from stavpr_lab.evaluation.paper.published import DENSENET, published_f1, VGG

    rows = {
        backbone: [published_f1(dataset, backbone, column.name) for column in columns]
        for backbone in (DENSENET, VGG)
    }
    return {backbone: row for backbone, row in rows.items() if any(row)}


def _table(rows: list[list[str]]) -> str:
    """Format a table: text left-aligned, numbers right-aligned, a rule below the head."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = [
        '  '.join(
            cell.ljust(width) if i < 2 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
    return '\n'.join([lines[0], '-' * len(lines[0]), *lines[1:]])


def _number(value: float | None) -> str:
    return EMPTY if value is None else f'{value:.3f}'


def _run(arguments: argparse.Namespace) -> None:
    from stavpr_lab.evaluation.report import jsonable

    if arguments.json:
        require_replaceable(arguments.json, JSON, arguments.force)
    folders = _check(arguments)
    columns, datasets = _columns(arguments), _datasets(arguments)
    # by its name in Metrics.to_json()
    metric = 'recall_at_1' if arguments.experiment == 'field' else 'f1'
    rows = [['data set', 'features', *(column.title for column in columns)]]
    results: list[dict[str, Any]] = []
    blanks: dict[str, list[str]] = {}  # data sets and columns, by reason
    for name, dataset in datasets.items():
        metrics: dict[str, Metrics | None] = dict.fromkeys(column.name for column in columns)
        if isinstance(dataset, SourceError):
            blanks[f'no data: {dataset}'] = [name]
        else:
            metrics = _run_row(dataset, arguments, columns, name, folders)
            for column in columns:
                if metrics[column.name] is None:
                    reason = _reason(name, dataset, column)
                    blanks.setdefault(reason, []).append(f'{name}, {column.title}')
        numbers = {
            key: None if value is None else value.to_json() for key, value in metrics.items()
        }
        cells = [None if row is None else row[metric] for row in numbers.values()]
        label = name
        if metric != 'f1' and not isinstance(dataset, SourceError):
            label = f'{name}, {dataset.criterion}'
        rows.append([label, arguments.features, *map(_number, cells)])
        results.append({'dataset': name, 'features': arguments.features, 'results': numbers})
        published_rows = _published_rows(name, columns) if metric == 'f1' else {}
        for backbone, published in published_rows.items():
            rows.append(['', f'published, {backbone}', *map(_number, published)])
            scores = dict(zip([column.name for column in columns], published, strict=True))
            results.append({'dataset': name, 'published': backbone, 'f1': scores})
    mode = f', mode {arguments.mode}' if metric == 'f1' else ''  # the field's table has both
    print(f'{arguments.experiment}{mode}: {metric}')
    print(_table(rows))
    for reason, where in blanks.items():
        print(f'{EMPTY} {"; ".join(where)}: {reason}')
    if arguments.json:
        text = json.dumps(jsonable(results), indent=2) + '\n'
        write_output(arguments.json, text, JSON, arguments.force)


def main(args: list[str] | None = None) -> int:
    """Run the command."""
    return run_program('experiments', lambda: _run(_parser().parse_args(args)))


if __name__ == '__main__':
    sys.exit(main())
