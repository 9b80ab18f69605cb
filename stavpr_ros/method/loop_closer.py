# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Loop closure: the map is the route so far, without its latest images."""

from collections import deque
from collections.abc import Callable
from dataclasses import replace
import math

import numpy as np
from stavpr_ros.alignment.settings import SpatialSettings
from stavpr_ros.checks import require_at_least, require_choice
from stavpr_ros.errors import SettingsError
from stavpr_ros.features import FeatureSettings, LocalFeatures
from stavpr_ros.features.registry import route_evidence_of
from stavpr_ros.method.columns import ColumnLayout
from stavpr_ros.method.lm_dtw_window import LmDtwWindow
from stavpr_ros.method.localizer import position_of, SequenceRecognizer
from stavpr_ros.method.match import Limits, Match, Status, WindowColumns
from stavpr_ros.method.model import AROUND, BAND, CONFIRMED, LONGEST_GAP, LONGEST_WAIT
from stavpr_ros.method.settings import RecognizerSettings
from stavpr_ros.method.window import FilterWindow
from stavpr_ros.prepare.matcher import CpuRouteMatcher, PRECISIONS
from stavpr_ros.prepare.route_features import RouteFeatures

EVICTED = 8  # the oldest one in so many is evicted at a time
NO_MATCH = -LONGEST_GAP - 1, 0  # image and place that no match continues
MIN_PLACES = 5  # fewer distances have no meaningful mean and deviation


class PathConfirmation:
    """
    Decides from which match on a path is confirmed, in mode robust.

    Streets in one light look alike for about a window: a path is confirmed by half a window
    of matches that are certain, or by two windows of any. Matches that waited are late ones of
    the match that confirms them. A camera at rest confirms nothing.

    :param length: images of a window.
    """

    def __init__(self, length: int) -> None:
        self._length = length
        # of the latest path: image and place of its last match; probabilities; waiting matches
        self._last = NO_MATCH
        self._path: deque[float] = deque(maxlen=2 * length)
        self._waiting: deque[Match] = deque(maxlen=LONGEST_WAIT * length)

    def reset(self) -> None:
        """Let the next match begin another path."""
        self._last = NO_MATCH

    def take(
        self,
        match: Match,
        oldest: list[Match],
        keep: Callable[[Match], Match],
        is_at_rest: bool,
        first: int,
    ) -> Match:
        """
        Return an accepted match; as no match while its path is not confirmed.

        :param oldest: the match of the oldest image, or none.
        :param keep: returns a match with all that is needed of it later.
        :param first: the oldest place that is not evicted.
        """
        images, apart = match.last_image - self._last[0], abs(match.place - self._last[1])
        if images > LONGEST_GAP or apart > BAND * images:  # another path begins
            self._path.clear()
            self._waiting.clear()
        self._last = match.last_image, match.place
        self._waiting += oldest
        if not is_at_rest:
            self._path.append(match.probability)
        certain = sum(probability > CONFIRMED for probability in self._path)
        if certain < self._length // 2 and len(self._path) < 2 * self._length:
            self._waiting.append(keep(match))
            return replace(
                match,
                limits=Limits(0.0, 1.0),
                status=Status.NO_MATCH,
                reason='its path is not confirmed yet',
            )
        # places of the others have been evicted
        late = tuple(m for m in self._waiting if m.path.pairs[:, 1].min() >= first)
        self._waiting.clear()
        return replace(match, late=late)


class LoopCloser(SequenceRecognizer):
    """
    Recognizer of places that the same traverse has passed before, one image at a time.

    Every image becomes a place; an image is compared with images that came at least ``exclude``
    images and ``exclude_seconds`` before it. Growing needs no rebuild: memory doubles when it is
    full; the mean that is subtracted (option ``mean_centering``) is updated when the route is an
    eighth longer, as is ``whitening`` until it is settled. The closer is the owner of the route's
    features; :meth:`features` returns the original ones.

    With a ``limit``, the oldest eighth of the places is evicted whenever there are so many. Places
    are numbered from the start of the route all the same: a number never comes to mean another
    image.

    :param settings: strategies that align strips; ``adaptive`` if none is set.
    :param exclude: the latest images that are not part of the map, at least 1.
    :param feature_settings: how the features are made.
    :param limit: most places that are kept; None for all. It must leave room for more than the
        excluded images.
    :param exclude_seconds: places younger than so many seconds are not part of the map either.
    :param precision: of the route's features once it is settled, ``float32``, also by ``auto``, or
        ``int8``; see :mod:`stavpr_ros.prepare.route_features`.
    :raises SettingsError: invalid settings.
    """

    _window: FilterWindow | LmDtwWindow
    no_places = 'no earlier place is old enough to be matched with'

    def __init__(
        self,
        settings: RecognizerSettings,
        exclude: int,
        feature_settings: FeatureSettings,
        limit: int | None = None,
        exclude_seconds: float = 0.0,
        precision: str = 'float32',
    ) -> None:
        settings = replace(settings, spatial=settings.spatial or SpatialSettings())
        _require_fitting(settings, exclude, limit, exclude_seconds)
        require_choice('precision', precision, ('auto', *PRECISIONS))
        self._track: list[np.ndarray] = []  # position of each place that is not evicted
        options, sequence = settings.applied_options, settings.sequence
        layout = ColumnLayout(nms_radius=settings.nms_radius)
        window: FilterWindow | LmDtwWindow
        if options.place_filter:
            constant = route_evidence_of(feature_settings.kind)
            window = FilterWindow(sequence, 0, layout, True, constant=constant)
        else:
            window = LmDtwWindow(sequence, 0, layout, options.query_znorm, AROUND)
        super().__init__(settings, feature_settings, window, self._track)
        W = feature_settings.strips
        self._exclude, self._exclude_ns, self._limit = exclude, round(exclude_seconds * 1e9), limit
        self._matcher = CpuRouteMatcher(W, settings.applied_spatial)
        self._route = RouteFeatures(
            feature_settings, options.mean_centering, options.whitening, limit, precision == 'int8'
        )
        # stamps of the latest places, not yet old enough in seconds
        self._recent_stamps: deque[int] = deque()
        self._places = 0  # the newest image may be matched with so many of the oldest places
        self._confirmation = PathConfirmation(sequence.length)

    def __len__(self) -> int:
        """Return the number of places that are not evicted; ``first + len`` images have come."""
        return self._route.count

    @property
    def first(self) -> int:
        """Return the oldest place that is not evicted: the number of evicted ones."""
        return self._window.first

    def features(self) -> LocalFeatures:
        """Return the features of the places, strips (W, n, d), neither centered nor whitened."""
        return self._route.original()

    def reset(self) -> None:
        """
        Begin a new window: the clock jumped, or the robot was carried elsewhere. The route stays.

        Places before the reset count as old enough in seconds, since stamps cannot be compared
        over a jump.
        """
        super().reset()
        self._recent_stamps.clear()
        self._confirmation.reset()

    def update(
        self, features: LocalFeatures, stamp: int = 0, pose: np.ndarray | None = None
    ) -> Match:
        """
        See :meth:`SequenceRecognizer.update`; places are earlier images.

        Without a stamp, only the count of images excludes places.
        """
        odometry_xy = position_of(pose)
        dimension = self._route.latest.shape[2] if len(self) else 0
        self._require_one_image(features, 'the route so far', dimension)
        self._append(features, stamp)
        self._track.append(odometry_xy)
        self._window.push(self._distances(), self._route.newest[:, 0], stamp)
        match = self._match(odometry_xy)
        oldest, is_at_rest = self._oldest(match), self._window.is_standstill
        if not match.accepted or math.isnan(match.probability):
            return match
        return self._confirmation.take(match, oldest, self._late, is_at_rest, self.first)

    def _first_image(self, images: int) -> int:
        return self.first + len(self) - images

    def _late(self, match: Match) -> Match:
        """Return a match of the present window with all that is needed of it later."""
        places = match.path.pairs[:, 1]
        first = max(int(places.min()) - BAND, self.first)
        end = min(int(places.max()) + BAND + 1, self.first + len(self))
        columns = super().window_columns(np.arange(first, end))
        return replace(match, columns=WindowColumns(first, columns))

    def _oldest(self, match: Match) -> list[Match]:
        """Return the match of the oldest image, if it had none as the middle and is certain."""
        if self.window_fill < self._window.length or not match.accepted:
            return []
        self._window.note_match()
        path = self._window.match_oldest().path
        status, reason = self._limits.decide(path.distance, path.probability)
        if status is not Status.MATCH:
            return []
        return [
            self._late(self._build(path, self._limits, status, reason, path.probability, True))
        ]

    def newest_row(self) -> np.ndarray:
        """
        Return the distances of the newest image to the places it may be matched with.

        :returns: shape (m,), float32, of the places from ``first`` on; lower is nearer.
        """
        return super().newest_row()[: self._places]

    def _append(self, features: LocalFeatures, stamp: int) -> None:
        """Make the image a place, and count the places that it may be matched with."""
        route, window = self._route, self._window
        if route.count == self._limit:
            evicted = max(1, self._limit // EVICTED)
            route.evict(evicted)
            window.evict(evicted)
            del self._track[:evicted]
            while len(self._recent_stamps) > route.count:
                self._recent_stamps.popleft()
        if route.append(features):
            window.grow(route.room)
        if isinstance(window, FilterWindow):
            window.change.learn_newest(route.latest, route.count)
            window.change.recenter_query(route.latest[:, -2:][:, 0])
        self._recent_stamps.append(stamp)
        self._places = max(0, route.count - max(self._exclude, self._count_young(stamp)))

    def _count_young(self, stamp: int) -> int:
        """Count the latest places, the newest included, that are too young for this stamp."""
        young = self._recent_stamps
        # a place whose stamp is unknown is as old as the one before it
        while young and (not young[0] or (stamp and stamp - young[0] >= self._exclude_ns)):
            young.popleft()
        return len(young) if stamp else 0

    def _distances(self) -> np.ndarray:
        """Return the distances of the newest image to its places; none if they are too few."""
        if self._places < MIN_PLACES:
            return np.empty(0, np.float32)
        return self._matcher.to_oldest(self._route.strips, self._route.newest, self._places)


def least_limit(exclude: int, length: int) -> int:
    """Return the smallest limit: after an eviction, a sequence at twice the speed fits in."""
    return -(-EVICTED * (exclude + 2 * length) // (EVICTED - 1))


def _require_fitting(
    settings: RecognizerSettings, exclude: int, limit: int | None, exclude_seconds: float
) -> None:
    """Reject invalid settings."""
    require_at_least('exclude', exclude, 1, 'image')
    require_at_least('exclude_seconds', exclude_seconds, 0)
    if limit is not None:
        least = least_limit(exclude, settings.sequence.length)
        if limit < least:
            raise SettingsError(
                f'limit = {limit} places leaves too few beyond exclude = {exclude} and windows of '
                f'{settings.sequence.length} images: take at least {least}'
            )
    spatial = settings.applied_spatial
    if not spatial.aligns_strips:
        raise SettingsError(
            f'strategy {spatial.strategy!r}, vertical {spatial.vertical}: '
            'take adaptive, vanilla or rigid, without vertical alignment'
        )
