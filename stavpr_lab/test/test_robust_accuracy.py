# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Mode robust on real traverses of other speed and view, and on other routes."""

import numpy as np
from places import map_of
import pytest
from scores import best_f1
from stavpr_lab.evaluation.drive import DriveChanges
from stavpr_lab.evaluation.evaluate import recognize_all
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_lab.evaluation.metrics import counts_at, image_matches
from stavpr_ros.features import FeatureExtractor, LocalFeatures
from stavpr_ros.mapping import extract_features
from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings, Status
from stavpr_ros.recognition.loop_closer import LoopCloser
from stavpr_ros.recognition.robust import MIN_PROBABILITY
from stavpr_ros.sources import open_source
import torch

WARPS = ('2x', '1.5x', '0.7x', '0.5x', 'vary', 'stop')


def robust(place_map) -> PlaceRecognizer:
    return PlaceRecognizer(place_map, RecognizerSettings(mode='robust'))


@pytest.fixture(scope='module')
def traverses(data_folder):
    """Return a function from a folder to the gradient features of its images."""
    extractor, known = FeatureExtractor(), {}

    def features(name):
        if name not in known:
            known[name] = extract_features(
                open_source(data_folder / name), extractor, progress=False
            )
        return known[name]

    return features


def evaluated(reference, query, truth):
    """Best F1, and the precision at the default threshold."""
    answers = image_matches(recognize_all(robust(map_of(reference)), query), 20)
    correct = truth.accepts(answers.places)
    return best_f1(answers.distances, correct).f1, counts_at(
        1 - MIN_PROBABILITY, answers.distances, correct
    ).precision


def taken(features, indices):
    rows = torch.from_numpy(np.asarray(indices))
    return LocalFeatures(features.strips[:, rows], features.weights[:, rows], features.settings)


def test_gardens_point_at_every_speed_is_recognized(traverses):
    reference, query = traverses('gardens_point/day_left'), traverses('gardens_point/day_right')
    truth = GroundTruth.identity(200, 200, 2)
    f1, precision = evaluated(reference, query, truth)
    print(f'Gardens Point, robust, gradient: F1 {f1:.4f}, precision {precision:.4f}')
    assert f1 >= 0.99
    assert precision >= 0.95
    for kind in WARPS:
        indices = DriveChanges.named(kind, 200).images(200)
        f1, precision = evaluated(reference, taken(query, indices), truth.select(indices))
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
    [
        ('gardens_point/day_left', 'corridor/query'),
        ('corridor/ref', 'gardens_point/day_right'),
    ],
)
def test_other_route_is_not_matched(traverses, route, query):
    answers = recognize_all(robust(map_of(traverses(route))), traverses(query))[19:]
    alarms = np.mean([answer.status is Status.MATCH for answer in answers])
    print(f'{query} on the map of {route}: {alarms:.3f} false alarms')
    assert alarms <= 0.05


def test_hallway_loop_is_closed(traverses, data_folder):
    features = traverses('rtabmap_hallway_loop/samples')
    truth = GroundTruth.from_file(
        data_folder / 'rtabmap_hallway_loop' / 'samples_GT.bmp', 84, 84, 0
    )
    truth = truth.loop_closures(19)
    assert truth.has_match.sum() == 44
    closer = LoopCloser(RecognizerSettings(mode='robust'), 20, features.settings)
    answers = [closer.update(features[i : i + 1]) for i in range(84)]
    answered = image_matches(answers, 20)
    score = counts_at(
        1 - MIN_PROBABILITY, answered.distances, truth.accepts(answered.places), truth.has_match
    )
    print(f'hallway: precision {score.precision:.3f}, recall {score.recall:.3f}')
    assert score.precision >= 0.95
    assert score.recall >= 0.7
