# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Maps of images or keyframes, and their files: what is saved is loaded."""

import threading

import numpy as np
import pytest
from stavpr_ros.errors import ImageError, InputError, SettingsError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import build_map, KeyframeSettings, Trajectory
from stavpr_ros.sources.frame import Frame

SECOND = 10**9
GRADIENT = FeatureExtractor('gradient')


def traverse(images, seconds=1):
    """Frames of a traverse, one in so many seconds."""
    return [Frame(image, (i + 1) * seconds * SECOND, f'{i}') for i, image in enumerate(images)]


def straight(count):
    poses = np.zeros((count, 7))
    poses[:, 0], poses[:, 6] = np.arange(count), 1
    return poses


def test_build_map_with_wrong_poses_fails(route):
    frames, extractor = traverse(route[:20]), GRADIENT
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
