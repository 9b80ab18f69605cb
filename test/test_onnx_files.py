# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""ONNX files as other programs write them: batches, inputs, layers, several files, devices."""

from pathlib import Path
import re
from types import SimpleNamespace

import cv2
import numpy as np
from pipelines import localizing, process
import pytest
from stavpr_ros.errors import (
    FeatureMismatchError,
    ImageError,
    InputError,
    SettingsError,
    UnavailableError,
)
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.features.registry import backbone_class, settings_class
from stavpr_ros.mapping import build_map, load_map, save_map
from stavpr_ros.method import Status
from stavpr_ros.sources.frame import Frame
import torch
from torch import nn

onnx = pytest.importorskip('onnx', reason='the extra onnx is not installed')
onnxruntime = pytest.importorskip('onnxruntime', reason='the extra onnx is not installed')
helper, FLOAT = onnx.helper, onnx.TensorProto.FLOAT
WEIGHTS = np.random.default_rng(0).standard_normal((8, 3, 8, 8)).astype(np.float32) / 50
IMAGES = list(np.random.default_rng(1).integers(0, 256, (4, 48, 64, 3), np.uint8))


@pytest.fixture
def save_network(tmp_path):
    """Return a function that writes a network: a convolution to 8 x 8 cells ``y``, and more."""

    def save(*nodes, shape=('b', 3, 64, 64), dtype=FLOAT, **constants):
        conv = helper.make_node('Conv', ['x', 'w'], ['y'], strides=[8, 8])
        arrays = {'w': WEIGHTS} | constants
        graph = helper.make_graph(
            [conv, *nodes],
            'net',
            [helper.make_tensor_value_info('x', dtype, shape)],
            [helper.make_tensor_value_info([conv, *nodes][-1].output[0], FLOAT, ['b', 8, 8, 8])],
            [onnx.numpy_helper.from_array(value, name) for name, value in arrays.items()],
        )
        opset = [helper.make_opsetid('', 13)]
        onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=8), tmp_path / 'a.onnx')
        return tmp_path / 'a.onnx'

    return save


def extractor(path, layer='y', size=64, strips=None, **changes):
    settings = settings_class('onnx')(model=str(path), layer=layer, size=size, **changes)
    return FeatureExtractor('onnx', settings, strips)


def single(made):
    return np.concatenate([made.extract([image]).strips for image in IMAGES], axis=1)


MEAN_OF_ALL = helper.make_node('ReduceMean', ['y'], ['z'], keepdims=0)
ARGMAX = helper.make_node('ArgMax', ['y'], ['z'], axis=1)
RESHAPE = helper.make_node('Reshape', ['y', 's'], ['z'])


def test_input_of_the_network_by_hand(save_network):
    """Sums over 64 equal pixels; blue first, mean and std by channel; two images."""
    image = np.full((64, 64, 3), (100, 2, 1), np.uint8)
    settings = settings_class('onnx')(
        model=str(save_network(w=np.ones((1, 3, 8, 8), np.float32))),
        size=64, layer='y', channels='bgr', scale=1.0, mean=(0, 0, 20), std=(1, 1, 2),
    )  # fmt: skip
    maps = backbone_class('onnx')(settings).feature_maps([image, 2 * image])
    assert maps.shape == (2, 1, 8, 8)
    assert (maps[0] == 64 * (1 + 2 + (100 - 20) / 2)).all()
    assert (maps[1] == 64 * (2 + 4 + (200 - 20) / 2)).all()


def test_features_that_are_not_finite_are_rejected(save_network):
    """Sums of 192 values are out of range where all are bright; or always."""
    path = save_network(w=np.ones((1, 3, 8, 8), np.float32))
    made = extractor(path, mean=(0, 0, 0), std=(1, 1, 1), scale=1e34)
    with pytest.raises(ImageError, match='not finite'):
        made.extract([np.full((16, 16, 3), 255, np.uint8)])
    with pytest.raises(SettingsError, match='test image are not finite'):
        extractor(path, scale=1e36)


@pytest.mark.parametrize('batch', ['b', 1, 4])
def test_batch_of_convolutions_may_be_stated(save_network, batch):
    made = extractor(save_network(shape=(batch, 3, 64, 64)))
    np.testing.assert_allclose(made.extract(IMAGES).strips, single(made), atol=1e-5)


def test_registers_of_tokens_are_excluded_or_rejected(save_network):
    """Tokens of DINOv3: class, four registers, then the patches row by row."""
    nodes = (
        helper.make_node('Reshape', ['y', 's'], ['flat']),
        helper.make_node('Transpose', ['flat'], ['patches'], perm=[0, 2, 1]),
        helper.make_node('Pad', ['patches', 'pads', 'large'], ['tokens']),
    )
    pads, large = np.array((0, 5, 0, 0, 0, 0)), np.float32(1e6)
    path = save_network(*nodes, s=np.array((0, 8, 64)), pads=pads, large=large)
    expected = extractor(path, 'y', strips=4).extract(IMAGES)
    result = extractor(path, 'tokens', strips=4, prefix_tokens=5).extract(IMAGES)
    np.testing.assert_array_equal(result.strips, expected.strips)
    with pytest.raises(
        SettingsError, match=r'68 without the first 1: .*prefix_tokens = 5 leaves 8'
    ):
        extractor(path, 'tokens')


@pytest.mark.parametrize('batch', ['b', 1])
def test_vector_of_a_whole_image_as_of_megaloc(save_network, batch):
    """8448 numbers of float16 weights that are cast, of unit norm, one row an image."""
    weights = np.random.default_rng(2).standard_normal((512, 8448)).astype(np.float16)
    nodes = (
        helper.make_node('Reshape', ['y', 's'], ['flat']),
        helper.make_node('Cast', ['half'], ['weights'], to=FLOAT),
        helper.make_node('MatMul', ['flat', 'weights'], ['product']),
        helper.make_node('LpNormalization', ['product'], ['descriptor'], axis=1, p=2),
    )
    shape = np.array((1 if batch == 1 else -1, 512))
    path = save_network(*nodes, shape=(batch, 3, 64, 64), s=shape, half=weights)
    made = extractor(path, 'descriptor')
    features = made.extract(IMAGES)
    assert (made.settings.strips, features.strips.shape) == (1, (1, 4, 8448))
    maps = extractor(save_network(), 'y', strips=1).extract(IMAGES).strips[0]
    product = maps @ weights
    expected = product / np.linalg.norm(product, axis=1, keepdims=True)
    np.testing.assert_allclose(features.strips[0], expected, atol=1e-5)


@pytest.mark.parametrize(
    ('changes', 'named'),
    [
        ({'strips': 7}, r'vector of 512 numbers .* not 7 and flatten'),
        ({'pooling': 'gem'}, 'not 1 and gem'),
        ({'layer': 'y', 'strips': 9}, r'Wf = 8 .*W = 9'),
        ({'layer': 'y', 'pooling': 'max'}, "pooling = 'max'"),
    ],
)
def test_settings_that_do_not_fit_the_layer_are_rejected_before_any_image(
    save_network, changes, named
):
    path = save_network(RESHAPE, s=np.array((-1, 512)))
    with pytest.raises((InputError, SettingsError), match=named):
        extractor(path, **{'layer': 'z'} | changes)


def test_map_of_vectors_localizes_in_the_pipeline(save_network, route, tmp_path):
    network, path = save_network(RESHAPE, s=np.array((-1, 512))), tmp_path / 'vectors.stavpr'
    frames = [Frame(image, i + 1, '') for i, image in enumerate(route)]
    save_map(build_map(frames, extractor(network, 'z'), progress=False), path)
    assert load_map(path).features.strips.shape == (1, 60, 512)
    noise = np.random.default_rng(0).normal(0, 10, (20, *route[0].shape))
    images = np.clip(route[20:40] + noise, 0, 255).astype(np.uint8)
    last = process(localizing(str(path), model_path=str(network)), images)[-1]
    assert (last.match.status, last.match.place) == (Status.MATCH, 37)


MEAN = helper.make_node('ReduceMean', ['y'], ['m'], axes=[0, 2, 3], keepdims=1)


@pytest.mark.parametrize(
    ('nodes', 'batch', 'shape'),
    [
        ([RESHAPE], 1, (1, -1)),
        ([RESHAPE], 1, (1, 512)),
        ([MEAN, helper.make_node('Sub', ['y', 'm'], ['z'])], 'b', ()),
    ],
    ids=['to any row', 'to one row', 'images influence each other'],
)
def test_network_for_one_image_is_run_image_by_image(save_network, nodes, batch, shape):
    made = extractor(
        save_network(*nodes, shape=(batch, 3, 64, 64), s=np.array(shape, np.int64)), 'z'
    )
    assert np.array_equal(made.extract(IMAGES).strips, single(made))


def test_nodes_after_the_layer_are_not_computed(save_network):
    """The reshaping fits images of 64 pixels only; a branch needs a tensor from outside it."""
    inner = helper.make_node('Identity', ['y'], ['v'])
    value = helper.make_tensor_value_info('v', FLOAT, None)
    branch = helper.make_graph([inner], 'branch', [], [value])
    either = helper.make_node('If', ['c'], ['w2'], then_branch=branch, else_branch=branch)
    path = save_network(
        RESHAPE, either, shape=('b', 3, 'h', 'w'), s=np.array((1, 512)), c=np.array(True)
    )
    whole = extractor(path, 'y', 128).extract(IMAGES).strips
    assert np.array_equal(extractor(path, 'w2', 128).extract(IMAGES).strips, whole)
    with pytest.raises(SettingsError, match='Reshape'):
        extractor(path, 'z', 128)


@pytest.mark.parametrize(
    ('network', 'changes', 'named'),
    [
        ({}, {'layer': 'fire'}, r"no layer 'fire'.*y"),
        ({}, {'channels': 'hsv'}, 'take one of rgb, bgr'),
        ({}, {'sha256': '0' * 64}, 'sha256'),
        ({'shape': (1, 3, 96, 96)}, {}, r'\(1, 3, 96, 96\).* not \(n, 3, 64, 64\): set size = 96'),
        ({'shape': ('b', 3, 64, 96)}, {}, 'square RGB images'),
        ({'shape': ('b', 64, 64, 3)}, {}, r'\(0, 64, 64, 3\).*square RGB images'),
        ({'shape': ('b', 1, 64, 64)}, {}, 'square RGB images'),
        ({'dtype': onnx.TensorProto.UINT8}, {}, "input 'x' is of ONNX type 2, expected 1"),
    ],
)
def test_other_inputs_and_settings_are_rejected_by_name(save_network, network, changes, named):
    with pytest.raises((FeatureMismatchError, SettingsError, UnavailableError), match=named):
        extractor(save_network(**network), **changes)


@pytest.mark.parametrize(
    ('node', 'layer', 'named'),
    [
        (RESHAPE, 'z', r'rejects images of size 64.*Reshape'),
        (MEAN_OF_ALL, 'z', r'returns \(\) for 1 image'),
        (ARGMAX, 'z', 'is int64, expected float numbers'),
        (RESHAPE, '', "no layer '': its layers are z, y"),
    ],
)
def test_layers_that_are_not_one_row_an_image_are_rejected_by_name(
    save_network, node, layer, named
):
    with pytest.raises(SettingsError, match=named):
        extractor(save_network(node, s=np.array((4, 512))), layer).extract(IMAGES)


def test_weights_in_another_file_are_rejected_with_the_remedy(save_network, tmp_path):
    with pytest.raises(UnavailableError, match='no usable ONNX model'):
        extractor(Path(__file__))
    model = onnx.load(save_network())
    path = tmp_path / 'b.onnx'
    onnx.save(model, path, save_as_external_data=True, location='b.bin', size_threshold=0)
    with pytest.raises(UnavailableError, match='weights are in other files: save it as one'):
        extractor(path)


class Network(nn.Module):
    """Patches of 32 pixels; returns a vector, the class token, and the map of the patches."""

    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.patches, self.norm = nn.Conv2d(3, 6, 32, stride=32), nn.LayerNorm(6)

    def forward(self, x):
        maps = self.patches(x)
        tokens = torch.cat([maps.mean((2, 3))[:, None], maps.flatten(2).transpose(1, 2)], 1)
        return self.norm(tokens)[:, 0], maps


@pytest.mark.filterwarnings('ignore::DeprecationWarning', 'ignore:no signature found')
@pytest.mark.parametrize('half', [False, True])
@pytest.mark.usefixtures('working_folder')
def test_network_of_torch_is_exported_as_documented(half):
    """Outputs, an inner layer and tokens of a TorchScript file, in float32 and float16."""
    page = Path(__file__).parents[1] / 'docs' / 'features.md'
    code = re.search('```python\n(.*?)```', page.read_text(), re.DOTALL)[1]
    if half:
        code = code.replace('.eval()', '.eval().half()').replace('224)', '224).half()')
    network = Network().eval()
    torch.jit.save(torch.jit.trace(network, torch.rand(1, 3, 224, 224)), 'net.pt')
    exec(code)
    plain = {'size': 224, 'mean': (0, 0, 0), 'std': (1, 1, 1)}
    squares = [cv2.resize(image, (224, 224)) for image in IMAGES]
    batch = torch.from_numpy(np.stack(squares) / 255).permute(0, 3, 1, 2).float()
    with torch.no_grad():
        vector, maps = network(batch)
        tokens = network.norm(maps.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)
    for layer, expected in (
        ('vector', vector),
        ('map', maps),
        ('/norm/LayerNormalization_output_0', tokens),
    ):
        settings = settings_class('onnx')(model='net.onnx', layer=layer, **plain)
        result = backbone_class('onnx')(settings).feature_maps(IMAGES)
        tolerance = 2e-2 if half else 1e-5
        np.testing.assert_allclose(result, expected, atol=tolerance, rtol=tolerance)


CUDA, TENSORRT, CPU = (f'{name}ExecutionProvider' for name in ('CUDA', 'Tensorrt', 'CPU'))


@pytest.fixture
def providers(monkeypatch):
    """
    Return a function that replaces the providers that onnxruntime offers and can load.

    It returns a list, to which a session adds its own.
    """

    def replace(offered, loaded):
        used = []

        def session(content, options, providers):
            used.extend(name for name in providers if name in (*loaded, CPU))
            return SimpleNamespace(
                get_providers=lambda: used,
                get_inputs=lambda: [SimpleNamespace(type='tensor(float)', name='x')],
                run=lambda outputs, inputs: [np.zeros((1, 4), np.float32)],
            )

        runtime = SimpleNamespace(
            get_available_providers=lambda: [*offered, CPU],
            SessionOptions=onnxruntime.SessionOptions,
            InferenceSession=session,
        )
        module = 'stavpr_ros.features.onnx'
        monkeypatch.setattr(f'{module}.import_onnxruntime', lambda: runtime)
        monkeypatch.setattr(f'{module}.choose_device', lambda name: name.replace('auto', 'cuda'))
        return used

    return replace


@pytest.mark.parametrize(
    ('device', 'offered', 'chosen'),
    [
        ('cuda', (TENSORRT, CUDA), CUDA),
        ('auto', (TENSORRT, CUDA), CUDA),
        ('cuda', (TENSORRT,), TENSORRT),
        ('cpu', (TENSORRT, CUDA), CPU),
    ],
)
def test_network_runs_on_the_provider_of_its_device(
    save_network, providers, device, offered, chosen
):
    used = providers(offered, offered)
    settings = settings_class('onnx')(model=str(save_network()), layer='y', size=64)
    backbone_class('onnx')(settings, device)
    assert used[0] == chosen


@pytest.mark.parametrize('offered', [(), (CUDA,)], ids=['not installed', 'not loaded'])
def test_network_without_provider_of_the_gpu(save_network, providers, caplog, offered):
    """An error if the GPU was requested; auto takes the CPU with a warning."""
    providers(offered, ())
    settings = settings_class('onnx')(model=str(save_network()), layer='y', size=64)
    with pytest.raises(UnavailableError, match=r"device 'cuda'.*onnxruntime-gpu.*'cpu' or 'auto'"):
        backbone_class('onnx')(settings, 'cuda')
    backbone_class('onnx')(settings, 'auto')
    assert 'onnxruntime-gpu' in caplog.text


@pytest.mark.skipif(not torch.cuda.is_available(), reason='no CUDA device')
def test_network_on_gpu_equals_cpu(save_network):
    settings = settings_class('onnx')(model=str(save_network()), layer='y', size=64)
    on_gpu, on_cpu = (
        backbone_class('onnx')(settings, device).feature_maps(IMAGES) for device in ('auto', 'cpu')
    )
    np.testing.assert_allclose(on_gpu, on_cpu, atol=1e-2, rtol=1e-2)
