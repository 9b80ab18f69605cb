# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Vectors of whole images in maps: files, growing maps, journals; and as a first stage."""

from dataclasses import replace

import map_reader
import numpy as np
import pytest
from stavpr_ros.alignment import SpatialSettings
from stavpr_ros.errors import FeatureMismatchError, InputError, MapFileError
from stavpr_ros.features import FeatureSettings, LocalFeatures
from stavpr_ros.features.registry import OnnxSettings
from stavpr_ros.mapping import load_map, open_map, PlaceMap, save_map
from stavpr_ros.mapping.growing_map import GrowingMap
from stavpr_ros.mapping.journal import Base, JournalPlace
from stavpr_ros.mapping.journal_map import journal_map, recover
from stavpr_ros.mapping.journal_writer import JournalWriter
from stavpr_ros.mapping.merging import merge_maps, select_places
from stavpr_ros.mapping.reduction import with_principal_components
from stavpr_ros.prepare import first_stage
from stavpr_ros.prepare.cpu_matcher import CpuMatcher
from stavpr_ros.prepare.first_stage import FirstStage
from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings

W, d, D = 3, 8, 20
BACKBONE = OnnxSettings(model='', layer='map', vector='global', sha256='0' * 64)
SETTINGS = FeatureSettings('onnx', BACKBONE, W)
pytestmark = pytest.mark.usefixtures('one_thread')


def unit(*shape, seed=0):
    drawn = np.random.default_rng(seed).standard_normal(shape).astype(np.float32)
    return drawn / np.linalg.norm(drawn, axis=-1, keepdims=True)


def features_of(n, seed=0):
    weights = np.full((W, n), W**-0.5, np.float32)
    return LocalFeatures(unit(W, n, d, seed=seed), weights, SETTINGS, None, unit(n, D, seed=seed))


def map_of(features):
    n = len(features)
    return PlaceMap(features, None, np.arange(1, n + 1), tuple(map(str, range(n))))


@pytest.fixture
def place_map():
    return map_of(features_of(50))


@pytest.mark.parametrize('storage', ['float32', 'float16'])
def test_map_file_returns_vectors(place_map, tmp_path, storage):
    path = tmp_path / 'a.stavpr'
    save_map(place_map, path, storage)
    expected = place_map.features.vectors
    if storage == 'float16':
        expected = expected.astype(np.float16).astype(np.float32)
    opened, loaded = open_map(path), load_map(path)
    assert np.array_equal(loaded.features.vectors, expected)
    assert np.array_equal(opened.features.vectors, expected)
    some = np.array([3, 4, 40])
    assert np.array_equal(opened.features[some].vectors, expected[some])
    stored = map_reader.read(path)[1]['vectors/vectors']
    np.testing.assert_array_equal(stored.astype(np.float32), expected)
    save_map(opened, tmp_path / 'b.stavpr')
    assert load_map(tmp_path / 'b.stavpr').map_id == loaded.map_id


def test_map_file_without_vectors_has_no_section(place_map, tmp_path):
    bare = replace(place_map, features=replace(place_map.features, vectors=None))
    save_map(bare, tmp_path / 'a')
    assert 'vectors' not in map_reader.read(tmp_path / 'a')[0]['sections']
    assert open_map(tmp_path / 'a').features.vectors is None


@pytest.mark.parametrize(
    ('vectors', 'named'),
    [
        (np.full((50, D), np.nan, np.float32), 'part vectors/vectors, from place 0'),
        (np.full((50, D), 9, np.float32), 'longer than 1'),
        (np.zeros((49, D), np.float32), 'expected 50 for n'),
        (np.zeros((50, 0), np.float32), 'no dimensions'),
    ],
)
def test_map_file_with_invalid_vectors_is_rejected(place_map, tmp_path, vectors, named):
    bad = replace(place_map.features, vectors=vectors)
    save_map(replace(place_map, features=bad), tmp_path / 'a')
    with pytest.raises(MapFileError, match=named):
        load_map(tmp_path / 'a')


def grown(features, limit=100):
    growing = GrowingMap(SETTINGS, None, limit)
    for i in range(len(features)):
        growing.add(features[i : i + 1], i + 1, str(i))
    return growing


def test_growing_map_holds_vectors(tmp_path):
    features = features_of(300)
    growing = grown(features, 400)
    assert np.array_equal(growing.snapshot().features.vectors, features.vectors)
    growing.forget(100)
    assert np.array_equal(growing.features.vectors, features.vectors[100:])
    save_map(growing.snapshot(), tmp_path / 'a')
    continued = GrowingMap.from_map(open_map(tmp_path / 'a'), 400)
    continued.add(features[:1], 999)
    expected = np.concatenate([features.vectors[100:], features.vectors[:1]])
    assert np.array_equal(continued.features.vectors, expected)


def test_growing_map_of_a_route_that_another_object_holds_has_vectors():
    features = features_of(5)
    bare = replace(features, vectors=None)
    growing = GrowingMap(SETTINGS, None, 10, held_features=lambda: bare)
    for i in range(5):
        growing.add(features[i : i + 1])
    assert np.array_equal(growing.snapshot().features.vectors, features.vectors)


@pytest.mark.parametrize(
    ('vectors', 'named'),
    [
        (None, 'no vector: places of the map have one of 20'),
        (np.zeros((1, 5), np.float32), 'a vector of 5 dimensions'),
        (np.full((1, D), np.nan, np.float32), 'not finite'),
    ],
)
def test_growing_map_rejects_another_vector(vectors, named):
    growing = grown(features_of(3))
    with pytest.raises(InputError, match=named):
        growing.add(replace(features_of(1), vectors=vectors))
    assert len(growing) == 3


def test_journal_returns_vectors(place_map, tmp_path):
    target = tmp_path / 'route.stavpr'
    writer = JournalWriter.create(target, Base(), select_places(place_map, np.arange(1)), print)
    for i in range(len(place_map)):
        writer.append(JournalPlace(i, place_map.place(i), place_map.features[i : i + 1], b''))
    writer.close()
    assert np.array_equal(journal_map(writer.path).features.vectors, place_map.features.vectors)
    assert recover(writer.path).recorded == 50
    found = load_map(target).features
    assert np.array_equal(found.vectors, place_map.features.vectors)
    assert np.array_equal(found.strips, place_map.features.strips)


def test_maps_made_of_maps_keep_vectors(place_map):
    vectors = place_map.features.vectors
    assert np.array_equal(with_principal_components(place_map, 4).features.vectors, vectors)
    both = merge_maps([place_map, place_map], ['a', 'b'])
    assert np.array_equal(both.features.vectors, np.concatenate([vectors, vectors]))
    assert np.array_equal(
        select_places(both, np.array([1, 60])).features.vectors, vectors[[1, 10]]
    )


def noisy(features, share):
    """Return the same images with other vectors."""
    drawn = unit(len(features), D, seed=9)
    vectors = features.vectors + share * drawn
    return replace(features, vectors=vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


@pytest.fixture
def few(monkeypatch):
    monkeypatch.setattr(first_stage, 'SAMPLED', 12)
    monkeypatch.setattr(first_stage, 'NEAREST', 3)


def recognizer(features, **changes):
    settings = RecognizerSettings(mode='robust', time_budget_ms=1e-6, **changes)
    return PlaceRecognizer(map_of(features), settings)


def test_first_stage_takes_candidates_by_vector_not_by_strips(few):
    """The strips of the image are of no place, its vector is that of place 816."""
    features = features_of(1200)
    image = replace(features_of(1, seed=5), vectors=features.vectors[816:817])
    matcher = CpuMatcher(features, SpatialSettings())
    strips, weights = image.strips[:, 0], image.weights[:, 0]
    expected = matcher.distances(strips, weights)
    whole = LocalFeatures(features.vectors[None], np.ones((1, 1200), np.float32), SETTINGS)

    def exact_in_chunk(held, *vector):
        stage = FirstStage(matcher, held, lambda: np.empty(0, np.int64))
        found = stage.distances(strips, weights, *vector)
        return np.isclose(found, expected, atol=1e-6)[800:832].all()

    assert exact_in_chunk(whole, image.vectors)
    assert not exact_in_chunk(features)


def test_recognizer_with_vectors_matches_as_exact_one(few):
    features = features_of(1200)
    query = noisy(features[800:840], 0.5)
    exact = PlaceRecognizer(map_of(features), RecognizerSettings(mode='robust'))
    coarse = recognizer(features)
    assert 'a first stage of vectors' in coarse.start_notes
    for i in range(len(query)):
        a, b = exact.update(query[i : i + 1]), coarse.update(query[i : i + 1])
        assert (a.status, a.place_index) == (b.status, b.place_index)
    assert b.accepted
    assert abs(b.sequence.middle - 829) <= 1
    coarse.reset()
    again = [coarse.update(query[i : i + 1]).probability for i in range(len(query))]
    assert again[-1] == b.probability, "the vectors' running mean is reset as well"


def test_first_stage_of_vectors_rejects_query_without(few):
    one = recognizer(features_of(300))
    with pytest.raises(FeatureMismatchError, match='without a vector of the whole image'):
        one.update(replace(features_of(1), vectors=None))
