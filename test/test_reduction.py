# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Projection of a map to its principal components: by hand, in files, when the map grows."""

import cv2
import numpy as np
import pytest
from stavpr_ros.commands import map as map_command
from stavpr_ros.errors import SettingsError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import build_map as map_of
from stavpr_ros.mapping import GrowingMap, load_map, Map, save_map, select_places
from stavpr_ros.mapping.reduction import with_principal_components
from stavpr_ros.sources.frame import Frame

D = 6
pytestmark = pytest.mark.usefixtures('one_thread')


def images(count):
    rng = np.random.default_rng(0)
    wide = cv2.blur(rng.integers(0, 256, (48, 48 + 8 * count, 3), np.uint8), (5, 5))
    return [np.ascontiguousarray(wide[:, 8 * i : 8 * i + 48]) for i in range(count)]


@pytest.fixture(scope='module')
def whole():
    frames = [Frame(image, 0, str(i)) for i, image in enumerate(images(30))]
    return map_of(frames, FeatureExtractor('gradient'), thumbnails=False, progress=False)


@pytest.mark.parametrize('count', [30, 40])
def test_directions_are_those_of_largest_variance(count):
    """Of 7 strips each, fewer and more than their 224 dimensions."""
    frames = [Frame(image, 0, str(i)) for i, image in enumerate(images(count))]
    whole = map_of(frames, FeatureExtractor('gradient'), thumbnails=False, progress=False)
    assert (7 * count < whole.dimension) == (count == 30)
    reduced = with_principal_components(whole, D)
    x = whole.features.strips.astype(np.float64)
    centered = (x - x.mean(axis=1, keepdims=True)).reshape(-1, x.shape[2])
    _, _, directions = np.linalg.svd(centered, full_matrices=False)
    matrix = reduced.projection.matrix
    np.testing.assert_allclose(matrix @ matrix.T, directions[:D].T @ directions[:D], atol=1e-4)
    projected = x @ matrix
    projected /= np.linalg.norm(projected, axis=2, keepdims=True)
    np.testing.assert_allclose(reduced.features.strips, projected, atol=1e-5)


def test_more_directions_than_a_third_of_the_strips_are_rejected(whole):
    few = select_places(whole, np.arange(3))
    assert with_principal_components(few, 7).dimension == 7
    with pytest.raises(SettingsError, match=r'^8 principal .* 21 strips .* at most 7'):
        with_principal_components(few, 8)


@pytest.mark.parametrize('before', [[], [12]])
def test_query_of_reduced_map_is_projected_as_its_places(whole, before):
    """Also where one reduction follows another."""
    reduced = whole
    for dimension in (*before, D):
        reduced = with_principal_components(reduced, dimension)
    assert reduced.projection.matrix.shape == (whole.dimension, D)
    query = reduced.extractor().extract(images(30)[7:8])
    query.require_same_settings(reduced.settings, 'the map')
    np.testing.assert_allclose(query.strips[:, 0], reduced.features.strips[:, 7], atol=1e-4)
    growing = GrowingMap.from_map(reduced, 100)
    growing.add(query)
    assert len(growing) == 31
    assert growing.projection.identity == reduced.projection.identity


@pytest.mark.parametrize('dimension', [0, -1, 224, 300])
def test_reduction_to_other_dimension_is_rejected(whole, dimension):
    with pytest.raises(SettingsError, match=f'^{dimension} principal .* of 224 dimensions'):
        with_principal_components(whole, dimension)


def test_compact_reduces_map_to_principal_components(whole, tmp_path, capsys):
    saved, compact, smaller = (str(tmp_path / name) for name in ('whole', 'compact', 'smaller'))
    save_map(whole, saved)
    assert map_command.main(['compact', saved, compact, '--pca', f'{D}']) == 0
    found = load_map(compact)
    assert isinstance(found, Map)
    assert found.features.strips.shape == (7, 30, D)
    assert found.projection.name == f'principal components 224 -> {D} of 30 places'
    assert map_command.main(['compact', compact, smaller, '--pca', '4']) == 0
    assert load_map(smaller).dimension == 4
    assert 'strips of 6 dimensions become 4' in capsys.readouterr().out
