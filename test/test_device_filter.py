# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The place filter in torch operations, against the oracle and the one on the CPU."""

from dataclasses import replace

import numpy as np
import oracle
from places import features_of, map_of, route_strips
import pytest
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.errors import SettingsError
from stavpr_ros.filter.device_filter import DevicePlaceFilter
from stavpr_ros.filter.model import FilterSettings
from stavpr_ros.filter.paths import TOP
from stavpr_ros.filter.place_filter import PlaceFilter
from stavpr_ros.mapping import Session
from stavpr_ros.prepare.normalization import z_normalized
from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings, Status
from stavpr_ros.recognition.device_windows import z_normalized_on_device
from stavpr_ros.recognition.settings import RobustOptions
import torch

pytestmark = pytest.mark.usefixtures('one_thread')
# Every probability large enough to matter, and the levels not as likely as each other
LIVELY = FilterSettings(
    keep_level=0.7, keep_speed=0.6, spread=0.15, leave=0.07, enter=0.2, start=0.6
)
FEW = replace(LIVELY, speeds=(0.0, 1.0, 2.5), levels=(-1.0, -2.0))
ONE = replace(LIVELY, speeds=(0.5,), levels=(-2.0,))
LAG = 4


def random_image(rng, n, s):
    """Return z, alpha, weights and likelihoods of the speeds."""
    z = rng.standard_normal(n).astype(np.float32)
    z[rng.random(n) < 0.1] = np.inf
    return z, float(rng.uniform(0.1, 0.5)), *rng.uniform(0.1, 1, (2, len(s.speeds)))


@pytest.mark.parametrize('settings', [LIVELY, FEW, ONE, replace(FEW, enter=0.0)])
@pytest.mark.parametrize('firsts', [(0,), (0, 12)])
def test_probabilities_and_paths_equal_oracle(device, settings, firsts):
    """Of one session, and of two with a gap of columns between them."""
    rng, n, gap = np.random.default_rng(5), 25, 7
    plain = oracle.PlaceFilter(settings, firsts)
    columns = np.arange(n) + gap * (np.arange(n) >= 12) * (len(firsts) > 1)
    width = int(columns[-1]) + 1
    gaps = np.setdiff1d(np.arange(width), columns)
    one = DevicePlaceFilter(width, LAG, settings, gaps, device)
    for image in range(8):
        z, alpha, weights, likelihoods = random_image(rng, n, settings)
        alpha = 0.0 if image == 3 else alpha
        row = np.full(width, np.inf, np.float32)
        row[columns] = z
        one.update(torch.from_numpy(row).to(device), alpha, weights, likelihoods)
        plain.update(z, alpha, weights, likelihoods)
        found = one.places_of_states()
        np.testing.assert_allclose(found[columns], plain.a.sum(axis=(0, 1)), rtol=1e-5, atol=1e-6)
        assert not found[gaps].any()
        assert 1 - found.sum(dtype=np.float64) == pytest.approx(sum(plain.off), abs=1e-5)
        ago = min(image, LAG)
        for state in one.belief(width, ago).states:
            k, v, y = (int(value) for value in state[:3])
            way = plain.way((k, v, int(np.searchsorted(columns, y))), ago)
            expected = [columns[at[2]] if at else -1 for at in way]
            np.testing.assert_array_equal(one.path(state, ago), expected)
            assert way[-1][1] == state[3]


@pytest.mark.parametrize('gaps', [(), (11, 12, 13, 14, 15, 16)])
def test_answers_equal_those_of_cpu(device, gaps):
    """Of a drive over the end of the map, and of another one after a reset."""
    rng, n, settings = np.random.default_rng(3), 90, FilterSettings()
    known = np.array(gaps, np.int64)
    cpu = PlaceFilter(n, LAG, settings, known)
    one = DevicePlaceFilter(n, LAG, settings, known, device)
    for drive in range(2):
        for image in range(12 - 6 * drive):
            z, _, weights, likelihoods = random_image(rng, n, settings)
            z[min(82 + image, n - 1)] -= 4 if 82 + image < n else 0
            z[known] = np.inf
            not_near = np.array([3, 40, 82 + image])[: 2 + (image % 2)] if image % 3 else known[:0]
            arguments = 0.0 if image == 6 else 0.3, weights, likelihoods, not_near
            not_near = not_near[not_near < n]
            cpu.update(z, *arguments[:3], not_near)
            one.update(torch.from_numpy(z).to(device), *arguments[:3], not_near)
            assert one.count == cpu.count == image + 1
            found, expected = one.places_of_states(), cpu.places_of_states()
            np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-7)
            ago = min(image, LAG)
            found, expected = one.belief(n, ago), cpu.belief(n, ago)
            most = np.argmax(expected.weights)
            assert found.places[np.argmax(found.weights)] == expected.places[most]
            assert found.weights.max() == pytest.approx(expected.weights[most], rel=1e-4)
            state = found.states[np.argmax(found.weights)]
            np.testing.assert_array_equal(state, expected.states[most])
            np.testing.assert_array_equal(one.path(state, ago), cpu.path(state, ago))
            for excluded in (known[:0], np.arange(70, n), np.arange(1, n)):
                place, probability = cpu.most_probable(excluded)
                assert one.most_probable(excluded) == (place, pytest.approx(probability, rel=1e-4))
        cpu.reset()
        one.reset()


def test_places_beyond_those_copied_are_found(device, monkeypatch):
    monkeypatch.setattr('stavpr_ros.filter.device_filter.COPIED', TOP)
    one = DevicePlaceFilter(80, LAG, FEW, device=device)
    z = np.linspace(-3, 3, 80, dtype=np.float32)
    one.update(torch.from_numpy(z).to(device), 0.3, np.ones(3))
    sums = one.places_of_states()
    order = np.argsort(sums)
    place, excluded = order[9], np.sort(order[10:])  # more of them than are copied
    assert one.most_probable(excluded) == (place, pytest.approx(sums[place]))


def test_filter_of_no_places_and_routes(device):
    one = DevicePlaceFilter(0, LAG, FEW, device=device)
    for _ in range(3):
        one.update(torch.empty(0, device=device), 0.3, np.ones(3))
    assert not len(one.belief(0, 1).places)
    with pytest.raises(SettingsError, match="backend 'cpu'"):
        one.grow(3)
    with pytest.raises(SettingsError, match="backend 'cpu'"):
        one.evict(3)


def test_z_normalized_equals_that_of_cpu(device):
    row = np.random.default_rng(0).uniform(0.2, 1, 150).astype(np.float32)
    row[[7, 149]] = np.inf
    flat, banned = np.full(5, 0.5, np.float32), np.full(3, np.inf, np.float32)
    for values in (row, row[:5], flat, banned):
        for counted in (np.ones(len(values), bool), np.arange(len(values)) % 3 > 0):
            arguments = (torch.from_numpy(each).to(device) for each in (values, counted))
            found = z_normalized_on_device(*arguments).cpu()
            np.testing.assert_allclose(found, z_normalized(values, counted=counted), atol=1e-5)


def drive_map(sessions):
    """Return a map of 120 places, of one session or of two, and the features of a drive."""
    strips = route_strips(0, 60)
    strips[:, 30:34] = strips[:, 30:31]  # the map's camera stood
    places, parts = features_of(strips), {}
    if sessions:
        places = features_of(np.concatenate([strips, strips], axis=1), 0.4, 1)
        same_as = np.arange(120, dtype=np.int32)
        same_as[60:] -= 60
        index = np.repeat(np.arange(2, dtype=np.int32), 60)
        parts = {
            'sessions': (Session('a'), Session('b')), 'session_index': index, 'same_as': same_as
        }  # fmt: skip
    driven = [*range(8, 20), *[20] * 9, *range(20, 60), *[59] * 3]  # it stands at 20, and leaves
    query = features_of(strips[:, driven], 0.3, 2)
    query.strips[:, 13:21] = query.strips[:, 12:13]
    query.strips[:, -3:] = features_of(route_strips(9, 3)).strips
    return map_of(places, **parts), query


@pytest.mark.parametrize('sessions', [False, True], ids=['session', 'sessions'])
@pytest.mark.parametrize(
    ('mode', 'precision'), [('robust', 'float32'), ('robust', 'int8'), ('paper', 'float32')]
)
def test_recognizer_equals_that_of_cpu(device, mode, precision, sessions):
    place_map, query = drive_map(sessions)
    settings = RecognizerSettings(
        0.8 if mode == 'paper' else None, sequence=SequenceSettings(8), nms_radius=5, mode=mode
    )
    cpu, one = (
        PlaceRecognizer(place_map, settings, backend, precision) for backend in ('cpu', device)
    )
    statuses = set()
    for i in range(len(query)):
        found, expected = (each.update(query[i : i + 1], i + 1) for each in (one, cpu))
        assert found.status == expected.status
        assert found.window_stamps == expected.window_stamps
        assert found.window_changes == expected.window_changes
        statuses.add(expected.status)
        np.testing.assert_allclose(one.newest_row(), cpu.newest_row(), atol=2e-5)
        if expected.sequence is None:
            continue
        assert found.distance == pytest.approx(expected.distance, abs=1e-5)
        if mode == 'robust':
            assert found.probability == pytest.approx(expected.probability, abs=1e-5)
        if not expected.accepted:
            continue
        assert found.sequence.middle == expected.sequence.middle
        np.testing.assert_array_equal(found.path, expected.path)
        places = [[each.place for each in recognizer.ranked(2)] for recognizer in (one, cpu)]
        assert places[0] == places[1]
    assert {Status.WARMING_UP, Status.MATCH} <= statuses
    one.reset()
    assert one.update(query[:1]).status == Status.WARMING_UP


def test_settings_that_need_the_cpu_are_rejected(device):
    place_map, _ = drive_map(False)
    options = RobustOptions(place_filter=False)
    with pytest.raises(SettingsError, match='mode paper only'):
        PlaceRecognizer(place_map, RecognizerSettings(robust_options=options), device)
