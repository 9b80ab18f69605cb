# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Maps of images or keyframes; their files: round trip, atomicity, damage of every kind."""

import dataclasses
import hashlib
import io
import json
import os
import pickle
import re
import threading
import zipfile

import cv2
from hypothesis import given, HealthCheck, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from stavpr_ros.errors import (
    FeatureMismatchError,
    ImageError,
    InputError,
    MapFileError,
    OutputError,
    SettingsError,
)
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import (
    build_map,
    encode_thumbnail,
    KeyframeSettings,
    load_map,
    PlaceMap,
    save_map,
    Trajectory,
)
from stavpr_ros.sources.frame import Frame

SECOND = 10**9


def assert_same(a: PlaceMap, b: PlaceMap) -> None:
    assert a.settings == b.settings
    np.testing.assert_array_equal(a.features.strips.numpy(), b.features.strips.numpy())
    np.testing.assert_array_equal(a.features.weights.numpy(), b.features.weights.numpy())
    np.testing.assert_array_equal(a.stamps, b.stamps)
    assert a.ids == b.ids
    assert a.thumbnails == b.thumbnails
    assert (a.poses is None) == (b.poses is None)
    if a.poses is not None:
        np.testing.assert_array_equal(a.poses, b.poses)


@pytest.fixture(scope='module')
def partial_map(small_map):
    """Return a map in which the pose of two places and the thumbnail of one are unknown."""
    poses = small_map.poses.copy()
    poses[[0, 7]] = np.nan
    thumbnails = (b'', *small_map.thumbnails[1:])
    return dataclasses.replace(small_map, poses=poses, thumbnails=thumbnails)


def test_map_id_depends_on_the_content_alone(partial_map, tmp_path):
    moved = dataclasses.replace(partial_map, stamps=partial_map.stamps + 1)
    ids = []
    for name, place_map in (('a', partial_map), ('b', partial_map), ('c', moved)):
        save_map(place_map, tmp_path / name)
        ids.append(load_map(tmp_path / name).map_id)
    assert re.fullmatch('[0-9a-f]{16}', ids[0])
    assert ids[0] == ids[1] != ids[2]
    assert partial_map.map_id == ''


@pytest.fixture
def saved(partial_map, tmp_path):
    path = tmp_path / 'route.stavpr'
    save_map(partial_map, path)
    return path


def test_save_map_then_load_map_is_identical(partial_map, saved, route):
    loaded = load_map(saved)
    assert_same(partial_map, loaded)
    assert loaded.projection.identity == partial_map.projection.identity
    assert loaded.thumbnail(0) is loaded.pose(0) is loaded.pose(7) is None
    assert loaded.thumbnail(3).shape == (96, 128, 3)
    assert loaded.pose(8).tolist() == [8, 0, 0, 0, 0, 0, 1]
    query = loaded.extractor().extract([route[5]])
    np.testing.assert_allclose(query.strips[:, 0], partial_map.features.strips[:, 5], atol=1e-6)


def test_save_map_without_extras_loads(route, tmp_path):
    plain = build_map(
        [Frame(route[0], 0, '')], FeatureExtractor(), thumbnails=False, progress=False
    )
    save_map(plain, tmp_path / 'plain.stavpr')
    loaded = load_map(tmp_path / 'plain.stavpr')
    assert_same(plain, loaded)
    assert loaded.thumbnail(0) is loaded.pose(0) is None
    assert not loaded.stamps.any()
    assert not any(loaded.ids)
    assert not loaded.has_poses


def test_recognizer_with_other_features_rejects_them(small_map, route):
    from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings

    recognizer = PlaceRecognizer(small_map, RecognizerSettings(threshold=1.0))
    for other in (
        FeatureExtractor(projection=64, seed=1),
        FeatureExtractor(),
        FeatureExtractor(projection=64, strips=6),
    ):
        with pytest.raises(FeatureMismatchError) as caught:
            recognizer.update(other.extract(route[:1]))
        assert small_map.settings.to_json() in str(caught.value)
        assert other.settings.to_json() in str(caught.value)
    assert recognizer.window_fill == 0


def test_build_map_of_no_images_fails():
    with pytest.raises(InputError, match='no images'):
        build_map([], FeatureExtractor(), progress=False)


@pytest.mark.parametrize('value', [np.nan, np.inf])
def test_place_map_with_partial_pose_is_rejected(small_map, value):
    poses = small_map.poses.copy()
    poses[3, 4] = value
    with pytest.raises(InputError, match='place 3'):
        dataclasses.replace(small_map, poses=poses)


# --------------------------------------------------------------------------- keyframes


def traverse(images, seconds=1):
    """Frames of a traverse, one in so many seconds."""
    return [Frame(image, (i + 1) * seconds * SECOND, f'{i}') for i, image in enumerate(images)]


def straight(count):
    poses = np.zeros((count, 7))
    poses[:, 0], poses[:, 6] = np.arange(count), 1
    return poses


@pytest.mark.parametrize('known', ['array', 'trajectory'])
def test_build_map_with_distance_selects_keyframes(route, known):
    frames, poses = traverse(route[:20], 3), straight(20)
    poses[4] = np.nan
    if known == 'trajectory':
        trajectory = Trajectory()  # does not interpolate over 6 s
        for frame, pose in zip(frames, poses, strict=True):
            if not np.isnan(pose[0]):
                trajectory.add(frame.stamp, pose)
        poses = trajectory
    built = build_map(
        frames, FeatureExtractor(), poses, progress=False, keyframes=KeyframeSettings(distance=2)
    )
    assert built.ids == ('0', '2', *map(str, range(5, 20, 2)))  # of 4 nothing is known
    assert built.poses[:, 0].tolist() == [0, 2, *range(5, 20, 2)]
    every = build_map(frames, FeatureExtractor(), poses, progress=False)
    assert len(every) == 20
    assert every.pose(4) is None
    assert every.pose(5)[0] == 5


def test_build_map_with_wrong_poses_fails(route):
    frames, extractor = traverse(route[:20]), FeatureExtractor()
    for count in (19, 21):
        with pytest.raises(InputError, match=f'{count} poses for 20 images'):
            build_map(frames, extractor, straight(count), progress=False)
    with pytest.raises(InputError, match='shape'):
        build_map(frames, extractor, straight(20)[:, :6], progress=False)
    for bad in ([1, 2, 0, 0, 0, 0, 0], [1, 2, 0, 0, 0, 0, np.nan]):
        poses = straight(20)
        poses[7] = bad
        with pytest.raises(InputError, match=r"image 7 '7': pose \[1.0, 2.0"):
            build_map(frames, extractor, poses, progress=False)
    with pytest.raises(SettingsError, match='without poses'):
        build_map(frames, extractor, progress=False, keyframes=KeyframeSettings(angle=1))
    nowhere = Trajectory()
    with pytest.raises(InputError, match=r'none of 20 images became a place.*no odometry'):
        build_map(
            frames, extractor, nowhere, progress=False, keyframes=KeyframeSettings(distance=1)
        )
    assert build_map(frames, extractor, nowhere, progress=False).poses is None


def test_build_map_scales_thumbnails(route):
    image = cv2.resize(route[0], (640, 480))
    built = build_map(traverse([image]), FeatureExtractor(), progress=False, thumbnail_width=320)
    assert built.thumbnail(0).shape == (240, 320, 3)
    assert built.thumbnails[0] == encode_thumbnail(image, 320)
    assert build_map(traverse([image]), FeatureExtractor(), progress=False).thumbnail(0).shape == (
        144,
        192,
        3,
    )
    with pytest.raises(SettingsError, match='width 0'):
        build_map(traverse([image]), FeatureExtractor(), progress=False, thumbnail_width=0)


class Watched:
    """A source that records which threads used and closed it."""

    def __init__(self, frames, fails_at=None):
        self.frames, self.fails_at = frames, fails_at
        self.used, self.closed = set(), []

    def __iter__(self):
        try:
            for i, frame in enumerate(self.frames):
                self.used.add(threading.get_ident())
                if i == self.fails_at:
                    raise ImageError('image 40 is damaged')
                yield frame
        finally:
            self.closed.append(threading.get_ident())


def test_build_map_reads_and_closes_source_on_one_thread(route):
    """Required by bags; also if the images, or their features, fail."""
    whole = Watched(traverse(route))
    assert len(build_map(whole, FeatureExtractor(), progress=False)) == 60
    damaged = Watched(traverse(route), fails_at=40)
    with pytest.raises(ImageError, match='40'):
        build_map(damaged, FeatureExtractor(), progress=False)
    abandoned = Watched(traverse(route))
    broken = FeatureExtractor()
    broken.extract = lambda images: 1 / 0
    with pytest.raises(ZeroDivisionError):
        build_map(abandoned, broken, progress=False)
    for source in (whole, damaged, abandoned):
        assert len(source.used) == 1
        assert source.closed == list(source.used)
        assert threading.get_ident() not in source.used
    assert not [thread for thread in threading.enumerate() if thread.name.startswith('decoding')]


# ------------------------------------------------------------------------------------------ files


def test_save_map_that_fails_keeps_old_file(partial_map, saved, monkeypatch):
    before = saved.read_bytes()

    def full_disk(*_):
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(os, 'fsync', full_disk)
    with pytest.raises(OutputError, match='untouched'):
        save_map(partial_map, saved, force=True)
    assert saved.read_bytes() == before
    assert [path.name for path in saved.parent.iterdir()] == [saved.name]


def test_map_file_at_invalid_path_fails(small_map, tmp_path):
    with pytest.raises(OutputError, match='does not exist: make it'):
        save_map(small_map, tmp_path / 'missing' / 'map.stavpr')
    with pytest.raises(MapFileError, match='name a map file'):
        load_map(tmp_path)


def zip_of(name):
    """Return the bytes of a ZIP file with one member."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, 'w') as archive:
        archive.writestr(name, 'hello')
    return buffer.getvalue()


@pytest.mark.parametrize(
    ('content', 'text'),
    [
        (None, 'does not exist'),
        (b'', 'no map'),
        (b'hello', 'no map'),
        (b'PK\x03\x04' + bytes(100), 'no map'),
        (bytes(range(256)) * 4, 'no map'),
        (zip_of('hello.txt'), 'no map of this program'),
        (zip_of('manifest.json'), 'damaged'),
    ],
)
def test_load_map_of_other_file_fails(tmp_path, content, text):
    path = tmp_path / 'other'
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(MapFileError, match=text):
        load_map(path)


def rewritten(saved, change=lambda manifest: None, members=None, compression=zipfile.ZIP_STORED):
    """Write the saved map again with a changed manifest and other members."""
    with zipfile.ZipFile(saved) as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    manifest = json.loads(content['manifest.json'])
    change(manifest)
    content['manifest.json'] = json.dumps(manifest).encode()
    content.update(members or {})
    with zipfile.ZipFile(saved, 'w', compression) as archive:
        for name, value in content.items():
            archive.writestr(name, value)


def test_load_map_with_other_content_than_hashed_fails(saved):
    buffer = io.BytesIO()
    np.save(buffer, load_map(saved).stamps + 1)
    rewritten(saved, members={'stamps.npy': buffer.getvalue()})
    with pytest.raises(MapFileError, match='stamps'):
        load_map(saved)


def test_load_map_of_newer_version_fails(saved):
    rewritten(saved, lambda manifest: manifest.update(version=99))
    with pytest.raises(MapFileError, match='version 99'):
        load_map(saved)


def test_load_map_with_unknown_features_fails(saved):
    def change(manifest):
        manifest['settings'] = manifest['settings'].replace('"gradient"', '"teleport"')

    rewritten(saved, change)
    with pytest.raises(MapFileError, match='teleport'):
        load_map(saved)


def test_load_map_with_compressed_members_fails(saved):
    rewritten(saved, compression=zipfile.ZIP_DEFLATED)
    with pytest.raises(MapFileError, match='compressed'):
        load_map(saved)


def test_load_map_executes_no_pickle(saved, tmp_path):
    class Bomb:
        def __reduce__(self):
            return (os.mkdir, (str(tmp_path / 'exploded'),))

    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.array([Bomb()], object), allow_pickle=True)
    digest = hashlib.sha256(buffer.getvalue()).hexdigest()
    rewritten(
        saved, lambda m: m['members'].update(stamps=digest), {'stamps.npy': buffer.getvalue()}
    )
    with pytest.raises(MapFileError, match='damaged'):
        load_map(saved)
    saved.write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(MapFileError):
        load_map(saved)
    assert not (tmp_path / 'exploded').exists()


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_load_map_with_damage_fails_or_is_identical(saved, partial_map, data):
    """Any byte changed, any tail cut off: the same map or a clear error, nothing else."""
    whole = saved.read_bytes()
    damaged = saved.parent / 'damaged'
    if data.draw(st.booleans(), label='truncate'):
        damaged.write_bytes(whole[: data.draw(st.integers(0, len(whole) - 1))])
    else:
        # half of the positions among the headers, where damage is hardest to detect
        near_end = data.draw(st.booleans())
        low = max(0, len(whole) - 1500) if near_end else 0
        position = data.draw(st.integers(low, len(whole) - 1))
        flipped = bytearray(whole)
        flipped[position] ^= data.draw(st.integers(1, 255))
        damaged.write_bytes(flipped)
    try:
        loaded = load_map(damaged)
    except MapFileError as error:
        assert str(damaged) in str(error)  # noqa: PT017
    else:
        assert_same(partial_map, loaded)
