# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Features that are one vector an image (W = 1), and pooled strips."""

import numpy as np
from pipelines import localizing, process
import pytest
from stavpr_ros.alignment import SpatialSettings
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.features import FeatureExtractor, FeatureSettings, LocalFeatures
from stavpr_ros.features.extractor import cut_strips
from stavpr_ros.features.registry import settings_class
from stavpr_ros.mapping import build_map, load_map, save_map
from stavpr_ros.prepare.matcher import make_matcher
from stavpr_ros.recognition import Status
from stavpr_ros.sources.frame import Frame


@pytest.mark.parametrize('pooling', ['mean', 'gem'])
def test_cut_strips_pooled_equals_plain_loops(pooling):
    """A map of 5 rows and 8 columns in three strips: columns 1-2, 3-4, 5-6."""
    maps = np.random.default_rng(0).standard_normal((2, 3, 5, 8)).astype(np.float32)
    strips = cut_strips(maps, 3, pooling)
    assert strips.shape == (3, 2, 3)
    for w in range(3):
        for n in range(2):
            for c in range(3):
                cells = [float(maps[n, c, y, 1 + 2 * w + x]) for y in range(5) for x in range(2)]
                expected = sum(cells) / 10
                if pooling == 'gem':
                    expected = (sum(max(v, 1e-6) ** 3 for v in cells) / 10) ** (1 / 3)
                assert float(strips[w, n, c]) == pytest.approx(expected, abs=1e-6)


@pytest.fixture(scope='module')
def network(tmp_path_factory):
    """Return an ONNX file with a map ``map``, its tokens ``tokens`` and a vector ``global``."""
    onnx = pytest.importorskip('onnx', reason='the extra onnx is not installed')
    from onnx import helper, numpy_helper, TensorProto

    weights = np.random.default_rng(0).standard_normal((16, 3, 8, 8)).astype(np.float32)
    constants = {
        'w': weights,
        'flat': np.array([0, 16, 64], np.int64),
        'out': np.random.default_rng(1).standard_normal((1024, 32)).astype(np.float32),
        'flatter': np.array([0, 1024], np.int64),
    }
    nodes = [
        helper.make_node('Conv', ['x', 'w'], ['conv'], strides=[8, 8]),
        helper.make_node('Relu', ['conv'], ['map']),
        helper.make_node('Reshape', ['map', 'flat'], ['channels']),
        helper.make_node('Transpose', ['channels'], ['tokens'], perm=[0, 2, 1]),
        helper.make_node('Reshape', ['tokens', 'flatter'], ['cells']),
        helper.make_node('MatMul', ['cells', 'out'], ['global']),
    ]
    graph = helper.make_graph(
        nodes,
        'net',
        [helper.make_tensor_value_info('x', TensorProto.FLOAT, ['b', 3, 64, 64])],
        [helper.make_tensor_value_info('global', TensorProto.FLOAT, ['b', 32])],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid('', 13)], ir_version=8)
    path = tmp_path_factory.mktemp('onnx') / 'net.onnx'
    onnx.save(model, path)
    return path


def extractor(path, layer='global', strips=None, **changes):
    settings = settings_class('onnx')(model=str(path), layer=layer, size=64, **changes)
    return FeatureExtractor('onnx', settings, strips)


@pytest.mark.parametrize(
    ('changes', 'text'),
    [
        ({'strips': 7}, r'vector of 32 numbers .* not 7 and flatten'),
        ({'pooling': 'gem'}, 'not 1 and gem'),
        ({'layer': 'tokens'}, '63 without the first 1'),
        ({'layer': 'map', 'strips': 9}, r'Wf = 8 .*W = 9'),
        ({'layer': 'map', 'pooling': 'max'}, "pooling = 'max'"),
        ({'layer': 'local'}, "no layer 'local'.* are global, conv, map"),
    ],
)
def test_unusable_layers_are_rejected_before_any_image(network, changes, text):
    with pytest.raises((InputError, SettingsError), match=text):
        extractor(network, **changes)


def test_map_of_vectors_localizes_in_the_pipeline(network, route, tmp_path):
    frames = [Frame(image, i + 1, '') for i, image in enumerate(route)]
    path = tmp_path / 'vectors.stavpr'
    save_map(build_map(frames, extractor(network), progress=False), path)
    assert load_map(path).features.strips.shape == (1, 60, 32)
    pipeline = localizing(str(path), model_path=str(network))
    noise = np.random.default_rng(0)
    images = [
        np.clip(image + noise.normal(0, 10, image.shape), 0, 255).astype(np.uint8)
        for image in route[20:40]
    ]
    last = process(pipeline, images)[-1]
    assert last.status == Status.MATCH
    assert last.place_index == 37


def vectors(n, d, seed=0):
    """Return unit-norm vectors along a random curve; the first is zero."""
    steps = np.random.default_rng(seed).standard_normal((n, d))
    curve = np.cumsum(steps, axis=0) * 0.5 + steps
    curve /= np.linalg.norm(curve, axis=1, keepdims=True)
    curve[0] = 0
    weights = (np.linalg.norm(curve, axis=1) > 0).astype(np.float32)
    return LocalFeatures(
        (curve[None].astype(np.float32)),
        weights[None],
        FeatureSettings('gradient', None, 1),
        (1, 1),
    )


@pytest.mark.parametrize(
    ('strategy', 'precision', 'error'),
    [
        ('adaptive', 'float32', 1e-5),
        ('vanilla', 'float32', 1e-5),
        ('none', 'float32', 1e-5),
        ('vertical', 'float32', 1e-5),
        ('adaptive', 'int8', 0.02),
    ],
)
def test_alignment_of_one_strip_is_the_cosine_distance(strategy, precision, error):
    vertical = strategy == 'vertical'
    spatial = SpatialSettings('adaptive' if vertical else strategy, vertical=vertical)
    features, queries = vectors(131, 515), vectors(3, 515, seed=1)
    matcher = make_matcher(features, spatial, 'cpu', precision)
    matrix = matcher.distance_matrix(queries.strips, queries.weights)
    expected = 1 - queries.strips[0] @ features.strips[0].T
    np.testing.assert_allclose(matrix, expected, rtol=0, atol=error)
    row = matcher.distances(queries.strips[:, 1], queries.weights[:, 1])
    assert np.array_equal(row, matrix[1])


def test_sliding_window_over_one_strip_is_rejected_with_the_map():
    with pytest.raises(InputError, match='W = 1 strips: the sliding window'):
        make_matcher(vectors(5, 4), SpatialSettings('sliding_window'), 'cpu', 'float32')
