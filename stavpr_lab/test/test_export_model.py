# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Networks to ONNX files: local repositories with the signatures of published networks."""

import hashlib
import re

import numpy as np
import pytest
from stavpr_lab.commands import export_model
from stavpr_ros.errors import SettingsError, UnavailableError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.features.registry import backbone_class, settings_class
import torch

onnx = pytest.importorskip('onnx', reason='the extra onnx is not installed')
onnxruntime = pytest.importorskip('onnxruntime', reason='the extra onnx is not installed')

SIZE = 28
HUBCONF = '''
import pathlib
import torch
from torch import nn
from torch.nn.functional import normalize

pathlib.Path(__file__).with_name('ran').touch()


class Backbone(nn.Module):
    """A map of patches of 7 pixels; beside it their mean if a token is wanted."""

    def __init__(self, channels=6, token=False):
        super().__init__()
        torch.manual_seed(0)
        self.patches, self.token = nn.Conv2d(3, channels, 7, stride=7), token

    def forward(self, x):
        maps = self.patches(x)
        return (maps, maps.mean((2, 3))) if self.token else maps


class Pooled(nn.Module):
    """As EigenPlaces, CosPlace, MegaLoc and MixVPR: a vector."""

    def __init__(self, fc_output_dim=12):
        super().__init__()
        self.backbone, self.fc = Backbone(), nn.Linear(6, fc_output_dim)

    def forward(self, x):
        return normalize(self.fc(self.backbone(x).clamp(min=1e-6).pow(3).mean((2, 3))), dim=1)


class Loop(Pooled):
    """As AnyLoc: a Python loop over the batch."""

    def forward(self, x):
        found = torch.empty(x.shape[0], 12)
        for i in range(x.shape[0]):
            found[i] = super().forward(x[i : i + 1])[0]
        return found


class Transformer(nn.Module):
    """As DINOv2 with registers: a dictionary of the class token and of the patches."""

    def __init__(self, registers=4):
        super().__init__()
        self.backbone = Backbone(8)
        self.prefix = nn.Parameter(torch.randn(1, 1 + registers, 8))
        self.block = nn.TransformerEncoderLayer(8, 2, 16, batch_first=True)
        self.norm = nn.LayerNorm(8)

    def forward(self, x):
        patches = self.backbone(x).flatten(2).transpose(1, 2)
        prefix = self.prefix.expand(x.shape[0], -1, -1)
        tokens = self.norm(self.block(torch.cat([prefix, patches], 1)))
        return {'token': tokens[:, 0], 'patches': tokens[:, 5:]}


class Salad(nn.Module):
    """As SALAD and BoQ: a vector and its attention; its backbone returns map and token."""

    def __init__(self):
        super().__init__()
        self.backbone, self.score = Backbone(token=True), nn.Conv2d(6, 4, 1)

    def forward(self, x):
        maps, token = self.backbone(x)
        shares = self.score(maps).flatten(2).softmax(2).squeeze()
        vector = (shares @ maps.flatten(2).transpose(1, 2)).flatten(1 if shares.ndim == 3 else 0)
        vector = torch.cat([token, vector.reshape(x.shape[0], -1)], 1)
        return normalize(vector, dim=1), [shares]


def pooled(backbone='ResNet18', fc_output_dim=32):
    assert backbone == 'ResNet50'
    return Pooled(fc_output_dim)


def loop():
    return nn.DataParallel(Loop())


def transformer():
    return Transformer()


def salad():
    return Salad()


def no_model():
    return 'no model'


def not_finite():
    network = Pooled()
    network.fc.bias.data[:] = float('nan')
    return network
'''


@pytest.fixture(scope='module')
def repository(tmp_path_factory):
    folder = tmp_path_factory.mktemp('repository')
    (folder / 'hubconf.py').write_text(HUBCONF)
    (folder / 'LICENSE.md').write_text('\n  GNU GENERAL PUBLIC LICENSE\n  Version 3\n\nmore')
    return folder


@pytest.fixture
def run(runner):
    return runner(export_model)


def entry(repository, name, *options):
    return ['--repository', repository, '--entry', name, '--size', SIZE, *options]


ALLOW = '--allow-foreign-code'


def original(repository, name, **arguments):
    network = torch.hub.load(str(repository), name, source='local', **arguments).eval()
    return network.module if isinstance(network, torch.nn.DataParallel) else network


def images(count=3):
    return list(np.random.default_rng(0).integers(0, 256, (count, SIZE, SIZE, 3), np.uint8))


def batch_of(images):
    mean, std = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    return torch.from_numpy(((np.stack(images) / 255 - mean) / std).transpose(0, 3, 1, 2)).float()


def features(path, layer):
    settings = settings_class('onnx')(model=str(path), layer=layer, size=SIZE)
    return backbone_class('onnx')(settings).feature_maps(images())


@pytest.mark.parametrize(
    ('name', 'options', 'arguments', 'batches'),
    [
        ('pooled', ['--argument', 'backbone="ResNet50"', '--argument', 'fc_output_dim=16'],
         {'backbone': 'ResNet50', 'fc_output_dim': 16}, True),
        ('transformer', ['--vector', 'token'], {}, True),
        ('salad', [], {}, True),
        ('loop', [], {}, False),
    ],
)  # fmt: skip
def test_export_of_each_signature_equals_the_original(
    run, repository, tmp_path, name, options, arguments, batches
):
    """Image by image, whatever the batch; the file states whether it takes batches."""
    path = tmp_path / 'net.onnx'
    code, output, _ = run(*entry(repository, name, ALLOW, '--output', path, *options))
    assert code == 0
    assert ('batches' in output) == batches
    assert 'GNU GENERAL PUBLIC LICENSE, Version 3' in output
    assert hashlib.sha256(path.read_bytes()).hexdigest() in output
    network, result = original(repository, name, **arguments), features(path, 'global')
    with torch.no_grad():
        singles = [network(image[None]) for image in batch_of(images())]
    which = {'transformer': 'token', 'salad': 0}.get(name)
    expected = torch.cat([one if which is None else one[which] for one in singles])
    np.testing.assert_allclose(result, expected, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(
    ('name', 'options'),
    [
        ('transformer', ['--vector', 'token', '--map-module', 'norm', '--prefix-tokens', 5]),
        ('transformer', ['--vector', '', '--map', 'patches', '--prefix-tokens', 0]),
        ('salad', ['--map-module', 'backbone']),
        ('salad', ['--vector', '', '--map-module', 'backbone.patches']),
    ],
)
def test_export_of_maps_equals_the_inner_module(run, repository, tmp_path, name, options):
    path = tmp_path / 'net.onnx'
    code, _, errors = run(*entry(repository, name, ALLOW, '--output', path, *options))
    assert (code, errors) == (0, '')
    result, network = features(path, 'map'), original(repository, name)
    with torch.no_grad():
        if name == 'salad':
            expected, _ = network.backbone(batch_of(images()))
        else:
            expected = network(batch_of(images()))['patches'].mT.reshape(3, 8, 4, 4)
    np.testing.assert_allclose(result, expected, atol=1e-5, rtol=1e-4)
    outputs = {value.name for value in onnx.load(path).graph.output}
    assert outputs == ({'map'} if '' in options else {'global', 'map'})


def test_export_runs_no_foreign_code_without_permission(run, tmp_path):
    (tmp_path / 'hubconf.py').write_text(HUBCONF)
    code, _, errors = run(*entry(tmp_path, 'pooled', '--output', tmp_path / 'net.onnx'))
    assert (code, '--allow-foreign-code' in errors) == (2, True)
    assert not (tmp_path / 'ran').exists()


TOKENS = ['--vector', 'token', '--map-module']


@pytest.mark.parametrize(
    ('name', 'options', 'code', 'words'),
    [
        ('transformer', [*TOKENS, 'norm'], 2, '20 without the first 1.*prefix_tokens = 5'),
        ('transformer', [*TOKENS, 'neck'], 2, "no module 'neck': its modules are backbone"),
        ('salad', ['--vector', ''], 2, 'neither a vector nor a map'),
        ('salad', ['--vector', '', '--map', '0'], 2, r'returns vectors \(1, 30\)'),
        ('transformer', [], 2, 'its outputs are token, patches'),
        ('salad', ['--vector', '1'], 2, 'is list: expected a vector'),
        ('pooled', [], 1, 'AssertionError'),
        ('pooled', ['--argument', 'backbone=x'], 2, "'x' is no JSON"),
        ('missing', [], 1, 'entry missing of .* fails'),
        ('no_model', [], 1, 'returns a str: expected a torch.nn.Module'),
        ('not_finite', [], 1, 'NaN or infinite'),
        ('loop', ['--commit', 'main', '--repository', 'owner/name'], 2, 'expected 40 digits'),
    ],
)
def test_export_names_what_is_wrong(run, repository, tmp_path, name, options, code, words):
    path = tmp_path / 'net.onnx'
    result, _, errors = run(*entry(repository, name, ALLOW, '--output', path, *options))
    assert result == code
    assert re.search(words, errors), errors
    assert not path.exists()


def test_int8_layer_of_quantized_numbers_is_rejected(repository, tmp_path):
    from onnxruntime.quantization import CalibrationDataReader, QuantFormat, quantize_static

    network = original(repository, 'pooled', backbone='ResNet50', fc_output_dim=16)
    batch, path = batch_of(images(8)), tmp_path / 'int8.onnx'
    torch.onnx.export(network, (batch,), tmp_path / 'net.onnx', dynamo=False, opset_version=17,
                      input_names=['image'], dynamic_axes={'image': {0: 'batch'}})  # fmt: skip

    class Reader(CalibrationDataReader):
        def __init__(self):
            self.left = [{'image': image[None].numpy()} for image in batch]

        def get_next(self):
            return self.left.pop() if self.left else None

    quantize_static(tmp_path / 'net.onnx', path, Reader(), QuantFormat.QOperator)
    node = next(n for n in onnx.load(path).graph.node if n.op_type == 'QLinearConv')
    settings = settings_class('onnx')(model=str(path), layer=node.output[0], size=SIZE)
    with pytest.raises((SettingsError, UnavailableError), match='quantized numbers'):
        FeatureExtractor('onnx', settings)
