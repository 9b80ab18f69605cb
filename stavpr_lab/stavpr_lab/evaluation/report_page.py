# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The HTML page of a report: one file that needs no server, no network and no other file."""

import base64
from collections.abc import Mapping
from importlib import resources
import json
from typing import Any

import cv2
import jinja2
import numpy as np
from stavpr_lab.evaluation.drive import UNSEEN_DISTANCE
from stavpr_lab.evaluation.evaluate import Evaluation, WindowDistances
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_lab.evaluation.metrics import RANKS
from stavpr_lab.evaluation.plots import Box
from stavpr_lab.evaluation.protocol import text
from stavpr_lab.evaluation.report import jsonable, METRICS, Report
from stavpr_lab.evaluation.verdict import verdict_of
from stavpr_ros import palette
from stavpr_ros.mapping import Map
from stavpr_ros.prepare.centering import evenly

TEMPLATE = 'report.html.jinja'
VIEWS = 240  # windows that can be looked at: more would make a large file
WIDTH, LARGE = 160, 4000  # of an image, pixels; bytes from which one is made smaller

PAIRS = 24  # on the sheet

# rows of the table: keys of Metrics.to_json
NUMBERS = {
    'F1': 'f1',
    'threshold of the best F1': 'threshold',
    'precision there': 'precision',
    'recall there': 'recall',
    'average precision': 'average_precision',
    **{f'recall@{k}': f'recall_at_{k}' for k in RANKS},
    'recall at 100 % precision': 'recall_at_100_precision',
}


def html_page(report: Report, mistakes: list[int], plots: Mapping[str, bytes], box: Box) -> str:
    """
    Return the page.

    :param mistakes: images whose wrong matches are on the sheet of pairs, the worst first.
    :param plots: PNG files ``distances``, ``similarity_matrix``, ``drive`` and, with ground truth,
        ``precision_recall`` and, where probabilities are declared, ``calibration``.
    :param box: where the axes of the matrix are.
    """
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    environment.policies['json.dumps_kwargs'] = {'separators': (',', ':')}
    template = resources.files('stavpr_lab.evaluation').joinpath(TEMPLATE).read_text('utf-8')
    evaluation = report.evaluation
    return environment.from_string(template).render(
        title=report.title,
        verdict=verdict_of(report),
        has_truth=report.has_truth,
        quantity=report.quantity,
        false_alarms=evaluation.false_alarm_rates,
        palette=palette,
        decision=report.decision(),
        error_rate=text(report.estimates[0]),
        recall=text(report.estimates[1]),
        unseen=report.unseen() if report.has_truth else [],
        unseen_distance=UNSEEN_DISTANCE,
        calibration=evaluation.calibration and evaluation.calibration.to_json(),
        plots={name: _data_url(content, 'png') for name, content in plots.items()},
        infinite={
            name: np.count_nonzero(~np.isfinite(distances))
            for name, distances in evaluation.distances.items()
        },
        rows=_rows(evaluation),
        settings={name: _text(value) for name, value in report.settings.items()},
        times={name: f'{value:.3g}' for name, value in report.times.items()},
        data=jsonable({**_data(report, mistakes), 'box': box, 'quantity': report.quantity}),
    )


def _data_url(content: bytes, kind: str) -> str:
    return f'data:image/{kind};base64,{base64.b64encode(content).decode()}'


def _text(value: Any) -> str:
    return '–' if value is None else value if isinstance(value, str) else json.dumps(value)


def _rows(evaluation: Evaluation) -> dict[str, list[str]]:
    """Return the table of all numbers: a row a number, a column a kind of metrics."""
    columns = [getattr(evaluation, name).to_json() for name in METRICS]
    rows = {name: [f'{column[key]:.4f}' for column in columns] for name, key in NUMBERS.items()}
    rows['scikit-learn’s F1'] = [f'{column["scikit_learn"]["f1"]:.4f}' for column in columns]
    if rates := evaluation.false_alarm_rates:
        rows['false alarms'] = [f'{rates["sequence"]:.4f}', '', f'{rates["single"]:.4f}', '']
    rows['queries'] = [str(column['queries']) for column in columns]
    rows['with a place in the map'] = [str(column['queries_with_match']) for column in columns]
    return rows


def _pairs(report: Report, mistakes: list[int]) -> list[dict[str, Any]]:
    """Return the pairs of the sheet: the worst mistakes first, and matches of the whole drive."""
    places, drive = report.evaluation.results.sequence.best, report.drive
    matched = np.flatnonzero(report.accepted)
    others = matched if len(matched) else np.flatnonzero(places >= 0)
    chosen = others[evenly(len(others), PAIRS)].tolist()
    return [
        {
            'image': image,
            'place': int(places[image]),
            'recorded': [int(drive.images[image]), int(drive.places[places[image]])],
            **_decision(report, image),
        }
        for image in dict.fromkeys([*(i for i in mistakes if report.accepted[i]), *chosen])
    ][:PAIRS]


def _decision(report: Report, image: int) -> dict[str, Any]:
    """Return the match of an image: its amount, whether it is matched, and right, if known."""
    truth = report.evaluation.ground_truth
    is_known = report.has_truth and truth.is_stated[image]
    return {
        'amount': float(report.amount(report.evaluation.results.sequence.scores[image])),
        'matched': bool(report.accepted[image]),
        'right': bool(report.evaluation.correct[image]) if is_known else None,
        'true': int(truth.middles[image]),
    }


def _image(place_map: Map, place: int) -> str:
    """Return a small image of a place as a data URL; empty where there is none."""
    if place < 0 or not place_map.thumbnails:
        return ''
    content = place_map.thumbnails[place]
    image = place_map.thumbnail(place) if len(content) > LARGE else None
    if image is not None and image.shape[1] > WIDTH:
        size = (WIDTH, max(1, round(image.shape[0] * WIDTH / image.shape[1])))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)[:, :, ::-1]
        content = cv2.imencode('.jpg', small, [cv2.IMWRITE_JPEG_QUALITY, 75])[1].tobytes()
    return _data_url(content, 'jpeg')


def _data(report: Report, mistakes: list[int]) -> dict[str, Any]:
    """Return the data of the page's script."""
    evaluation = report.evaluation
    windows = evaluation.results.windows
    indices = set(evenly(len(windows), VIEWS).tolist())
    sample = [
        window for i, window in enumerate(windows) if i in indices or window.image in mistakes
    ]
    views = [_view(report, window) for window in sample]
    pairs = _pairs(report, mistakes)
    places = {entry[name] for entry in [*views, *pairs] for name in ('place', 'true')}
    images = {entry['image'] for entry in [*views, *pairs]}
    return {
        'images': len(report.query),
        'views': views,
        'pairs': pairs,
        'start': mistakes[0] if mistakes else len(report.query) // 2,
        'queries': {image: _image(report.query, image) for image in sorted(images)},
        'places': {place: _image(report.reference, place) for place in sorted(places)},
    }


def _view(report: Report, window: WindowDistances) -> dict[str, Any]:
    """Return a window for the script; its distances as bytes: 0 near, 254 far, 255 none."""
    evaluation = report.evaluation
    truth = evaluation.ground_truth
    rows, columns = window.distances.shape
    low, high = np.nanmin(window.distances), np.nanmax(window.distances)
    share = (window.distances - low) / max(float(high - low), 1e-9)
    cells = np.where(np.isnan(share), 255, np.round(np.nan_to_num(share) * 254)).astype(np.uint8)
    return {
        'image': window.image,
        'newest': window.newest,
        'first': window.first,
        'rows': rows,
        'columns': columns,
        'cells': base64.b64encode(cells.tobytes()).decode(),
        'path': window.path.tolist(),
        'truth': _true_stretches(truth, window),
        'place': int(evaluation.results.sequence.best[window.image]),
        'single': int(evaluation.results.single.best[window.image]),
        **_decision(report, window.image),
    }


def _true_stretches(truth: GroundTruth, window: WindowDistances) -> list[list[int]]:
    """Return the true places of a window: position, first and last place of each stretch."""
    rows, columns = window.distances.shape
    stretches: list[list[int]] = []
    for row in range(rows):
        places = truth.accepted(window.newest - rows + 1 + row)
        places = places[(places >= window.first) & (places < window.first + columns)]
        parts = np.split(places, np.flatnonzero(np.diff(places) > 1) + 1)
        stretches += [[row, int(part[0]), int(part[-1])] for part in parts if len(part)]
    return stretches
