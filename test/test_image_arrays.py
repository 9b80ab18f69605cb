# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Arrays of users at the public entries: a sentence with the remedy, or the features."""

import time

import numpy as np
from PIL import Image
import pytest
from stavpr_ros import Localizer, Map
from stavpr_ros.errors import InputError
from stavpr_ros.features import FeatureExtractor, LocalFeatures, Projection
from stavpr_ros.mapping import (
    build_map,
    encode_thumbnail,
    KeyframeSelector,
    KeyframeSettings,
    Trajectory,
)
from stavpr_ros.relative_pose.offset import describe_columns, OffsetFilter
from stavpr_ros.sources.frame import Frame, ImageRecord

RGB = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)
SAME = np.count_nonzero(RGB[0, 0, 0] == RGB)
EXTRACTOR = FeatureExtractor('gradient')


class Tensor:
    def __array__(self, *_, **__):
        raise RuntimeError("Can't call numpy() on Tensor that requires grad.")


IMAGES = {
    'float': (RGB / 255, 'np.uint8(255 * image)'),
    'float of bytes': (RGB.astype(float), 'np.uint8(image)'),
    'NaN': (np.where(RGB[0, 0, 0] == RGB, np.nan, RGB), f'{SAME} NaN and 0 infinite values'),
    'infinite': (np.where(RGB[0, 0, 0] == RGB, -np.inf, RGB), f'0 NaN and {SAME} infinite values'),
    '16 bit': (RGB.astype(np.uint16) * 256, 'scale them to 0 to 255'),
    'gray': (RGB[..., 0], 'np.dstack(3 * [image])'),
    'RGBA': (np.dstack([RGB, RGB[..., :1]]), 'image[..., :3]'),
    'channels first': (RGB.transpose(2, 0, 1), 'image.transpose(1, 2, 0)'),
    'batch': (RGB[None], 'image[0]'),
    'no rows': (RGB[:0], 'no pixels'),
    'a name': ('image.png', 'stavpr_ros.images(path)'),
    'a list': (RGB.tolist(), 'np.uint8(image)'),
    'a ragged list': ([[1, 2], [3]], 'no array'),
    'a tensor with gradients': (Tensor(), 'requires grad'),
    'a frame': (Frame(RGB, 0, ''), 'field image'),
    'BGRA': (np.dstack([RGB, RGB[..., :1]]), 'image[..., 2::-1]'),
    'gray of 16 bits': (RGB[..., 0].astype(np.uint16), 'np.dstack(3 * [image])'),
    'two channels': (RGB[..., :2], 'an axis is missing'),
    'gray of Pillow': (Image.new('L', (8, 8)), "image.convert('RGB')"),
    'palette of Pillow': (Image.new('P', (8, 8)), "image.convert('RGB')"),
    'bytes of a file': (b'\xff\xd8\xff', 'stavpr_ros.images(path)'),
    'not read': (None, 'check the name of its file'),
    'a generator': ((image for image in [RGB]), 'one by one'),
}
ENTRIES = {
    'extract': lambda image: EXTRACTOR.extract([RGB, image]),
    'Frame': lambda image: Frame(image, 0, ''),
    'encode_thumbnail': encode_thumbnail,
    'accept': lambda image: KeyframeSelector(KeyframeSettings()).accept(0, None, image),
    'describe_columns': describe_columns,
    'Localizer': Localizer(Map.from_images([RGB, RGB[::-1]], EXTRACTOR, progress=False)),
    'from_images': lambda image: Map.from_images([RGB, image], EXTRACTOR, progress=False),
}
WIDE = {'Frame', 'Localizer'}  # take images of 16 bits


@pytest.mark.parametrize('entry', ENTRIES)
@pytest.mark.parametrize('kind', IMAGES)
def test_an_image_of_another_kind_is_a_sentence_that_converts_it(kind, entry):
    image, remedy = IMAGES[kind]
    if kind == '16 bit' and entry in WIDE:
        assert ENTRIES[entry](image)
        assert ImageRecord.of_image(Frame(image, 0, '').image, 0).encoding == 'rgb16'
        return
    if (kind, entry) == ('a frame', 'from_images'):
        assert len(ENTRIES[entry](image)) == 2
        return
    with pytest.raises(InputError) as caught:
        ENTRIES[entry](image)
    text = str(caught.value)
    assert type(image).__name__ in text
    assert remedy in text
    assert 'expected RGB pixels of shape (height, width, 3), uint8' in text
    assert len(text) < 400


@pytest.mark.parametrize('images', [RGB, Image.fromarray(RGB), None, np.uint8(1)])
def test_one_image_instead_of_a_list_is_a_sentence(images):
    with pytest.raises(InputError, match=r'expected a list, extract\(\[image\]\)'):
        EXTRACTOR.extract(images)


@pytest.mark.parametrize(('work', 'text'), [
    (lambda: build_map(RGB, EXTRACTOR, progress=False), 'one ndarray: expected a list'),
    (lambda: Frame(RGB, time.time(), ''), r'stamp is of type float: .*time\.time_ns\(\)'),
    (lambda: Trajectory().add(1, 'here'), r"pose 'here' is no array"),
    (lambda: Projection(np.eye(3), 'mine'), r'matrix of the projection: .*float64, .*float32'),
    (lambda: LocalFeatures(RGB / 1, RGB[0] / 1, EXTRACTOR.settings), 'strips: .*64, .*float32'),
])  # fmt: skip
def test_other_arguments_are_named_with_what_is_expected(work, text):
    with pytest.raises(ValueError, match=text):
        work()


@pytest.mark.parametrize('bad', [RGB, None, np.full((192, 80), np.nan, np.float32)])
def test_columns_of_another_kind_leave_the_filter_as_it_was(bad):
    columns, offsets = describe_columns(RGB), OffsetFilter()
    expected = OffsetFilter().update(columns, columns)
    for query, place in ((bad, columns), (columns, bad)):
        with pytest.raises(InputError, match=r'describe_columns\(image\)'):
            offsets.update(query, place)
    assert offsets.update(columns, columns) == expected
