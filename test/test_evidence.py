# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The probability of a match: evidence of its window, cells that agree, and error rates."""

from dataclasses import replace

import numpy as np
from places import features_of, map_of, recognize_all, route_strips
import pytest
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.features.registry import Cells, evidence_of, KINDS
from stavpr_ros.mapping import save_map
from stavpr_ros.mapping.place_map import ErrorRisks
from stavpr_ros.method import evidence, PlaceRecognizer, RecognizerSettings
from stavpr_ros.method.cells import agreeing, CellAgreement, cells_of
from stavpr_ros.method.error_rate import least_probability
from stavpr_ros.method.evidence import (
    probability_of,
    Quantities,
    RecentWindows,
    unevenness,
)
from stavpr_ros.pipeline import Pipeline, PipelineSettings, read_map


def test_probability_by_hand():
    """Of odds 3, a lead of 1, and half a window; of a drive that rarely matched."""
    window = Quantities(0.75, lead=1.0, images=10, cells=4.0)
    assert window.odds == pytest.approx(np.log(3))
    expected = -7.0 + 0.5 * np.log(3) + 1.5 * np.log(11) + 2.0 * np.log(5)
    assert window.own(-7.0) == pytest.approx(expected)
    plain = window._replace(cells=0.0)
    assert window._replace(cells=-2.0).own(-7.0) == plain.own(-7.0)
    assert plain._replace(creep=0.4).own(-7.0) == pytest.approx(plain.own(-7.0) - 2 * 0.4)
    own = plain._replace(lead=0.6).own(-7.0)
    expected = 1 / (1 + np.exp(5 * np.log(3) - own))
    assert probability_of(own, 0.25) == pytest.approx(expected)
    assert probability_of(own, 0.5) == probability_of(own, 0.9) > expected
    sure = Quantities(1.0, lead=4.0, images=20)
    assert sure.own(-7.0) == sure._replace(belief=1 - 1e-9).own(-7.0) > 1
    assert probability_of(-np.inf, 0.9) == 0


def test_checks_of_a_path_lower_its_odds_by_hand():
    window = Quantities(0.75, uneven=0.05, excess=0.06)
    assert window.odds == pytest.approx(np.log(3) - 10 * 0.05 - 25 * 0.02)
    assert window._replace(uneven=0.0, excess=0.04).odds == pytest.approx(np.log(3))
    assert window._replace(excess=9.0).odds == -evidence.LIMIT


def test_unevenness_is_of_each_place_once_with_its_nearest_image():
    path = np.array([3, 3, 4, 4, 5, 5])
    assert unevenness(path, np.array([-4, 1, 1, -4, -4, 1], np.float32)) == 0
    z = np.array([-4, np.inf, -1, 2, 0.5, np.inf], np.float32)
    assert unevenness(path, z) == pytest.approx(np.std([-4, -1, 0.5]) - 1.4)
    far = np.array([-9, -9, -3, -3, -3, -3], np.float32)
    assert unevenness(path, far) == pytest.approx(np.std([9, 3, 3]) - 0.45 * 5)
    assert unevenness(path, np.array([-9, 1, np.inf, np.inf, 9, 9], np.float32)) == 0  # of two


def test_recent_windows_start_even_and_forget():
    recent = RecentWindows()
    for _ in range(4):
        recent.add(1.0)
    assert recent.share == pytest.approx((0.5 + 4) / 5)
    for _ in range(600):
        recent.add(-np.inf)
    assert recent.share < 0.01
    for _ in range(30):
        recent.add(1.0)
    assert 0.4 < recent.share < 0.5


def test_weak_windows_make_a_drive_less_likely_with_learned_features():
    """Where right windows are farther ahead, on floors that look alike, these are not right."""
    probabilities = []
    for kind in ('gradient', 'hybrid', 'unknown'):
        places, query = features_of(route_strips(0, 120)), features_of(route_strips(0, 120), 7.0)
        places, query = (
            replace(part, settings=replace(part.settings, kind=kind)) for part in (places, query)
        )
        recognizer = PlaceRecognizer(map_of(places), RecognizerSettings(mode='robust'))
        matches = recognize_all(recognizer, query)
        probabilities.append(np.array([match.probability for match in matches]))
    gradient, hybrid, unknown = np.nan_to_num(probabilities)
    assert unknown.tolist() == gradient.tolist()
    assert (hybrid <= gradient).all()
    assert hybrid[40:].mean() < 0.9 * gradient[40:].mean()


# Cells of two images that are each other's nearest, and the lead of a path in them

CELLS = Cells(0, 4, 14, 2, dimension=112)


def random_cells(rng):
    cells = rng.standard_normal((49, 24)).astype(np.float32)
    return cells / np.linalg.norm(cells, axis=1, keepdims=True)


def plainly_agreeing(a, b):
    """Count the cells that agree, by the definition."""
    products = a @ b.T
    pairs = [(i, int(products[i].argmax())) for i in range(49)]
    pairs = [(i, j) for i, j in pairs if products[:, j].argmax() == i]
    pairs = [(i, j) for i, j in pairs if abs(i // 7 - j // 7) <= 1]
    return max(sum(abs(j % 7 - i % 7 - shift) <= 1 for i, j in pairs) for shift in range(-3, 4))


def test_cells_agree_as_plain_loops_count_them():
    rng = np.random.default_rng(0)
    a = random_cells(rng)
    assert agreeing(a, a) == 49
    for noise in (0.1, 0.3, 0.6, 2):
        b = a + noise * random_cells(rng)
        assert agreeing(a, b) == plainly_agreeing(a, b)
    moved = a.reshape(7, 7, 24)[:, np.r_[2:7, 0:2]].reshape(49, 24)  # two columns to the left
    assert agreeing(a, moved) == plainly_agreeing(a, moved) == 35
    assert agreeing(a, a[::-1].copy()) == plainly_agreeing(a, a[::-1]) < 15  # upside down


def test_cells_are_the_parts_of_an_image_row_by_row():
    maps = np.random.default_rng(1).standard_normal((3, 4, 14, 14)).astype(np.float32)
    strips = maps.reshape(3, 4, 14, 7, 2).transpose(3, 0, 1, 2, 4).reshape(7, 3, 112)
    cells = cells_of(strips, CELLS)
    assert cells.shape == (3, 49, 16)
    expected = maps[1][:, 4:6, 6:8].ravel()  # third row, fourth column
    np.testing.assert_allclose(cells[1, 17], expected / np.linalg.norm(expected), rtol=1e-5)


@pytest.mark.parametrize('count', [4, 20])
def test_lead_is_the_mean_over_images_of_path_less_competitor(count):
    """Also of images that went before in the window, whose cells are compared once."""
    rng = np.random.default_rng(2)
    strips = rng.standard_normal((7, 40, 112)).astype(np.float32)
    asked = []

    def strips_of(columns):
        asked.extend(columns.tolist())
        return strips[:, columns]

    agreement = CellAgreement(CELLS, strips_of, 20)
    noisy = strips + 0.8 * rng.standard_normal(strips.shape).astype(np.float32)
    for i in range(count):
        agreement.push(noisy[:, i])
    images = np.arange(count)
    own, place = cells_of(noisy, CELLS), cells_of(strips, CELLS)
    used = images if count == 4 else images[images % 2 == 0]
    expected = np.mean([plainly_agreeing(own[i], place[i]) for i in used])
    elsewhere = np.mean([plainly_agreeing(own[i], place[i + 15]) for i in used])
    lead = agreement.lead(images, images + 15)
    assert lead == pytest.approx(expected - elsewhere)
    assert lead > 5
    before = len(asked)
    assert agreement.lead(images, images[:0]) == pytest.approx(expected)
    assert len(asked) == before == 2 * len(used)
    agreement.reset()
    agreement.push(noisy[:, 0])
    assert agreement.lead(images[:1], images[:0]) == plainly_agreeing(own[0], place[0])


def test_kinds_have_cells_where_strips_are_as_they_were_extracted():
    for kind, entry in KINDS.items():
        if entry.cells is not None:
            assert evidence_of(kind, 7, entry.cells.dimension) == (entry.with_cells, entry.cells)
            for strips, dimension in ((7, 64), (1, entry.cells.dimension)):
                assert evidence_of(kind, strips, dimension) == (entry.constant, None)
    assert evidence_of('of another program', 7, 224) == (-4.6, None)


@pytest.mark.parametrize('precision', ['float32', 'int8'])
def test_cells_are_compared_on_all_backends(device, precision):
    """Features as long as gradients have cells; in int8 and on a device, c is nearly the same."""
    places = features_of(route_strips(0, 90, 224), 0.2, 1)
    query = features_of(route_strips(0, 90, 224)[:, 20:70], 0.6, 2)
    settings = RecognizerSettings()
    one = PlaceRecognizer(map_of(places), settings)
    matches = recognize_all(one, query)
    others = recognize_all(PlaceRecognizer(map_of(places), settings, device, precision), query)
    probabilities, same = ([m.probability for m in drive[20:]] for drive in (matches, others))
    np.testing.assert_allclose(same, probabilities, atol=0.02)


# The probability that an error rate chooses, by the built-in table or the risks of a map


def test_smaller_error_rates_choose_greater_probabilities():
    result = [least_probability(rate) for rate in np.geomspace(0.1, 0.005, 30)]
    assert (np.diff(result) > 0).all()


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
