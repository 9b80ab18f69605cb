# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""NetVLAD from files of all published layouts, made here, against its equations."""

import math

import numpy as np
import pytest
from scipy.io import savemat
from scipy.signal import correlate2d
from stavpr_lab.features.netvlad import STAGES
from stavpr_ros.errors import FeatureMismatchError, SettingsError, UnavailableError
from stavpr_ros.features.registry import backbone_class, settings_class
import torch

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


def convolved(x, kernels, shift):
    """Correlate (H, W, in) with (out, in, 3, 3) in float64, zeros around it."""
    maps = [
        sum(correlate2d(x[..., c], k[c].astype(np.float64), 'same') for c in range(len(k)))
        for k in kernels
    ]
    return np.stack(maps, axis=-1) + shift


def pooled(x):
    return x.reshape(len(x) // 2, 2, len(x) // 2, 2, -1).max(axis=(1, 3))


def oracle(image, p, layout, whitening=True):
    """Return the vector by the equations, in float64."""
    matlab = layout.startswith('mat')
    x = image.astype(np.float64) - MEAN if matlab else image / 255
    if not matlab:
        x = (x - (0.485, 0.456, 0.406)) / (0.229, 0.224, 0.225)
    for i, (kernel, shift) in enumerate(zip(p['kernels'], p['biases'], strict=True)):
        x = convolved(x, kernel, shift)
        if i < 12:
            x = np.maximum(x, 0)
            x = pooled(x) if i in np.cumsum(STAGES) - 1 else x
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
    found = vector(path, image)
    assert found.shape == (OUT,)
    np.testing.assert_allclose(found, oracle(image, numbers, layout), atol=1e-5)
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
