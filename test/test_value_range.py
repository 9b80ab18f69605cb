# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Images that use few of 16 bits, as thermal cameras make: one range for a map."""

from dataclasses import replace

import cv2
import numpy as np
from places import recognize_all
import pytest
from sensor_msgs.msg import CompressedImage, Image
from stavpr_ros.errors import FeatureMismatchError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import build_map, extract_features, load_map, save_map
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings, Status
from stavpr_ros.pipeline import Pipeline
from stavpr_ros.pipeline.settings import PipelineSettings
from stavpr_ros.sources import open_source
from stavpr_ros.sources.bag import BagSource
from stavpr_ros.sources.bag_writer import write_bag
from stavpr_ros.sources.encodings import decode_message
from stavpr_ros.sources.files import RangeFinder, scale

IMAGES = 40
LOW, HIGH = 29_000, 30_500  # 15 K in steps of 0.01 K


@pytest.fixture(scope='module')
def drives():
    """Return two drives of a thermal camera, each (IMAGES, 60, 80) uint16, the second colder."""
    rng = np.random.default_rng(3)
    wall = cv2.resize(rng.integers(0, 256, (8, 60), np.uint8), (480, 64))[2:62].astype(float)
    views = np.stack([wall[:, 8 * i : 8 * i + 80] for i in range(IMAGES)])
    noise = rng.normal(0, 2, views.shape)
    return [
        np.clip(LOW + 5.5 * shades, 0, 65535).astype(np.uint16)
        for shades in (views, 0.8 * views + 20 + noise)
    ]


@pytest.fixture(scope='module')
def folders(drives, tmp_path_factory):
    made = [tmp_path_factory.mktemp(name) for name in ('map', 'query')]
    for folder, images in zip(made, drives, strict=True):
        for i, image in enumerate(images):
            cv2.imwrite(str(folder / f'{i}.png'), image)
    return made


@pytest.fixture(scope='module')
def thermal_map(folders):
    return build_map(open_source(folders[0]), FeatureExtractor('gradient'), progress=False)


def matches(place_map, query):
    results = recognize_all(PlaceRecognizer(place_map, RecognizerSettings()), query)
    return [match.newest for match in results if match.accepted]


def raw(image, big=False):
    data = image.astype('>u2' if big else '<u2').tobytes()
    return Image(
        height=image.shape[0], width=image.shape[1], encoding='mono16', is_bigendian=big,
        step=2 * image.shape[1], data=data,
    )  # fmt: skip


def test_range_is_of_percentiles_and_clips():
    finder = RangeFinder()
    assert finder.value_range is None
    values = np.concatenate([np.full(4, 7), np.arange(1000, 1991), np.full(5, 60_000)])
    np.testing.assert_array_equal(finder(values.astype(np.uint16)), values >> 8)
    assert finder.value_range == (1000, 1990)
    converted = scale((1000, 1200))(np.array([[0, 1000, 1120, 1200, 65535]], np.uint16))
    assert converted.tolist() == [[0, 0, 153, 255, 255]]
    assert scale(None) is None
    finder(np.full(1_000_000, 5, np.uint16))
    assert finder.value_range == (5, 6)


def test_thermal_images_match_by_the_range_of_the_map(thermal_map, folders, caplog, tmp_path):
    low, high = thermal_map.settings.value_range
    assert LOW <= low < high <= HIGH
    path = tmp_path / 'thermal.stavpr'
    save_map(thermal_map, path)
    loaded = load_map(path)
    assert loaded.settings == thermal_map.settings
    query = extract_features(open_source(folders[1]), loaded.extractor(), progress=False)
    result = matches(loaded, query)
    assert len(result) > IMAGES / 2
    again = build_map(open_source(folders[0]), FeatureExtractor('gradient'), progress=False)
    assert again.settings == thermal_map.settings
    assert caplog.text.count(f'images of 16 bits: their values {low} to {high}') == 1


def test_a_map_without_a_range_keeps_the_upper_byte(folders, drives, thermal_map, tmp_path):
    """A map of today: its file has no such section, and its queries are decoded as before."""
    images = [np.repeat((image >> 8).astype(np.uint8)[..., None], 3, 2) for image in drives[0]]
    extractor = FeatureExtractor('gradient')
    extractor.set_value_range(None)
    old = build_map(open_source(folders[0]), extractor, progress=False)
    np.testing.assert_array_equal(old.features.strips, extractor.extract(images).strips)
    save_map(old, tmp_path / 'old.stavpr')
    assert b'value_range' not in (tmp_path / 'old.stavpr').read_bytes()
    query = extract_features(open_source(folders[0]), old.extractor(), progress=False)
    np.testing.assert_array_equal(query.strips, old.features.strips)
    with pytest.raises(FeatureMismatchError, match='value_range'):
        thermal_map.features.require_same_settings(old.settings, 'the map')
    assert 'value_range' not in old.settings.to_json()


@pytest.mark.parametrize('kind', ['little', 'big', 'png'])
def test_messages_are_converted_as_files_are(drives, kind):
    image, to_bytes = drives[0][0], scale((LOW, HIGH))
    message = raw(image, kind == 'big')
    if kind == 'png':
        data = cv2.imencode('.png', image)[1].tobytes()
        message = CompressedImage(format='mono16; png compressed ', data=data)
    expected = np.repeat(to_bytes(image)[..., None], 3, 2)
    np.testing.assert_array_equal(decode_message(message, to_bytes=to_bytes), expected)


def test_replayed_images_keep_their_16_bits(folders, drives, tmp_path):
    """As the map that they will be compared with decides the range."""
    record = next(open_source(folders[0]).records(10))
    assert (record.encoding, record.step) == ('rgb16', 480)
    message = replace(record, data=record.data.tobytes())
    to_bytes = scale((LOW, HIGH))
    expected = np.repeat(to_bytes(drives[0][0])[..., None], 3, 2)
    np.testing.assert_array_equal(decode_message(message, to_bytes=to_bytes), expected)
    write_bag(tmp_path / 'bag', '/thermal', [record])
    source = BagSource(tmp_path / 'bag')
    source.to_bytes = to_bytes
    np.testing.assert_array_equal(next(iter(source)).image, expected)


@pytest.mark.parametrize('operation', ['mapping', 'loop_closure'])
def test_pipeline_finds_the_range_before_its_first_place(drives, thermal_map, operation):
    pipeline = Pipeline(PipelineSettings(features='gradient'), operation)
    results = [
        pipeline.operation.process(raw(image), (i + 1) * 10**9)
        for i, image in enumerate(drives[0])
    ]
    assert {result.match.status for result in results[:20]} == {Status.NOT_READY}
    assert results[4].match.reason == 'images of 16 bits, 5 of 20 for their range'
    places = pipeline.places
    assert (len(places), places.settings) == (IMAGES - 20, thermal_map.settings)
    expected = thermal_map.features.strips[:, 20:]
    np.testing.assert_allclose(places.features.strips, expected, atol=1e-6)
    assert places.snapshot().settings == thermal_map.settings
