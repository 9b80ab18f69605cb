"""Loop closure: the map is the route so far, without its latest images."""

import math
from collections import deque
from dataclasses import replace

import numpy as np
import torch

from stavpr_ros.alignment.cpu import dot
from stavpr_ros.alignment.similarity import tiled
from stavpr_ros.alignment.spatial import adaptive_weights
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.features import FeatureSettings, LocalFeatures
from stavpr_ros.recognition.match import Match, Status
from stavpr_ros.recognition.recognizer import (
    RecognizerSettings,
    WindowAnswers,
    answer,
    require_finite,
)
from stavpr_ros.recognition.robust.options import Track
from stavpr_ros.recognition.robust.window import CalibratedWindow

ROOM = 256  # images that there is room for at first; doubled when they are full
GROWTH = 1.125
FORGOTTEN = 8  # the oldest one in so many is forgotten at a time
LEAST_PLACES = 5  # fewer distances have no mean and deviation worth the name
PIECE = 512  # images centered at a time: what is in between stays in the cache


class LoopCloser(WindowAnswers):
    """
    Recognizes places that the same drive has passed before, one image at a time.

    Every image becomes a place; an image is compared with those that came at least ``exclude`` images and
    ``exclude_seconds`` before it. Growing costs no rebuild: memory doubles when it is full, and the mean that
    is taken off the features (option ``mean_centering``) is brought up to date when the route is an eighth longer.

    With a ``limit``, the oldest eighth of the places is forgotten whenever there are so many. Places are
    numbered from the start of the route all the same: a number never comes to mean another image.

    :param settings: strategies ``adaptive`` and ``vanilla``.
    :param exclude: the latest images that are not part of the map, at least 1.
    :param feature_settings: how the features are made.
    :param limit: most places kept; None for all. It must leave room for more than what is excluded.
    :param exclude_seconds: places younger than so many seconds are not part of the map either.
    :raises SettingsError: settings that do not do.
    """

    _window: CalibratedWindow

    def __init__(
        self,
        settings: RecognizerSettings,
        exclude: int,
        feature_settings: FeatureSettings,
        limit: int | None = None,
        exclude_seconds: float = 0.0,
    ) -> None:
        _require_fitting(settings, exclude, limit, exclude_seconds)
        W = feature_settings.strips
        self._settings, self._exclude, self._feature_settings = settings, exclude, feature_settings
        self._limit, self._exclude_ns = limit, round(exclude_seconds * 1e9)
        self._band = settings.spatial.band(W)
        self._a = adaptive_weights(W, settings.spatial, np.dtype(np.float32))
        self._route = _Route(settings.applied_options.mean_centering, limit)
        self._window = CalibratedWindow(0, settings.sequence, settings.applied_options)
        self._track = Track()
        self._young: deque[int] = deque()  # stamps of the latest places, not yet old enough in seconds
        self._places = 0  # kept places that the newest image may be matched with: the oldest so many
        self._nearest = None

    def __len__(self) -> int:
        """Count the places that are kept; ``first + len`` images have come."""
        return self._route.count

    @property
    def first(self) -> int:
        """The oldest place that is kept: so many are forgotten."""
        return self._window.first

    @property
    def limit(self) -> int | None:
        """Most places that are kept, None for all."""
        return self._limit

    def reset(self) -> None:
        """
        Begin a new window: the clock jumped, or the robot was carried elsewhere. The route stays.

        Places before the reset count as old enough in seconds, since stamps cannot be compared over a jump.
        """
        self._window.clear()
        self._track = Track()
        self._young.clear()
        self._nearest = None

    def update(self, features: LocalFeatures, stamp: int = 0) -> Match:
        """
        Take in the next image and answer for the window that ends with it; places are earlier images.

        An error leaves everything as it was.

        :param features: those of one image, strips (W, 1, d).
        :param stamp: when it was taken, ns; 0 = unknown: it is then excluded by the count of images alone.
        :raises FeatureMismatchError: made with other settings.
        :raises InputError: not one image, or features that are not finite.
        """
        features.require_same_settings(self._feature_settings, 'the route so far')
        if len(features) != 1:
            raise InputError(f'features of {len(features)} images came: expected those of one')
        require_finite(features, 'the image')
        self._keep(features.strips.cpu(), stamp)
        self._window.push(torch.from_numpy(self._distances()))
        match = answer(self._window, self._settings, self._track)
        self._nearest = match.sequence
        if match.status is Status.NO_MATCH and match.sequence is None:
            return replace(match, reason='no earlier place is old enough to be matched with')
        return match

    def newest_row(self) -> np.ndarray:
        """
        Distances of the newest image to all places that it may be matched with, as they are matched.

        :returns: shape (m,), float32, of the places from ``first`` on; lower is nearer.
        """
        return self._window.newest_row()[: self._places]

    def _keep(self, strips: torch.Tensor, stamp: int) -> None:
        """Make the image a place, and say how many places it may be matched with."""
        route = self._route
        if route.count == self._limit:
            forgotten = max(1, self._limit // FORGOTTEN)
            route.forget(forgotten)
            self._window.forget(forgotten)
            while len(self._young) > route.count:
                self._young.popleft()
        if route.append(strips):
            self._window.grow(route.room)
        self._young.append(stamp)
        self._places = max(0, route.count - max(self._exclude, self._count_young(stamp)))

    def _count_young(self, stamp: int) -> int:
        """Count the latest places, the newest included, that are too young for an image of this stamp."""
        young = self._young
        # a place whose stamp is unknown is as old as the one before it
        while young and (not young[0] or (stamp and stamp - young[0] >= self._exclude_ns)):
            young.popleft()
        return len(young) if stamp else 0

    def _distances(self) -> np.ndarray:
        """Distances of the newest image to the places it may be matched with; none while they are few."""
        if self._places < LEAST_PLACES:
            return np.empty(0, np.float32)
        out = np.empty((1, self._places), np.float32)
        dot.image_distances(
            self._route.strips.numpy(), tiled(self._route.newest), self._a, self._band, out
        )
        return out[0]


class _Route:
    """
    Features of the places that are kept, less their mean if that is wanted, unit norm.

    With the norm before it was made 1, features give back what came: nothing is kept twice.

    :param mean_centering: take the mean off.
    :param limit: most places there will be.
    """

    def __init__(self, mean_centering: bool, limit: int | None) -> None:
        self._centering, self._limit = mean_centering, limit
        self.count, self._next_mean = 0, 1
        self.strips = torch.empty((0, 0, 0))  # (W, room, d)
        self._norms = torch.empty((0, 0))  # (W, room): that of a feature less the mean; 0 for zero features
        self._sum = self._mean = torch.empty((0, 0))  # of the features as they came, (W, d)

    @property
    def room(self) -> int:
        """Places that there is room for."""
        return self.strips.shape[1]

    @property
    def newest(self) -> torch.Tensor:
        """Features of the newest place, (W, 1, d)."""
        return self.strips[:, self.count - 1 : self.count]

    def append(self, strips: torch.Tensor) -> bool:
        """Take in the features of one image, (W, 1, d); True if more room was made for it."""
        grows = self.count == self.room
        if grows:
            self._grow(strips)
        self.strips[:, self.count] = strips[:, 0]
        self._norms[:, self.count] = strips[:, 0].any(dim=1)
        self.count += 1
        if self._centering:
            self._sum += strips[:, 0]
            self._center(self.count - 1, self.count - 1, -self._mean)
            if self.count >= self._next_mean:
                self._move_mean(0)
                self._next_mean = int(self.count * GROWTH) + 1
        return grows

    def forget(self, count: int) -> None:
        """Forget the oldest places; the mean is that of the others then, until the next are forgotten."""
        if self._centering:
            self._take_off_sum(count)
            self.count -= count
            self._move_mean(count)
            self._next_mean = self.count + count + 1
            return
        for first in range(count, self.count, count):
            last = min(first + count, self.count)
            self.strips[:, first - count : last - count] = self.strips[:, first:last]
        self.count -= count

    def _grow(self, strips: torch.Tensor) -> None:
        """Double the room; memory that is not used yet is not touched."""
        W, _, d = strips.shape
        room = max(ROOM, 2 * self.room)
        room = room if self._limit is None else min(room, self._limit)
        grown, norms = torch.empty((W, room, d)), torch.empty((W, room))
        if self.count:
            grown[:, : self.count], norms[:, : self.count] = self.strips, self._norms
        else:
            self._sum, self._mean = torch.zeros((W, d), dtype=torch.float64), torch.zeros((W, d))
        self.strips, self._norms = grown, norms

    def _take_off_sum(self, count: int) -> None:
        """Take the oldest places' features, as they came, out of the sum."""
        for j in range(len(self.strips)):
            for low in range(0, count, PIECE):
                piece = slice(low, min(low + PIECE, count))
                norms = self._norms[j, piece]
                self._sum[j] -= norms @ self.strips[j, piece] + (norms > 0).sum() * self._mean[j]

    def _move_mean(self, first: int) -> None:
        """Take the mean of now off instead of the one before; places from ``first`` on become the first."""
        mean = (self._sum / self.count).float()
        self._center(first, 0, self._mean - mean)
        self._mean = mean

    def _center(self, first: int, to: int, change: torch.Tensor) -> None:
        """
        Add to features, and make them unit norm again; zero features stay zero.

        :param first: place from which on; the last one ends up as the last of ``count``.
        :param to: place where they are laid down, at most ``first``.
        :param change: shape (W, d).
        """
        for j in range(len(self.strips)):
            strips, norms = self.strips[j], self._norms[j]
            for low in range(to, self.count, PIECE):
                high = min(low + PIECE, self.count)
                source, target = slice(low + first - to, high + first - to), slice(low, high)
                alive = norms[source, None] > 0
                moved = strips[source] * norms[source, None]
                moved += change[j]
                moved *= alive
                length = moved.norm(dim=1, keepdim=True).clamp_(min=1e-12)
                torch.div(moved, length, out=strips[target])
                norms[target] = (length * alive)[:, 0]


def least_limit(exclude: int, length: int) -> int:
    """Return the fewest places that do: after forgetting, a window's sequence at twice its speed fits in."""
    return -(-FORGOTTEN * (exclude + 2 * length) // (FORGOTTEN - 1))


def _require_fitting(
    settings: RecognizerSettings, exclude: int, limit: int | None, exclude_seconds: float
) -> None:
    """Refuse settings that do not do."""
    if exclude < 1:
        raise SettingsError(f'exclude = {exclude} must be at least 1 image')
    if not (math.isfinite(exclude_seconds) and exclude_seconds >= 0):
        raise SettingsError(f'exclude_seconds = {exclude_seconds} must be a finite number >= 0')
    if limit is not None:
        # what is left after forgetting must hold the window's sequence at twice its speed
        least = least_limit(exclude, settings.sequence.length)
        if limit < least:
            raise SettingsError(
                f'limit = {limit} places leaves too few beyond exclude = {exclude} and windows of '
                f'{settings.sequence.length} images: take at least {least}'
            )
    if settings.spatial.strategy not in ('adaptive', 'vanilla') or settings.spatial.vertical:
        raise SettingsError(
            f'strategy {settings.spatial.strategy!r}, vertical {settings.spatial.vertical}: '
            'take adaptive or vanilla, without vertical alignment'
        )
    robust_options = settings.applied_options
    if robust_options.reference_znorm and not robust_options.query_znorm:
        raise SettingsError(
            'reference_znorm without query_znorm: a new place starts at mean 0 and deviation 1, '
            'which says nothing of distances as they are; take both or neither'
        )
