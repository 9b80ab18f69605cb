# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Image messages and files to RGB: a table of what is read, one of errors, and garbage."""

import array
from io import BytesIO
import re
import struct
from unittest import mock
import zlib

import cv2
from hypothesis import example, given
from hypothesis import strategies as st
import numpy as np
from PIL import Image
import pytest
from raw_images import (
    BAYER,
    CHANNELS,
    encode,
    file_message,
    is_deep,
    mosaic,
    noise,
    packed_yuv,
    pad_rows,
    PAIRS,
    raw,
    YUV,
)
from stavpr_ros.errors import ImageError
from stavpr_ros.sources import files
from stavpr_ros.sources.encodings import decode_message, ENCODINGS

NOISE = np.random.default_rng(0).integers(0, 256, (30, 40, 3), np.uint8)
SMOOTH = cv2.GaussianBlur(NOISE, (0, 0), 5)
# every size that a Bayer mosaic can have, odd and even, and where OpenCV cannot interpolate
MOSAICS = [(2, 2), (2, 7), (6, 2), (3, 5), (5, 3), (7, 8)]
SCENE = np.full((6, 8, 3), (220, 130, 30), np.uint8)
BUFFERS = {
    'bytearray': bytearray,
    'memoryview': memoryview,
    'array': lambda content: array.array('B', content),
    'numpy': lambda content: np.frombuffer(content, np.uint8),
    'apart': lambda content: np.repeat(np.frombuffer(content, np.uint8), 2)[::2],
}
FILM = b'\xff\xda ftyp \xff\xd9', b'\xff\xd9 ftyp \xff\xda'


def rgb_of(yuv):
    """BT.601 from its definition: R = Y' + 2 (1 - Kr) Cr and so on, in float64."""
    kr, kb = 0.299, 0.114
    y = (yuv[..., 0].astype(float) - 16) / 219
    cb, cr = ((yuv[..., i].astype(float) - 128) / 224 for i in (1, 2))
    red, blue = y + 2 * (1 - kr) * cr, y + 2 * (1 - kb) * cb
    green = (y - kr * red - kb * blue) / (1 - kr - kb)
    return 255 * np.clip(np.dstack([red, green, blue]), 0, 1)


def bilinear(encoding, scene):
    """Return what a mosaic becomes by the mean of the nearest; NaN at the border."""
    height, width = scene.shape[:2]
    expected = np.full((height, width, 3), np.nan)
    for y in range(1, height - 1):
        for x in range(1, width - 1):
            for channel, color in enumerate('rgb'):
                near = [
                    float(scene[v, u, channel])
                    for v in (y - 1, y, y + 1)
                    for u in (x - 1, x, x + 1)
                    if BAYER[encoding][2 * (v % 2) + u % 2] == color
                ]
                own = BAYER[encoding][2 * (y % 2) + x % 2] == color
                expected[y, x, channel] = scene[y, x, channel] if own else np.mean(near)
    return expected


def raw_messages():
    """Yield names, raw messages, the RGB that must come out, and the largest difference."""
    for name in CHANNELS:
        for big in (False, True):
            for height, width, padding in ((1, 1, 0), (4, 6, 3), (8, 1, 5)):
                step, data, rgb = noise(name, height, width, big, padding)
                message = raw(name, height, width, step, data, big)
                yield f'{name} {height}x{width} {"big" * big}', message, rgb, 0
    for name in ('rgb8', '8UC3', 'mono16'):
        _, data, rgb = noise(name, 4, 6)
        yield f'{name} in another case, step 0', raw(name.swapcase(), 4, 6, 0, data), rgb, 0
    step, data, rgb = noise('rgb8', 4, 5, padding=2)
    for name, kind in BUFFERS.items():
        yield f'rgb8 in {name}', raw('rgb8', 4, 5, step, kind(data)), rgb, 0
    step, data, rgb = noise('bgr8', 3, 4, padding=5)
    yield 'bgr8 without its last padding', raw('bgr8', 3, 4, step, data[:-5]), rgb, 0
    for name, suffix in (('MJPEG', '.jpg'), ('png', '.png')):
        rgb = np.full((8, 8, 3), 90, np.uint8)
        yield f'raw with a file, {name}', raw(name, 8, 8, 0, encode(suffix, rgb)), rgb, 2


def bayer_messages():
    """Yield raw mosaics, also of YUV with shared colors, as above."""
    rng = np.random.default_rng(2)
    for name in BAYER:
        for height, width in MOSAICS:
            for color in ((200, 0, 0), (10, 120, 230)):
                rgb = np.full((height, width, 3), color, np.uint8)
                for big, padding in ((False, 0), (True, 3)):
                    step, data = pad_rows(mosaic(name, rgb, big), padding)
                    message = raw(name, height, width, step, data, big)
                    yield f'{name} {height}x{width} {color[0]} {padding}', message, rgb, 0
        scene = rng.integers(0, 256, (8, 9, 3), np.uint8)
        step, data = pad_rows(mosaic(name, scene), 0)
        yield f'{name} of noise', raw(name, 8, 9, step, data), bilinear(name, scene), 1
    for name in YUV:
        rows, columns = (1, 1) if name == 'nv24' else (1, 2) if name in PAIRS else (2, 2)
        for height, width, padding in ((2, 2, 0), (4, 10, 6), (2, 64, 1)):
            yuv = rng.integers(16, 236, (height, width, 3)).astype(np.uint8)
            # pixels of one block share the color of its first
            yuv[..., 1:] = np.repeat(np.repeat(yuv[::rows, ::columns, 1:], rows, 0), columns, 1)
            step, data = packed_yuv(name, yuv, padding)
            for part in {len(data), len(data) - padding}:  # the last padding is not needed
                message = raw(name, height, width, step, data[:part])
                yield f'{name} {height}x{width} {part}', message, rgb_of(yuv), 2


def plain_files():
    """Yield files of every format, and of names in messages, as above."""
    rgb = np.random.default_rng(0).integers(0, 256, (11, 13, 3), np.uint8)
    for suffix in ('.png', '.bmp', '.tiff', '.ppm', '.webp'):
        lossless = [cv2.IMWRITE_WEBP_QUALITY, 101] * (suffix == '.webp')
        yield suffix, file_message(encode(suffix, rgb, *lossless)), rgb, 0
    transparent = np.dstack([rgb[..., ::-1], rgb[..., :1]])
    content = cv2.imencode('.png', transparent)[1].tobytes()
    yield 'transparent', file_message(content), rgb, 0
    for name in ('jpeg', 'rgb8; jpeg compressed bgr8', '16UC1; png compressed ', 'h264'):
        yield f'PNG named {name}', file_message(encode('.png', rgb), name), rgb, 0
    for extra in (b'\0', b'\n' * 8, b'\x7f\xff\xff\xffextra data'):
        message = file_message(encode('.png', NOISE) + extra)
        yield f'PNG, behind its end {extra}', message, NOISE, 0
    gray = np.dstack([np.arange(20, dtype=np.uint8).reshape(4, 5)] * 3)
    yield 'PGM', file_message(b'P5 5 4 255 ' + gray[..., 0].tobytes(), 'pgm'), gray, 0
    for name in BAYER:
        for suffix in ('.png', '.tiff'):
            deep = is_deep(name)
            seen = mosaic(name, SCENE).view(np.uint16 if deep else np.uint8)
            transport = f'{name}; {suffix[1:]} compressed {"" if deep else name}'
            yield f'{name} {suffix}', file_message(encode(suffix, seen), transport), SCENE, 0
    gray = mosaic('bayer_rggb8', SCENE)
    for transport in (
        'bayer_rggb8; jpeg compressed mono8',
        'bayer_rggb8',
        'bayer_rggb8; png',
        'bayer_none8; png compressed ',
        'mono8; png compressed ',
    ):
        message = file_message(encode('.png', gray), transport)
        yield f'no mosaic, {transport}', message, np.dstack([gray] * 3), 0


def deep_files():
    """Yield files of more than 8 bits, or with another largest value, as above."""
    for suffix in ('.png', '.tiff', '.pgm', '.ppm'):
        shape = (30, 40) if suffix == '.pgm' else (30, 40, 3)
        values = np.random.default_rng(0).integers(0, 65536, shape).astype(np.uint16)
        data = encode(suffix, values)
        expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        yield f'16 bits {suffix}', file_message(data), expected, 0
    for kind, channels in (('P5', 1), ('P6', 3)):
        for most in (1, 100, 255, 4095, 65535):
            values = np.linspace(0, most, 120 * 160 * channels).round()
            values = values.reshape(120, 160, channels)
            expected = np.broadcast_to(values * (255 / most), (120, 160, 3))
            yield f'{kind} of {most}', file_message(pnm(kind, values, most)), expected, 1
    gray = np.tile(np.linspace(0, 1, 160, dtype=np.float32), (120, 1))
    expected = np.repeat((np.round(gray * 65535).astype(np.uint16) >> 8)[..., None], 3, axis=2)
    for compression in TIFF_COMPRESSIONS:
        for values in (gray, np.round(gray * 65535).astype(np.int32)):
            message = file_message(tiff(values, compression=compression))
            yield f'TIFF of {values.dtype} {compression}', message, expected, 0


TIFF_COMPRESSIONS = (None, 'tiff_lzw', 'tiff_deflate', 'packbits')


def pnm(kind, values, most):
    head = f'{kind}\n# by hand\n160 120\n{most}\n'.encode()
    return head + values.astype('>u2' if most > 255 else np.uint8).tobytes()


def tiff(values, **options):
    file = BytesIO()
    Image.fromarray(values).save(file, 'TIFF', **options)
    return file.getvalue()


def turned_files():
    """Yield files that state an orientation by EXIF, where different programs write it."""
    turns = {
        2: SMOOTH[:, ::-1], 3: SMOOTH[::-1, ::-1], 4: SMOOTH[::-1], 5: SMOOTH.swapaxes(0, 1),
        6: np.rot90(SMOOTH, -1), 7: SMOOTH[::-1, ::-1].swapaxes(0, 1), 8: np.rot90(SMOOTH),
    }  # fmt: skip
    for name in ('JPEG', 'PNG', 'PNG late', 'TIFF', 'WEBP', 'WEBP prefixed'):
        for turn in range(10):
            message = file_message(with_turn(name, turn))
            yield f'{name} {turn}', message, turns.get(turn, SMOOTH), 20 * (name == 'JPEG')


def with_turn(name, turn):
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


def chunk(key, content):
    size = len(content).to_bytes(4, 'big')
    return size + key + content + zlib.crc32(key + content).to_bytes(4, 'big')


def jpegs():
    """
    Yield names and files: as of cameras, progressive, with restarts, of several images.

    The first has a thumbnail. Those of noise have every two bytes in their own data, too.
    """
    plain = encode('.jpg', np.full((64, 64, 3), (200, 100, 30), np.uint8))
    small = encode('.jpg', np.zeros((8, 8, 3), np.uint8))
    segment = b'\xff\xe1' + (len(small) + 2).to_bytes(2, 'big') + small
    yield 'thumbnail', plain[:2] + segment + plain[2:]
    for name, options in (
        ('noise', []),
        ('progressive', [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
        ('restarts', [cv2.IMWRITE_JPEG_RST_INTERVAL, 2]),
    ):
        image = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
        yield name, encode('.jpg', image, *options)
    file = BytesIO()
    first, second = (Image.new('RGB', (64, 64), color) for color in ((200, 100, 30), (0, 0, 0)))
    first.save(file, 'MPO', save_all=True, append_images=[second])
    yield 'MPO', file.getvalue()


def whole_jpegs():
    """Yield JPEGs with what follows the end, and without the end, as above."""
    for name, data in jpegs():
        expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        # cameras fill up with zeros, telephones append a film, and the end may be missing
        tails = [b'', bytes(50), *FILM]
        contents = [data + tail for tail in tails] + [data[:-1], data[:-2]]
        for i, content in enumerate(contents):
            yield f'JPEG {name} {i}', file_message(content), expected, 0


def mosaic_that_opencv_does_not_read():
    content = bytearray(encode('.tiff', np.arange(96, dtype=np.uint8).reshape(8, 12)))
    content[78] = 0
    del content[114:]
    gray = np.asarray(Image.open(BytesIO(content)).convert('L'))
    expected = decode_message(raw('bayer_rggb8', 8, 12, 12, gray.tobytes()))
    message = file_message(bytes(content), 'bayer_rggb8; png compressed ')
    yield 'mosaic that OpenCV does not read', message, expected, 0


READ = {
    name: case
    for group in (
        raw_messages,
        bayer_messages,
        plain_files,
        deep_files,
        turned_files,
        whole_jpegs,
        mosaic_that_opencv_does_not_read,
    )
    for name, *case in group()
}


@pytest.mark.filterwarnings('ignore::UserWarning')  # Pillow's
@pytest.mark.parametrize('name', READ)
def test_message_becomes_rgb(name):
    message, expected, tolerance = READ[name]
    image = decode_message(message)
    assert (image.shape, image.dtype) == (expected.shape, np.uint8)
    assert np.nanmax(np.abs(image - expected.astype(float))) <= tolerance
    assert image.flags.c_contiguous
    assert image.flags.writeable


def test_encodings_are_all_tested():
    assert {*CHANNELS, *BAYER, *YUV} == ENCODINGS.keys()


def wrong_headers():
    """Yield names, raw messages, and kind and text of their errors."""
    fields = {'height': 3, 'width': 4, 'encoding': 'rgb8', 'step': 12, 'data': bytes(36)}
    for change, kind, text in (
        ({'height': 0}, 'size', 'expected at least 1x1'),
        ({'width': 0}, 'size', 'expected at least 1x1'),
        ({'step': 11}, 'step', 'step of 11 bytes is too small'),
        ({'data': b''}, 'cut off', '0 bytes of data'),
        ({'height': 2**32 - 1, 'width': 2**32 - 1, 'step': 2**34}, 'cut off', 'cut off'),
        ({'step': 2**32 - 1}, 'cut off', 'cut off'),
        ({'step': 14, 'data': bytes(39)}, 'cut off', r'39 bytes of data .*expected 40'),
        ({'encoding': 'rgb16', 'step': 23}, 'step', 'expected 24'),
        ({'encoding': 'rgb16', 'step': 24}, 'cut off', 'expected 72'),
        ({'encoding': 'uyvy', 'width': 3}, 'size', r'3x3 .*multiple of 2 and .* multiple of 1'),
        ({'encoding': 'yuyv', 'step': 7}, 'step', 'expected 8'),
        ({'encoding': 'nv12'}, 'size', r'4x3 pixels: .*multiple of 2 and .* multiple of 2'),
        *(
            ({'encoding': name, 'height': height, 'step': step, 'data': bytes(n)}, 'cut off', text)
            for name, height, step, n, text in (
                ('nv12', 4, 4, 23, 'expected 24'),
                ('nv21', 4, 9, 48, 'expected 49'),
                ('nv24', 2, 4, 23, 'expected 24'),
            )
        ),
        (
            {'encoding': 'bayer_rggb9'},
            'encoding',
            'is unknown: expected a color or gray image, such as rgb8',
        ),
        *(
            ({'encoding': f'{kind}C{n}'}, 'depth', f"'{kind}C{n}' has depth or measurements")
            for kind in ('8S', '16S', '32S', '32F', '64F')
            for n in (1, 4)
        ),
        *(
            (
                {'encoding': name, 'height': height, 'width': width, 'data': bytes(99)},
                'size',
                f'{width}x{height} pixels: expected at least 2x2',
            )
            for name in BAYER
            for height, width in ((1, 1), (1, 6), (5, 1))
        ),
    ):
        yield f'{change}', raw(**fields | change), kind, text


def wrong_files():
    """Yield files that are no image or cut off, and names of depth images, as above."""
    damaged = 'is damaged or cut off: copy or record it again'
    for name, data, text in (
        ('empty', b'', '0 bytes are no image'),
        ('byte', b'\xff', '1 bytes are no image'),
        ('text', b'no image at all', '15 bytes are no image'),
        ('PNG', b'\x89PNG\r\n\x1a\n', '8 bytes are no image'),
        ('start of JPEG', b'\xff\xd8\xff\xe0', '4 bytes are no image'),
        ('video', bytes([0, 0, 0, 1, 0x67] * 4), "format 'h264': 20 bytes are no image"),
        ('PNG cut off', encode('.png', NOISE)[:-30], damaged),
        (
            'wider than OpenCV reads',
            b'P5 2000000 1 255 ' + bytes(2_000_000),
            'image of 2000017 bytes is damaged or cut off',
        ),
        *(
            (f'{kind} of {most}, cut off', pnm(kind, np.zeros(size), most)[:-300], damaged)
            for kind, size in (('P5', 120 * 160), ('P6', 120 * 160 * 3))
            for most in (1, 100, 255, 4095, 65535)
        ),
    ):
        yield name, file_message(data, 'h264'), 'damaged', text
    for name, data in jpegs():
        end = data.index(b'\xff\xd9') if name == 'MPO' else len(data)
        restarts = [mark.end() for mark in re.finditer(b'\xff[\xd0-\xd7]', data)]
        middle = [len(data) // 2, *restarts] if len(data) > 4000 else []
        for at in (end - 20, end - 60, *middle):
            yield (
                f'JPEG {name} at {at}',
                file_message(data[:at]),
                'cut off',
                'is cut off: expected',
            )
    png = encode('.png', np.zeros((4, 4), np.uint8))  # an image: only the name is wrong
    for transport in (
        '16UC1; compressedDepth rvl',
        'compressedDepth',
        'mono16; CompressedDepth',
        '32FC1; tiff compressed ',
        '32FC1',
        ' 16SC1 ; png',
    ):
        text = f'{re.escape(repr(transport))} has depth or measurements: expected a color or gray'
        yield f'{transport!r}', file_message(png, transport), 'depth', text
    gray = np.tile(np.linspace(0, 1, 160, dtype=np.float32), (120, 1))
    counts = np.round(gray * 65535).astype(np.int32)
    for i, values in enumerate((gray * 300, gray - 1, gray * np.nan, counts * 2, -counts)):
        for compression in TIFF_COMPRESSIONS:
            content = tiff(values, compression=compression)
            name = f'TIFF without a range {i} {compression}'
            yield name, file_message(content), 'depth', 'TIFF with values from'


def wrong_claims():
    """Yield files whose header claims more than is there: OpenCV would allocate it first."""
    png, ihdr = encode('.png', NOISE), 8 + 8  # bytes before the size
    for size, text in (
        ((9000, 8000), '9000x8000 pixels: expected at most 64000000'),
        ((20_000, 10_000), 'expected at most 64000000'),  # Pillow refuses by itself
    ):
        head = struct.pack('>II', *size) + png[ihdr + 8 : ihdr + 13]
        content = png[: ihdr - 8] + chunk(b'IHDR', head) + png[ihdr + 17 :]
        yield f'PNG of {size}', file_message(content), 'too large', text
    first = ihdr + 17  # the chunk behind the header's
    for length in (2**31 - 1, 2**32 - 1, 1000):
        content = png[:first] + length.to_bytes(4, 'big') + png[first + 4 : 500]
        text = 'is damaged or cut off'
        yield f'PNG, chunk of {length}', file_message(content), 'damaged', text
        for size in (9, 8, 4):  # the last, incomplete chunk
            message = file_message(content[: first + size])
            yield f'PNG, {size} bytes of a chunk of {length}', message, 'damaged', 'damaged'
    for tags in ({278: 2**23}, {322: 16, 323: 2**23}):
        data = bytearray(tiff(NOISE, tiffinfo={278: 3}))
        strips = data.index(struct.pack('<H', 278), 8)  # the entry of this tag
        for i, (tag, value) in enumerate(tags.items()):
            struct.pack_into('<HHII', data, strips + 12 * i, tag, 4, 1, value)
        text = 'x8388608 pixels: expected at most'
        yield f'TIFF of tags {tags}', file_message(bytes(data)), 'too large', text


CLAIMS = {name: case for name, *case in wrong_claims()}
REFUSED = CLAIMS | {name: case for make in (wrong_headers, wrong_files) for name, *case in make()}


@pytest.mark.parametrize('name', REFUSED)
def test_message_is_refused_with_the_kind_of_its_error(monkeypatch, name):
    message, kind, text = REFUSED[name]
    if name in CLAIMS:
        monkeypatch.setattr(files.cv2, 'imdecode', lambda *_: pytest.fail('decoded'))
    with pytest.raises(ImageError, match=text) as caught:
        decode_message(message)
    assert caught.value.kind == kind


def test_raw_image_of_too_many_pixels_is_refused():
    with pytest.raises(ImageError, match=r'8000x8001 .*at most 64000000') as caught:
        decode_message(raw('mono8', 8001, 8000, 8000, bytes(8000 * 8001)))
    assert caught.value.kind == 'too large'


@pytest.mark.parametrize(
    ('kind', 'padding', 'is_view'),
    [(bytearray, 0, True), (bytes, 0, False), (bytearray, 2, False)],
)
def test_rgb8_is_a_view_of_bytes_that_can_be_written(kind, padding, is_view):
    step, data, _ = noise('rgb8', 4, 5, padding=padding)
    held = kind(data)
    image = decode_message(raw('rgb8', 4, 5, step, held))
    assert np.shares_memory(image, np.frombuffer(held, np.uint8)) is is_view


def test_heic_is_read_by_pillow_heif_which_is_named_if_missing(hide_module):
    heif = pytest.importorskip('pillow_heif', reason='the extra heif is not installed')
    file = BytesIO()
    heif.from_pillow(Image.fromarray(SMOOTH)).save(file, quality=95)
    image = decode_message(file_message(file.getvalue()))
    assert np.abs(image.astype(int) - SMOOTH).mean() < 3
    with pytest.raises(ImageError, match='are no image, or damaged'):
        decode_message(file_message(file.getvalue()[:200]))
    hide_module('pillow_heif')
    with pytest.raises(ImageError, match='not installed: pip install pillow-heif') as caught:
        decode_message(file_message(file.getvalue()))
    assert caught.value.kind == 'format'


TRANSPORTS = ['', ';', 'png', 'rgb8; jpeg compressed bgr8', 'bayer_rggb8; png compressed ']
SUFFIXES = ['.jpg', '.png', '.bmp', '.tiff', '.pgm', '.webp']


@st.composite
def damaged_files(draw):
    """Return messages with a file, some of its bytes changed, and its end cut off."""
    gray = np.arange(96, dtype=np.uint8).reshape(8, 12)
    content = bytearray(encode(draw(st.sampled_from(SUFFIXES)), gray))
    for _ in range(draw(st.integers(1, 8))):
        content[draw(st.integers(0, len(content) - 1))] = draw(st.integers(0, 255))
    del content[draw(st.integers(0, len(content))) :]
    transport = draw(st.sampled_from(TRANSPORTS) | st.text(max_size=20))
    return file_message(bytes(content), transport)


raw_garbage = st.builds(
    raw,
    encoding=st.sampled_from([*ENCODINGS, '32FC1', '8UC2']) | st.text(max_size=12),
    height=st.integers(0, 9) | st.integers(0, 2**32 - 1),
    width=st.integers(0, 9) | st.integers(0, 2**32 - 1),
    step=st.integers(0, 80) | st.integers(0, 2**32 - 1),
    data=st.binary(max_size=700),
    big=st.booleans(),
)


@pytest.mark.filterwarnings('ignore::UserWarning')  # Pillow's, on the way to the error
@given(raw_garbage | damaged_files())
@example(raw('mono8', 1, 2, 2**32 - 1, b'ab'))
@example(raw('bgr16', 1, 2, 2**32 - 1, bytes(12), True))
def test_garbage_is_decoded_or_refused(message):
    try:
        # a damaged header may claim the largest size: a lower limit keeps this test short
        with mock.patch.object(files, 'MAX_PIXELS', 10**6):
            image = decode_message(message)
    except ImageError as error:  # the one error that is allowed
        assert error.kind in {  # noqa: PT017
            'cut off', 'damaged', 'depth', 'encoding', 'format', 'size', 'step', 'too large'
        }  # fmt: skip
        return
    assert (image.dtype, image.shape[2:]) == (np.uint8, (3,))
    if hasattr(message, 'height'):
        assert image.shape[:2] == (message.height, message.width)
    assert image.flags.c_contiguous
    assert not np.shares_memory(image, np.frombuffer(message.data, np.uint8))
