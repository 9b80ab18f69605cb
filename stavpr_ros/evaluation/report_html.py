"""The report as one page of HTML with everything in it: no server, no network, no other file."""

import base64
import html
import json
import math
import re
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from stavpr_ros.evaluation import report_figures as figures
from stavpr_ros.evaluation import report_page
from stavpr_ros.evaluation.metrics import Metrics
from stavpr_ros.evaluation.evaluate import WindowDistances
from stavpr_ros.evaluation.ground_truth import GroundTruth
from stavpr_ros.evaluation.report_matrix import accepted_answers
from stavpr_ros.mapping import PlaceMap

if TYPE_CHECKING:
    from stavpr_ros.evaluation.report import Report

VIEWS = 240  # windows that can be looked at: more would make a heavy file
SMALL, LIGHT = 160, 4000  # pixels and bytes of a picture

ROWS = {
    'F1': lambda j: j.best.f1,
    'threshold of the best F1': lambda j: j.best.threshold,
    'precision there': lambda j: j.best.precision,
    'recall there': lambda j: j.best.recall,
    'average precision': lambda j: j.average_precision,
    'recall@1': lambda j: j.recall_at[1],
    'recall@5': lambda j: j.recall_at[5],
    'recall@10': lambda j: j.recall_at[10],
    'recall@20': lambda j: j.recall_at[20],
    'recall at 100 % precision': lambda j: j.recall_at_full_precision,
    'scikit-learn’s F1': lambda j: j.sklearn_f1,
}


def html_page(report: 'Report', mistakes: list[int]) -> str:
    """
    Return the page.

    :param mistakes: images whose wrong answers are shown, the worst first.
    """
    evaluation = report.evaluation
    parts = {
        'TITLE': html.escape(report.title),
        'LEAD': _lead(report),
        'CARDS': _cards(report),
        'CURVES': figures.precision_recall_svg(
            [
                (name, color, judged.curve, (judged.best.recall, judged.best.precision))
                for name, color, judged in (
                    ('single images', figures.SINGLE, evaluation.single),
                    ('sequences', figures.SEQUENCE, evaluation.sequence),
                )
            ]
        ),
        **_scores(report),
        'MATRIX': _matrix(report),
        'MISTAKES_TEXT': _mistakes_text(mistakes),
        'MISTAKES': ''.join(_mistake(report, image) for image in mistakes),
        'TABLE': _table(report),
        'SETTINGS': _plain_table(report.settings),
        'TIMES': _plain_table({name: f'{value:.3g}' for name, value in report.times.items()}),
        'DATA': json.dumps(jsonable(_data(report, mistakes)), separators=(',', ':')).replace('</', '<\\/'),
        'GLOSSARY': report_page.GLOSSARY,
        'STYLE': report_page.STYLE,
        'SCRIPT': report_page.SCRIPT,
        'SEQUENCE': figures.SEQUENCE,
        'SINGLE': figures.SINGLE,
        'RIGHT': figures.RIGHT,
        'WRONG': figures.WRONG,
    }
    # in one pass: what a user named is no blank to be filled in
    return re.sub('@@([A-Z_]+)@@', lambda blank: parts[blank[1]], report_page.PAGE)


def _lead(report: 'Report') -> str:
    best, single = report.evaluation.sequence.best, report.evaluation.single.best
    accepted = best.true_positives + best.false_positives
    count = len(report.evaluation.results.single)
    text = (
        f'Of {count} images, {accepted} are recognized at the best threshold, {best.threshold:.4g}: '
        f'{best.true_positives} rightly, {best.false_positives} wrongly. Rejected although in the map: '
        f'{best.false_negatives}. Looking at single images only, {single.true_positives} would be right and '
        f'{single.false_positives} wrong.'
    )
    rate = report.evaluation.false_alarm_rate('sequence')
    if rate is not None:
        text += f' Of the images of unknown places, {rate:.1%} are recognized all the same.'
    return ' '.join([text, *map(html.escape, report.notes)])


def _cards(report: 'Report') -> str:
    evaluation = report.evaluation
    sequence, single = evaluation.sequence, evaluation.single
    cards = [
        ('F1 of sequences', sequence.best.f1, f'single images: {single.best.f1:.3f}', figures.SEQUENCE),
        ('recall@1', sequence.recall_at[1], f'single images: {single.recall_at[1]:.3f}', figures.SEQUENCE),
        (
            'average precision',
            sequence.average_precision,
            f'single images: {single.average_precision:.3f}',
            figures.SEQUENCE,
        ),
        (
            'recall at 100 % precision',
            sequence.recall_at_full_precision,
            f'single images: {single.recall_at_full_precision:.3f}',
            figures.SEQUENCE,
        ),
    ]
    alarms = evaluation.false_alarm_rate('sequence')
    if alarms is not None:
        alone = evaluation.false_alarm_rate('single')
        cards.append(('false alarms', alarms, f'single images: {alone:.3f}', figures.WRONG))
    return ''.join(
        f'<div class="card"><span>{name}</span><b>{value:.3f}</b><span>{note}</span>'
        f'<i style="--v:{100 * value:.1f}%;--c:{color}"></i></div>'
        for name, value, note, color in cards
    )


def _scores(report: 'Report') -> dict[str, str]:
    evaluation = report.evaluation
    answers = evaluation.results.sequence
    right = report.truth.accepts(answers.best)
    groups = [
        ('right', figures.RIGHT, answers.scores[right]),
        ('wrong', figures.WRONG, answers.scores[~right]),
    ]
    if evaluation.unknown is not None:
        groups.append(('unknown places', figures.UNKNOWN, evaluation.unknown.sequence.scores))
    keys = ''
    for name, color, scores in groups:
        none = np.count_nonzero(~np.isfinite(scores))
        keys += f'<span class="key" style="--c:{color}">{name}</span> '
        keys += f'({none} of them without a distance: no nearer than chance) ' if none else ''
    return {
        'SCORES': figures.scores_svg(groups, evaluation.sequence.best.threshold),
        'SCORE_KEYS': keys,
    }


def accepted_lists(truth: GroundTruth) -> list[np.ndarray]:
    """Return the accepted places of each query, N sorted arrays."""
    queries, places = truth.pairs.T
    return np.split(places, np.searchsorted(queries, np.arange(1, truth.N)))


def _matrix(report: 'Report') -> str:
    truth = report.truth
    colors = {'right': figures.RIGHT, 'wrong': figures.WRONG}
    dots = {colors[name]: pairs for name, pairs in accepted_answers(report.evaluation, truth).items()}
    return figures.matrix_svg(
        report.evaluation.results.distances.values, (truth.N, truth.n), accepted_lists(truth), dots
    )


def _mistakes_text(mistakes: list[int]) -> str:
    if not mistakes:
        return 'There are none: every answer is right.'
    return (
        'Wrong answers with the smallest distance, those that are at least a window off first, one of each '
        'stretch of road. From left to right: the query image, the answer, the true place.'
    )


def _mistake(report: 'Report', image: int) -> str:
    answers = report.evaluation.results.sequence
    place, true = int(answers.best[image]), int(report.truth.middles[image])
    images = [
        (f'image {image}', _picture(report.query, image)),
        (f'place {place}', _picture(report.reference, place)),
        (f'place {true}' if true >= 0 else 'not in the map', _picture(report.reference, true)),
    ]
    shown = ''.join(
        f'<span>{f"<img src={url!r} alt={name!r}>" if url else "<img alt=>"}<em>{name}</em></span>'
        for name, url in images
    )
    accepted = answers.scores[image] < report.evaluation.sequence.best.threshold
    status = 'accepted' if accepted else 'rejected, rightly'
    off = f', {abs(place - true)} places off' if true >= 0 else ''
    caption = f'distance {answers.scores[image]:.4f}, {status}{off}'
    return f'<figure><div>{shown}</div><figcaption>{caption}</figcaption></figure>'


def _picture(place_map: PlaceMap, place: int) -> str:
    """Return a small picture as a data URL; empty where there is none."""
    if place < 0 or not place_map.thumbnails:
        return ''
    content = place_map.thumbnails[place]
    picture = place_map.thumbnail(place) if len(content) > LIGHT else None
    if picture is not None and picture.shape[1] > SMALL:
        size = (SMALL, max(1, round(picture.shape[0] * SMALL / picture.shape[1])))
        small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)[:, :, ::-1]
        content = cv2.imencode('.jpg', small, [cv2.IMWRITE_JPEG_QUALITY, 75])[1].tobytes()
    return figures.data_url(content, 'jpeg')


def _table(report: 'Report') -> str:
    evaluation = report.evaluation
    judged: list[Metrics] = [
        evaluation.sequence,
        evaluation.sequence_without_ends,
        evaluation.single,
        evaluation.single_without_ends,
    ]
    head = ('', 'sequences', 'without the ends', 'single images', 'without the ends')
    lines = [[name, *(f'{value(j):.4f}' for j in judged)] for name, value in ROWS.items()]
    if evaluation.unknown is not None:
        rates = [f'{evaluation.false_alarm_rate(kind):.4f}' for kind in ('sequence', 'single')]
        lines.append(['false alarms', rates[0], '', rates[1], ''])
    lines.append(['queries', *(str(j.queries) for j in judged)])
    lines.append(['with a place in the map', *(str(j.with_match) for j in judged)])
    return f'<thead>{_line(head, "th")}</thead><tbody>{"".join(_line(line) for line in lines)}</tbody>'


def _line(cells: Iterable[str], tag: str = 'td') -> str:
    return '<tr>' + ''.join(f'<{tag}>{cell}</{tag}>' for cell in cells) + '</tr>'


def _plain_table(values: dict[str, Any]) -> str:
    return ''.join(
        _line((html.escape(name.replace('_', ' ')), _shown(value))) for name, value in values.items()
    )


def _shown(value: Any) -> str:
    return html.escape('–' if value is None else value if isinstance(value, str) else json.dumps(value))


def _data(report: 'Report', mistakes: list[int]) -> dict[str, Any]:
    """Return what the script of the page draws."""
    evaluation = report.evaluation
    views = _chosen_views(evaluation.results.windows, mistakes)
    accepted = accepted_lists(report.truth)
    shown = [_view(report, view, accepted) for view in views]
    places = {view[name] for view in shown for name in ('answer', 'true')}
    curves = {'sequences': evaluation.sequence.curve, 'single images': evaluation.single.curve}
    return {
        'views': shown,
        'start': mistakes[0] if mistakes else len(report.query) // 2,
        'queries': {view.image: _picture(report.query, view.image) for view in views},
        'places': {place: _picture(report.reference, place) for place in sorted(places)},
        'curves': {
            name: np.round(
                np.stack([(c := figures.thinned(curve)).thresholds, c.precision, c.recall], axis=1), 6
            ).tolist()
            for name, curve in curves.items()
        },
    }


def _chosen_views(views: tuple[WindowDistances, ...], mistakes: list[int]) -> list[WindowDistances]:
    keep = set(np.linspace(0, len(views) - 1, min(VIEWS, len(views))).round().astype(int).tolist())
    return [view for i, view in enumerate(views) if i in keep or view.image in mistakes]


def _view(report: 'Report', view: WindowDistances, accepted: list[np.ndarray]) -> dict[str, Any]:
    """Return a window for the script, its distances as bytes: 0 near, 254 far, 255 nothing."""
    answers, single = report.evaluation.results.sequence, report.evaluation.results.single
    rows, columns = view.distances.shape
    low, high = np.nanmin(view.distances), np.nanmax(view.distances)
    share = (view.distances - low) / max(float(high - low), 1e-9)
    cells = np.where(np.isnan(share), 255, np.round(np.nan_to_num(share) * 254)).astype(np.uint8)
    last, oldest = view.first + columns - 1, view.newest - rows + 1
    band = [
        [row, max(first, view.first), min(end, last)]
        for row in range(rows)
        for first, end in figures.runs(accepted[oldest + row])
        if end >= view.first and first <= last
    ]
    answer = int(answers.best[view.image])
    score = float(answers.scores[view.image])
    return {
        'image': view.image,
        'newest': view.newest,
        'first': view.first,
        'rows': rows,
        'columns': columns,
        'cells': base64.b64encode(cells.tobytes()).decode(),
        'path': view.path.tolist(),
        'truth': band,
        'answer': answer,
        'single': int(single.best[view.image]),
        'true': int(report.truth.middles[view.image]),
        'right': answer in accepted[view.image],
        'accepted': score < report.evaluation.sequence.best.threshold,
        'score': score,
    }


def jsonable(value: Any) -> Any:
    """Replace what JSON has no word for: NaN and infinities by None, NumPy's numbers by Python's."""
    if isinstance(value, dict):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [jsonable(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
