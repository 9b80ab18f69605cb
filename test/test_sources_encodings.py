# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Raw image messages to RGB: hand-made pixels of every encoding, lying headers, garbage."""

import array
from types import SimpleNamespace

from bags import SECOND, writing
import cv2
from hypothesis import example, given
from hypothesis import strategies as st
import numpy as np
import pytest
from raw_images import BAYER, CHANNELS, message, YUV
from stavpr_ros.errors import ImageError
from stavpr_ros.sources import files, open_source
from stavpr_ros.sources.bag import RAW
from stavpr_ros.sources.encodings import decode_image, decode_message, ENCODINGS


def test_encodings_are_all_tested():
    assert {*CHANNELS, *BAYER, *YUV} == ENCODINGS.keys()


@pytest.mark.parametrize('encoding', sorted(CHANNELS))
@pytest.mark.parametrize('big', [False, True])
@pytest.mark.parametrize(('height', 'width', 'padding'), [(1, 1, 0), (4, 6, 3), (8, 1, 5)])
def test_decode_image_of_every_encoding_is_exact(encoding, big, height, width, padding):
    step, data, expected = message(encoding, height, width, big, padding)
    image = decode_image(height, width, encoding, big, step, data)
    np.testing.assert_array_equal(image, expected)
    assert image.dtype == np.uint8
    assert image.flags.c_contiguous
    assert image.flags.writeable


@pytest.mark.parametrize('name', ['rgb8', '8UC3', 'mono16'])
def test_encoding_in_another_case_and_a_step_of_0_are_read(name):
    _, data, expected = message(name, 4, 6)
    np.testing.assert_array_equal(decode_image(4, 6, name.swapcase(), False, 0, data), expected)


@pytest.mark.parametrize(('encoding', 'suffix'), [('MJPEG', '.jpg'), ('png', '.png')])
def test_raw_message_with_the_bytes_of_a_file_is_read(encoding, suffix):
    pixels = np.full((8, 8, 3), 90, np.uint8)
    data = cv2.imencode(suffix, pixels)[1].tobytes()
    raw = SimpleNamespace(height=8, width=8, encoding=encoding, is_bigendian=0, step=0, data=data)
    np.testing.assert_allclose(decode_message(raw), pixels, atol=2)


@pytest.mark.parametrize(
    'kind',
    [
        bytes,
        bytearray,
        memoryview,
        lambda b: array.array('B', b),
        lambda b: np.frombuffer(b, np.uint8),
        lambda b: np.repeat(np.frombuffer(b, np.uint8), 2)[::2],
    ],
)
def test_decode_image_of_any_buffer_is_exact(kind):
    step, data, expected = message('rgb8', 4, 5, padding=2)
    np.testing.assert_array_equal(decode_image(4, 5, 'rgb8', False, step, kind(data)), expected)


@pytest.mark.parametrize(
    ('kind', 'padding', 'is_view'),
    [(bytearray, 0, True), (bytes, 0, False), (bytearray, 2, False)],
)
def test_rgb8_is_a_view_of_bytes_that_can_be_written(kind, padding, is_view):
    step, data, _ = message('rgb8', 4, 5, padding=padding)
    held = kind(data)
    image = decode_image(4, 5, 'rgb8', False, step, held)
    assert np.shares_memory(image, np.frombuffer(held, np.uint8)) is is_view


def test_decode_image_without_last_padding_is_exact():
    step, data, expected = message('bgr8', 3, 4, padding=5)
    np.testing.assert_array_equal(decode_image(3, 4, 'bgr8', False, step, data[:-5]), expected)
    with pytest.raises(ImageError, match=r'45 bytes of data .*expected 46'):
        decode_image(3, 4, 'bgr8', False, step, data[:-6])


@pytest.mark.parametrize(
    ('change', 'kind', 'text'),
    [
        ({'height': 0}, 'size', 'expected at least 1x1'),
        ({'width': 0}, 'size', 'expected at least 1x1'),
        ({'step': 11}, 'step', 'step of 11 bytes is too small'),
        ({'data': b''}, 'cut off', '0 bytes of data'),
        ({'height': 2**32 - 1, 'width': 2**32 - 1, 'step': 2**34}, 'cut off', 'cut off'),
        ({'step': 2**32 - 1}, 'cut off', 'cut off'),
        ({'encoding': 'rgb16', 'step': 23}, 'step', 'expected 24'),
        ({'encoding': 'rgb16', 'step': 24}, 'cut off', 'expected 72'),
        ({'encoding': 'uyvy', 'width': 3}, 'size', r'3x3 .*multiple of 2 and .* multiple of 1'),
        ({'encoding': 'yuyv', 'step': 7}, 'step', 'expected 8'),
        ({'encoding': 'nv12'}, 'size', r'4x3 pixels: .*multiple of 2 and .* multiple of 2'),
        (
            {'encoding': 'nv12', 'height': 4, 'step': 4, 'data': bytes(23)},
            'cut off',
            'expected 24',
        ),
        (
            {'encoding': 'nv21', 'height': 4, 'step': 9, 'data': bytes(48)},
            'cut off',
            'expected 49',
        ),
        (
            {'encoding': 'nv24', 'height': 2, 'step': 4, 'data': bytes(23)},
            'cut off',
            'expected 24',
        ),
        ({'encoding': 'bayer_rggb9'}, 'encoding', 'is not supported: expected one of rgb8'),
        (
            {'width': 13, 'data': bytes(9**4), 'step': 39},
            'too large',
            '13x3 pixels: .* at most 12',
        ),
        *(
            ({'encoding': f'{kind}C{n}'}, 'depth', f"'{kind}C{n}' is depth or measurements")
            for kind in ('8S', '16S', '32S', '32F', '64F')
            for n in (1, 4)
        ),
    ],
)
def test_decode_image_with_wrong_header_is_rejected(monkeypatch, change, kind, text):
    monkeypatch.setattr(files, 'MAX_PIXELS', 12 if kind == 'too large' else 2**65)
    fields = {'height': 3, 'width': 4, 'encoding': 'rgb8', 'step': 12, 'data': bytes(36)} | change
    with pytest.raises(ImageError, match=text) as caught:
        decode_image(is_bigendian=False, **fields)
    assert caught.value.kind == kind


def test_decode_message_of_either_type_is_exact():
    step, data, expected = message('mono16', 4, 5, big=True, padding=1)
    raw = SimpleNamespace(
        height=4, width=5, encoding='mono16', is_bigendian=1, step=step, data=data
    )
    np.testing.assert_array_equal(decode_message(raw), expected)
    pgm = SimpleNamespace(format='pgm', data=b'P5 5 4 255 ' + expected[..., 0].tobytes())
    np.testing.assert_array_equal(decode_message(pgm), expected)


def test_bag_errors_keep_their_kind(tmp_path):
    with writing(tmp_path / 'bag') as bag:
        for i, (encoding, step) in enumerate([('rgb8', 5), ('nv12', 2)]):
            pixels = np.full(6, 128, np.uint8)
            bag.write('/image', RAW, i, bag.header(i * SECOND), 2, 2, encoding, 0, step, pixels)
        bag.write_bytes('/image', RAW, 2, b'no message')
    errors = []
    (frame,) = open_source(tmp_path / 'bag', on_error=errors.append)
    np.testing.assert_array_equal(frame.image, np.full((2, 2, 3), 130))
    assert [error.kind for error in errors] == ['step', 'damaged']


def check(image, height, width, data):
    assert (image.shape, image.dtype) == ((height, width, 3), np.uint8)
    assert image.flags.c_contiguous
    assert not np.shares_memory(image, np.frombuffer(data, np.uint8))


@given(
    height=st.integers(0, 9) | st.integers(0, 2**32 - 1),
    width=st.integers(0, 9) | st.integers(0, 2**32 - 1),
    encoding=st.sampled_from([*ENCODINGS, '32FC1', '8UC2']) | st.text(max_size=12),
    big=st.booleans(),
    step=st.integers(0, 80) | st.integers(0, 2**32 - 1),
    data=st.binary(max_size=700),
)
@example(1, 2, 'mono8', False, 2**32 - 1, b'ab')
@example(1, 2, 'bgr16', True, 2**32 - 1, bytes(12))
def test_decode_image_of_random_message_decodes_or_fails(height, width, encoding, big, step, data):
    try:
        image = decode_image(height, width, encoding, big, step, data)
    except ImageError as error:
        image, kind = None, error.kind
    if image is None:
        assert kind in {'encoding', 'depth', 'size', 'step', 'cut off'}
    else:
        check(image, height, width, data)
