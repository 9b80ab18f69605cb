# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Large images are reduced while they are decoded; results are as with whole images."""

from functools import partial

import cv2
import numpy as np
from pipelines import settings_of
import pytest
from raw_images import encode, file_message, pad_rows, raw
from stavpr_ros.commands import build_map as command
from stavpr_ros.errors import ImageError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import build_map, load_map
from stavpr_ros.mapping.place_map import THUMBNAIL_WIDTH
from stavpr_ros.pipeline import Pipeline
from stavpr_ros.sources import open_source
from stavpr_ros.sources.encodings import decode_message
from stavpr_ros.sources.files import reduction

MIN_SIZE = (224, 224)


def as_nv12(rgb):
    height, width = rgb.shape[:2]
    planar = cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV_I420)
    u, v = planar[height:].reshape(2, height // 2, width // 2)
    return np.vstack([planar[:height], np.dstack([u, v]).reshape(height // 2, width)])


ENCODERS = {
    'rgb8': lambda rgb: rgb,
    'bgr8': lambda rgb: rgb[..., ::-1],
    'rgba8': lambda rgb: cv2.cvtColor(rgb, cv2.COLOR_RGB2RGBA),
    'rgb16': lambda rgb: rgb.astype('<u2') << 8,
    'nv12': as_nv12,
}


@pytest.fixture(scope='module')
def image():
    """Return a smooth image of 1920x1080 pixels, in color."""
    coarse = np.random.default_rng(0).integers(0, 256, (18, 32, 3), np.uint8)
    return cv2.resize(coarse, (1920, 1080), interpolation=cv2.INTER_CUBIC)


def block_means(image, divisor):
    height, width = image.shape[0] // divisor, image.shape[1] // divisor
    return image.reshape(height, divisor, width, divisor, 3).mean((1, 3))


def message_of(image, encoding='rgb8', padding=0):
    """Return the message of an image with padded rows."""
    rows = np.ascontiguousarray(ENCODERS[encoding](image))
    step, data = pad_rows(rows.reshape(len(rows), -1).view(np.uint8), padding)
    return raw(encoding, *image.shape[:2], step, data)


@pytest.mark.parametrize(
    ('size', 'least', 'divisor'),
    [
        ((480, 640), MIN_SIZE, 1),
        ((768, 1024), MIN_SIZE, 1),  # not large
        ((960, 1280), MIN_SIZE, 2),
        ((720, 1280), MIN_SIZE, 2),
        ((1080, 1920), MIN_SIZE, 4),
        ((1080, 1920), (224, 480), 4),
        ((1080, 1920), (224, 481), 2),
        ((1080, 1920), (271, 271), 2),
        ((1080, 1920), None, 1),
        ((1081, 1920), MIN_SIZE, 1),
        ((1080, 1918), MIN_SIZE, 2),
        ((2160, 3840), MIN_SIZE, 8),
    ],
)
def test_reduction_keeps_needed_size_and_whole_pixels(size, least, divisor):
    assert reduction(*size, least) == divisor


@pytest.mark.parametrize(('make', 'tolerance'), [
    *((partial(message_of, encoding=name, padding=7 * (name != 'rgb8')), 1) for name in ENCODERS),
    (partial(message_of, encoding='nv12'), 1),
    (lambda image: file_message(encode('.png', image)), 1),
    (lambda image: file_message(encode('.jpg', image)), 4),
])  # fmt: skip
def test_decode_of_large_image_averages_blocks(image, make, tolerance):
    """To within what is rounded twice, and what a JPEG rounds."""
    reduced, whole = decode_message(make(image), MIN_SIZE), decode_message(make(image))
    assert (whole.shape, reduced.shape) == ((1080, 1920, 3), (270, 480, 3))
    assert np.abs(reduced - block_means(whole, 4)).max() <= tolerance
    assert reduced.flags.c_contiguous


def test_decode_of_small_image_is_unchanged(image):
    small = image[:768, :1024]
    for message in (message_of(small), file_message(encode('.jpg', small))):
        np.testing.assert_array_equal(decode_message(message, MIN_SIZE), decode_message(message))
    assert not np.shares_memory(decode_message(message_of(small), MIN_SIZE), small)


def test_decode_of_large_image_cut_off_is_rejected(image):
    for message, missing in ((message_of(image), 1), (file_message(encode('.jpg', image)), 30)):
        message.data = message.data[:-missing]
        with pytest.raises(ImageError, match='cut off'):
            decode_message(message, MIN_SIZE)


@pytest.mark.parametrize(
    ('resize', 'changes', 'rows'),
    [
        ('area', {}, 270),
        ('area', {'thumbnail_width': 960}, 540),
        ('bilinear', {}, 1080),  # its features are of single pixels
    ],
)
def test_pipeline_reduces_large_images_to_what_is_needed(image, resize, changes, rows):
    settings = settings_of(feature_settings=f'{{"resize": "{resize}"}}', **changes)
    pipeline = Pipeline(settings, 'mapping')
    assert pipeline.operation.process(message_of(image), 1).image.shape[0] == rows


def test_map_of_large_files_has_the_features_that_a_node_computes(image, tmp_path):
    """Of the library and of the command."""
    path, folder, extractor = tmp_path / 'map', tmp_path / 'images', FeatureExtractor('gradient')
    folder.mkdir()
    (folder / 'large.jpg').write_bytes(encode('.jpg', image))
    options = ['--input', str(folder), '--output', str(path), '--features', 'gradient']
    assert command.main(options) == 0
    least = extractor.needed_size(THUMBNAIL_WIDTH)
    reduced = decode_message(file_message(encode('.jpg', image)), least)
    assert reduced.shape == (270, 480, 3)
    expected = extractor.extract([reduced]).strips
    for places in (build_map(open_source(folder), extractor, progress=False), load_map(path)):
        np.testing.assert_array_equal(places.features.strips, expected, strict=True)
