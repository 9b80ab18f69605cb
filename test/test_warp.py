"""Changed drives: which image each image is, by hand; and what cropping leaves of an image."""

import numpy as np
import pytest

from stavpr_ros.errors import ImageError, SettingsError
from stavpr_ros.evaluation.warp import KINDS, STOP, CroppedSource, cropped, warp_indices
from stavpr_ros.sources.frame import Frame


@pytest.mark.parametrize(
    ('n', 'kind', 'expected'),
    [
        (7, '2x', [0, 2, 4, 6]),
        (8, '2x', [0, 2, 4, 6]),
        (8, '1.5x', [0, 1, 3, 4, 6, 7]),
        (7, '1.5x', [0, 1, 3, 4, 6]),
        (5, '0.7x', [0, 0, 1, 2, 2, 3, 4, 4]),
        (3, '0.5x', [0, 0, 1, 1, 2, 2]),
        (4, 'stop', [0, 1, 2] + [2] * STOP + [3]),
        (1, 'stop', [0] * (STOP + 1)),
    ],
)
def test_by_hand(n, kind, expected):
    assert warp_indices(n, kind).tolist() == expected


def test_rates_are_those_of_their_names():
    """floor(r i), also where 0.7 i is a whole number that binary fractions miss."""
    for kind in ('2x', '1.5x', '0.7x', '0.5x'):
        tenths = round(float(kind[:-1]) * 10)
        indices = warp_indices(1000, kind)
        assert indices.tolist() == [i * tenths // 10 for i in range(len(indices))]
        assert len(indices) * tenths // 10 >= 1000  # the next one would be outside


def test_varying_speed():
    indices = warp_indices(2000, 'vary')
    speeds = (indices[9:] - indices[:-9]) / 9
    assert 1.8 < speeds.max() <= 2.1
    assert 0.4 <= speeds.min() < 0.6
    # position += 2 ** sin(2 pi i / 60): steps of 1, 1.08, 1.16, ...; 2 near i = 15, 1/2 near i = 45
    assert indices[:5].tolist() == [0, 1, 2, 3, 4]
    assert indices[16] - indices[13] == 6
    assert indices[49] - indices[41] == 4
    steps = 2 ** np.sin(2 * np.pi * np.arange(len(indices)) / 60)
    assert indices.tolist() == [int(steps[:i].sum()) for i in range(len(indices))]
    assert indices[-1] <= 1999 < indices[-1] + 3


@pytest.mark.parametrize('kind', KINDS)
def test_every_kind_stays_on_the_drive(kind):
    for n in (1, 2, 59, 200):
        indices = warp_indices(n, kind)
        assert indices.dtype == np.int64
        assert indices[0] == 0
        assert indices[-1] < n
        assert (np.diff(indices) >= 0).all()
        np.testing.assert_array_equal(indices, warp_indices(n, kind))


def test_what_cannot_be_warped():
    with pytest.raises(SettingsError, match=r'take one of 2x, 1\.5x, 0\.7x, 0\.5x, vary, stop'):
        warp_indices(10, '3x')
    with pytest.raises(SettingsError, match='0 images'):
        warp_indices(0, '2x')


# ------------------------------------------------------------------------------------------ cropping


def columns(width):
    """An image whose pixels say in which column they are."""
    return np.broadcast_to(np.arange(width, dtype=np.uint8)[None, :, None], (2, width, 3)).copy()


def test_cropping_by_hand():
    source = [Frame(columns(10), 7, 'a'), Frame(columns(15), 8, 'b')]
    frames = list(cropped(source, 0.1, 0.3))
    assert frames[0].image[0, :, 0].tolist() == [1, 2, 3, 4, 5, 6]
    assert frames[1].image[0, :, 0].tolist() == list(range(2, 10))  # 1.5 and 4.5 pixels, rounded: 2 and 5
    assert [(frame.stamp, frame.identifier) for frame in frames] == [(7, 'a'), (8, 'b')]
    assert all(frame.image.flags.c_contiguous and frame.image.shape[2] == 3 for frame in frames)
    assert source[0].image.shape == (2, 10, 3)


def test_cropping_can_be_read_again():
    source = CroppedSource([Frame(columns(10), 0, '')] * 3, 0.5, 0)
    assert len(source) == 3
    assert [len(list(source)) for _ in range(2)] == [3, 3]


def test_nothing_cropped_is_the_source_itself():
    source = [Frame(columns(4), 0, '')]
    assert cropped(source, 0, 0) is source
    assert cropped(source, 0.25, 0) is not source
    assert cropped(source, 0, 0.25) is not source


@pytest.mark.parametrize('fractions', [(-0.1, 0), (0, -0.1), (0.5, 0.5), (1, 0), (float('nan'), 0)])
def test_fractions_that_leave_nothing(fractions):
    with pytest.raises(SettingsError, match='fractions >= 0'):
        cropped([], *fractions)


def test_an_image_too_narrow():
    with pytest.raises(ImageError, match='b is 1 pixels wide'):
        list(cropped([Frame(columns(1), 0, 'b')], 0.6, 0.3))
