# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Geometric verification: whether two images show the same scene from two viewpoints.

Keypoints of both are matched, and the matches counted that one epipolar geometry explains. A wrong
place that looks alike has matches as well; one geometry explains few of them.
"""

from collections import OrderedDict
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from stavpr_ros.checks import require_at_least, require_choice, require_shape
from stavpr_ros.mapping import GrowingMap, Map
from stavpr_ros.mapping.place_map import resized
from stavpr_ros.method.match import Match, Status

METHODS = ('orb', 'sift')
# These belong together: more keypoints, a ratio nearer to 1 and more pixels let more matches of
# wrong places through, and min_inliers has to rise with them.
FEATURES = 1000  # most keypoints of an image
RATIO = 0.9  # of the distances to the nearest and the second nearest descriptor
WIDTH = 320  # pixels, which images are brought to before
PIXELS = 2.0  # how far a match may lie off the geometry, at that width
MIN_MATCHES = 8  # a fundamental matrix fits any seven
ITERATIONS = 2000
CONFIDENCE = 0.999
LOWEST = 32  # rows of an image below which keypoints have no room, and certain detectors fail
TALLEST = 4  # an image is brought to at most so many times its width
IMPROBABLE, CERTAIN = 0.1, 0.99  # probabilities between which a match is checked
EACH = 10  # of so many certain matches one is checked
WRONG_PASSED = 0.1  # share of wrong pairs that pass: doubtful ones look alike
PRIOR_PASSED, PRIOR_CHECKED = 1.0, 4.0  # right pairs before the first is checked
MIN_PASS_RATE = 0.3  # r of a pair that has passed: right pairs do pass on this drive
CACHED = 256  # places whose keypoints are kept, about 40 kB each


@dataclass(frozen=True)
class GeometricSettings:
    """
    How two images are checked against each other.

    :param method: keypoints: ``orb`` (fast) or ``sift`` (slower, fewer matches).
    :param min_inliers: matches that one geometry must explain; at least 8. For ``sift``, 20 do.
    """

    method: str = 'orb'
    min_inliers: int = 30

    def __post_init__(self) -> None:
        require_choice('method', self.method, METHODS)
        require_at_least('min_inliers', self.min_inliers, MIN_MATCHES)


@dataclass(frozen=True)
class Keypoints:
    """Those of an image: points (m, 2), pixels at the common width, and descriptors (m, ...)."""

    points: np.ndarray
    descriptors: np.ndarray


class PlaceVerifier:
    """
    Checks images against places of a map. Belongs to one thread.

    The same images give the same count. The keypoints of the last image and of the latest places
    are kept: another image against one of these costs the half.

    :param settings: see :class:`GeometricSettings`.
    """

    def __init__(self, settings: GeometricSettings) -> None:
        library: Any = cv2  # its types leave these out
        self._detector = library.ORB_create(FEATURES, fastThreshold=7)
        if settings.method == 'sift':
            self._detector = library.SIFT_create(FEATURES)
        self._query: tuple[np.ndarray, Keypoints] | None = None  # small and gray; its keypoints
        self._places: Map | GrowingMap | None = None
        self._known: OrderedDict[int, Keypoints] = OrderedDict()

    def inliers(self, query: np.ndarray, places: Map | GrowingMap, place: int) -> int | None:
        """
        Count the matches of an image and a place that one geometry explains.

        :param query: RGB (h, w, 3) uint8; a thumbnail of the width that maps keep is sufficient.
        :param places: the map, or the route, that the place is of.
        :returns: 0 for images that have too few; None where the place has no thumbnail.
        :raises InputError: another array than such an image.
        """
        if places is not self._places:
            self._places = places
            self._known.clear()
        if place not in self._known:
            thumbnail = places.thumbnail(place)
            if thumbnail is None:
                return None
            self._known[place] = self._detect(self._small_gray(thumbnail, f'place {place}'))
            if len(self._known) > CACHED:
                self._known.popitem(last=False)
        self._known.move_to_end(place)
        gray = self._small_gray(query, 'query')
        # compared by content: a caller may use the memory of an image again for the next
        if self._query is None or not np.array_equal(self._query[0], gray):
            self._query = gray, self._detect(gray)
        mine, theirs = self._query[1], self._known[place]
        pairs = mutual_matches(mine.descriptors, theirs.descriptors, RATIO)
        if len(pairs[0]) < MIN_MATCHES:
            return 0
        return _count_explained(mine.points[pairs[0]], theirs.points[pairs[1]])

    def _small_gray(self, image: np.ndarray, name: str) -> np.ndarray:
        """Return an image at the common width, (h, w) uint8."""
        height, width, _ = require_shape(f'{name}, RGB', image, 'H W 3', 'uint8')
        size = WIDTH, min(max(1, round(height * WIDTH / width)), TALLEST * WIDTH)
        return resized(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), size)

    def _detect(self, gray: np.ndarray) -> Keypoints:
        nothing = Keypoints(np.empty((0, 2), np.float32), np.empty((0, 0), np.uint8))
        if len(gray) < LOWEST:
            return nothing
        keypoints, descriptors = self._detector.detectAndCompute(gray, None)
        if descriptors is None:
            return nothing
        return Keypoints(np.array([point.pt for point in keypoints], np.float32), descriptors)


def mutual_matches(
    mine: np.ndarray, theirs: np.ndarray, ratio: float
) -> tuple[np.ndarray, np.ndarray]:
    """
    Pair the descriptors that are each other's clear nearest.

    :param mine, theirs: shape (m, d) and (k, d), uint8 for ORB, float32 for SIFT.
    :param ratio: the nearest is this much nearer than the second nearest, in (0, 1].
    :returns: two arrays of indices, of equal length.
    """
    none = np.empty(0, np.intp)
    if not len(mine) or len(theirs) < 2:
        return none, none
    limit = ratio**2
    if mine.dtype == np.uint8:  # the square of the distance of bits is Hamming's
        bits = (np.unpackbits(points, axis=1).astype(np.float32) for points in (mine, theirs))
        (mine, theirs), limit = bits, ratio
    # squares of L2 by one product: exact: SIFT's are whole numbers below 2**24
    squares = mine @ theirs.T
    squares *= -2
    squares += (mine * mine).sum(axis=1)[:, None]
    squares += (theirs * theirs).sum(axis=1)
    rows, nearest = np.arange(len(mine)), squares.argmin(axis=1)
    back = squares.argmin(axis=0)
    least = squares[rows, nearest].copy()
    squares[rows, nearest] = np.inf
    clear = (least < limit * squares.min(axis=1)) & (back[nearest] == rows)
    return np.flatnonzero(clear), nearest[clear]


class GeometricEvidence:
    """
    The probability of a match in mode robust, after the check of its pair.

    With the share r of right pairs that pass the check, and f of wrong ones, a check multiplies
    the odds by r / f if it is passed, and by (1 - r) / (1 - f) if not. r is learned on the drive
    from pairs that are certain without a check, and starts low: by night, where hardly any right
    pair passes, a failed check is no evidence.
    """

    def __init__(self) -> None:
        self._passed, self._checked = PRIOR_PASSED, PRIOR_CHECKED
        self._certain = 0  # pairs since the last one that was checked

    def wants(self, probability: float) -> bool:
        """Return whether to check a pair: it is doubtful, or one of many certain ones."""
        if probability < CERTAIN:
            return probability > IMPROBABLE
        self._certain += 1
        return self._certain % EACH == 1

    def update_probability(self, probability: float, passed: bool) -> float:
        """Return the probability of a match whose pair has passed the check, or not."""
        if probability >= CERTAIN:
            self._passed += passed
            self._checked += 1
            return probability
        right, wrong = self._passed / self._checked, WRONG_PASSED
        if passed:
            factor = max(right, MIN_PASS_RATE) / wrong
        else:
            factor = min((1 - right) / (1 - wrong), 1.0)
        odds = probability / (1 - probability) * factor
        return odds / (1 + odds)


class GeometricCheck:
    """Checks matches; it learns from those since the last reset how often right ones pass."""

    def __init__(self, settings: GeometricSettings) -> None:
        self.settings = settings
        self._verifier = PlaceVerifier(settings)
        self._evidence = GeometricEvidence()

    def reset(self) -> None:
        """Forget the passes of earlier matches."""
        self._evidence = GeometricEvidence()

    def check(
        self,
        match: Match,
        places: Map | GrowingMap,
        query: np.ndarray | None,
        is_weighed: bool,
    ) -> Match:
        """
        Return a match after the check; without thumbnails, as it is.

        Matches with too few inliers are rejected.

        :param query: thumbnail of its image, RGB (h, w, 3) uint8; None = unknown.
        :param is_weighed: the result changes the probability instead (:class:`GeometricEvidence`),
            where the match is doubtful.
        """
        if match.path.place < 0 or query is None:
            return match
        if not (self._evidence.wants(match.probability) if is_weighed else match.accepted):
            return match
        inliers = self._verifier.inliers(query, places, match.path.place)
        if inliers is None:
            return match
        least = self.settings.min_inliers
        if is_weighed:
            probability = self._evidence.update_probability(match.probability, inliers >= least)
            return match.with_probability(probability, inliers)
        if inliers >= least:
            return replace(match, inliers=inliers)
        reason = (
            f'geometric check: {inliers} inliers are fewer than {least} (parameter min_inliers)'
        )
        return replace(match, inliers=inliers, status=Status.NO_MATCH, reason=reason)


def _count_explained(points: np.ndarray, others: np.ndarray) -> int:
    """Count matches that the best fundamental matrix explains; also of a flat scene."""
    try:
        _, mask = cv2.findFundamentalMat(
            points, others, cv2.USAC_MAGSAC, PIXELS, CONFIDENCE, ITERATIONS
        )
    except cv2.error:  # no matrix fits: many of the matches in one point
        return 0
    return 0 if mask is None else int(np.count_nonzero(mask))
