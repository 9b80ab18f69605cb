# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The Gaussian random projection: seeded, identifiable, and nearly distance-preserving."""

import numpy as np
import pytest
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.features import Projection


def test_projection_identity_follows_matrix():
    one, two = Projection.gaussian(40, 16, seed=3), Projection.gaussian(40, 16, seed=3)
    np.testing.assert_array_equal(one.matrix, two.matrix)
    assert one.matrix.dtype == np.float32
    assert Projection(one.matrix.copy(), one.name).identity == two.identity  # of a loaded map
    two.matrix[3, 5] = np.nextafter(two.matrix[3, 5], np.float32(9))
    assert Projection(two.matrix, one.name).identity != one.identity
    others = [(40, 16, 0), (40, 16, 1), (40, 17, 0), (41, 16, 0)]
    assert len({Projection.gaussian(*other).identity for other in others}) == 4


def test_apply_equals_matrix_product():
    projection = Projection.gaussian(6, 4, seed=1)
    strips = np.random.default_rng(0).standard_normal((3, 5, 6)).astype(np.float32)
    strips[1, 2] = 0
    result = projection.apply(strips)
    assert result.dtype == np.float32
    np.testing.assert_allclose(
        result, np.einsum('ind,dm->inm', strips.astype(float), projection.matrix), atol=1e-5
    )
    assert not result[1, 2].any()


def test_gaussian_entries_are_normal_with_mean_zero():
    matrix = Projection.gaussian(1000, 512).matrix
    spread = matrix.std()
    assert spread == pytest.approx(512**-0.5, rel=0.01)  # norms are kept on average
    # 512,000 entries: the mean deviates by spread / 715, the share within one sigma by .0007
    assert abs(matrix.mean()) < 5 * spread / 715
    assert np.mean(np.abs(matrix) < spread) == pytest.approx(0.6827, abs=0.004)


def test_apply_of_other_dimension_is_rejected():
    with pytest.raises(InputError, match=r'shape \(7, 2, 5\) float32, expected \(W, n, 6\)'):
        Projection.gaussian(6, 4).apply(np.zeros((7, 2, 5), np.float32))


@pytest.mark.parametrize(
    ('arguments', 'text'),
    [((0, 4), 'features = 0'), ((6, 0), '= 0'), ((6, -3), '= -3'), ((6, 4, -1), 'seed .* = -1')],
)
def test_gaussian_out_of_range_is_rejected(arguments, text):
    with pytest.raises(SettingsError, match=text):
        Projection.gaussian(*arguments)
