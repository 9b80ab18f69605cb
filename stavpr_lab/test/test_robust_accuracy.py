# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Mode robust on real traverses of other speed and view, and on other routes."""

import numpy as np
from places import map_of
import pytest
from stavpr_lab.evaluation.drive import DriveChanges
from stavpr_lab.evaluation.evaluate import evaluate_on_map, recognize_all
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_lab.evaluation.metrics import accepted_counts
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import extract_features
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings, Status
from stavpr_ros.sources import open_source

SETTINGS = RecognizerSettings(mode='robust')


@pytest.fixture(scope='module')
def traverses(data_folder):
    """Return a function from a folder to the gradient features of its images."""
    extractor, known = FeatureExtractor('gradient'), {}

    def features(name):
        if name not in known:
            known[name] = extract_features(
                open_source(data_folder / name), extractor, progress=False
            )
        return known[name]

    return features


def evaluated(reference, query, truth):
    """Best F1, and the precision at the default threshold."""
    found = evaluate_on_map(map_of(reference), query, truth, SETTINGS)
    accepted = accepted_counts(found.results.accepted, found.correct, truth.has_match)
    return found.sequence.best.f1, accepted.precision


def test_gardens_point_at_every_speed_is_recognized(traverses):
    reference, query = traverses('gardens_point/day_left'), traverses('gardens_point/day_right')
    truth = GroundTruth.identity(200, 200, 2)
    f1, precision = evaluated(reference, query, truth)
    print(f'Gardens Point, robust, gradient: F1 {f1:.4f}, precision {precision:.4f}')
    assert f1 >= 0.99
    assert precision >= 0.95
    for kind in ('2x', '0.5x', 'vary', 'stop'):
        indices = DriveChanges.from_name(kind, 200).images(200)
        f1, precision = evaluated(reference, query[indices], truth.select(indices))
        print(f'Gardens Point {kind}: F1 {f1:.4f}, precision {precision:.4f}')
        assert f1 >= 0.95
        assert precision >= 0.93


def test_corridor_is_recognized(traverses, data_folder):
    truth = GroundTruth.from_file(data_folder / 'corridor' / 'ground_truth.csv', 111, 111, 0)
    f1, precision = evaluated(traverses('corridor/ref'), traverses('corridor/query'), truth)
    print(f'corridor, robust, gradient: F1 {f1:.4f}, precision {precision:.4f}')
    assert f1 >= 0.95
    assert precision >= 0.95


@pytest.mark.parametrize(
    ('route', 'query'),
    [('gardens_point/day_left', 'corridor/query'), ('corridor/ref', 'gardens_point/day_right')],
)
def test_other_route_is_not_matched(traverses, route, query):
    answers = recognize_all(PlaceRecognizer(map_of(traverses(route)), SETTINGS), traverses(query))[
        19:
    ]
    alarms = np.mean([answer.status is Status.MATCH for answer in answers])
    print(f'{query} on the map of {route}: {alarms:.3f} false alarms')
    assert alarms <= 0.05
