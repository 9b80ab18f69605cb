# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Published networks: parameters by name and shape, against a second implementation."""

from dataclasses import replace
import math

import cv2
from fixtures import route_images
from map_examples import VERSION2
import networks
import numpy as np
import pytest
from scipy.io import savemat
from scipy.signal import correlate2d
from scipy.spatial.distance import cosine
from stavpr_lab.features.netvlad import STAGES
from stavpr_lab.features.paper_networks import DenseNet161, VGG16, VGG16Fc6
from stavpr_lab.features.weights import load_parameters
from stavpr_ros.errors import FeatureMismatchError, SettingsError, UnavailableError
from stavpr_ros.features.registry import backbone_class, settings_class
from stavpr_ros.mapping import load_map
import torch
from torch import nn


@pytest.mark.parametrize(
    ('network', 'shapes', 'count'),
    [
        (VGG16, networks.vgg16_shapes, 138_357_544),  # as torchvision documents
        # for 365 classes instead of 1000: 635 rows of 2208 + 1 fewer
        (DenseNet161, networks.densenet161_shapes, 28_681_000 - 635 * 2209),
    ],
)
def test_network_has_published_parameters(network, shapes, count):
    with torch.device('meta'):
        built = network()
    ours = {name: tuple(value.shape) for name, value in built.state_dict().items() if value.ndim}
    assert ours == shapes()
    assert sum(value.numel() for value in built.parameters()) == count


@pytest.fixture(scope='module', autouse=True)
def one_thread():
    """Use one thread: several of them would wait for each other on shared cores."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def standardize(images: list[np.ndarray], size: int) -> torch.Tensor:
    """Prepare images as the networks were trained, step by step in float64: (n, 3, size, size)."""
    small = np.stack(
        [cv2.resize(image, (size, size), interpolation=cv2.INTER_LINEAR) for image in images]
    )
    values = (small / 255 - np.array([0.485, 0.456, 0.406])) / np.array([0.229, 0.224, 0.225])
    return torch.from_numpy(values.transpose(0, 3, 1, 2))


def assert_same(ours: np.ndarray, oracle: torch.Tensor) -> None:
    """Compare to 10^-5 of the largest value, the accuracy of float32; neither is trivial."""
    assert ours.dtype == np.float32
    assert 0.05 < float((oracle > 0).double().mean()) < 0.95
    assert abs(ours - oracle.numpy()).max() < 1e-5 * float(oracle.max())


def smooth_images(*sizes: tuple[int, int]) -> list[np.ndarray]:
    """Smooth random images: neighbors similar, as in photographs, so that resizing keeps most."""
    rng = np.random.default_rng(0)
    coarse = [rng.integers(0, 256, (12, 12, 3), np.uint8) for _ in sizes]
    return [
        cv2.resize(c, (w, h), interpolation=cv2.INTER_CUBIC)
        for c, (h, w) in zip(coarse, sizes, strict=True)
    ]


def test_densenet161_equals_second_implementation(densenet_file, densenet_parameters):
    """At 96 pixels, from the published file format to 3 x 3 x 1488, in a batch of two."""
    images = smooth_images((120, 160), (300, 200))
    settings = settings_class('densenet161_places365')(model=str(densenet_file), size=96)
    ours = backbone_class('densenet161_places365')(settings).feature_maps(images)
    doubles = {name: value.double() for name, value in densenet_parameters.items()}
    assert ours.shape == (2, 1488, 3, 3)
    assert_same(ours, networks.densenet161_layer10(doubles, standardize(images, 96)))


def test_vgg16_equals_second_implementation(vgg_file, vgg_parameters):
    """In a batch of three."""
    images = smooth_images((120, 160), (96, 96), (50, 70))
    settings = settings_class('vgg16')(model=str(vgg_file), size=64)
    ours = backbone_class('vgg16')(settings).feature_maps(images)
    doubles = {
        name: value.double() for name, value in vgg_parameters.items() if 'features' in name
    }
    assert ours.shape == (3, 512, 4, 4)
    assert_same(ours, networks.vgg16_pool4(doubles, standardize(images, 64)))


def test_vgg16_fc6_by_hand():
    """Maps of other sizes are averaged to 7 x 7, flattened channel by channel; then ReLU."""
    network = nn.Module()
    network.features = nn.Identity()
    network.classifier = nn.Sequential(nn.Linear(2 * 49, 4), nn.ReLU(), nn.Dropout())
    maps = torch.rand(3, 2, 14, 14)
    result = VGG16Fc6.up_to_layer(network)(maps.to(memory_format=torch.channels_last))
    weight, bias = network.classifier[0].weight, network.classifier[0].bias
    means = maps.reshape(3, 2, 7, 2, 7, 2).mean(dim=(3, 5)).reshape(3, 98)
    torch.testing.assert_close(result, torch.relu(means @ weight.T + bias))
    assert VGG16Fc6.published.name == 'vgg16-397923af.pth'


@pytest.fixture(scope='module')
def small_vgg(vgg_file):
    """VGG16 for images of 32 pixels, in half precision where that is possible."""
    settings = settings_class('vgg16')(model=str(vgg_file), half=True, size=32)
    return backbone_class('vgg16')(settings)


def test_network_half_on_cpu_changes_nothing(small_vgg):
    """A robot's CPU may query a map that a GPU made in half precision."""
    assert small_vgg.feature_maps(smooth_images((32, 32))).dtype == np.float32
    assert small_vgg.settings == replace(small_vgg.settings, half=False)


@pytest.mark.skipif(not torch.cuda.is_available(), reason='no CUDA device')
@pytest.mark.parametrize('kind', ['vgg16', 'densenet161_places365'])
def test_network_in_half_precision_on_gpu_is_close(kind, vgg_file, densenet_file):
    path = vgg_file if kind == 'vgg16' else densenet_file
    images = smooth_images((120, 160), (300, 200))
    whole = backbone_class(kind)(settings_class(kind)(model=str(path)), 'cpu').feature_maps(images)
    half = backbone_class(kind)(
        settings_class(kind)(model=str(path), half=True), 'cuda'
    ).feature_maps(images)
    for one, other in zip(whole, half, strict=True):
        assert 1 - cosine(one.ravel(), other.ravel()) > 0.9999


@pytest.mark.parametrize(
    ('changes', 'words'),
    [
        ({'classifier.weight': torch.zeros(1000, 2208)},  # of ImageNet: other features
         r'a\.pth is no .*DenseNet161: classifier\.weight .*1000, 2208'),
        ({'classifier.weight': None, 'classifier.bias': None},
         r"lacks 'classifier\.bias' and 1 more"),
        ({'features.conv9': torch.zeros(1)}, r"has 'features\.conv9', unknown to the network"),
        ({'classifier.bias': torch.zeros(365, dtype=torch.long)}, 'no plain floats'),
        ({'classifier.bias': torch.full((365,), torch.nan)},
         r'damaged: classifier\.bias contains NaN'),
    ],
)  # fmt: skip
def test_load_parameters_of_other_network_is_rejected(densenet_parameters, changes, words):
    with torch.device('meta'):
        network = DenseNet161()
    changed = (densenet_parameters | changes).items()
    with pytest.raises(UnavailableError, match=words):
        load_parameters(network, {k: v for k, v in changed if v is not None}, 'a.pth')


@pytest.mark.parametrize('kind', ['vgg16', 'densenet161_places365'])
@pytest.mark.parametrize(
    'bad', [{'size': 31}, {'resize': 'cubic'}, {'sha256': '397923af'}, {'sha256': 'Z' * 64}]
)
def test_published_settings_out_of_range_are_rejected(kind, bad):
    with pytest.raises(SettingsError):
        settings_class(kind)(**bad)


@pytest.mark.parametrize(
    ('kind', 'weights'), [('vgg16', 'vgg_file'), ('densenet161_places365', 'densenet_file')]
)
def test_features_extracted_now_are_those_of_a_kept_map(kind, weights, request):
    """Maps of ``route_images(8)``, of the random weights of the fixtures."""
    kept = load_map(VERSION2 / f'{kind}.stavpr')
    model = str(request.getfixturevalue(weights))
    query = kept.extractor(model=model).extract(route_images(8))
    torch.testing.assert_close(query.strips, kept.features.strips, rtol=0, atol=1e-5)
    torch.testing.assert_close(query.weights, kept.features.weights, rtol=0, atol=1e-5)


# NetVLAD from files of all published layouts, made here, against its equations

WIDTHS = (4, 4, 5, 5, 6, 6, 6, 7, 7, 7, 8, 8, 8)
K, D, OUT, SIZE = 3, 8, 5, 32
MEAN = (123.0, 117.0, 104.0)
LAYOUTS = ('mat', 'mat v2', 'pth', 'pth v2', 'pth parallel')


@pytest.fixture(scope='module')
def numbers():
    """Return random parameters: kernels, w, b, c, whitening of V with d or k running fastest."""
    rng = np.random.default_rng(0)

    def normal(*shape, scale=1.0):
        return (rng.standard_normal(shape) * scale).astype(np.float32)

    channels = zip((3, *WIDTHS), WIDTHS, strict=False)
    return {
        'kernels': [normal(out, d, 3, 3, scale=math.sqrt(2 / (9 * d))) for d, out in channels],
        'biases': [normal(out, scale=0.1) for out in WIDTHS],
        'w': normal(K, D, scale=3),
        'b': normal(K),
        'c': normal(K, D),
        'matrix': normal(OUT, K * D),
        'shift': normal(OUT, scale=0.1),
    }


def matlab_file(path, p, bias=False, whitening=True):
    """Write net.layers as net_class2struct.m does: MATLAB's axes, the centers negated."""

    def cell(*values):
        row = np.empty((1, len(values)), object)
        row[0, :] = values
        return row

    layers = []
    for i, (kernel, shift) in enumerate(zip(p['kernels'], p['biases'], strict=True)):
        weights = cell(kernel.transpose(2, 3, 1, 0), shift[:, None])
        layers.append({'type': 'conv', 'weights': weights})
        layers.append({'type': 'relu', 'weights': np.zeros((0, 0))})
        if i in np.cumsum(STAGES) - 1:
            layers.append({'type': 'pool'})
    del layers[-2:]
    layers.append({'type': 'normalize', 'name': 'preL2'})
    offset = -p['c'].T
    vlad = [p['w'].T, p['b'][None], offset] if bias else [p['w'].T, offset]
    layers.append({'type': 'custom', 'name': 'vlad:core', 'weights': cell(*vlad)})
    layers.append({'type': 'normalize', 'name': 'vlad:intranorm'})
    if whitening:
        matrix = p['matrix'].T[None, None]
        layers.append({'name': 'WPCA', 'weights': cell(matrix, p['shift'][:, None])})
    average = np.broadcast_to(np.array(MEAN, np.float32), (224, 224, 3))
    meta = {'normalization': {'averageImage': average}}
    savemat(path, {'net': {'layers': cell(*layers), 'meta': meta}})


def torch_file(path, p, bias=False, whitening=True, parallel=False):
    """Write a checkpoint as pytorch-NetVlad and Patch-NetVLAD do."""
    part = '.module' if parallel else ''
    state, index = {}, 0
    for i, (kernel, shift) in enumerate(zip(p['kernels'], p['biases'], strict=True)):
        state[f'encoder{part}.{index}.weight'] = torch.from_numpy(kernel)
        state[f'encoder{part}.{index}.bias'] = torch.from_numpy(shift)
        index += 3 if i in np.cumsum(STAGES) - 1 else 2
    state[f'pool{part}.conv.weight'] = torch.from_numpy(p['w'][:, :, None, None])
    if bias:
        state[f'pool{part}.conv.bias'] = torch.from_numpy(p['b'])
    state[f'pool{part}.centroids'] = torch.from_numpy(p['c'])
    if whitening:
        state['WPCA.0.weight'] = torch.from_numpy(p['matrix'][:, :, None, None])
        state['WPCA.0.bias'] = torch.from_numpy(p['shift'])
    recalls = {5: np.float64(0.87), 1: np.float64(0.7)}
    torch.save({'epoch': 30, 'state_dict': state, 'recalls': recalls, 'parallel': parallel}, path)


def write(folder, layout, p, whitening=True):
    kind, _, change = layout.partition(' ')
    path = folder / f'net.{kind}{"" if kind == "mat" else ".tar"}'
    if kind == 'mat':
        matlab_file(path, p, change == 'v2', whitening)
    else:
        torch_file(path, p, change == 'v2', whitening, change == 'parallel')
    return path


def convolve(x, kernels, shift):
    """Correlate (H, W, in) with (out, in, 3, 3) in float64, zeros around it."""
    maps = [
        sum(correlate2d(x[..., c], k[c].astype(np.float64), 'same') for c in range(len(k)))
        for k in kernels
    ]
    return np.stack(maps, axis=-1) + shift


def pool(x):
    return x.reshape(len(x) // 2, 2, len(x) // 2, 2, -1).max(axis=(1, 3))


def oracle(image, p, layout, whitening=True):
    """Return the vector by the equations, in float64."""
    matlab = layout.startswith('mat')
    x = image.astype(np.float64) - MEAN if matlab else image / 255
    if not matlab:
        x = (x - (0.485, 0.456, 0.406)) / (0.229, 0.224, 0.225)
    for i, (kernel, shift) in enumerate(zip(p['kernels'], p['biases'], strict=True)):
        x = convolve(x, kernel, shift)
        if i < 12:
            x = np.maximum(x, 0)
            x = pool(x) if i in np.cumsum(STAGES) - 1 else x
    b = p['b'] if 'v2' in layout else np.zeros(K)
    V = np.zeros((K, D))
    for values in x.reshape(-1, D):
        column = values / np.linalg.norm(values)
        powers = np.exp(p['w'].astype(np.float64) @ column + b)
        for k in range(K):
            V[k] += powers[k] / sum(powers) * (column - p['c'][k])
    V /= np.linalg.norm(V, axis=1, keepdims=True) * math.sqrt(K)
    flat = V.T.ravel() if matlab else V.ravel()
    if whitening:
        flat = p['matrix'].astype(np.float64) @ flat + p['shift']
    return flat / np.linalg.norm(flat)


@pytest.fixture(scope='module')
def image():
    return np.random.default_rng(1).integers(0, 256, (SIZE, SIZE, 3), np.uint8)


def vector(path, image, **changes):
    settings = settings_class('netvlad')(model=str(path), size=SIZE, **changes)
    return backbone_class('netvlad')(settings).feature_maps([image])[0]


@pytest.mark.parametrize('layout', LAYOUTS)
def test_netvlad_of_each_layout_equals_its_equations(tmp_path, numbers, image, layout):
    path = write(tmp_path, layout, numbers)
    result = vector(path, image)
    assert result.shape == (OUT,)
    np.testing.assert_allclose(result, oracle(image, numbers, layout), atol=1e-5)
    whole = vector(path, image, whitening=False)
    assert whole.shape == (K * D,)
    expected = oracle(image, numbers, layout, whitening=False)
    np.testing.assert_allclose(whole, expected, atol=1e-5)


def test_netvlad_without_whitening_or_of_another_hash_is_rejected(tmp_path, numbers, image):
    path = write(tmp_path, 'pth', numbers, whitening=False)
    assert vector(path, image, whitening=False).shape == (K * D,)
    with pytest.raises(SettingsError, match=r'no PCA whitening: .* 24 dimensions'):
        vector(path, image)
    with pytest.raises(FeatureMismatchError, match='sha256'):
        vector(path, image, sha256='0' * 64)


def test_netvlad_of_other_files_is_rejected(tmp_path, numbers, image):
    savemat(tmp_path / 'other.mat', {'x': 1})
    cut = write(tmp_path, 'mat', numbers).read_bytes()[:-2000]
    (tmp_path / 'cut.mat').write_bytes(cut)
    (tmp_path / 'text.pth.tar').write_text('no weights')
    torch.save({'conv.weight': torch.zeros(2)}, tmp_path / 'other.pth.tar')
    for name, words in (
        ('other.mat', "cannot be read as the MATLAB file .*'net'"),
        ('cut.mat', 'cannot be read as the MATLAB file'),
        ('text.pth.tar', 'cannot be read as a file of weights'),
        ('other.pth.tar', 'lacks .encoder.0.weight.; it has conv.weight'),
    ):
        with pytest.raises(UnavailableError, match=words):
            vector(tmp_path / name, image)


@pytest.mark.parametrize('layout', ['mat', 'pth'])
@pytest.mark.parametrize(
    ('name', 'value', 'words'),
    [
        ('c', np.full((K, D), np.nan, np.float32), 'damaged: it contains NaN'),
        ('c', np.zeros((K + 1, D), np.float32), r'assignment \(3, 8\), centers \(4, 8\)'),
        ('matrix', np.zeros((OUT, 7), np.float32), 'takes 7 numbers, expected 24'),
        ('kernels', None, 'convolution 0 has shape'),
    ],
)
def test_netvlad_of_wrong_parameters_is_rejected(
    tmp_path, numbers, image, layout, name, value, words
):
    value = [numbers['kernels'][1], *numbers['kernels'][1:]] if value is None else value
    with pytest.raises(UnavailableError, match=words):
        vector(write(tmp_path, layout, numbers | {name: value}), image)
