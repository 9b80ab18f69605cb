# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Maps that are built of images or keyframes, or grow place by place; errors without effect."""

import dataclasses
import threading

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from places import poses_at
import pytest
from stavpr_ros.errors import FeatureMismatchError, ImageError, InputError, SettingsError
from stavpr_ros.features import FeatureExtractor, LocalFeatures
from stavpr_ros.features.gradient import GradientSettings
from stavpr_ros.mapping import (
    build_map,
    encode_thumbnail,
    growing_map,
    GrowingMap,
    KeyframeSettings,
    load_map,
    save_map,
    Trajectory,
)
from stavpr_ros.sources.frame import Frame

# 7 x 7 cells, one column a strip
EXTRACTOR = FeatureExtractor('gradient', GradientSettings(28, cell=4, orientations=2))
W, D = 7, 14


@pytest.fixture(autouse=True)
def little_room(set_constants):
    """Borders are crossed by a few places."""
    set_constants(growing_map, ROOM=4)


def features(i, d=D, settings=EXTRACTOR.settings, count=1):
    strips = np.arange(W * count * d, dtype=np.float32).reshape(W, count, d) + 1000 * i
    return LocalFeatures(
        strips / 2**20, np.full((W, count), i / 128, np.float32), settings, (7, 1)
    )


def where(i):
    return np.array([i, 2 * i, 3, 0, 0, 0.6, 0.8])


def grow_map(count, limit=100):
    """Return a map of count places; every third has no pose, every second no thumbnail."""
    made = GrowingMap(EXTRACTOR.settings, None, limit)
    for i in range(count):
        add(made, i)
    return made


def add(made, i):
    pose = where(i) if i % 3 else None
    return made.add(features(i), i * 10, f'place {i}', pose, b'' if i % 2 else thumbnail(i))


def thumbnail(i):
    return encode_thumbnail(np.full((8, 8, 3), i, np.uint8))


def assert_holds(made, numbers):
    """Compare the places of a map, or a snapshot of one, with these numbers."""
    assert len(made) == len(numbers)
    assert made.stamps.tolist() == [i * 10 for i in numbers]
    assert tuple(made.ids) == tuple(f'place {i}' for i in numbers)
    assert tuple(made.features.strips.shape) == (W, len(numbers), D)
    for place, i in enumerate(numbers):
        np.testing.assert_allclose(
            made.features.strips[:, place], features(i).strips[:, 0], rtol=0, atol=0
        )
        assert made.features.weights[:, place].tolist() == [i / 128] * W
        known = where(i) if i % 3 else np.full(7, np.nan)
        np.testing.assert_allclose(made.poses[place], known)
        assert made.thumbnails[place] == (b'' if i % 2 else thumbnail(i))


def test_growing_map_at_its_limit_is_full():
    made = grow_map(18, 18)
    with pytest.raises(InputError, match=r'full, it has 18 places: raise its limit, evict'):
        add(made, 18)
    assert_holds(made, range(18))
    assert made.features.cells == (7, 1)


def test_snapshot_is_independent_of_map():
    made = grow_map(3)
    snapshot = made.snapshot()
    assert_holds(snapshot, range(3))
    made.features.strips[:] = 0
    made.poses[:] = 0
    made.stamps[:] = 0
    made.forget(2)
    add(made, 3)
    assert_holds(snapshot, range(3))


def test_snapshot_saved_and_loaded_continues(tmp_path):
    """Poses of some places, thumbnails of some places."""
    save_map(grow_map(7).snapshot(), tmp_path / 'map')
    loaded = load_map(tmp_path / 'map')
    assert_holds(loaded, range(7))
    assert loaded.pose(3) is None
    assert loaded.thumbnail(1) is None
    continued = GrowingMap.from_map(loaded, 8)
    assert add(continued, 7) == 7
    assert_holds(continued, range(8))
    assert_holds(loaded, range(7))


def test_from_map_keeps_all_parts_up_to_its_limit(small_map):
    snapshot = GrowingMap.from_map(small_map, 60).snapshot()
    assert snapshot.projection is small_map.projection
    assert (snapshot.ids, snapshot.thumbnails) == (small_map.ids, small_map.thumbnails)
    np.testing.assert_array_equal(snapshot.poses, small_map.poses)
    with pytest.raises(InputError, match='60 places does not fit into a limit of 59'):
        GrowingMap.from_map(small_map, 59)
    plain = GrowingMap.from_map(dataclasses.replace(small_map, poses=None, thumbnails=()), 60)
    assert plain.snapshot().poses is None
    assert plain.thumbnails == [b''] * 60


@given(st.lists(st.one_of(st.none(), st.integers(0, 6)), max_size=60))
def test_growing_map_equals_plain_list(steps):
    """None adds a place, a number forgets so many."""
    made, plain, added = GrowingMap(EXTRACTOR.settings, None, 9), [], 0
    for step in steps:
        if step is not None:
            made.forget(min(step, len(plain)))
            plain = plain[step:]
        elif len(plain) < 9:
            assert add(made, added) == added
            plain.append(added)
            added += 1
        assert made.first == added - len(plain)
        assert made.full is (len(plain) == 9)
    assert len(made) == len(plain)
    if plain:
        assert_holds(made, plain)


@pytest.mark.parametrize('count', [0, 4])
@pytest.mark.parametrize(
    ('arguments', 'error', 'words'),
    [
        (
            (features(1, settings=FeatureExtractor('gradient', strips=6).settings),),
            FeatureMismatchError,
            'strips',
        ),
        ((features(1, count=2),), InputError, 'features of 2 images'),
        ((features(1, count=0),), InputError, 'features of 0 images'),
        ((features(float('nan')),), InputError, 'not finite'),
        ((features(1), 0, '', np.zeros(7)), InputError, 'norm 0'),
        ((features(1), 0, '', np.zeros(6)), InputError, 'shape'),
        ((features(1), 2**64), OverflowError, 'int'),
    ],
)
def test_add_with_error_changes_nothing(count, arguments, error, words):
    made = grow_map(count)
    with pytest.raises(error, match=words):
        made.add(*arguments)
    if count:
        with pytest.raises(FeatureMismatchError, match='6 dimensions, the map has 14'):
            made.add(features(2, d=6))
        assert_holds(made, range(count))
    assert add(made, count) == count
    assert_holds(made, range(count + 1))


def test_growing_map_with_wrong_settings_is_rejected(small_map):
    with pytest.raises(SettingsError, match='limit = 0'):
        GrowingMap(EXTRACTOR.settings, None, 0)
    for settings, projection in (
        (small_map.settings, None),
        (EXTRACTOR.settings, small_map.projection),
    ):
        with pytest.raises(InputError, match='projection'):
            GrowingMap(settings, projection, 5)


# Maps of images or keyframes, and their files: what is saved is loaded

SECOND = 10**9
GRADIENT = FeatureExtractor('gradient')


def traverse(images, seconds=1):
    """Frames of a traverse, one in so many seconds."""
    return [Frame(image, (i + 1) * seconds * SECOND, f'{i}') for i, image in enumerate(images)]


def test_build_map_with_wrong_poses_fails(route):
    frames, extractor = traverse(route[:20]), GRADIENT
    for count in (19, 21):
        with pytest.raises(InputError, match=f'{count} poses for 20 images'):
            build_map(frames, extractor, poses_at(range(count)), progress=False)
    with pytest.raises(InputError, match='shape'):
        build_map(frames, extractor, poses_at(range(20))[:, :6], progress=False)
    for bad in ([1, 2, 0, 0, 0, 0, 0], [1, 2, 0, 0, 0, 0, np.nan]):
        poses = poses_at(range(20))
        poses[7] = bad
        with pytest.raises(InputError, match=r"image 7 '7': pose \[1.0, 2.0"):
            build_map(frames, extractor, poses, progress=False)
    with pytest.raises(InputError, match='no images'):
        build_map([], extractor, progress=False)
    with pytest.raises(SettingsError, match='without poses'):
        build_map(frames, extractor, progress=False, keyframes=KeyframeSettings(angle=1))
    nowhere = Trajectory()
    with pytest.raises(InputError, match=r'none of 20 images became a place.*no odometry'):
        build_map(
            frames, extractor, nowhere, progress=False, keyframes=KeyframeSettings(distance=1)
        )
    assert build_map(frames, extractor, nowhere, progress=False).poses is None


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
    assert len(build_map(whole, GRADIENT, progress=False)) == 60
    damaged = Watched(traverse(route), fails_at=40)
    with pytest.raises(ImageError, match='40'):
        build_map(damaged, GRADIENT, progress=False)
    abandoned = Watched(traverse(route))
    broken = FeatureExtractor('gradient')
    broken.extract = lambda images: 1 / 0
    with pytest.raises(ZeroDivisionError):
        build_map(abandoned, broken, progress=False)
    for source in (whole, damaged, abandoned):
        assert len(source.used) == 1
        assert source.closed == list(source.used)
        assert threading.get_ident() not in source.used
    assert not [thread for thread in threading.enumerate() if thread.name.startswith('decoding')]
