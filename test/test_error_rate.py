# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The probability that an error rate chooses, by the built-in table or the risks of a map."""

from dataclasses import replace

import numpy as np
import pytest
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.mapping import save_map
from stavpr_ros.mapping.place_map import ErrorRisks
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.method.error_rate import least_probability
from stavpr_ros.pipeline import Pipeline, PipelineSettings, read_map


def test_smaller_error_rates_choose_greater_probabilities():
    found = [least_probability(rate) for rate in np.geomspace(0.1, 0.005, 30)]
    assert (np.diff(found) > 0).all()


@pytest.mark.parametrize('rate', [0.0, 0.001, 1.0, -0.1, float('nan')])
def test_error_rates_that_were_not_measured_are_rejected(rate):
    with pytest.raises(SettingsError, match=r'max_error = .*: expected 0 = off'):
        least_probability(rate)


def error_risks(risks=(3.0, 1.0, 0.0), units=39, method='robust'):
    return ErrorRisks(method, units, (0.2, 0.6, 0.9), risks)


@pytest.mark.parametrize(
    ('risks', 'rate', 'probability'),
    [
        (error_risks(), 0.1, 0.2),  # bounds 4 / 40, 2 / 40, 1 / 40
        (error_risks(), 0.0999, 0.6),
        (error_risks(), 0.025, 0.9),
        (error_risks(), 0.005, 0.95),  # too few blocks, and the built-in table is stricter
        (
            error_risks((2.0, 0.9, 0.0), 9),
            0.09,
            0.9,
        ),  # too few: their mean is at most .09 above .9
        (error_risks((2.0, 0.9, 0.0), 9), 0.1, 0.9),
        (error_risks((0.1, 0.0, 0.0), 2), 0.05, 0.2),  # their mean above .2 is .05
        (error_risks((39.0, 39.0, 39.0)), 0.1, 0.9),  # all wrong
    ],
)
def test_error_risks_of_a_map_choose_the_least_probability_that_keeps_the_rate(
    risks, rate, probability
):
    assert least_probability(rate, risks) == pytest.approx(probability)


@pytest.mark.parametrize(
    ('probabilities', 'risks', 'units'),
    [
        ((), (), 3),
        ((0.5,), (0.0, 0.0), 3),
        ((0.5, 0.5), (1.0, 0.0), 3),
        ((0.0, 0.5), (1.0, 0.0), 3),
        ((0.5, 1.0), (1.0, 0.0), 3),
        ((0.1, 0.5), (0.0, 1.0), 3),
        ((0.1, 0.5), (1.0, -0.1), 3),
        ((0.1, 0.5), (3.5, 0.0), 3),
        ((0.1, 0.5), (0.0, 0.0), 0),
        ((0.1, float('nan')), (0.0, 0.0), 3),
    ],
)
def test_impossible_error_risks_are_rejected(probabilities, risks, units):
    with pytest.raises(InputError, match='error risks'):
        ErrorRisks('robust', units, probabilities, risks)


@pytest.mark.parametrize(
    ('changes', 'probability', 'word'),
    [
        ({}, 0.6, ''),
        ({'max_error': 0.005}, 0.95, '39 blocks, 0.025 at least'),
        ({'sequence': SequenceSettings(12)}, 0.001, 'length=12'),
        ({'min_probability': 0.8}, 0.8, ''),
        ({'max_error': 0.0}, 0.5, ''),
    ],
)
def test_recognizer_keeps_the_error_rate_by_its_map_or_gives_the_reason(
    small_map, changes, probability, word
):
    settings = RecognizerSettings(mode='robust', max_error=0.05)
    place_map = replace(small_map, error_risks=error_risks(method=settings.calibration_key))
    recognizer = PlaceRecognizer(place_map, replace(settings, **changes))
    match = recognizer.update(small_map.features[:1])
    assert (match.limits.probability, match.threshold) == pytest.approx(
        (probability, 1 - probability)
    )
    assert recognizer.threshold == match.threshold
    assert word in recognizer.start_notes
    assert bool(word) == bool(recognizer.start_notes)
    assert PlaceRecognizer(small_map, settings).threshold == pytest.approx(0.999)


def test_pipeline_publishes_the_threshold_of_its_map(small_map, tmp_path):
    risks = error_risks(method=RecognizerSettings(mode='robust').calibration_key)
    save_map(replace(small_map, error_risks=risks), tmp_path / 'route.stavpr')
    pipeline = Pipeline(PipelineSettings(max_error=0.05))
    assert pipeline.operation.threshold == pytest.approx(0.999)
    pipeline.change(loaded=read_map(str(tmp_path / 'route.stavpr'), pipeline.settings))
    assert pipeline.operation.threshold == pytest.approx(0.4)
    pipeline.change(replace(pipeline.settings, max_error=0.1))
    assert pipeline.operation.threshold == pytest.approx(0.8)
