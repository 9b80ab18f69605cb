# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Changed traverses: speeds and crops, by hand."""

import numpy as np
import pytest
from stavpr_lab.evaluation.warp import cropped, STOP, warp_indices
from stavpr_ros.errors import SettingsError
from stavpr_ros.sources.frame import Frame


@pytest.mark.parametrize(
    ('n', 'kind', 'expected'),
    [
        (7, '2x', [0, 2, 4, 6]),
        (7, '1.5x', [0, 1, 3, 4, 6]),
        (5, '0.7x', [0, 0, 1, 2, 2, 3, 4, 4]),
        (4, 'stop', [0, 1, 2] + [2] * STOP + [3]),
        (1, 'stop', [0] * (STOP + 1)),
    ],
)
def test_warp_indices_by_hand(n, kind, expected):
    assert warp_indices(n, kind).tolist() == expected


def test_warp_indices_at_rate_are_floors():
    """floor(r i), also where 0.7 i is a whole number that binary fractions miss."""
    for kind in ('2x', '1.5x', '0.7x', '0.5x'):
        tenths = round(float(kind[:-1]) * 10)
        indices = warp_indices(1000, kind)
        assert indices.tolist() == [i * tenths // 10 for i in range(len(indices))]
        assert len(indices) * tenths // 10 >= 1000  # the next one would be outside


def test_warp_indices_vary_between_half_and_double_speed():
    indices = warp_indices(2000, 'vary')
    # steps of 2 ** sin(2 pi i / 60): 1, 1.08, 1.16, ...; 2 near i = 15, 1/2 near i = 45
    assert indices[:5].tolist() == [0, 1, 2, 3, 4]
    assert indices[16] - indices[13] == 6
    assert indices[49] - indices[41] == 4
    steps = 2 ** np.sin(2 * np.pi * np.arange(len(indices)) / 60)
    assert indices.tolist() == [int(steps[:i].sum()) for i in range(len(indices))]
    assert indices[-1] <= 1999 < indices[-1] + 3


def test_warp_indices_of_unknown_kind_raise():
    with pytest.raises(SettingsError, match=r'take one of 2x, 1\.5x, 0\.7x, 0\.5x, vary, stop'):
        warp_indices(10, '3x')


# ---------------------------------------------------------------------------------- cropping


def columns(width):
    """Return an image whose pixels are their column."""
    return np.broadcast_to(np.arange(width, dtype=np.uint8)[None, :, None], (2, width, 3)).copy()


def test_cropped_images_by_hand():
    source = [Frame(columns(10), 7, 'a'), Frame(columns(15), 8, 'b')]
    frames = list(cropped(source, 0.1, 0.3))
    assert frames[0].image[0, :, 0].tolist() == [1, 2, 3, 4, 5, 6]
    assert frames[1].image[0, :, 0].tolist() == list(
        range(2, 10)
    )  # 1.5 and 4.5 pixels, rounded: 2 and 5
    assert [(frame.stamp, frame.identifier) for frame in frames] == [(7, 'a'), (8, 'b')]
    assert all(frame.image.flags.c_contiguous and frame.image.shape[2] == 3 for frame in frames)
    assert source[0].image.shape == (2, 10, 3)


@pytest.mark.parametrize(
    'fractions', [(-0.1, 0), (0, -0.1), (0.5, 0.5), (1, 0), (float('nan'), 0)]
)
def test_cropped_by_invalid_fractions_raises(fractions):
    with pytest.raises(SettingsError, match='fractions >= 0'):
        cropped([], *fractions)
