# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Alignments, matcher and recognizer in torch operations, against the oracle and the CPU."""

import numpy as np
import oracle
from places import features_of, map_of, route_strips
import pytest
from stavpr_ros.alignment import best_match, SequenceDistances, SequenceSettings, SpatialSettings
from stavpr_ros.alignment.cpu.int8 import Int8Strips, round_queries
from stavpr_ros.alignment.device import lm_dtw, spatial_alignment
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.features import FeatureSettings, LocalFeatures
from stavpr_ros.mapping import Session
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings, Status
from stavpr_ros.method.columns import ColumnLayout
from stavpr_ros.method.device import DeviceLmDtwWindow, z_normalized_on_device
from stavpr_ros.method.lm_dtw_window import LmDtwWindow
from stavpr_ros.method.settings import RobustOptions
from stavpr_ros.prepare import device_matcher
from stavpr_ros.prepare.centering import z_normalized
from stavpr_ros.prepare.matcher import make_matcher
import torch

W, D = 4, 24
# Sums are formed in the order of the library, and products may be fused with sums. Random features
# have no near-ties, where the last bit decides on a path or the nearest strip.
TOLERANCE = 1e-5


def random_distances(seed, shape, levels=None):
    products = np.random.default_rng(seed).random(shape, np.float32)
    if levels is not None:
        products = np.round(products * levels).astype(np.float32) / np.float32(levels)
    return np.float32(1) - products


@pytest.mark.parametrize('strategy', ['adaptive', 'vanilla', 'rigid', 'sliding_window'])
@pytest.mark.parametrize(
    ('strips', 'xi', 'n', 'sigma', 'levels'),
    [
        (7, None, 50, 1.0, None),
        (7, 3, 50, 0.3, 3),  # three levels: ties everywhere
        (6, None, 1, 0.0, 3),
        (4, None, 6, 5.0, None),  # an even number of strips
        (5, 1, 9, 1.0, None),
    ],
)
def test_image_distances_equal_oracle(device, strategy, strips, xi, n, sigma, levels):
    d = random_distances(strips, (strips, strips, n), levels)
    settings = SpatialSettings(strategy, sigma, xi)
    result = spatial_alignment(strips, settings, device)(torch.from_numpy(d).to(device))
    expected = oracle.image_distances(d, strategy, sigma, xi, np.float32)
    np.testing.assert_allclose(result.cpu().numpy(), expected, rtol=0, atol=1e-6)


def test_published_figure(device):
    d = torch.from_numpy(oracle.GOLDEN[:, :, None].astype(np.float32)).to(device)
    result = spatial_alignment(7, SpatialSettings(), device)(d).item()
    assert result == pytest.approx(0.28724851, abs=1e-6)


@pytest.mark.parametrize('radius', [0, 3])
@pytest.mark.parametrize(
    ('l', 'n', 'beta', 'levels', 'banned'),
    [
        (3, 11, 2.0, None, 0.1),
        (5, 30, 2.0, 4, 0.1),  # ties
        (2, 1, 1.5, None, 0),
        (6, 20, 1.3, 2, 0.3),
        (4, 3, 3.0, None, 0),  # fewer places than a start searches
        (3, 5, 2.0, None, 1),  # no path
    ],
)
def test_window_equals_oracle_bit_for_bit(device, l, n, beta, levels, banned, radius):
    """Distances, lengths, nearest start and second best, and the path that the CPU finds."""
    rng, sequence = np.random.default_rng(n), SequenceSettings(l, beta)
    layout = ColumnLayout(nms_radius=radius)
    window, twin = DeviceLmDtwWindow(sequence, n, layout, device), LmDtwWindow(sequence, n, layout)
    rows = random_distances(n, (2 * l + 1, n), levels)
    rows[rng.random(rows.shape) < banned] = np.inf
    for t, row in enumerate(rows):
        window.push(torch.from_numpy(row).to(device), row, t)
        twin.push(row, row, t)
        if t + 1 < l:
            continue
        (result, sequences), (expected, _) = window.match(), twin.match()
        q, m = oracle.match_sequence(rows[t + 1 - l : t + 1], beta, np.float32)
        answer = oracle.best_match(q, m, radius)
        np.testing.assert_equal(vars(result), vars(expected))
        if answer is None:
            assert result.place < 0
            continue
        assert (result.first, result.last) == (answer.start, answer.last)
        assert result.distance == answer.distance
        costs, middles = sequences()[:2]
        np.testing.assert_array_equal(costs, q)
        m = np.where(np.isfinite(q), m, 0)
        np.testing.assert_array_equal(middles, SequenceDistances(q, m).middles)
        assert best_match(SequenceDistances(q, m), radius).first == answer.start
    window.reset()
    assert len(window.images) == 0


def test_starts_of_default_window_equal_oracle(device):
    rows, sequence = random_distances(1, (20, 60)), SequenceSettings()
    window = torch.full((20, 60 + sequence.k - 1), torch.inf, device=device)
    window[:, :60] = torch.from_numpy(rows)
    distances, lengths = lm_dtw(window, sequence.k)
    q, m = oracle.match_sequence(rows, 2.0, np.float32)
    np.testing.assert_array_equal(distances.cpu(), q)
    np.testing.assert_array_equal(lengths.cpu(), m)


def features(n, seed=0, strips=W, zero=()):
    """Return unit-norm features of n images, with all zeros at ``zero`` (strip, image)."""
    rng = np.random.default_rng(seed)
    x = rng.random((strips, n, D), np.float32) - np.float32(0.2)
    x /= np.linalg.norm(x, axis=2, keepdims=True)
    weights = rng.random((strips, n), np.float32) + np.float32(0.1)
    for strip, image in zero:
        x[strip, image] = weights[strip, image] = 0
    return LocalFeatures(
        x, weights / np.linalg.norm(weights, axis=0), FeatureSettings('gradient', None, strips)
    )


def expected_row(reference, query, i, settings, precision):
    """Distances of image i of the query, by products in float64 and the oracle."""
    x, y = query.strips[:, i].astype(float), reference.strips.astype(float)
    if precision == 'int8':
        whole, lengths = round_queries(query.strips)
        x = whole[i].astype(float) * lengths[i, :, None]
        held = Int8Strips(*y.shape)
        held[:, :] = reference.strips
        y = held[:, :].astype(float)
    products = np.einsum('id,jnd->ijn', x, y)
    if settings.strategy == 'none':
        weights = query.weights[:, i].astype(float)[:, None] * reference.weights.astype(float)
        return 1 - (np.einsum('iin->in', products) * weights).sum(axis=0)
    return oracle.image_distances(1 - products, settings.strategy, settings.sigma, settings.xi)


@pytest.mark.parametrize('precision', ['float32', 'int8'])
@pytest.mark.parametrize(
    ('strategy', 'xi'),
    [
        ('adaptive', None),
        ('adaptive', 2),
        ('vanilla', 2),
        ('rigid', None),
        ('rigid', 2),
        ('sliding_window', 2),
        ('none', None),
    ],
)
def test_distances_of_every_strategy_equal_oracle(device, set_constants, strategy, xi, precision):
    set_constants(device_matcher, WIDENED=3 * W * D)
    reference, query = features(7, zero=[(1, 2)]), features(4, seed=1, zero=[(0, 0)])
    settings = SpatialSettings(strategy, 0.7, xi)
    matcher = make_matcher(reference, settings, device, precision)
    assert matcher.places == 7
    matrix = matcher.distance_matrix(query.strips, query.weights)
    rows = [matcher.distances(query.strips[:, i], query.weights[:, i]) for i in range(4)]
    for i, row in enumerate(rows):
        expected = expected_row(reference, query, i, settings, precision)
        np.testing.assert_allclose(matrix[i], expected, rtol=0, atol=TOLERANCE)
        np.testing.assert_array_equal(row.cpu().numpy(), matrix[i])


def test_strip_distances_of_int8_are_those_of_cpu_bit_for_bit(device):
    reference, query = features(9, strips=7), features(2, seed=1, strips=7)
    matcher = make_matcher(reference, SpatialSettings(), device, 'int8')
    held = Int8Strips(*reference.strips.shape)
    held[:, :] = reference.strips
    whole, lengths = round_queries(query.strips)
    for i in range(2):
        matcher.distances(query.strips[:, i], query.weights[:, i])
        expected = oracle.whole_number_distances(
            whole[i], held.codes(), lengths[i], held.reciprocals[:, :9]
        )
        np.testing.assert_array_equal(matcher._strip_distances().cpu(), expected)


def test_empty_map_has_no_distances_and_no_match(device):
    query = features(1)
    matcher = make_matcher(features(3)[0:0], SpatialSettings(), device, 'float32')
    window = DeviceLmDtwWindow(SequenceSettings(3), 0, ColumnLayout(), device)
    for t in range(3):
        row = matcher.distances(query.strips[:, 0], query.weights[:, 0])
        assert row.shape == (0,)
        window.push(row, query.strips[:, 0], t)
    assert window.match().path.place < 0


def test_invalid_settings_are_rejected(device):
    with pytest.raises(SettingsError, match='xi = 5'):
        make_matcher(features(3), SpatialSettings(xi=5), device, 'float32')
    with pytest.raises(InputError, match='at least 4'):
        make_matcher(features(3, strips=3), SpatialSettings('sliding_window'), device, 'float32')
    with pytest.raises(SettingsError, match='no vertical alignment'):
        make_matcher(features(3), SpatialSettings(vertical=True), device, 'float32')


# The recognizer on devices of torch against the one on the CPU

pytestmark = pytest.mark.usefixtures('one_thread')


def test_z_normalized_equals_that_of_cpu(device):
    row = np.random.default_rng(0).uniform(0.2, 1, 150).astype(np.float32)
    row[[7, 149]] = np.inf
    flat, banned = np.full(5, 0.5, np.float32), np.full(3, np.inf, np.float32)
    for values in (row, row[:5], flat, banned):
        for counted in (np.ones(len(values), bool), np.arange(len(values)) % 3 > 0):
            arguments = (torch.from_numpy(array).to(device) for array in (values, counted))
            result = z_normalized_on_device(*arguments).cpu()
            np.testing.assert_allclose(result, z_normalized(values, counted=counted), atol=1e-5)


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
        result, expected = (
            recognizer.update(query[i : i + 1], i + 1) for recognizer in (one, cpu)
        )
        assert result.status == expected.status
        assert result.window_stamps == expected.window_stamps
        assert result.window_changes == expected.window_changes
        statuses.add(expected.status)
        np.testing.assert_allclose(one.newest_row(), cpu.newest_row(), atol=2e-5)
        if expected.path.place < 0:
            continue
        assert result.distance == pytest.approx(expected.distance, abs=1e-5)
        if mode == 'robust':
            assert result.probability == pytest.approx(expected.probability, abs=1e-5)
        if not expected.accepted:
            continue
        assert result.path.place == expected.path.place
        np.testing.assert_array_equal(result.path.pairs, expected.path.pairs)
        places = [[c.place for c in recognizer.ranked(2)] for recognizer in (one, cpu)]
        assert places[0] == places[1]
    assert {Status.WARMING_UP, Status.MATCH} <= statuses
    one.reset()
    assert one.update(query[:1]).status == Status.WARMING_UP


def test_settings_that_need_the_cpu_are_rejected(device):
    place_map, _ = drive_map(False)
    options = RobustOptions(place_filter=False)
    with pytest.raises(SettingsError, match='mode paper only'):
        PlaceRecognizer(place_map, RecognizerSettings(mode=options), device)
