"""What an evaluation leaves behind: JSON, CSV, pictures, and one page of HTML that needs nothing else."""

import csv
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stavpr_ros.errors import SettingsError, SourceError
from stavpr_ros.evaluation import plots
from stavpr_ros.evaluation.evaluate import Evaluation, WindowDistances
from stavpr_ros.evaluation.ground_truth import GroundTruth
from stavpr_ros.evaluation.plots import MatchPair
from stavpr_ros.evaluation.report_html import html_page, jsonable
from stavpr_ros.evaluation.report_matrix import draw_matrix
from stavpr_ros.mapping import PlaceMap

JUDGED = ('sequence', 'sequence_without_ends', 'single', 'single_without_ends')
MISTAKES = 9


@dataclass(frozen=True)
class Report:
    """
    An evaluation and what is told about it.

    :param query: the described query, with thumbnails if pictures of it are wanted.
    :param reference: the map; the query itself for loop closures.
    :param truth: of the query's images.
    :param title: what was evaluated, a line.
    :param settings: of the run, for the reader and for a run like it.
    :param times: of the run, by what took them; seconds, milliseconds where the name says so.
    :param default_threshold: the mode's own, if it has one.
    """

    evaluation: Evaluation
    query: PlaceMap
    reference: PlaceMap
    truth: GroundTruth
    title: str
    settings: dict[str, Any]
    times: dict[str, float]
    default_threshold: float | None = None
    window: int | None = None
    notes: tuple[str, ...] = field(default=())

    def to_json(self) -> dict[str, Any]:
        """Return all numbers for a JSON file; what is not defined is None."""
        evaluation = self.evaluation
        numbers: dict[str, Any] = {name: getattr(evaluation, name).to_json() for name in JUDGED}
        numbers['recommended_threshold'] = evaluation.sequence.best.threshold
        if self.default_threshold is not None:
            numbers['default_threshold'] = self._at_default()
        if evaluation.unknown is not None:
            for kind in ('sequence', 'single'):
                numbers[kind]['false_alarm_rate'] = evaluation.false_alarm_rate(kind)
            numbers['false_alarm_rate'] = evaluation.false_alarm_rate('sequence')
            numbers['unknown_images'] = len(evaluation.unknown.single)
        numbers |= {'images': len(self.query), 'places': len(self.reference)}
        numbers |= {'settings': self.settings, 'times': self.times}
        return jsonable(numbers)

    def _at_default(self) -> dict[str, Any]:
        from stavpr_ros.evaluation.metrics import counts_at

        evaluation, threshold = self.evaluation, self.default_threshold
        assert threshold is not None
        answers = evaluation.results.sequence
        score = counts_at(threshold, answers.scores, self.truth.accepts(answers.best), self.truth.has_match)
        found: dict[str, Any] = {'threshold': threshold}
        found |= {'precision': score.precision, 'recall': score.recall, 'f1': score.f1}
        if evaluation.unknown is not None:
            found['false_alarm_rate'] = evaluation.false_alarm_rate('sequence', threshold)
        return found


def write_json(report: Report, path: Path) -> None:
    """
    Write the numbers.

    :raises SourceError: the file cannot be written.
    """
    try:
        path.write_text(json.dumps(report.to_json(), indent=2, allow_nan=False) + '\n', encoding='utf-8')
    except OSError as error:
        raise SourceError(f'{path} cannot be written: {error}') from error


def write_folder(report: Report, folder: Path) -> list[Path]:
    """
    Write everything: numbers, answers, curves, pictures and the page.

    :returns: the files, the page first.
    :raises SourceError: the folder or a file in it cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _write_answers(report, folder / 'answers.csv')
        _write_curves(report.evaluation, folder / 'curves.csv')
        drawn = _draw(report, folder)
        page = folder / 'report.html'
        page.write_text(html_page(report, worst_mistakes(report.evaluation, MISTAKES)), encoding='utf-8')
    except OSError as error:
        raise SourceError(f'the report cannot be written into {folder}: {error}') from error
    write_json(report, folder / 'results.json')
    return [page, folder / 'results.json', folder / 'answers.csv', folder / 'curves.csv', *drawn]


def _write_answers(report: Report, path: Path) -> None:
    evaluation = report.evaluation
    sequence, single, truth = evaluation.results.sequence, evaluation.results.single, report.truth
    columns = {
        'image': range(len(report.query)),
        'identifier': report.query.ids,
        'in_map': truth.has_match.astype(int).tolist(),
        'true_place': truth.middles.tolist(),
        'sequence_place': sequence.best.tolist(),
        'sequence_distance': sequence.scores.tolist(),
        'sequence_right': truth.accepts(sequence.best).astype(int).tolist(),
        'single_place': single.best.tolist(),
        'single_distance': single.scores.tolist(),
        'single_right': truth.accepts(single.best).astype(int).tolist(),
    }
    with path.open('w', newline='', encoding='utf-8') as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))


def _write_curves(evaluation: Evaluation, path: Path) -> None:
    with path.open('w', newline='', encoding='utf-8') as file:
        writer = csv.writer(file)
        writer.writerow(['answers', 'threshold', 'precision', 'recall'])
        for name in JUDGED:
            curve = getattr(evaluation, name).curve
            for point in zip(curve.thresholds, curve.precision, curve.recall, strict=True):
                writer.writerow([name, *map(float, point)])


def worst_mistakes(evaluation: Evaluation, count: int) -> list[int]:
    """
    Choose wrong answers: another place before a near miss, the surest first, no two within half a window.

    A near miss is less than a window off.

    :returns: up to ``count`` images, the worst first.
    """
    answers, true = evaluation.results.sequence, evaluation.ground_truth.middles
    wrong = ~evaluation.ground_truth.accepts(answers.best) & np.isfinite(answers.scores)
    near = (true >= 0) & (np.abs(answers.best - true) < evaluation.sequence_length)
    chosen: list[int] = []
    for image in np.lexsort((answers.scores, near)).tolist():
        if wrong[image] and all(abs(image - other) > evaluation.sequence_length // 2 for other in chosen):
            chosen.append(image)
            if len(chosen) == count:
                break
    return chosen


def _draw(report: Report, folder: Path) -> list[Path]:
    """Draw the pictures: curves, all distances, mistakes, one window."""
    evaluation = report.evaluation
    curves = {
        'sequences': evaluation.sequence.curve,
        'sequences, without the ends': evaluation.sequence_without_ends.curve,
        'single images': evaluation.single.curve,
    }
    best = evaluation.sequence.best
    drawn = [
        plots.precision_recall(
            folder / 'precision_recall.png',
            {name: (curve.recall, curve.precision) for name, curve in curves.items()},
            (best.recall, best.precision),
        ),
        draw_matrix(folder / 'similarity_matrix.png', evaluation, report.truth),
    ]
    pairs = [pair for image in worst_mistakes(evaluation, 6) if (pair := _mistake(report, image))]
    if pairs:
        drawn.append(plots.match_overview(folder / 'mistakes.png', pairs, columns=2))
    view = chosen_view(evaluation, report.window)
    if view is not None:
        local = view.path - [0, view.first]
        drawn.append(
            plots.warping_path(folder / f'window_{view.image}.png', view.distances, local, view.first)
        )
    return drawn


def chosen_view(evaluation: Evaluation, image: int | None) -> WindowDistances | None:
    """
    Return the window around an image, or the worst mistake's (else the middle one) if none is named.

    :raises SettingsError: no window is centered on that image.
    """
    views = evaluation.results.windows
    if image is not None:
        for view in views:
            if view.image == image:
                return view
        raise SettingsError(
            f'no window is centered on image {image}: choose one of {evaluation.centered.start} .. '
            f'{evaluation.centered.stop - 1}'
        )
    if not views:
        return None
    mistakes = worst_mistakes(evaluation, 1)
    wanted = mistakes[0] if mistakes else views[len(views) // 2].image
    return min(views, key=lambda view: abs(view.image - wanted))


def _mistake(report: Report, image: int) -> MatchPair | None:
    """Return a wrong answer beside its query, with the true place in words."""
    answers = report.evaluation.results.sequence
    place, true = int(answers.best[image]), int(report.truth.middles[image])
    query, shown = report.query.thumbnail(image), report.reference.thumbnail(place)
    if query is None or shown is None:
        return None
    shown = cv2.resize(shown, query.shape[1::-1], interpolation=cv2.INTER_AREA)
    where = f'true place {true}' if true >= 0 else 'not in the map'
    caption = f'image {image}: place {place}, {where}, distance {answers.scores[image]:.3f}'
    return MatchPair(query, shown, caption, 'wrong')
