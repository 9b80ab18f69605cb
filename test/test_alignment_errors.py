# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Invalid input and settings of the alignments: each error names the value."""

import math
import re

import numpy as np
import pytest
from stavpr_ros.alignment import (
    aligned_index,
    image_distances,
    match_sequence,
    SequenceSettings,
    SpatialSettings,
)
from stavpr_ros.errors import InputError, SettingsError

ADAPTIVE = SpatialSettings()
VANILLA = SpatialSettings(strategy='vanilla')
WINDOW = SpatialSettings(strategy='sliding_window')
THREE = SequenceSettings(length=3)


@pytest.mark.parametrize(
    ('call', 'shapes'),
    [
        (lambda d: image_distances(d, ADAPTIVE), [(7, 7), (7, 6, 3), (0, 0, 3)]),
        (lambda D: match_sequence(D, THREE), [(4, 9), (2, 9), (3,), (3, 9, 1)]),
    ],
)
def test_distances_of_other_shape_are_rejected(call, shapes):
    for shape in shapes:
        with pytest.raises(InputError, match=re.escape(str(shape))):
            call(np.ones(shape))


@pytest.mark.parametrize('dtype', [np.int64, np.float16, bool])
def test_distances_of_other_dtype_are_rejected(dtype):
    with pytest.raises(InputError, match=np.dtype(dtype).name):
        image_distances(np.zeros((7, 7, 3), dtype), ADAPTIVE)
    with pytest.raises(InputError, match=np.dtype(dtype).name):
        match_sequence(np.ones((3, 9), dtype), THREE)


@pytest.mark.parametrize('value', [np.nan, -np.inf])
def test_distances_with_nan_are_rejected(value):
    d, D = np.ones((7, 7, 100)), np.ones((3, 100))
    d[3, 2, 77] = D[1, 77] = value
    for call in (
        *(lambda s=s: image_distances(d, s) for s in (ADAPTIVE, VANILLA, WINDOW)),
        lambda: match_sequence(D, THREE),
    ):
        with pytest.raises(InputError):
            call()


@pytest.mark.parametrize(
    ('settings', 'arguments', 'named'),
    [
        (SpatialSettings, {'strategy': 'diagonal'}, 'diagonal'),
        (SpatialSettings, {'sigma': -0.5}, '-0.5'),
        (SpatialSettings, {'sigma': math.inf}, 'inf'),
        (SpatialSettings, {'xi': 0}, '0'),
        (SpatialSettings, {'xi': 2.5}, '2.5'),
        (SequenceSettings, {'length': 1}, '1'),
        (SequenceSettings, {'length': 2.5}, '2.5'),
        (SequenceSettings, {'beta': 1.0}, '1.0'),
        (SequenceSettings, {'beta': math.inf}, 'inf'),
    ],
)
def test_settings_out_of_range_are_rejected(settings, arguments, named):
    with pytest.raises(SettingsError, match=re.escape(named)):
        settings(**arguments)


@pytest.mark.parametrize(
    ('W', 'spatial', 'error', 'named'),
    [
        (5, SpatialSettings(xi=6), SettingsError, r'6.*5'),
        (3, WINDOW, InputError, 'W = 3'),
        (7, SpatialSettings(strategy='none'), SettingsError, 'none'),
    ],
)
def test_settings_that_do_not_fit_the_strips_are_rejected(W, spatial, error, named):
    with pytest.raises(error, match=named):
        image_distances(np.zeros((W, W, 2)), spatial)


def test_aligned_index_of_row_not_on_path_is_rejected():
    with pytest.raises(InputError, match='2'):
        aligned_index(np.array([(0, 3), (1, 4)], np.int32), 2)
