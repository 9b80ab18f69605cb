"""The matcher on CUDA beside the one on the CPU; in the simulator as well (see test_cuda_kernels.py)."""

import os

import numpy as np
import oracle
import pytest
import torch

from stavpr_ros.alignment import SequenceSettings, SpatialSettings
from stavpr_ros.errors import InputError, SettingsError, UnavailableError
from stavpr_ros.features import LocalFeatures
from stavpr_ros.features.extractor import FeatureSettings

SIMULATOR = os.environ.get('NUMBA_ENABLE_CUDASIM') == '1'
SHORT = SequenceSettings(length=3, beta=2.0)
W, D = 4, 24
# Of products summed up in float32: the order of the sum is the library's. Away from near-ties, that is: where
# the last bit decides on a path, or on the nearest strip I_c, the distance jumps.
TOLERANCE = 1e-5


@pytest.fixture(scope='module')
def matcher_class():
    """The class, with small blocks; skips where there is nothing that kernels could run on."""
    from stavpr_ros.alignment.cuda.compilation import runtime
    from stavpr_ros.recognition.cuda_matcher import CudaMatcher

    try:
        runtime()
    except UnavailableError as error:
        pytest.skip(f'{error}; the same test runs in the simulator')

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dtw, 'BLOCK', 4)
        patch.setattr(lm_dtw, 'BLOCK', 8)
        yield CudaMatcher


def features(n, seed=0, strips=W, zero=()):
    """Features of n images, unit norm; those of ``zero`` (strip, image) are all zeros."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand((strips, n, D), generator=generator) - 0.2
    x = x / x.norm(dim=2, keepdim=True)
    weights = torch.rand((strips, n), generator=generator) + 0.1
    for strip, image in zero:
        x[strip, image] = weights[strip, image] = 0
    return LocalFeatures(x, weights / weights.norm(dim=0), FeatureSettings('gradient', None, strips))


def rounded(x, precision):
    """What is left of the features in half width, in full width."""
    return LocalFeatures(x.strips.to(getattr(torch, precision)).float(), x.weights, x.settings)


def expected_row(reference, query, i, settings):
    """Distances of image i of the query, by products in float64 and the oracle."""
    x, y = query.strips[:, i].double().numpy(), reference.strips.double().numpy()
    products = np.einsum('id,jnd->ijn', x, y)
    if settings.strategy == 'none':
        weights = query.weights[:, i].double().numpy()[:, None] * reference.weights.double().numpy()
        return 1 - (np.einsum('iin->in', products) * weights).sum(axis=0)
    return oracle.image_distances(1 - products, settings.strategy, settings.sigma, settings.xi)


@pytest.mark.parametrize('strategy', ['adaptive', 'vanilla', 'sliding_window', 'none'])
@pytest.mark.parametrize('xi', [None, 2])
@pytest.mark.parametrize('precision', ['float32', 'float16'])
def test_distances_of_every_strategy(matcher_class, strategy, xi, precision):
    reference, query = features(7, zero=[(1, 2)]), features(3, seed=1, zero=[(0, 0)])
    settings = SpatialSettings(strategy, 0.7, xi)
    matcher = matcher_class(reference, settings, SHORT, precision)
    assert matcher.places == 7
    matrix = matcher.distance_matrix(query.strips, query.weights)
    assert matrix.dtype == torch.float32
    kept = rounded(reference, precision)
    for i in range(3):
        expected = expected_row(kept, rounded(query, precision), i, settings)
        np.testing.assert_allclose(matrix[i].cpu().numpy(), expected, rtol=0, atol=TOLERANCE)
        row = matcher.distances(query.strips[:, i], query.weights[:, i])
        np.testing.assert_allclose(row.cpu().numpy(), expected, rtol=0, atol=TOLERANCE)


def test_half_width_is_not_full_width(matcher_class):
    reference, query = features(7), features(1, seed=1)
    rows = [
        matcher_class(reference, SpatialSettings(), SHORT, precision)
        .distances(query.strips[:, 0], query.weights[:, 0])
        .cpu()
        for precision in ('float32', 'float16')
    ]
    assert not torch.equal(*rows)
    torch.testing.assert_close(*rows, rtol=0, atol=0.2)


@pytest.mark.parametrize('precision', ['float32', 'float16'])
def test_maps_and_batches_in_pieces(matcher_class, monkeypatch, precision):
    from stavpr_ros.recognition import cuda_matcher

    reference, query = features(11), features(5, seed=1)
    whole = matcher_class(reference, SpatialSettings(), SHORT, precision)
    expected = whole.distance_matrix(query.strips, query.weights).cpu().numpy()
    monkeypatch.setattr(cuda_matcher, 'BLOCK_WORDS', 4 * W * W * 2)
    monkeypatch.setattr(cuda_matcher, 'QUERIES', 2)
    monkeypatch.setattr(cuda_matcher, 'PLACES_IN_PIECES', 3)
    pieces = matcher_class(reference, SpatialSettings(), SHORT, precision)
    got = pieces.distance_matrix(query.strips, query.weights).cpu().numpy()
    np.testing.assert_allclose(got, expected, rtol=0, atol=TOLERANCE)
    holistic = matcher_class(reference, SpatialSettings('none'), SHORT, precision)
    row = holistic.distances(query.strips[:, 0], query.weights[:, 0]).cpu().numpy()
    kept = rounded(reference, precision)
    expected = expected_row(kept, rounded(query, precision), 0, SpatialSettings('none'))
    np.testing.assert_allclose(row, expected, rtol=0, atol=TOLERANCE)


def same(a, b):
    """Two answers are one."""
    if a[0] is None or b[0] is None:
        return a[0] is b[0] and a[1].shape == b[1].shape == (0, 2)
    (match, path), (twin, twin_path) = a, b
    fields = ('first', 'last', 'distance', 'second_best_index')
    equal = all(getattr(match, name) == getattr(twin, name) for name in fields)
    runners = np.array_equal(match.second_best_distance, twin.second_best_distance, equal_nan=True)
    return equal and runners and np.array_equal(path, twin_path) and path.dtype == twin_path.dtype


@pytest.mark.parametrize(('n', 'length', 'beta'), [(19, 3, 2.0), (1, 2, 1.5), (4, 3, 3.0)])
@pytest.mark.parametrize('nms_radius', [0, 3])
def test_the_window_rolls_like_the_one_of_the_cpu(matcher_class, n, length, beta, nms_radius):
    from stavpr_ros.recognition.cpu_matcher import CpuMatcher

    sequence = SequenceSettings(length=length, beta=beta)
    reference = features(n)
    matcher = matcher_class(reference, SpatialSettings(), sequence)
    twin = CpuMatcher(reference, SpatialSettings(), sequence)
    rng = np.random.default_rng(n)
    for t in range(2 * length + 2):
        row = np.round(rng.random(n, np.float32), 1)
        row[rng.random(n) < 0.2] = np.inf
        matcher.push(torch.from_numpy(row).to(matcher.distances(*first_image(reference)).device))
        twin.push(torch.from_numpy(row))
        assert len(matcher) == len(twin) == min(t + 1, length)
        if t + 1 >= length:
            answer, expected = matcher.match(nms_radius), twin.match(nms_radius)
            assert same(answer, expected), (answer, expected)
    matcher.reset()
    assert len(matcher) == 0
    assert matcher.match(nms_radius)[0] is None


def first_image(x):
    return x.strips[:, 0], x.weights[:, 0]


def test_a_drive_is_recognized_with_cures_between(matcher_class):
    reference = features(12)
    matcher = matcher_class(reference, SpatialSettings(xi=2), SHORT)
    for place in range(5, 8):
        row = matcher.distances(reference.strips[:, place], reference.weights[:, place])
        matcher.push((row - row.mean()) / row.std())
    match, path = matcher.match(nms_radius=2)
    assert (match.first, match.last) == (5, 7)
    assert path.tolist() == [[0, 5], [1, 6], [2, 7]]


def test_rows_that_were_given_out_stay_as_they_were(matcher_class):
    reference = features(6)
    matcher = matcher_class(reference, SpatialSettings(), SHORT)
    first = matcher.distances(*first_image(reference))
    kept = first.clone()
    matcher.distances(reference.strips[:, 3], reference.weights[:, 3])
    assert torch.equal(first, kept)


@pytest.mark.parametrize('strategy', ['adaptive', 'none'])
def test_an_empty_map_has_no_match(matcher_class, strategy):
    query = features(1)
    matcher = matcher_class(features(3)[0:0], SpatialSettings(strategy), SHORT)
    assert matcher.places == 0
    for _ in range(3):
        row = matcher.distances(*first_image(query))
        assert row.shape == (0,)
        matcher.push(row)
    match, path = matcher.match(20)
    assert match is None
    assert path.shape == (0, 2)


def test_settings_that_do_not_fit_the_map(matcher_class):
    with pytest.raises(SettingsError, match='xi = 5'):
        matcher_class(features(3), SpatialSettings(xi=5), SHORT)
    with pytest.raises(InputError, match='at least 4'):
        matcher_class(features(3, strips=3), SpatialSettings('sliding_window'), SHORT)


@pytest.mark.skipif(SIMULATOR, reason='sizes of a real map take a real device')
@pytest.mark.parametrize('precision', ['float32', 'float16'])
def test_a_large_map_on_the_device(matcher_class, monkeypatch, precision):
    from stavpr_ros.recognition.cpu_matcher import CpuMatcher

    monkeypatch.setattr(dtw, 'BLOCK', 128)
    monkeypatch.setattr(lm_dtw, 'BLOCK', 128)
    reference, query = features(30_000, strips=7), features(25, seed=1, strips=7)
    settings, sequence = SpatialSettings(xi=3), SequenceSettings()
    matcher = matcher_class(reference, settings, sequence, precision)
    twin = CpuMatcher(reference, settings, sequence, precision)
    matrix = matcher.distance_matrix(query.strips, query.weights)
    expected = twin.distance_matrix(rounded(query, precision).strips, query.weights)
    apart = (matrix.cpu() - expected).abs() > TOLERANCE
    assert apart.float().mean() < 1e-4  # near-ties
    for row in matrix:
        matcher.push(row)
        twin.push(row.cpu())
    assert same(matcher.match(20), twin.match(20))
