# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The files of a report: JSON, CSV, plots and the page."""

from collections.abc import Iterable
import csv
import io
import json
from pathlib import Path

import numpy as np
from stavpr_lab.evaluation import plots
from stavpr_lab.evaluation.evaluate import Evaluation
from stavpr_lab.evaluation.plots import Box
from stavpr_lab.evaluation.report import chosen_window, METRICS, Report, worst_mistakes
from stavpr_lab.evaluation.report_page import html_page
from stavpr_ros import palette
from stavpr_ros.errors import SourceError
from stavpr_ros.output_file import csv_kind, HTML, JSON, require_replaceable, write_output

PAGE = 'report.html'
MISTAKES = 9  # on the page


def write_json(report: Report, path: Path, force: bool = False) -> None:
    """
    Write the numbers.

    :param force: replace an existing file of numbers.
    :raises OutputError: the file cannot be written.
    """
    text = json.dumps(report.to_json(), indent=2, allow_nan=False)
    write_output(path, text + '\n', JSON, force)


def write_folder(report: Report, folder: Path, force: bool = False) -> Path:
    """
    Write the numbers, the matches, the curves, the plots and the page.

    :param force: replace an earlier report.
    :returns: the page.
    :raises SourceError: the folder cannot be made.
    :raises OutputError: a file cannot be written, or must not be replaced.
    """
    page = folder / PAGE
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SourceError(f'the report cannot be written into {folder}: {error}') from error
    require_replaceable(page, HTML, force)
    _write_matches(report, folder / 'answers.csv')
    box = _draw(report, folder)
    embedded = ['distances', 'similarity_matrix', 'drive']
    if report.has_truth:
        _write_curves(report.evaluation, folder / 'curves.csv')
        embedded.append('precision_recall')
    if report.evaluation.calibration is not None:
        embedded.append('calibration')
    contents = {name: (folder / f'{name}.png').read_bytes() for name in embedded}
    mistakes = worst_mistakes(report.evaluation, MISTAKES)
    write_output(page, html_page(report, mistakes, contents, box), HTML, force)
    write_json(report, folder / 'results.json', force=True)
    return page


def _write_matches(report: Report, path: Path) -> None:
    results, truth = report.evaluation.results, report.evaluation.ground_truth
    sequence, single = results.sequence, results.single
    columns = {
        'image': range(len(report.query)),
        'identifier': report.query.ids,
        'in_map': truth.has_match.astype(int).tolist(),
        'true_place': truth.middles.tolist(),
        'sequence_place': sequence.best.tolist(),
        'sequence_distance': sequence.scores.tolist(),
        'sequence_right': report.evaluation.correct.astype(int).tolist(),
        'single_place': single.best.tolist(),
        'single_distance': single.scores.tolist(),
        'single_right': truth.accepts(single.best).astype(int).tolist(),
        'accepted': report.accepted.astype(int).tolist(),
        'probability': results.probabilities.tolist(),
        'recorded_image': report.drive.images.tolist(),
    }
    for name in ('in_map', 'true_place', 'sequence_right', 'single_right'):
        values = zip(columns[name], truth.is_stated, strict=True)
        is_known = report.has_truth
        columns[name] = [value if is_known and stated else '' for value, stated in values]
    _write_csv(path, list(columns), zip(*columns.values(), strict=True))


def _write_curves(evaluation: Evaluation, path: Path) -> None:
    points = [
        [name, *point] for name in METRICS for point in getattr(evaluation, name).curve.tolist()
    ]
    _write_csv(path, ['answers', 'threshold', 'precision', 'recall'], points)


def _write_csv(path: Path, columns: list[str], rows: Iterable[Iterable[object]]) -> None:
    text = io.StringIO(newline='')
    writer = csv.writer(text)
    writer.writerow(columns)
    writer.writerows(rows)
    write_output(path, text.getvalue(), csv_kind(columns), force=True)


def _draw(report: Report, folder: Path) -> Box:
    """
    Draw the curves, the distances, the drive, the calibration and one window.

    :returns: where the axes of the matrix are in its plot.
    """
    evaluation = report.evaluation
    box = _draw_matrix(report, folder / 'similarity_matrix.png')
    if report.has_truth:
        _draw_curves(evaluation, folder / 'precision_recall.png')
    _draw_distances(report, folder / 'distances.png')
    _draw_drive(report, folder / 'drive.png')
    if evaluation.calibration is not None:
        plots.reliability(folder / 'calibration.png', evaluation.calibration)
    window = chosen_window(evaluation, report.window)
    if window is not None:
        local = window.path - [0, window.first]
        path = folder / f'window_{window.image}.png'
        plots.warping_path(path, window.distances, local, window.first)
    return box


def _draw_curves(evaluation: Evaluation, path: Path) -> None:
    kinds = {
        'sequences': (palette.BLUE, evaluation.sequence),
        'sequences, without the ends': (palette.SKY, evaluation.sequence_without_ends),
        'single images': (palette.GRAY, evaluation.single),
    }
    plots.precision_recall(path, kinds)


def _draw_distances(report: Report, path: Path) -> None:
    colors = {'correct': palette.BLUE, 'wrong': palette.VERMILION, 'match': palette.SKY}
    groups = {
        name: (colors.get(name, palette.ORANGE), report.amount(row))
        for name, row in report.evaluation.distances.items()
    }
    best, default = report.evaluation.sequence.best.threshold, report.default_threshold
    limit = report.amount(best if default is None else default)
    plots.match_histogram(path, groups, limit, report.quantity)


def _draw_drive(report: Report, path: Path) -> None:
    truth, places = report.evaluation.ground_truth, report.evaluation.results.sequence.best
    unseen = np.any([np.zeros(truth.N, bool), *report.drive.unseen()], axis=0)
    correct = report.evaluation.correct if report.has_truth else None
    outcomes = plots.outcomes(report.accepted, correct, truth.has_match)
    if report.has_truth and truth.stated is not None:
        outcomes[~truth.stated] = plots.outcomes(report.accepted[~truth.stated], None, None)
    plots.drive(path, truth.pairs, truth.n, places, outcomes, unseen)


def _draw_matrix(report: Report, path: Path) -> Box:
    evaluation = report.evaluation
    reduced, truth = evaluation.results.distances, evaluation.ground_truth
    true_blocks = np.zeros(reduced.values.shape, bool)
    rows, columns = (truth.pairs // reduced.block).T
    true_blocks[rows, columns] = True
    pairs = np.stack([np.arange(truth.N), evaluation.results.sequence.best], axis=1)
    accepted, correct = report.accepted, evaluation.correct
    wrong = accepted & ~correct & truth.is_stated
    matches = {'right': pairs[accepted & correct], 'wrong': pairs[wrong]}
    if truth.stated is not None:
        matches['match'] = pairs[accepted & ~truth.stated]
    if not report.has_truth:
        matches = {'match': pairs[report.accepted]}
    truth_blocks = true_blocks if report.has_truth else None
    return plots.reduced_matrix(path, reduced.values, (truth.N, truth.n), truth_blocks, matches)
