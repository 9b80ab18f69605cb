# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Maps of format version 1, as robots have them: they load and recognize, and their keys are fixed.

The files in ``data/version1`` were written by commit eb40c94, before most names changed, with its
``build_map`` on the eight images ``route_images(8)`` of conftest.py, and with an extractor of the
kind, settings, strips and projection of the table ``MAPS`` below. ``gradient_projected`` has
stamps, identifiers, poses (x = i, that of place 3 unknown) and thumbnails 48 pixels wide.
``tiny.onnx`` is one convolution and a ReLU; the weights of the paper's networks
are the random ones of conftest.py, whose files are equal to the bit on every machine.
"""

import json
from pathlib import Path

import cv2
from fixtures import route_images
import numpy as np
import pytest
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.features.registry import kinds, settings_class
from stavpr_ros.mapping import load_map, save_map
from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings
import torch

FOLDER = Path(__file__).parent / 'data' / 'version1'
PLACES = 8
IMAGENET = {'mean': [0.485, 0.456, 0.406], 'std': [0.229, 0.224, 0.225], 'scale': 1 / 255}
# File: kind, its settings, strips, dimensions of the projection (seed 0).
MAPS = {
    'gradient': (
        'gradient',
        {'cell': 8, 'orientations': 4, 'resize': 'area', 'signed': True, 'size': 32}
        | {'logarithm': False},
        2,
        None,
    ),
    'gradient_projected': (
        'gradient',
        {'cell': 16, 'orientations': 8, 'resize': 'area', 'signed': True, 'size': 224}
        | {'logarithm': False},
        7,
        16,
    ),
    'onnx': (
        'onnx',
        IMAGENET
        | {'layer': 'relu', 'mean': [0.5, 0.4, 0.3], 'channels': 'bgr', 'size': 32}
        | {'model': 'tiny.onnx', 'resize': 'bilinear', 'sha256': '1b60677c8ac4ead5'},
        4,
        None,
    ),
    'densenet161_places365': (
        'densenet161_places365',
        {'half': False, 'model': 'densenet161_places365.pth.tar', 'resize': 'bilinear'}
        | {'sha256': 'bbeb2756675dd8e3', 'size': 32},
        1,
        None,
    ),
    'vgg16': (
        'vgg16',
        {'half': False, 'model': 'vgg16.pth', 'resize': 'bilinear', 'size': 32}
        | {'sha256': '0a7ae55e899900c7'},
        2,
        8,
    ),
}


@pytest.fixture
def model(request, name):
    """Return the file of the map's network: stored beside the map, or made again."""
    if name == 'onnx':
        return str(FOLDER / 'tiny.onnx')
    made = {'densenet161_places365': 'densenet_file', 'vgg16': 'vgg_file'}
    return str(request.getfixturevalue(made[name])) if name in made else ''


def test_version1_maps_cover_every_kind():
    assert {path.stem for path in FOLDER.glob('*.stavpr')} == MAPS.keys()
    assert {kind for kind, *_ in MAPS.values()} <= set(kinds())


@pytest.mark.parametrize('name', MAPS)
def test_version1_map_loads_with_its_settings(name, tmp_path):
    """Settings are read as written, and a map saved now, of version 2, has the same."""
    place_map = load_map(FOLDER / f'{name}.stavpr')
    kind, backbone, strips, projection = MAPS[name]
    read = json.loads(place_map.settings.to_json())
    if 'sha256' in backbone:
        read['backbone']['sha256'] = read['backbone']['sha256'][:16]
    forgotten = {'model': '', 'half': False}  # nothing that a map may state
    before = getattr(settings_class(kind), 'BEFORE', {})  # settings that there were none of
    forgotten = {key: v for key, v in forgotten.items() if key in read['backbone']}
    expected = before | backbone | forgotten
    assert (read['kind'], read['backbone'], read['strips']) == (kind, expected, strips)
    assert read['feature_version'] == 1
    assert (place_map.projection is None) is (projection is None)
    assert place_map.features.strips.shape[:2] == (strips, PLACES)
    save_map(place_map, tmp_path / 'again')
    again = load_map(tmp_path / 'again')
    assert again.settings == place_map.settings
    assert torch.equal(again.features.strips, place_map.features.strips)


@pytest.mark.parametrize('name', MAPS)
def test_version1_map_recognizes_its_images(name, model):
    """Features extracted now are those of the map, and a window of three finds its places."""
    if name == 'onnx':
        pytest.importorskip('onnxruntime', reason='the extra onnx is not installed')
    place_map = load_map(FOLDER / f'{name}.stavpr')
    query = place_map.extractor(model=model).extract(route_images(PLACES))
    torch.testing.assert_close(query.strips, place_map.features.strips, rtol=0, atol=1e-5)
    torch.testing.assert_close(query.weights, place_map.features.weights, rtol=0, atol=1e-5)
    settings = RecognizerSettings(0.5, sequence=SequenceSettings(3), mode='paper')
    recognizer = PlaceRecognizer(place_map, settings)
    matches = [recognizer.update(query[i : i + 1]) for i in range(3, 7)]
    assert [match.place_index for match in matches] == [-1, -1, 4, 5]


def test_version1_map_keeps_facts_of_places():
    place_map = load_map(FOLDER / 'gradient_projected.stavpr')
    assert place_map.stamps.tolist() == [(i + 1) * 10**9 for i in range(PLACES)]
    assert place_map.ids == tuple(f'place {i}' for i in range(PLACES))
    assert place_map.pose(3) is None
    assert place_map.pose(5).tolist() == [5, 0, 0, 0, 0, 0, 1]
    thumbnail = place_map.thumbnail(6).astype(int)
    small = [cv2.resize(image, (48, 36)) for image in route_images(PLACES)]
    assert np.argmin([np.abs(thumbnail - image).mean() for image in small]) == 6
    assert place_map.projection.matrix.shape == (224, 16)
    plain = load_map(FOLDER / 'gradient.stavpr')
    assert (plain.stamps.any(), any(plain.ids), plain.has_poses) == (False, False, False)
    assert plain.thumbnail(0) is None
