# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The names at the top, arrays of users at the public entries, and the examples of the rooms."""

import doctest
import time

import cv2
from evaluation_commands import write_images
from fixtures import route_images
import numpy as np
from PIL import Image
import pytest
import stavpr_ros as stavpr
from stavpr_ros import Localizer, Map, method, prepare
from stavpr_ros.errors import FeatureMismatchError, InputError, SettingsError, SourceError
from stavpr_ros.features import FeatureExtractor, LocalFeatures, Projection
from stavpr_ros.mapping import (
    build_map,
    encode_thumbnail,
    extract_features,
    KeyframeSelector,
    KeyframeSettings,
    Trajectory,
)
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings, Status
from stavpr_ros.relative_pose.offset import describe_columns, OffsetFilter
from stavpr_ros.sources import open_source
from stavpr_ros.sources.bag_writer import write_bag
from stavpr_ros.sources.frame import Frame, ImageRecord
from videos import write_video

ROUTE = route_images(40)


def wide(images):
    """Return gray images that use few of 16 bits, as a thermal camera does."""
    return [29_000 + 5 * image[..., 1].astype(np.uint16) for image in images]


def folder_of_wide_images(path):
    path.mkdir(parents=True)
    for i, image in enumerate(wide(ROUTE)):
        cv2.imwrite(str(path / f'{i:03}.png'), image)
    return path


def bag(path, images):
    write_bag(
        path, '/image', [ImageRecord.of_image(x, (i + 1) * 10**9) for i, x in enumerate(images)]
    )
    return path


SOURCES = {
    'folder': lambda path: write_images(path / 'folder', ROUTE),
    'video': lambda path: write_video(path / 'drive.mp4', ROUTE, rate=5),
    'bag': lambda path: bag(path / 'bag', ROUTE),
    'folder of 16 bits': lambda path: folder_of_wide_images(path / 'wide'),
    'bag of 16 bits': lambda path: bag(path / 'bag', [np.dstack(3 * [x]) for x in wide(ROUTE)]),
    'large images': lambda path: write_images(
        path / 'large', [cv2.resize(image, (1024, 800)) for image in ROUTE[:30]]
    ),
}


def answers(matches):
    return [(match.status, match.reason, match.place, match.probability) for match in matches]


@pytest.mark.parametrize('kind', SOURCES)
def test_localizer_returns_what_the_parts_return(kind, tmp_path):
    source = SOURCES[kind](tmp_path)
    route = stavpr.Map.from_images(source, 'gradient', progress=False)
    expected_map = build_map(open_source(source), FeatureExtractor('gradient'), progress=False)
    np.testing.assert_array_equal(route.features.strips, expected_map.features.strips)
    assert route.settings == expected_map.settings

    query = extract_features(open_source(source), expected_map.extractor(), progress=False)
    recognizer = PlaceRecognizer(expected_map, RecognizerSettings(min_probability=0.3))
    expected = [recognizer.update(query[i : i + 1]) for i in range(len(query))]
    localizer = stavpr.Localizer(route, min_probability=0.3)
    images = stavpr.images(source)
    assert len(images) == len(query)
    matches = [localizer(image) for image in images]
    assert answers(matches) == answers(expected)
    assert matches[-1].status is Status.MATCH
    assert matches[-1].window_stamps[-1] == route.stamps[-1]
    localizer.reset()
    assert answers(map(localizer, images)) == answers(expected)  # and a source is read again


@pytest.mark.parametrize('form', ['arrays', 'generator', 'stack', 'frames', 'images', 'opened'])
def test_map_is_made_of_any_iterable_of_images(form, tmp_path):
    folder = write_images(tmp_path / 'monday', ROUTE)
    source = {
        'arrays': ROUTE,
        'generator': (image for image in ROUTE),
        'stack': np.stack(ROUTE),
        'frames': [Frame(image, 7, 'name') for image in ROUTE],
        'images': stavpr.images(folder),
        'opened': open_source(folder),
    }[form]
    route = stavpr.Map.from_images(source, FeatureExtractor('gradient'), progress=False)
    expected = stavpr.Map.from_images(folder, route.settings, progress=False)
    np.testing.assert_array_equal(route.features.strips, expected.features.strips)
    names = {'arrays': 'image 39', 'generator': 'image 39', 'stack': 'image 39', 'frames': 'name'}
    assert route.ids[-1] == names.get(form, '039.png')
    identity = route.save(tmp_path / 'monday.stavpr')
    loaded = stavpr.Map.load(tmp_path / 'monday.stavpr')
    assert (loaded.map_id, loaded.ids) == (identity, route.ids)


def test_images_carry_stamp_and_name_into_their_parts(tmp_path):
    image = [*stavpr.images(bag(tmp_path / 'bag', ROUTE[:2]))][1]
    assert (image.stamp, image[::2].stamp, image.copy().name) == (2 * 10**9, 2 * 10**9, '/image#1')
    assert np.asarray(image).tobytes() == ROUTE[1].tobytes()


def test_features_of_an_image_are_an_image(small_map, route):
    """Also where no extractor can be made, as for vectors of a file."""
    one, other = stavpr.Localizer(small_map), stavpr.Localizer(small_map)
    for i, image in enumerate(route[:30]):
        match = one(small_map.features[i : i + 1], i, small_map.pose(i))
        same = other(Image.fromarray(image), i, small_map.pose(i))
        assert (match.place, match.window_stamps) == (same.place, same.window_stamps)
    assert match.status is Status.MATCH


def test_wrong_image_changes_nothing(small_map, route):
    localizer, other = stavpr.Localizer(small_map), stavpr.Localizer(small_map)
    for image in route[:25]:
        for wrong in (None, image / 255, image[..., 0]):
            with pytest.raises(InputError, match='expected RGB pixels'):
                localizer(wrong)
        assert answers([localizer(image)]) == answers([other(image)])


@pytest.mark.parametrize(('work', 'kind', 'text'), [
    (lambda path, _: stavpr.images(path / 'empty'), SourceError, 'empty has no images: expected'),
    (lambda path, _: stavpr.images(path / 'none'), SourceError, 'does not exist: expected a fold'),
    (lambda path, _: stavpr.images(path / 'one.png'), SourceError, 'is no folder, video or bag'),
    (lambda path, _: stavpr.images(ROUTE), InputError, 'path is of type list: expected the path'),
    (lambda path, _: stavpr.Map.from_images(path / 'empty', 'gradient'), SourceError, 'no images'),
    (lambda path, _: stavpr.Map.from_images([], 'gradient'), InputError, 'no images to build'),
    (lambda path, _: stavpr.Map.from_images(ROUTE[0], 'gradient'), InputError, 'expected a list'),
    (lambda path, _: stavpr.Map.from_images(b'x', 'gradient'), InputError, r"frames is b'x'"),
    (lambda path, _: stavpr.Map.from_images(ROUTE, 'sift'), SettingsError, "'sift'"),
    (lambda path, _: stavpr.Map.from_images(ROUTE, 7), InputError, 'features is of type int'),
    (lambda path, _: stavpr.Localizer('monday.stavpr'), InputError, r'Map\.load\(path\)'),
    (lambda path, route: stavpr.Localizer(route, min_prob=0.3), SettingsError, 'min_probability'),
    (lambda path, route: stavpr.Localizer(route, max_error=2), SettingsError, 'max_error = 2'),
    (lambda path, route: stavpr.Localizer(route, settings={}), InputError, 'type dict'),
    (lambda path, route: stavpr.Localizer(route, backend='gpu'), SettingsError, "'gpu'"),
    (lambda path, route: stavpr.Localizer(route)(ROUTE[0], 0.5), InputError, 'whole nanoseconds'),
    (lambda path, route: stavpr.Localizer(route)(ROUTE[0], 0, [1]), InputError, 'pose'),
    (lambda path, route: stavpr.Localizer(route)(
        FeatureExtractor('gradient').extract(ROUTE[:1])), FeatureMismatchError, 'projection'),
])  # fmt: skip
def test_wrong_source_or_argument_is_a_sentence(work, kind, text, small_map, tmp_path):
    (tmp_path / 'empty').mkdir()
    cv2.imwrite(str(tmp_path / 'one.png'), ROUTE[0])
    with pytest.raises(kind, match=text):
        work(tmp_path, small_map)


def test_unknown_name_of_the_package_is_an_attribute_error():
    assert {*stavpr.__all__} == {'Localizer', 'Map', 'images'} <= {*dir(stavpr)}
    with pytest.raises(AttributeError, match="module 'stavpr_ros' has no attribute 'typo'"):
        _ = stavpr.typo


# Arrays of users at the public entries: a sentence with the remedy, or the features

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


# The example at the head of each room of the method runs


@pytest.mark.parametrize('room', [method, prepare], ids=lambda room: room.__name__)
def test_example_at_the_head_of_a_room_runs(room):
    result = doctest.testmod(room)
    assert result.attempted > 5
    assert result.failed == 0
