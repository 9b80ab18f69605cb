# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The kinds of features, the extractor, and the table that they are rows of."""

import numpy as np
import pytest
from stavpr_ros.errors import (
    FeatureMismatchError,
    ImageError,
    SettingsError,
    UnavailableError,
)
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.features.gradient import GradientSettings
from stavpr_ros.features.registry import backbone_class, settings_class
import torch


def test_extractor_of_unknown_kind_is_rejected():
    with pytest.raises(SettingsError, match=r'teleport.*gradient'):
        FeatureExtractor('teleport')


@pytest.mark.parametrize('bad', [{'cell': 1}, {'cell': 15}, {'size': 16}, {'orientations': 1}])
def test_gradient_settings_out_of_range_are_rejected(bad):
    with pytest.raises(SettingsError):
        GradientSettings(**bad)


@pytest.fixture(scope='session')
def tiny_onnx(tmp_path_factory):
    """Save a network of one convolution that sums each 2 x 2 block."""
    onnx = pytest.importorskip('onnx', reason='the extra onnx is not installed')
    from onnx import helper, numpy_helper, TensorProto

    weights = numpy_helper.from_array(np.ones((1, 3, 2, 2), np.float32), 'w')
    nodes = [
        helper.make_node('Conv', ['x', 'w'], ['block'], strides=[2, 2]),
        helper.make_node('Relu', ['block'], ['relu']),
        helper.make_node('GlobalAveragePool', ['relu'], ['y']),
    ]
    graph = helper.make_graph(
        nodes,
        'tiny',
        [helper.make_tensor_value_info('x', TensorProto.FLOAT, [1, 3, 16, 16])],
        [helper.make_tensor_value_info('y', TensorProto.FLOAT, [1, 1, 1, 1])],
        [weights],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid('', 13)], ir_version=8)
    path = tmp_path_factory.mktemp('onnx') / 'tiny.onnx'
    onnx.save(model, path)
    return path


def onnx_settings(path, **changes):
    options = {'layer': 'relu', 'size': 16, 'scale': 1.0, 'mean': (0, 0, 0), 'std': (1, 1, 1)}
    return settings_class('onnx')(model=str(path), **options | changes)


def test_onnx_inner_layer_by_hand(tiny_onnx):
    """Sums over blocks of four equal pixels; blue first, mean and std by channel; two images."""
    image = np.zeros((16, 16, 3), np.uint8)
    image[:, :] = 100, 2, 1
    settings = onnx_settings(tiny_onnx, channels='bgr', mean=(0, 0, 20), std=(1, 1, 2))
    maps = backbone_class('onnx')(settings).feature_maps([image, 2 * image])
    assert maps.shape == (2, 1, 8, 8)
    assert (maps[0] == 4 * (1 + 2 + (100 - 20) / 2)).all()
    assert (maps[1] == 4 * (2 + 4 + (200 - 20) / 2)).all()


def test_extractor_of_features_not_finite_fails(tiny_onnx):
    """Sums of 1.2e38 at 255, more than float32 holds where all four pixels are bright."""
    extractor = FeatureExtractor('onnx', onnx_settings(tiny_onnx, scale=1.5e35), strips=2)
    with pytest.raises(ImageError, match='not finite'):
        extractor.extract([np.full((16, 16, 3), 255, np.uint8)])


def test_extractor_of_network_never_finite_is_rejected(tiny_onnx):
    with pytest.raises(SettingsError, match='test image are not finite'):
        FeatureExtractor('onnx', onnx_settings(tiny_onnx, scale=1e38), strips=2)


def test_onnx_errors_name_file_and_layer(tiny_onnx, tmp_path):
    with pytest.raises(UnavailableError, match='cannot be read'):
        FeatureExtractor('onnx', onnx_settings(tmp_path / 'missing.onnx'))
    (tmp_path / 'broken.onnx').write_bytes(b'no model')
    with pytest.raises(UnavailableError, match='no usable ONNX model'):
        FeatureExtractor('onnx', onnx_settings(tmp_path / 'broken.onnx'))
    with pytest.raises(SettingsError, match=r"no layer 'fire'.*block, relu, y"):
        FeatureExtractor('onnx', onnx_settings(tiny_onnx, layer='fire'))
    with pytest.raises(SettingsError, match='must be'):
        onnx_settings(tiny_onnx, channels='hsv')
    with pytest.raises(FeatureMismatchError, match='sha256'):
        FeatureExtractor('onnx', onnx_settings(tiny_onnx, sha256='0' * 64))


def test_onnx_squeezenet_has_expected_shape(squeezenet_settings):
    """The real network's inner layer: 13 x 13 x 384, cropped to seven strips of one column."""
    extractor = FeatureExtractor('onnx', squeezenet_settings)
    rng = np.random.default_rng(0)
    features = extractor.extract([rng.integers(0, 256, (60, 80, 3), np.uint8) for _ in range(3)])
    assert features.strips.shape == (7, 3, 13 * 384)
    torch.testing.assert_close(torch.linalg.vector_norm(features.strips, dim=2), torch.ones(7, 3))
