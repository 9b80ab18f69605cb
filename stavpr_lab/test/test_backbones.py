# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The paper's networks: parameters by name and shape, against a second implementation."""

from dataclasses import replace

import cv2
from fixtures import route_images
from map_examples import VERSION2
import networks
import numpy as np
import pytest
from scipy.spatial.distance import cosine
from stavpr_lab.features.paper_networks import DenseNet161, VGG16, VGG16Fc6
from stavpr_lab.features.weights import load_parameters
from stavpr_ros.errors import SettingsError, UnavailableError
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


def standardized(images: list[np.ndarray], size: int) -> torch.Tensor:
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
    assert_same(ours, networks.densenet161_layer10(doubles, standardized(images, 96)))


def test_vgg16_equals_second_implementation(vgg_file, vgg_parameters):
    """In a batch of three."""
    images = smooth_images((120, 160), (96, 96), (50, 70))
    settings = settings_class('vgg16')(model=str(vgg_file), size=64)
    ours = backbone_class('vgg16')(settings).feature_maps(images)
    doubles = {
        name: value.double() for name, value in vgg_parameters.items() if 'features' in name
    }
    assert ours.shape == (3, 512, 4, 4)
    assert_same(ours, networks.vgg16_pool4(doubles, standardized(images, 64)))


def test_vgg16_fc6_by_hand():
    """Maps of other sizes are averaged to 7 x 7, flattened channel by channel; then ReLU."""
    network = nn.Module()
    network.features = nn.Identity()
    network.classifier = nn.Sequential(nn.Linear(2 * 49, 4), nn.ReLU(), nn.Dropout())
    maps = torch.rand(3, 2, 14, 14)
    found = VGG16Fc6.up_to_layer(network)(maps.to(memory_format=torch.channels_last))
    weight, bias = network.classifier[0].weight, network.classifier[0].bias
    means = maps.reshape(3, 2, 7, 2, 7, 2).mean(dim=(3, 5)).reshape(3, 98)
    torch.testing.assert_close(found, torch.relu(means @ weight.T + bias))
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
