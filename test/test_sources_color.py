# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bayer mosaics and YUV to RGB: scenes of one color, ramps, a plain-loop oracle, every size."""

import numpy as np
import pytest
from raw_images import BAYER, mosaic, packed_yuv, padded, PAIRS, YUV
from stavpr_ros.errors import ImageError
from stavpr_ros.sources.encodings import decode_image

# every size that a Bayer mosaic can have, odd and even, and where OpenCV cannot interpolate
MOSAICS = [(2, 2), (2, 7), (6, 2), (3, 5), (5, 3), (7, 8)]


def rgb_of(yuv):
    """BT.601 from its definition: R = Y' + 2 (1 - Kr) Cr and so on, in float64."""
    kr, kb = 0.299, 0.114
    y = (yuv[..., 0].astype(float) - 16) / 219
    cb, cr = ((yuv[..., i].astype(float) - 128) / 224 for i in (1, 2))
    red, blue = y + 2 * (1 - kr) * cr, y + 2 * (1 - kb) * cb
    green = (y - kr * red - kb * blue) / (1 - kr - kb)
    return 255 * np.clip(np.dstack([red, green, blue]), 0, 1)


@pytest.mark.parametrize('encoding', sorted(BAYER))
@pytest.mark.parametrize(('height', 'width'), MOSAICS)
@pytest.mark.parametrize('color', [(200, 0, 0), (10, 120, 230)])
def test_bayer_of_one_color_is_exact(encoding, height, width, color):
    scene = np.full((height, width, 3), color, np.uint8)
    for big, padding in ((False, 0), (True, 3)):
        step, data = padded(mosaic(encoding, scene, big), padding)
        image = decode_image(height, width, encoding, big, step, data)
        np.testing.assert_array_equal(image, scene)
        assert image.flags.c_contiguous


@pytest.mark.parametrize('encoding', sorted(BAYER))
def test_bayer_of_noise_is_bilinear(encoding):
    scene = np.random.default_rng(2).integers(0, 256, (8, 9, 3), np.uint8)
    step, data = padded(mosaic(encoding, scene), 0)
    image = decode_image(8, 9, encoding, False, step, data)
    for y in range(1, 7):
        for x in range(1, 8):
            for channel, color in enumerate('rgb'):
                near = [
                    float(scene[v, u, channel])
                    for v in (y - 1, y, y + 1)
                    for u in (x - 1, x, x + 1)
                    if BAYER[encoding][2 * (v % 2) + u % 2] == color
                ]
                own = BAYER[encoding][2 * (y % 2) + x % 2] == color
                expected = scene[y, x, channel] if own else np.mean(near)
                assert abs(image[y, x, channel] - expected) <= 1


@pytest.mark.parametrize('encoding', sorted(BAYER))
@pytest.mark.parametrize(('height', 'width'), [(1, 1), (1, 6), (5, 1)])
def test_bayer_without_every_color_is_rejected(encoding, height, width):
    with pytest.raises(
        ImageError, match=f'{width}x{height} pixels: expected at least 2x2'
    ) as caught:
        decode_image(height, width, encoding, False, 2 * width, bytes(2 * height * width))
    assert caught.value.kind == 'size'


@pytest.mark.parametrize('encoding', YUV)
@pytest.mark.parametrize(('height', 'width', 'padding'), [(2, 2, 0), (4, 10, 6), (2, 64, 1)])
def test_yuv_of_noise_equals_definition(encoding, height, width, padding):
    rng = np.random.default_rng(3)
    yuv = rng.integers(16, 236, (height, width, 3)).astype(np.uint8)
    rows, columns = (1, 1) if encoding == 'nv24' else (1, 2) if encoding in PAIRS else (2, 2)
    # pixels of one block share the color of its first
    yuv[..., 1:] = np.repeat(np.repeat(yuv[::rows, ::columns, 1:], rows, 0), columns, 1)
    step, data = packed_yuv(encoding, yuv, padding)
    image = decode_image(height, width, encoding, False, step, data)
    assert np.abs(image - rgb_of(yuv)).max() <= 2
    assert image.flags.c_contiguous
    # nothing of the last row's padding is needed
    np.testing.assert_array_equal(
        decode_image(height, width, encoding, False, step, data[: len(data) - padding]), image
    )
