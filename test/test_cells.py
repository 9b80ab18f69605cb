# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cells of two images that are each other's nearest, and the lead of a path in them."""

import numpy as np
from places import features_of, map_of, recognize_all, route_strips
import pytest
from stavpr_ros.features.registry import Cells, evidence_of, KINDS
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.method.cells import agreeing, CellAgreement, cells_of

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
    plain = PlaceRecognizer(map_of(places), settings)
    plain._window.cells = None
    without = recognize_all(plain, query)
    probabilities, same, lower = (
        np.array([match.probability for match in each[20:]]) for each in (matches, others, without)
    )
    np.testing.assert_allclose(same, probabilities, atol=0.02)
    assert (lower < probabilities).all()
