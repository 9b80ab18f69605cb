# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Image files and compressed messages to RGB: formats, mosaics, depth, damage, garbage."""

from contextlib import contextmanager
from io import BytesIO
import re
import struct
import sys
from types import SimpleNamespace
from unittest import mock
import zlib

import cv2
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from PIL import Image
import pytest
from raw_images import BAYER, is_deep, mosaic
from stavpr_ros.errors import ImageError
from stavpr_ros.sources import files, open_source
from stavpr_ros.sources.encodings import decode_compressed_message, decode_message
from stavpr_ros.sources.files import decode_file as decode_compressed

TRANSPORTS = ['', ';', 'png', 'rgb8; jpeg compressed bgr8', 'bayer_rggb8; png compressed ']


def encoded(suffix, image):
    return cv2.imencode(suffix, image)[1].tobytes()


def compressed(transport, data):
    return SimpleNamespace(format=transport, data=data)


@contextmanager
def rejects(kind, text):
    """Expect an error of a kind, with a text."""
    with pytest.raises(ImageError, match=text) as caught:
        yield
    assert caught.value.kind == kind


@pytest.mark.parametrize('suffix', ['.png', '.bmp', '.tiff', '.ppm', '.webp'])
def test_decode_compressed_of_lossless_file_is_exact(suffix):
    rgb = np.random.default_rng(0).integers(0, 256, (11, 13, 3), np.uint8)
    quality = [cv2.IMWRITE_WEBP_QUALITY, 101] if suffix == '.webp' else []
    data = cv2.imencode(suffix, rgb[..., ::-1].copy(), quality)[1]
    image = decode_compressed(data)
    np.testing.assert_array_equal(image, rgb)
    assert image.flags.c_contiguous


def test_decode_compressed_drops_transparency():
    bgra = np.random.default_rng(0).integers(0, 256, (5, 6, 4), np.uint8)
    np.testing.assert_array_equal(decode_compressed(encoded('.png', bgra)), bgra[..., 2::-1])


def test_decode_compressed_of_too_large_image_is_rejected_first(monkeypatch):
    data = encoded('.png', np.zeros((100, 101), np.uint8))
    monkeypatch.setattr(files, 'MAX_PIXELS', 10_000)
    monkeypatch.setattr(files.cv2, 'imdecode', lambda *_: pytest.fail('decoded'))
    with rejects('too large', '101x100 pixels: expected at most 10000'):
        decode_compressed(data)
    # from here on Pillow refuses by itself
    monkeypatch.setattr(Image, 'MAX_IMAGE_PIXELS', 5000)
    with rejects('too large', 'expected at most 10000'):
        decode_compressed(data)


NOISE = np.random.default_rng(0).integers(0, 256, (30, 40, 3), np.uint8)
SMOOTH = cv2.GaussianBlur(NOISE, (0, 0), 5)


@pytest.mark.parametrize(
    ('data', 'message'),
    [
        (b'', '0 bytes are no image'),
        (b'\xff', '1 bytes are no image'),
        (b'no image at all', '15 bytes are no image'),
        (b'\x89PNG\r\n\x1a\n', '8 bytes are no image'),
        (b'\xff\xd8\xff\xe0', '4 bytes are no image'),
        (bytes([0, 0, 0, 1, 0x67] * 4), "format 'h264': 20 bytes are no image"),
        (encoded('.png', NOISE)[:-30], 'is damaged or cut off: copy or record it again'),
        (b'P5 2000000 1 255 ' + bytes(2_000_000), 'image of 2000017 bytes is damaged or cut off'),
    ],
    ids=['empty', 'byte', 'text', 'png', 'jpeg', 'video', 'cut off', 'wider than OpenCV reads'],
)
def test_decode_compressed_of_damaged_image_fails(data, message):
    with rejects('damaged', message):
        decode_message(compressed('h264', data))


def chunk(key, content):
    size = len(content).to_bytes(4, 'big')
    return size + key + content + zlib.crc32(key + content).to_bytes(4, 'big')


def with_turn(name, turn):
    """Return a file that states an orientation by EXIF, where different programs write it."""
    exif, file = Image.Exif(), BytesIO()
    exif[0x0112] = turn
    late, options = name == 'PNG late', {'lossless': True, 'quality': 100}
    Image.fromarray(SMOOTH).save(file, name.split()[0], exif=b'' if late else exif, **options)
    data, content = file.getvalue(), exif.tobytes().removeprefix(b'Exif\0\0')
    if late:
        return data[:-12] + chunk(b'eXIf', content) + data[-12:]
    if name == 'WEBP prefixed':
        content = b'Exif\0\0' + content
        body = data[12 : data.rfind(b'EXIF')] + b'EXIF' + len(content).to_bytes(4, 'little')
        body += content + b'\0' * (len(content) % 2)
        return b'RIFF' + (len(body) + 4).to_bytes(4, 'little') + b'WEBP' + body
    return data


@pytest.mark.parametrize('name', ['JPEG', 'PNG', 'PNG late', 'TIFF', 'WEBP', 'WEBP prefixed'])
@pytest.mark.parametrize('turn', range(10))
def test_decode_compressed_applies_the_orientation_of_exif(name, turn):
    turns = {
        2: SMOOTH[:, ::-1], 3: SMOOTH[::-1, ::-1], 4: SMOOTH[::-1], 5: SMOOTH.swapaxes(0, 1),
        6: np.rot90(SMOOTH, -1), 7: SMOOTH[::-1, ::-1].swapaxes(0, 1), 8: np.rot90(SMOOTH),
    }  # fmt: skip
    expected = turns.get(turn, SMOOTH)
    image = decode_compressed(with_turn(name, turn))
    assert image.shape == expected.shape
    mean_error = np.abs(image.astype(int) - expected).mean()
    assert mean_error < (3 if name == 'JPEG' else 1e-9)


@pytest.mark.parametrize('suffix', ['.png', '.tiff', '.pgm', '.ppm'])
def test_decode_compressed_of_16_bits_takes_the_upper_byte_as_opencv_does(suffix):
    shape = (30, 40) if suffix == '.pgm' else (30, 40, 3)
    data = encoded(suffix, np.random.default_rng(0).integers(0, 65536, shape).astype(np.uint16))
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    np.testing.assert_array_equal(decode_compressed(data), expected)


@pytest.mark.parametrize('maximum', [1, 100, 255, 4095, 65535])
@pytest.mark.parametrize('kind', ['P5', 'P6'])
def test_decode_compressed_of_pnm_scales_its_largest_value_to_white(kind, maximum):
    shape = (120, 160, 1 if kind == 'P5' else 3)
    values = np.round(np.linspace(0, maximum, np.prod(shape))).reshape(shape)
    head = f'{kind}\n# by hand\n160 120\n{maximum}\n'.encode()
    data = head + values.astype('>u2' if maximum > 255 else np.uint8).tobytes()
    assert np.abs(decode_compressed(data) - values * (255 / maximum)).max() <= 1
    with pytest.raises(ImageError, match='is damaged or cut off'):
        decode_compressed(data[:-300])


@pytest.mark.parametrize('compression', [None, 'tiff_lzw', 'tiff_deflate', 'packbits'])
def test_decode_compressed_of_sound_tiff_that_opencv_does_not_read(compression):
    """Of 32 bits; what has no range of its own is not called damaged."""

    def tiff(values):
        file = BytesIO()
        Image.fromarray(values).save(file, 'TIFF', compression=compression)
        return file.getvalue()

    gray = np.tile(np.linspace(0, 1, 160, dtype=np.float32), (120, 1))
    expected = np.repeat((np.round(gray * 65535).astype(np.uint16) >> 8)[..., None], 3, axis=2)
    np.testing.assert_array_equal(decode_compressed(tiff(gray)), expected)
    counts = np.round(gray * 65535).astype(np.int32)
    np.testing.assert_array_equal(decode_compressed(tiff(counts)), expected)
    for values in (gray * 300, gray - 1, gray * np.nan, counts * 2, -counts):
        with rejects('depth', 'TIFF with values from'):
            decode_compressed(tiff(values))


def test_decode_compressed_of_heic(monkeypatch):
    heif = pytest.importorskip('pillow_heif', reason='the extra heif is not installed')
    file = BytesIO()
    heif.from_pillow(Image.fromarray(SMOOTH)).save(file, quality=95)
    assert np.abs(decode_compressed(file.getvalue()).astype(int) - SMOOTH).mean() < 3
    with pytest.raises(ImageError, match='are no image, or damaged'):
        decode_compressed(file.getvalue()[:200])
    monkeypatch.setitem(sys.modules, 'pillow_heif', None)
    with rejects('format', 'not installed: pip install pillow-heif'):
        decode_compressed(file.getvalue())


@pytest.mark.parametrize('length', [2**31 - 1, 2**32 - 1, 1000])
def test_decode_compressed_of_png_with_long_chunk_allocates_nothing(monkeypatch, length):
    data = bytearray(encoded('.png', NOISE))
    first_chunk = 8 + 12 + 13  # behind the header's
    data[first_chunk : first_chunk + 4] = length.to_bytes(4, 'big')
    monkeypatch.setattr(files.cv2, 'imdecode', lambda *_: pytest.fail('decoded'))
    with rejects('damaged', 'is damaged or cut off'):
        decode_compressed(bytes(data[:500]))
    for size in (first_chunk + 9, first_chunk + 8, first_chunk + 4):  # the last, incomplete chunk
        with pytest.raises(ImageError, match='damaged'):
            decode_compressed(bytes(data[:size]))


def test_decode_compressed_of_png_ignores_what_follows_its_end():
    for extra in (b'\0', b'\n' * 8, b'\x7f\xff\xff\xffextra data'):
        np.testing.assert_array_equal(
            decode_compressed(encoded('.png', NOISE) + extra), NOISE[..., ::-1]
        )


@pytest.mark.parametrize('tags', [{278: 2**23}, {322: 16, 323: 2**23}])
def test_decode_compressed_of_tiff_with_large_parts_allocates_nothing(monkeypatch, tags):
    """Strips and tiles of up to a gigabyte are allocated by OpenCV before it reads the pixels."""
    file = BytesIO()
    Image.fromarray(NOISE).save(file, 'TIFF', tiffinfo={278: 3})
    data = bytearray(file.getvalue())
    strips = data.index(struct.pack('<H', 278), 8)  # the entry of this tag
    for i, (tag, value) in enumerate(tags.items()):
        struct.pack_into('<HHII', data, strips + 12 * i, tag, 4, 1, value)
    monkeypatch.setattr(files.cv2, 'imdecode', lambda *_: pytest.fail('decoded'))
    with rejects('too large', 'x8388608 pixels: expected at most'):
        decode_compressed(bytes(data))


def test_decode_compressed_of_cut_off_jpeg_fails():
    rgb = np.full((64, 64, 3), (200, 100, 30), np.uint8)
    small = encoded('.jpg', rgb[:8, :8])
    data = encoded('.jpg', rgb[..., ::-1].copy())
    # where cameras put a thumbnail
    segment = b'\xff\xe1' + (len(small) + 2).to_bytes(2, 'big') + small
    data = data[:2] + segment + data[2:]
    # cameras fill up with zeros
    assert np.abs(decode_compressed(data + bytes(50)).astype(int) - rgb).max() <= 4
    for missing in (1, 2):  # of the end alone, which not all cameras write
        np.testing.assert_array_equal(decode_compressed(data[:-missing]), decode_compressed(data))
    for missing in (20, 60):
        with rejects('cut off', 'is cut off: expected the end of a JPEG'):
            decode_compressed(data[:-missing])


@pytest.mark.parametrize(
    'options', [[], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 2]]
)
def test_decode_compressed_of_jpeg_with_video_ignores_it(options):
    """As phones append one; any two bytes may be in it. Noise: its own data has every byte too."""
    bgr = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    data = cv2.imencode('.jpg', bgr, options)[1].tobytes()
    expected = decode_compressed(data)
    for video in (b'\xff\xda ftyp \xff\xd9', b'\xff\xd9 ftyp \xff\xda'):
        np.testing.assert_array_equal(decode_compressed(data + video), expected)
    for missing in (1, 2):
        np.testing.assert_array_equal(decode_compressed(data[:-missing]), expected)
    restarts = [len(data) - mark.end() for mark in re.finditer(b'\xff[\xd0-\xd7]', data)]
    for missing in (4, 20, len(data) // 2, *restarts):
        with pytest.raises(ImageError, match='is cut off'):
            decode_compressed(data[:-missing])


def test_decode_compressed_of_mpo_reads_first_image():
    first, second = (Image.new('RGB', (64, 64), color) for color in ((200, 100, 30), (0, 0, 0)))
    file = BytesIO()
    first.save(file, 'MPO', save_all=True, append_images=[second])
    data = file.getvalue()
    assert np.abs(decode_compressed(data)[0, 0].astype(int) - (200, 100, 30)).max() <= 4
    with pytest.raises(ImageError, match='is cut off'):
        decode_compressed(data[: data.index(b'\xff\xd9') - 20])


@pytest.mark.parametrize(
    'transport', ['', 'jpeg', 'rgb8; jpeg compressed bgr8', '16UC1; png compressed ', 'h264']
)
def test_compressed_message_format_is_taken_from_bytes(transport):
    rgb = np.random.default_rng(0).integers(0, 256, (5, 6, 3), np.uint8)
    image = decode_message(compressed(transport, encoded('.png', rgb[..., ::-1].copy())))
    np.testing.assert_array_equal(image, rgb)


@pytest.mark.parametrize(
    'transport',
    [
        '16UC1; compressedDepth rvl',
        'compressedDepth',
        'mono16; CompressedDepth',
        '32FC1; tiff compressed ',
        '32FC1',
        ' 16SC1 ; png',
    ],
)
def test_compressed_message_of_depth_is_rejected(transport):
    png = encoded('.png', np.zeros((4, 4), np.uint8))  # an image, so that only the name is wrong
    with pytest.raises(ImageError, match='is depth or measurements, not an image') as caught:
        decode_compressed_message(compressed(transport, png))
    assert repr(transport) in str(caught.value)
    assert caught.value.kind == 'depth'


@pytest.mark.parametrize('encoding', BAYER)
@pytest.mark.parametrize('suffix', ['.png', '.tiff'])
def test_compressed_message_of_bayer_is_demosaiced(encoding, suffix):
    scene, deep = np.full((6, 8, 3), (220, 130, 30), np.uint8), is_deep(encoding)
    seen = mosaic(encoding, scene).view(np.uint16 if deep else np.uint8)
    transport = f'{encoding}; {suffix[1:]} compressed {"" if deep else encoding}'
    image = decode_compressed_message(compressed(transport, encoded(suffix, seen)))
    np.testing.assert_array_equal(image, scene)


def test_mosaic_in_a_tiff_that_pillow_alone_decodes():
    file = bytearray(encoded('.tiff', np.arange(96, dtype=np.uint8).reshape(8, 12)))
    file[78] = 0
    del file[114:]
    image = decode_compressed_message(compressed('bayer_rggb8; png compressed ', bytes(file)))
    assert image.shape == (8, 12, 3)


@pytest.mark.parametrize(
    'transport',
    [
        'bayer_rggb8; jpeg compressed mono8',
        'bayer_rggb8',
        'bayer_rggb8; png',
        'bayer_none8; png compressed ',
        'mono8; png compressed ',
    ],
)
def test_compressed_message_of_converted_bayer_is_gray(transport):
    gray = mosaic('bayer_rggb8', np.full((6, 8, 3), (220, 130, 30), np.uint8))
    image = decode_compressed_message(compressed(transport, encoded('.png', gray)))
    np.testing.assert_array_equal(image, np.dstack([gray] * 3))


def test_folder_with_unreadable_file_fails(tmp_path):
    (tmp_path / '1.png').write_bytes(b'gone before it is read')
    source = open_source(tmp_path)
    (tmp_path / '1.png').unlink()
    with rejects('unreadable', 'cannot be read'):
        list(source)


@pytest.mark.filterwarnings('ignore::UserWarning')  # Pillow's, on the way to the error
@given(st.data())
def test_compressed_message_of_damaged_file_decodes_or_fails(data):
    transport = data.draw(st.sampled_from(TRANSPORTS) | st.text(max_size=20))
    suffix = data.draw(st.sampled_from(['.jpg', '.png', '.bmp', '.tiff', '.pgm', '.webp']))
    file = bytearray(encoded(suffix, np.arange(96, dtype=np.uint8).reshape(8, 12)))
    for _ in range(data.draw(st.integers(1, 8))):
        file[data.draw(st.integers(0, len(file) - 1))] = data.draw(st.integers(0, 255))
    del file[data.draw(st.integers(0, len(file))) :]
    try:
        # a damaged header may claim the largest size: a lower limit keeps this test short
        with mock.patch.object(files, 'MAX_PIXELS', 10**6):
            image = decode_compressed_message(compressed(transport, bytes(file)))
    except ImageError as error:  # the one error that is allowed
        image, kind = None, error.kind
    if image is None:
        assert kind in {'cut off', 'damaged', 'depth', 'format', 'size', 'too large'}
        return
    assert (image.dtype, image.shape[2:]) == (np.uint8, (3,))
    assert image.flags.c_contiguous
    assert not np.shares_memory(image, np.frombuffer(file, np.uint8))
