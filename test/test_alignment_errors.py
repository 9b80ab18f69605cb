# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the alignments refuse: each error names the value that came."""

import math

import numpy as np
import oracle
import pytest
from stavpr_ros.alignment import (
    align_images,
    align_sequence,
    aligned_index,
    image_distances,
    match_sequence,
    SequenceSettings,
    SpatialSettings,
)
from stavpr_ros.errors import InputError, SettingsError, StavprError

ADAPTIVE = SpatialSettings()
VANILLA = SpatialSettings(strategy='vanilla')
WINDOW = SpatialSettings(strategy='sliding_window')

# ------------------------------------------------ spatial


@pytest.mark.parametrize('shape', [(7, 7), (7, 6, 3), (0, 0, 3), (7, 7, 3, 1), (7,)])
def test_wrong_strip_shapes_are_refused_by_name(shape):
    with pytest.raises(InputError) as error:
        image_distances(np.zeros(shape), ADAPTIVE)
    assert str(shape) in str(error.value)


@pytest.mark.parametrize('dtype', [np.int64, np.float16, np.complex64, bool])
def test_wrong_strip_dtypes_are_refused_by_name(dtype):
    with pytest.raises(InputError) as error:
        image_distances(np.zeros((7, 7, 3), dtype), ADAPTIVE)
    assert np.dtype(dtype).name in str(error.value)


@pytest.mark.parametrize('value', [np.nan, -np.inf])
@pytest.mark.parametrize('spatial', [ADAPTIVE, VANILLA, WINDOW])
def test_nan_among_strip_distances_is_refused(value, spatial):
    d = np.ones((7, 7, 100))
    d[3, 2, 77] = value
    with pytest.raises(InputError):
        image_distances(d, spatial)
    if spatial is not WINDOW:
        with pytest.raises(InputError):
            align_images(d[:, :, 77], spatial)


@pytest.mark.parametrize('shape', [(7, 7, 3), (7, 6), (0, 0)])
def test_wrong_pairs_are_refused_by_name(shape):
    with pytest.raises(InputError) as error:
        align_images(np.zeros(shape), ADAPTIVE)
    assert str(shape) in str(error.value)


@pytest.mark.parametrize(
    ('arguments', 'named'),
    [
        ({'strategy': 'diagonal'}, 'diagonal'),
        ({'sigma': -0.5}, '-0.5'),
        ({'sigma': math.nan}, 'nan'),
        ({'sigma': math.inf}, 'inf'),
        ({'xi': 0}, '0'),
        ({'xi': -2}, '-2'),
        ({'xi': 2.5}, '2.5'),
        ({'xi': math.nan}, 'nan'),
    ],
)
def test_spatial_settings_out_of_range_are_refused(arguments, named):
    with pytest.raises(SettingsError) as error:
        SpatialSettings(**arguments)
    assert named in str(error.value)


def test_settings_are_frozen():
    with pytest.raises(AttributeError):
        ADAPTIVE.sigma = 2.0


def test_restriction_wider_than_the_image_is_refused():
    with pytest.raises(StavprError) as error:
        image_distances(np.zeros((5, 5, 2)), SpatialSettings(xi=6))
    assert '6' in str(error.value)
    assert '5' in str(error.value)
    with pytest.raises(StavprError):
        align_images(np.zeros((5, 5)), SpatialSettings(xi=6))


def test_sliding_window_wider_than_the_image_is_refused():
    with pytest.raises(StavprError) as error:
        image_distances(np.zeros((3, 3, 2)), WINDOW)
    assert '3' in str(error.value)


def test_strategies_without_a_path_are_refused_where_a_path_is_asked_for():
    for strategy in ('sliding_window', 'none'):
        with pytest.raises(StavprError) as error:
            align_images(oracle.GOLDEN, SpatialSettings(strategy=strategy))
        assert strategy in str(error.value)
    with pytest.raises(StavprError) as error:
        image_distances(np.zeros((7, 7, 2)), SpatialSettings(strategy='none'))
    assert 'none' in str(error.value)


# ------------------------------------------------ temporal


@pytest.mark.parametrize('value', [math.nan, -math.inf])
def test_nan_among_image_distances_is_refused(value):
    D = np.ones((3, 100))
    D[1, 77] = value
    with pytest.raises(InputError):
        match_sequence(D, SequenceSettings(length=3))
    with pytest.raises(InputError):
        align_sequence(D, 76, SequenceSettings(length=3))


@pytest.mark.parametrize('shape', [(4, 9), (2, 9), (3,), (3, 9, 1)])
def test_wrong_sequence_shapes_are_refused_by_name(shape):
    with pytest.raises(InputError) as error:
        match_sequence(np.ones(shape), SequenceSettings(length=3))
    assert str(shape) in str(error.value)
    with pytest.raises(InputError) as error:
        align_sequence(np.ones(shape), 0, SequenceSettings(length=3))
    assert str(shape) in str(error.value)


@pytest.mark.parametrize('dtype', [np.int32, np.float16, bool])
def test_wrong_sequence_dtypes_are_refused_by_name(dtype):
    with pytest.raises(InputError) as error:
        match_sequence(np.ones((3, 9), dtype), SequenceSettings(length=3))
    assert np.dtype(dtype).name in str(error.value)


@pytest.mark.parametrize('start', [-1, 9, 100])
def test_a_start_outside_the_map_is_refused(start):
    with pytest.raises(InputError) as error:
        align_sequence(np.ones((3, 9)), start, SequenceSettings(length=3))
    assert str(start) in str(error.value)
    assert '9' in str(error.value)


@pytest.mark.parametrize(
    ('arguments', 'named'),
    [
        ({'length': 1}, '1'),
        ({'length': 0}, '0'),
        ({'length': 2.5}, '2.5'),
        ({'length': math.nan}, 'nan'),
        ({'beta': 1.0}, '1.0'),
        ({'beta': 0.5}, '0.5'),
        ({'beta': math.nan}, 'nan'),
        ({'beta': math.inf}, 'inf'),
    ],
)
def test_sequence_settings_out_of_range_are_refused(arguments, named):
    with pytest.raises(SettingsError) as error:
        SequenceSettings(**arguments)
    assert named in str(error.value)


def test_a_query_frame_that_the_path_does_not_have_is_refused():
    with pytest.raises(InputError) as error:
        aligned_index(np.array([(0, 3), (1, 4)], np.int32), 2)
    assert '2' in str(error.value)
