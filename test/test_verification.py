# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Geometric verification: synthetic scenes from two viewpoints, blank images, real places."""

import cv2
import numpy as np
import pytest
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.method import verification
from stavpr_ros.method.verification import GeometricEvidence, GeometricSettings, PlaceVerifier
from stavpr_ros.sources import open_source

METHODS = ['orb', 'sift']


def texture(seed, size=(480, 640)):
    """Blobs of all sizes, RGB."""
    rng = np.random.default_rng(seed)
    image = np.zeros((*size, 3))
    for cells in (8, 24, 80):
        image += cv2.resize(
            rng.random((cells * 3 // 4, cells, 3)), size[::-1], interpolation=cv2.INTER_CUBIC
        )
    return np.ascontiguousarray(np.clip(image * 85, 0, 255).astype(np.uint8))


def move(image, matrix):
    return cv2.warpPerspective(
        image, np.float64(matrix), image.shape[1::-1], borderMode=cv2.BORDER_REFLECT
    )


VIEWS = {
    'same': np.eye(3),
    'shifted': [[1, 0, 60], [0, 1, 20], [0, 0, 1]],
    'turned and nearer': [[1.1, -0.2, 30], [0.2, 1.1, -60], [0, 0, 1]],
    'slanted': [[1, 0.05, 10], [0.02, 1, 5], [2e-4, 1e-4, 1]],
}


class Thumbnails:
    """Thumbnails of places, and a list of the places that were read."""

    def __init__(self, images):
        self.images, self.read = images, []

    def thumbnail(self, place):
        self.read.append(place)
        return self.images.get(place)


class Pairs:
    """Checks pairs of images."""

    def __init__(self, settings=None):
        self._verifier = PlaceVerifier(settings or GeometricSettings())

    def inliers(self, query, place):
        return self._verifier.inliers(query, Thumbnails({0: place}), 0)


@pytest.mark.parametrize(
    ('method', 'view'), [*(('orb', view) for view in VIEWS), ('sift', 'slanted')]
)
def test_inliers_of_flat_scene_from_other_viewpoint_are_many(method, view):
    check = Pairs(GeometricSettings(method))
    one = texture(0)
    assert check.inliers(one, move(one, VIEWS[view])) > 100


@pytest.mark.parametrize('method', METHODS)
def test_inliers_of_other_scene_are_few_and_of_blank_image_zero(method):
    check, scene = Pairs(GeometricSettings(method)), texture(0)
    assert max(check.inliers(texture(seed), texture(seed + 100)) for seed in range(2)) < 30
    dot = np.zeros((480, 640, 3), np.uint8)
    dot[200:230, 300:330] = 255
    tiny = (np.ascontiguousarray(part) for part in (scene[:1, :1], scene[:1], scene[:, :1]))
    for blank in (np.zeros_like(scene), dot, *tiny):
        for pair in ((scene, blank), (blank, scene)):
            assert check.inliers(*pair) == 0


@pytest.mark.parametrize('method', METHODS)
def test_inliers_of_two_depths_count_both(method):
    """Parallax, which no homography explains."""
    check = Pairs(GeometricSettings(method))
    near, far = texture(1), texture(2)
    one, other = far.copy(), move(far, [[1, 0, 10], [0, 1, 0], [0, 0, 1]])
    one[240:], other[240:] = near[240:], move(near, [[1, 0, 50], [0, 1, 0], [0, 0, 1]])[240:]
    shuffled = other.copy()
    shuffled[240:] = texture(3)[240:]
    assert check.inliers(one, other) > 1.5 * check.inliers(one, shuffled)


def test_inliers_without_common_geometry_are_few(set_constants):
    """The same small patches, each elsewhere: they match, but not as one scene."""
    rng = np.random.default_rng(0)
    one, other = texture(4), texture(5)
    patches = [texture(50 + i, (60, 60)) for i in range(40)]
    cells = [(y, x) for y in range(0, 480, 80) for x in range(0, 640, 80)]
    for cell, place, patch in zip(cells, rng.permutation(len(cells)), patches, strict=False):
        for image, (y, x) in ((one, cell), (other, cells[place])):
            image[y + 10 : y + 70, x + 10 : x + 70] = patch
    set_constants(verification, FEATURES=2000, WIDTH=640)
    assert Pairs().inliers(one, one) > 800
    assert Pairs().inliers(one, other) < 150


def test_inliers_of_one_patch_repeated_in_query_are_few():
    """Each of its keypoints counts for the one that is nearest to it, not for every copy."""
    patch = texture(0, (120, 160))
    place = np.pad(patch, ((0, 360), (0, 480), (0, 0)))
    least = GeometricSettings().min_inliers
    assert Pairs().inliers(place, place) >= least
    assert Pairs().inliers(np.tile(patch, (4, 4, 1)), place) < least


def test_inliers_after_query_memory_is_reused_are_of_new_query():
    check, buffer = Pairs(), texture(0)
    place = move(texture(7), VIEWS['shifted'])
    before = check.inliers(buffer, place)
    buffer[:] = texture(7)
    assert check.inliers(buffer, place) > 100 > before


def test_settings_out_of_range_and_other_arrays_are_rejected():
    for changes, words in (({'method': 'none'}, "'none'"), ({'min_inliers': 7}, 'inliers = 7')):
        with pytest.raises(SettingsError, match=words):
            GeometricSettings(**changes)
    good = texture(0)
    for bad in (good[:, :, 0], good.astype(np.float32), good[:0], np.dstack([good, good])):
        for name, pair in (('query', (bad, good)), ('place', (good, bad))):
            with pytest.raises(InputError, match=name):
                Pairs().inliers(*pair)


# ------------------------------------------------ real places


def images(folder):
    return [frame.image for frame in open_source(folder)]


def thumbnail(image, width=192):
    size = width, round(image.shape[0] * width / image.shape[1])
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


@pytest.mark.parametrize(('name', 'recall'), [('gardens_point', 0.7), ('corridor', 0.6)])
def test_inliers_separate_real_places(data_folder, name, recall):
    """Thumbnails, as a map keeps them; wrong places are at least twenty away."""
    folders = ('day_right', 'day_left') if name == 'gardens_point' else ('query', 'ref')
    query, reference = (images(data_folder / name / folder) for folder in folders)
    right = [(i, i) for i in range(0, len(query), 8)]
    wrong = [(i, (i + 37) % len(query)) for i in range(0, len(query), 8)]
    check, least = Pairs(), GeometricSettings().min_inliers
    verified = [
        np.mean([check.inliers(query[i], thumbnail(reference[j])) >= least for i, j in pairs])
        for pairs in (right, wrong)
    ]
    assert verified[0] >= recall
    assert verified[1] <= 0.03


def test_place_verifier_keeps_keypoints_of_places_until_map_changes():
    check = GeometricSettings()
    verifier, one, other = PlaceVerifier(check), texture(0), texture(100)
    places = Thumbnails({3: move(one, VIEWS['shifted']), 4: other})
    counts = [verifier.inliers(one, places, place) for place in (3, 4, 3)]
    assert counts[0] == Pairs(check).inliers(one, places.images[3]) > 100
    assert counts == [counts[0], Pairs(check).inliers(one, other), counts[0]]
    assert places.read == [3, 4]
    another = Thumbnails({3: other})
    assert verifier.inliers(one, another, 3) == counts[1]
    assert verifier.inliers(one, another, 5) is None


# ------------------------------------------------ as evidence


def test_evidence_checks_doubtful_matches_and_each_tenth_certain_one():
    evidence = GeometricEvidence()
    assert [evidence.wants(p) for p in (0.05, 0.3, 0.98)] == [False, True, True]
    assert [evidence.wants(0.999) for _ in range(21)] == [True, *[False] * 9] * 2 + [True]


@pytest.mark.parametrize(('passing', 'right'), [(30, 31 / 34), (0, 1 / 34)])
def test_evidence_is_the_share_of_certain_matches_that_pass(passing, right):
    """Where none passes, as by night, a failed check is next to no evidence."""
    evidence = GeometricEvidence()
    for i in range(30):
        assert evidence.update_probability(0.999, i < passing) == 0.999
    odds = (1 - right) / 0.9 if passing else 1.0
    assert evidence.update_probability(0.5, False) == pytest.approx(odds / (1 + odds))
    odds = max(right, 0.3) / 0.1
    assert evidence.update_probability(0.5, True) == pytest.approx(odds / (1 + odds))
