"""The Gaussian random projection: seeded, recognizable, and nearly keeping distances."""

import numpy as np
import oracle
import pytest

from stavpr_ros.errors import InputError, SettingsError

torch = pytest.importorskip('torch')
Projection = pytest.importorskip('stavpr_ros.features.projection').Projection


def test_the_same_seed_is_the_same_projection():
    one, two = Projection.gaussian(40, 16, seed=3), Projection.gaussian(40, 16, seed=3)
    np.testing.assert_array_equal(one.matrix, two.matrix)
    assert one.matrix.dtype == np.float32
    assert one.identity == two.identity
    assert isinstance(one.identity, str)


def test_another_seed_is_another_matrix():
    assert not np.array_equal(Projection.gaussian(40, 16).matrix, Projection.gaussian(40, 16, seed=1).matrix)


def test_identity_tells_projections_apart():
    identities = {
        Projection.gaussian(40, 16).identity,
        Projection.gaussian(40, 16, seed=1).identity,
        Projection.gaussian(40, 17).identity,
        Projection.gaussian(41, 16).identity,
    }
    assert len(identities) == 4


def test_identity_follows_the_matrix_not_the_seed_alone():
    one = Projection.gaussian(40, 16)
    changed = one.matrix.copy()
    changed[3, 5] = np.nextafter(changed[3, 5], np.float32(9))
    assert Projection(changed, one.name).identity != one.identity
    assert Projection(one.matrix.copy(), one.name).identity == one.identity  # as when a map is loaded


def test_default_is_512_dimensions():
    assert tuple(Projection.gaussian(30).apply(torch.zeros(7, 2, 30)).shape) == (7, 2, 512)


def test_apply_is_the_matrix_product():
    projection = Projection.gaussian(6, 4, seed=1)
    strips = np.random.default_rng(0).standard_normal((3, 5, 6)).astype(np.float32)
    result = projection.apply(torch.from_numpy(strips))
    assert result.dtype == torch.float32
    for i in range(3):
        for image in range(5):
            for column in range(4):
                expected = sum(
                    float(strips[i, image, row]) * float(projection.matrix[row, column]) for row in range(6)
                )
                assert float(result[i, image, column]) == pytest.approx(expected, abs=1e-5)


def test_zero_strips_stay_zero():
    assert not Projection.gaussian(6, 4).apply(torch.zeros(7, 2, 6)).any()


def test_an_empty_map_can_be_projected():
    assert tuple(Projection.gaussian(6, 4).apply(torch.zeros(7, 0, 6)).shape) == (7, 0, 4)


def test_entries_are_gaussian_of_mean_zero():
    matrix = Projection.gaussian(1000, 512).matrix
    spread = matrix.std()
    # 512,000 entries: the mean's deviation is spread / 715; the share within one deviation is .6827 +- .0007
    assert abs(matrix.mean()) < 5 * spread / 715
    assert np.mean(np.abs(matrix) < spread) == pytest.approx(0.6827, abs=0.004)


def test_cosine_distances_are_nearly_kept():
    # a cosine of m projected dimensions deviates by at most 1 / sqrt(m) = .044; 5 deviations
    strips = np.maximum(np.random.default_rng(5).standard_normal((6, 1, 3000)), 0).astype(np.float32)
    projected = Projection.gaussian(3000, 512, seed=2).apply(torch.from_numpy(strips)).numpy()
    before = oracle.distances(strips[:, 0], strips)
    after = oracle.distances(projected[:, 0], projected)
    np.testing.assert_allclose(after, before, atol=5 / np.sqrt(512))
    assert np.abs(after - before).max() > 1e-4  # it did project


def test_another_number_of_dimensions_is_refused_by_both_numbers():
    with pytest.raises(InputError) as error:
        Projection.gaussian(6, 4).apply(torch.zeros(7, 2, 5))
    assert '5' in str(error.value)
    assert '6' in str(error.value)


@pytest.mark.parametrize(('dimension_in', 'dimension', 'named'), [(0, 4, '0'), (6, 0, '0'), (6, -3, '-3')])
def test_dimensions_out_of_range_are_refused(dimension_in, dimension, named):
    with pytest.raises(SettingsError) as error:
        Projection.gaussian(dimension_in, dimension)
    assert named in str(error.value)


def test_a_negative_seed_is_refused():
    with pytest.raises(SettingsError) as error:
        Projection.gaussian(6, 4, seed=-1)
    assert '-1' in str(error.value)
