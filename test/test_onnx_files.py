# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""ONNX files as other programs write them: batches, inputs, layers, several files."""

from evaluation_commands import runner, write_images
import numpy as np
import pytest
from stavpr_ros.commands import build_map
from stavpr_ros.errors import SettingsError, UnavailableError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.features.registry import settings_class
import torch

onnx = pytest.importorskip('onnx', reason='the extra onnx is not installed')
helper, FLOAT = onnx.helper, onnx.TensorProto.FLOAT
WEIGHTS = np.random.default_rng(0).standard_normal((8, 3, 8, 8)).astype(np.float32) / 50
IMAGES = list(np.random.default_rng(1).integers(0, 256, (4, 48, 64, 3), np.uint8))


@pytest.fixture
def saved(tmp_path):
    """Return a function that writes a network: a convolution to 8 x 8 cells ``y``, and more."""

    def save(*nodes, shape=('b', 3, 64, 64), dtype=FLOAT, **constants):
        conv = helper.make_node('Conv', ['x', 'w'], ['y'], strides=[8, 8])
        arrays = {'w': WEIGHTS} | constants
        graph = helper.make_graph(
            [conv, *nodes],
            'net',
            [helper.make_tensor_value_info('x', dtype, shape)],
            [helper.make_tensor_value_info('y', FLOAT, ['b', 8, 8, 8])],
            [onnx.numpy_helper.from_array(value, name) for name, value in arrays.items()],
        )
        opset = [helper.make_opsetid('', 13)]
        onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=8), tmp_path / 'a.onnx')
        return tmp_path / 'a.onnx'

    return save


def extractor(path, layer='y', size=64, **changes):
    settings = settings_class('onnx')(model=str(path), layer=layer, size=size, **changes)
    return FeatureExtractor('onnx', settings)


def single(made):
    return torch.cat([made.extract([image]).strips for image in IMAGES], dim=1)


def reshape(*shape):
    return helper.make_node('Reshape', ['y', 's'], ['z']), np.array(shape, np.int64)


@pytest.mark.parametrize('batch', ['b', 1, 4])
def test_batch_of_convolutions_may_be_stated(saved, batch):
    made = extractor(saved(shape=(batch, 3, 64, 64)))
    torch.testing.assert_close(made.extract(IMAGES).strips, single(made))


@pytest.mark.parametrize('shape', [(1, -1), (1, 512)])
def test_network_for_one_image_is_run_image_by_image(saved, shape):
    node, s = reshape(*shape)
    made = extractor(saved(node, shape=(1, 3, 64, 64), s=s), 'z')
    features = made.extract(IMAGES).strips
    assert features.shape == (1, 4, 512)
    assert torch.equal(features, single(made))


def test_network_whose_images_influence_each_other_is_run_image_by_image(saved):
    mean = helper.make_node('ReduceMean', ['y'], ['m'], axes=[0, 2, 3], keepdims=1)
    made = extractor(saved(mean, helper.make_node('Sub', ['y', 'm'], ['z'])), 'z')
    assert torch.equal(made.extract(IMAGES).strips, single(made))


def test_network_for_four_images_is_rejected_before_any_image(saved):
    node, s = reshape(4, 512)
    with pytest.raises(SettingsError, match=r'rejects images of size 64.*Reshape'):
        extractor(saved(node, shape=(4, 3, 64, 64), s=s), 'z')


@pytest.mark.parametrize(
    ('changes', 'named'),
    [
        ({'shape': (1, 3, 96, 96)}, r'\(1, 3, 96, 96\).* not \(n, 3, 64, 64\): set size = 96'),
        ({'shape': ('b', 3, 64, 96)}, 'square RGB images'),
        ({'shape': ('b', 64, 64, 3)}, r'\(0, 64, 64, 3\).*square RGB images'),
        ({'shape': ('b', 1, 64, 64)}, 'square RGB images'),
        ({'shape': (3,)}, 'square RGB images'),
        ({'dtype': onnx.TensorProto.UINT8}, "input 'x' is of ONNX type 2, expected 1"),
        ({'dtype': onnx.TensorProto.DOUBLE}, 'ONNX type 11'),
    ],
)
def test_other_inputs_are_rejected_by_name(saved, changes, named):
    with pytest.raises((SettingsError, UnavailableError), match=named):
        extractor(saved(**changes))


def test_layers_that_are_not_one_row_an_image_are_rejected_by_name(saved):
    mean = helper.make_node('ReduceMean', ['y'], ['z'], keepdims=0)
    with pytest.raises(SettingsError, match=r"layer 'z' .* returns \(\) for 1 images"):
        extractor(saved(mean), 'z')
    node, s = reshape(-1)
    with pytest.raises(SettingsError, match=r'returns \(512,\) for 1 images'):
        extractor(saved(node, s=s), 'z')
    index = helper.make_node('ArgMax', ['y'], ['z'], axis=1)
    with pytest.raises(SettingsError, match="layer 'z' is int64, expected float numbers"):
        extractor(saved(index), 'z')
    with pytest.raises(SettingsError, match="no layer '': its layers are y"):
        extractor(saved(), '')


def test_weights_in_another_file_are_rejected_with_the_remedy(saved, tmp_path):
    model = onnx.load(saved())
    path = tmp_path / 'b.onnx'
    onnx.save(model, path, save_as_external_data=True, location='b.bin', size_threshold=0)
    with pytest.raises(UnavailableError, match='weights are in other files: save it as one'):
        extractor(path)


def test_build_map_with_a_network_anywhere_suggests_a_threshold(
    saved, tmp_path, monkeypatch, capsys
):
    """The file is in no folder of models; its place is an option of the command."""
    folder = write_images(tmp_path / 'drive', np.tile(IMAGES, (20, 1, 1, 1)))
    run = runner(build_map, monkeypatch, capsys)
    code, output, errors = run(
        *('--input', folder, '--output', tmp_path / 'map.stavpr', '--features', 'onnx'),
        *('--onnx-model', saved(), '--onnx-layer', 'y', '--onnx-size', 64),
    )
    assert code == 0, errors
    assert 'suggested threshold for mode paper' in output
