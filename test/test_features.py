# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The kinds of features, the extractor, and the table that they are rows of."""

import numpy as np
import pytest
from stavpr_ros.errors import FeatureMismatchError, SettingsError, UnavailableError
from stavpr_ros.features import FeatureExtractor, FeatureSettings
from stavpr_ros.features.gradient import Gradient, GradientSettings
from stavpr_ros.features.registry import backbone_class, settings_class
import torch


def test_extractor_of_unknown_kind_is_rejected():
    with pytest.raises(SettingsError, match=r'teleport.*gradient'):
        FeatureExtractor('teleport')


def edge(angle: float, size: int = 224) -> np.ndarray:
    """Return a step edge through the middle; its gradient points along ``angle``."""
    y, x = np.mgrid[:size, :size] - size / 2
    bright = (x * np.cos(angle) + y * np.sin(angle)) > 0
    return np.repeat((bright * 200 + 20).astype(np.uint8)[:, :, None], 3, axis=2)


@pytest.mark.parametrize('direction', [0, 3, 6])
def test_gradient_of_edge_has_its_orientation(direction):
    angle = direction * np.pi / 4
    maps = Gradient(GradientSettings()).feature_maps([edge(angle)])
    assert maps.shape == (1, 8, 14, 14)
    assert int(maps.sum(dim=(0, 2, 3)).argmax()) == direction


def test_gradient_unsigned_ignores_polarity():
    maps = Gradient(GradientSettings(signed=False)).feature_maps([edge(0.5), 255 - edge(0.5)])
    torch.testing.assert_close(
        maps[0].sum(dim=(1, 2)), maps[1].sum(dim=(1, 2)), rtol=1e-3, atol=1e-3
    )


def test_extractor_edge_stays_in_its_strip():
    image = np.zeros((224, 224, 3), np.uint8)
    image[:, 3 * 32 + 16 :] = 255  # the edge is in the middle of strip 4 of 7
    features = FeatureExtractor().extract([image])
    assert int(features.weights[:, 0].argmax()) == 3


def test_extractor_is_robust_to_contrast(route):
    """Half the contrast, other brightness: nearly the same direction in feature space."""
    dim = [(image.astype(float) * 0.5 + 30).astype(np.uint8) for image in route[:4]]
    extractor = FeatureExtractor()
    a, b = extractor.extract(route[:4]), extractor.extract(dim)
    assert float((a.strips * b.strips).sum(dim=2).min()) > 0.97


def test_extractor_batch_equals_single_images(route):
    extractor = FeatureExtractor()
    mixed = [
        route[0],
        np.ascontiguousarray(route[1][:50]),
        route[2].repeat(3, axis=0),
    ]  # sizes differ
    together = extractor.extract(mixed)
    for i, image in enumerate(mixed):
        torch.testing.assert_close(extractor.extract([image]).strips[:, 0], together.strips[:, i])


def test_extractor_of_black_image_returns_zeros():
    features = FeatureExtractor().extract([np.zeros((10, 10, 3), np.uint8)])
    assert not features.strips.any()
    assert not features.weights.any()


@pytest.mark.parametrize('bad', [{'cell': 1}, {'cell': 15}, {'size': 16}, {'orientations': 1}])
def test_gradient_settings_out_of_range_are_rejected(bad):
    with pytest.raises(SettingsError):
        GradientSettings(**bad)


def test_feature_settings_survive_json():
    for settings in (
        FeatureExtractor().settings,
        FeatureExtractor(strips=5, projection=32, seed=3).settings,
    ):
        assert FeatureSettings.from_json(settings.to_json()) == settings
    with pytest.raises(SettingsError, match='cannot be read'):
        FeatureSettings.from_json('{"kind": "gradient", "backbone": {"teleport": 1}, "strips": 7}')
    with pytest.raises(SettingsError):
        FeatureSettings.from_json('not json')


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
    options = {
        'layer': 'relu',
        'size': 16,
        'scale': 1.0,
        'mean': (0, 0, 0),
        'std': (1, 1, 1),
    } | changes
    return settings_class('onnx')(model=str(path), **options)


def test_onnx_inner_layer_by_hand(tiny_onnx):
    """Pixel values summed over a block of four equal pixels, by hand; batch of two."""
    image = np.zeros((16, 16, 3), np.uint8)
    image[:, :, 0], image[:, :, 1], image[:, :, 2] = 1, 2, 3
    backbone = backbone_class('onnx')(onnx_settings(tiny_onnx))
    maps = backbone.feature_maps([image, 2 * image])
    assert maps.shape == (2, 1, 8, 8)
    assert (maps[0] == 4 * (1 + 2 + 3)).all()
    assert (maps[1] == 8 * (1 + 2 + 3)).all()


def test_onnx_normalization_by_hand(tiny_onnx):
    image = np.zeros((16, 16, 3), np.uint8)
    image[:, :, 0] = 100  # red
    settings = onnx_settings(tiny_onnx, channels='bgr', mean=(0, 0, 20), std=(1, 1, 2))
    assert (backbone_class('onnx')(settings).feature_maps([image]) == 4 * (100 - 20) / 2).all()


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


def test_onnx_model_may_move_but_not_change(tiny_onnx, tmp_path):
    """A moved file gives the same features; another file under its name is rejected."""
    settings = FeatureExtractor('onnx', onnx_settings(tiny_onnx)).settings
    moved = tmp_path / 'moved.onnx'
    moved.write_bytes(tiny_onnx.read_bytes())
    assert FeatureExtractor.from_settings(settings, None, model=str(moved)).settings == settings
    moved.write_bytes(tiny_onnx.read_bytes() + b'\x00')
    with pytest.raises((FeatureMismatchError, UnavailableError)):
        FeatureExtractor.from_settings(settings, None, model=str(moved))


def test_onnx_squeezenet_has_expected_shape(squeezenet_settings):
    """The real network's inner layer: 13 x 13 x 384, cropped to seven strips of one column."""
    extractor = FeatureExtractor('onnx', squeezenet_settings)
    rng = np.random.default_rng(0)
    features = extractor.extract([rng.integers(0, 256, (60, 80, 3), np.uint8) for _ in range(3)])
    assert features.strips.shape == (7, 3, 13 * 384)
    torch.testing.assert_close(torch.linalg.vector_norm(features.strips, dim=2), torch.ones(7, 3))
