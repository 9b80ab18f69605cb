"""Image messages and files to RGB: hand-made pixels, lying headers, garbage."""

import array
from unittest import mock

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stavpr_ros.errors import ImageError
from stavpr_ros.sources import encodings
from stavpr_ros.sources.encodings import ENCODINGS, decode_compressed, decode_image

# channel of the message at which red, green and blue lie
CHANNELS = {
    'rgb8': (0, 1, 2),
    'bgr8': (2, 1, 0),
    'rgba8': (0, 1, 2),
    'bgra8': (2, 1, 0),
    'mono8': (0, 0, 0),
    'mono16': (0, 0, 0),
    'rgb16': (0, 1, 2),
    'bgr16': (2, 1, 0),
    'rgba16': (0, 1, 2),
    'bgra16': (2, 1, 0),
    '8UC1': (0, 0, 0),
    '8UC3': (2, 1, 0),
    '8UC4': (2, 1, 0),
}


def message(encoding, height, width, big=False, padding=0):
    """Random pixels as a message's (step, bytes), and the RGB that must come out."""
    channels = max(4 if 'a' in encoding or encoding.endswith('4') else 0, max(CHANNELS[encoding]) + 1)
    deep = encoding.endswith('16')
    dtype = np.dtype(np.uint16 if deep else np.uint8).newbyteorder('>' if big else '<')
    values = (
        np.random.default_rng(1).integers(0, np.iinfo(dtype).max + 1, (height, width, channels)).astype(dtype)
    )
    expected = (values >> 8 if deep else values)[..., CHANNELS[encoding]].astype(np.uint8)
    rows = values.reshape(height, -1).view(np.uint8)
    padded = np.hstack([rows, np.full((height, padding), 99, np.uint8)])
    return padded.shape[1], padded.tobytes(), expected


def test_every_encoding_is_tested():
    assert CHANNELS.keys() == ENCODINGS.keys()


@pytest.mark.parametrize('encoding', sorted(CHANNELS))
@pytest.mark.parametrize('big', [False, True])
@pytest.mark.parametrize(
    ('height', 'width', 'padding'), [(1, 1, 0), (5, 7, 0), (4, 6, 3), (1, 9, 1), (8, 1, 5)]
)
def test_pixels(encoding, big, height, width, padding):
    step, data, expected = message(encoding, height, width, big, padding)
    image = decode_image(height, width, encoding, big, step, data)
    np.testing.assert_array_equal(image, expected)
    assert image.dtype == np.uint8
    assert image.flags.c_contiguous
    assert image.flags.writeable


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
def test_any_buffer_and_no_sharing(kind):
    step, data, expected = message('rgb8', 4, 5, padding=2)
    image = decode_image(4, 5, 'rgb8', False, step, kind(data))
    np.testing.assert_array_equal(image, expected)
    assert image.base is None


def test_the_last_rows_padding_may_be_missing():
    step, data, expected = message('bgr8', 3, 4, padding=5)
    np.testing.assert_array_equal(decode_image(3, 4, 'bgr8', False, step, data[:-5]), expected)
    with pytest.raises(ImageError, match=r'45 bytes of data .*expected 46'):
        decode_image(3, 4, 'bgr8', False, step, data[:-6])


@pytest.mark.parametrize(
    ('change', 'text'),
    [
        ({'height': 0}, 'expected at least 1x1'),
        ({'width': 0}, 'expected at least 1x1'),
        ({'step': 11}, 'step of 11 bytes is too small'),
        ({'data': b''}, '0 bytes of data'),
        ({'height': 2**32 - 1}, 'cut off'),
        ({'encoding': '16UC1'}, 'depth'),
        ({'encoding': '32FC1'}, 'depth'),
        ({'encoding': 'bayer_rggb9'}, "'bayer_rggb9' is not read: expected one of rgb8"),
        ({'encoding': ''}, 'is not read'),
    ],
)
def test_lying_headers(change, text):
    fields = {
        'height': 3,
        'width': 4,
        'encoding': 'rgb8',
        'is_bigendian': False,
        'step': 12,
        'data': bytes(36),
    }
    with pytest.raises(ImageError, match=text):
        decode_image(**(fields | change))


@given(
    height=st.integers(0, 9) | st.integers(0, 2**32 - 1),
    width=st.integers(0, 9) | st.integers(0, 2**32 - 1),
    encoding=st.sampled_from([*ENCODINGS, '32FC1', 'yuv422']) | st.text(max_size=6),
    big=st.booleans(),
    step=st.integers(0, 80) | st.integers(0, 2**32 - 1),
    data=st.binary(max_size=700),
)
def test_random_messages_decode_or_say_why(height, width, encoding, big, step, data):
    try:
        image = decode_image(height, width, encoding, big, step, data)
    except ImageError:
        return  # the one error that is allowed
    assert (image.shape, image.dtype) == ((height, width, 3), np.uint8)


def encoded(suffix, image):
    return cv2.imencode(suffix, image)[1].tobytes()


@pytest.mark.parametrize('suffix', ['.png', '.bmp', '.tiff', '.ppm', '.webp'])
def test_lossless_files(suffix):
    rgb = np.random.default_rng(0).integers(0, 256, (11, 13, 3), np.uint8)
    quality = [cv2.IMWRITE_WEBP_QUALITY, 101] if suffix == '.webp' else []
    data = cv2.imencode(suffix, rgb[..., ::-1].copy(), quality)[1]
    image = decode_compressed(data)
    np.testing.assert_array_equal(image, rgb)
    assert image.flags.c_contiguous


def test_jpeg_is_near():
    rgb = np.full((16, 24, 3), (200, 100, 30), np.uint8)
    assert np.abs(decode_compressed(encoded('.jpg', rgb[..., ::-1].copy())).astype(int) - rgb).max() <= 4


@pytest.mark.parametrize('suffix', ['.png', '.pgm', '.tiff'])
def test_sixteen_bits_lose_the_lower_byte(suffix):
    grey = (np.arange(12, dtype=np.uint16) * 5000).reshape(3, 4)
    np.testing.assert_array_equal(decode_compressed(encoded(suffix, grey)), np.dstack([grey >> 8] * 3))


def test_transparency_is_dropped():
    bgra = np.random.default_rng(0).integers(0, 256, (5, 6, 4), np.uint8)
    np.testing.assert_array_equal(decode_compressed(encoded('.png', bgra)), bgra[..., 2::-1])


def test_a_bomb_is_refused_before_it_is_decoded(monkeypatch):
    data = encoded('.png', np.zeros((100, 101), np.uint8))
    monkeypatch.setattr(encodings, 'MAX_PIXELS', 10_000)
    monkeypatch.setattr(encodings.cv2, 'imdecode', lambda *_: pytest.fail('decoded'))
    with pytest.raises(ImageError, match='101x100 pixels: expected at most 10000'):
        decode_compressed(data)


@pytest.mark.filterwarnings('ignore::UserWarning')  # Pillow's, on the way to the error
@given(st.data())
def test_damaged_files_decode_or_say_why(data):
    suffix = data.draw(st.sampled_from(['.jpg', '.png', '.bmp', '.tiff', '.pgm', '.webp']))
    file = bytearray(encoded(suffix, np.arange(96, dtype=np.uint8).reshape(8, 12)))
    for _ in range(data.draw(st.integers(1, 8))):
        file[data.draw(st.integers(0, len(file) - 1))] = data.draw(st.integers(0, 255))
    del file[data.draw(st.integers(0, len(file))) :]
    try:
        # a damaged header may promise as many pixels as are allowed: a lower limit keeps this test short
        with mock.patch.object(encodings, 'MAX_PIXELS', 10**6):
            image = decode_compressed(bytes(file))
    except ImageError:
        return  # the one error that is allowed
    assert image.ndim == 3
    assert image.dtype == np.uint8


@pytest.mark.parametrize(
    'data', [b'', b'\xff', b'no image at all', b'\x89PNG\r\n\x1a\n', b'\xff\xd8\xff\xe0']
)
def test_no_image(data):
    with pytest.raises(ImageError, match=f'{len(data)} bytes are no image'):
        decode_compressed(data)
