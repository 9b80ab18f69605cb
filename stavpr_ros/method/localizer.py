# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The chain, image by image (:meth:`PlaceRecognizer.update`).

1. **Light**: the running mean of the query is subtracted, and the rest whitened
   (:class:`stavpr_ros.prepare.centering.MeanCentering`).
2. **Distances** to all places (:mod:`stavpr_ros.prepare.matcher`).
3. **z**: less their mean, by their deviation (:func:`stavpr_ros.prepare.centering.z_normalized`).
4. **Motion**: whether the camera moved, and how much (:class:`.motion.ImageChange`).
5. **Filter**: an image that moved advances the states (:meth:`.filter.Filter.update`).
6. **Place** of the middle image by all of the window
   (:meth:`.filter.Filter.beliefs`, :func:`.path.centered_place`).
7. **Path** through the places of the window (:func:`.path.follow`).
8. **Evidence**: belief, checks of the path, lead, cells, recent windows (:mod:`.evidence`).
9. **Match**: the limits, odometry, and the newest images alone where the window shows nothing
   (:meth:`SequenceRecognizer._match`).

Steps 3 to 8 are in :class:`.window.FilterWindow`; mode paper has :mod:`.lm_dtw_window` instead.
docs/architecture.md has their diagram.
"""

from abc import ABC, abstractmethod
from dataclasses import replace
from functools import partial
import math
from typing import Any, TYPE_CHECKING

import numpy as np
from stavpr_ros.checks import require_type
from stavpr_ros.devices import choose_backend
from stavpr_ros.errors import InputError
from stavpr_ros.features import FeatureSettings, LocalFeatures
from stavpr_ros.features.registry import evidence_of
from stavpr_ros.mapping import Map
from stavpr_ros.mapping.stored_features import StoredFeatures
from stavpr_ros.mapping.trajectory import normalize_pose
from stavpr_ros.method.cells import CellAgreement
from stavpr_ros.method.match import Candidate, Limits, Match, Path, Status, WindowMatch
from stavpr_ros.method.model import EARLY, UNUSUAL
from stavpr_ros.method.relative_motion import (
    Positions,
    RelativeMotion,
    Run,
    with_odometry_test,
)
from stavpr_ros.method.settings import RecognizerSettings
from stavpr_ros.method.window import FilterWindow, QueryWindow
from stavpr_ros.method.windows import time_note, window_of
from stavpr_ros.prepare.blocks import convert_blocks
from stavpr_ros.prepare.matcher import make_matcher
from stavpr_ros.prepare.prepared_map import prepare_map
from stavpr_ros.threads import one_thread

if TYPE_CHECKING:
    import torch

EMPTY = Match(Status.WARMING_UP), WindowMatch().sequences
INT8_PLACES = 2_000  # from which on `auto` is int8: faster, a quarter of the memory
SMALL_MAP = 2**24  # bytes of features, below which a second thread takes as much as it saves


class SequenceRecognizer(ABC):
    """
    Base of the recognizers: the window of a query and its match.

    :param settings: see :class:`RecognizerSettings`.
    :param feature_settings: how the features are made.
    :param window: of the query, empty.
    :param positions: x and y of the places in the window, meters; the path of a match is compared
        with them if the settings require it. Empty = unknown.

    ``problem`` is why places of the map cannot be reached, empty while they can; ``start_notes``
    are of the start, for the log; ``no_places`` is the reason where a window has no places.
    """

    problem = ''
    start_notes = ''
    no_places = 'the map is empty'

    def __init__(
        self,
        settings: RecognizerSettings,
        feature_settings: FeatureSettings,
        window: QueryWindow,
        positions: Positions = (),
    ) -> None:
        self._settings, self._feature_settings = settings, feature_settings
        self.set_limits(settings.threshold, settings.min_probability, settings.max_error)
        self._window = window
        if not settings.compares_odometry:
            positions = ()
        self._motion = RelativeMotion(settings.sequence.length, settings.odometry_error, positions)
        self._newest, self._sequences = EMPTY

    @abstractmethod
    def update(
        self, features: LocalFeatures, stamp: int = 0, pose: np.ndarray | None = None
    ) -> Match:
        """
        Add the next image and match the window that ends with it.

        An error changes nothing.

        :param features: of one image, strips (W, 1, d).
        :param stamp: when it was taken, ns; 0 = unknown.
        :param pose: by odometry, shape (7,), z is up; None = unknown.
        :raises FeatureMismatchError: made with other settings than the places.
        :raises InputError: not one image, features that are not finite, or an invalid pose.
        """

    def reset(self) -> None:
        """Drop the images of the window."""
        self._window.reset()
        self._motion.reset()
        self._newest, self._sequences = EMPTY

    @property
    def window_fill(self) -> int:
        """Return the number of images in the window, up to l."""
        return len(self._window.images)

    @property
    def threshold(self) -> float | None:
        """Return the distance below which a window is matched: as set, or by the map; or None."""
        return None if math.isnan(self._limits.threshold) else self._limits.threshold

    def set_limits(
        self, threshold: float | None, min_probability: float, max_error: float = 0.0
    ) -> None:
        """
        Change the limits from which on a window is matched, for the next images.

        :param threshold, min_probability, max_error: see :class:`RecognizerSettings`.
        :raises SettingsError: out of range.
        """
        self._settings = settings = replace(
            self._settings,
            threshold=threshold,
            min_probability=min_probability,
            max_error=max_error,
        )
        threshold = settings.applied_threshold
        threshold = math.nan if threshold is None else threshold
        self._limits = Limits(threshold, settings.applied_probability)

    def candidates(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """
        Return the nearest places of the newest window, nearest first, each once.

        :returns: places, int64, and the costs of their sequences, at most ``count`` of each.
        """
        costs, places, _ = self._sequences()
        order = np.argsort(costs, kind='stable')
        order = order[np.isfinite(costs[order])]
        _, first = np.unique(places[order], return_index=True)
        order = order[np.sort(first)[:count]]
        return places[order].astype(np.int64), costs[order]

    def ranked(self, count: int, match: Match | None = None) -> list[Candidate]:
        """
        Rank places for the newest window, no two of them neighbors, nearest first.

        The first is the nearest place of the match, accepted or not, with its distance, the second
        its second best.

        :param count: most candidates, at least 0.
        :param match: of the newest window, after a check of it; None = as it was returned.
        :returns: empty while the window has no match and is not full.
        :raises InputError: count below 0.
        """
        match, nearest = match or self._newest, None
        if (place := match.path.place) >= 0:
            nearest = Candidate(place, match.distance, match.probability)
        return self._window.layout.ranked(nearest, self._sequences(), count)

    def newest_row(self) -> np.ndarray:
        """
        Return the distances of the newest image to every place, z-normalized as they are matched.

        :returns: shape (n,), float32; lower is nearer.
        """
        window = self._window
        return window.layout.to_places(window.newest_row())

    def place_probabilities(self) -> np.ndarray:
        """Return the probability of each place for the newest image, (n,); mode paper: none."""
        window = self._window
        if not isinstance(window, FilterWindow):
            return np.empty(0)
        return window.layout.sums_of_places(window.filter.by_place())

    def window_columns(self, places: np.ndarray) -> np.ndarray:
        """
        Return the distances of the images in the window, as :meth:`newest_row`, to certain places.

        Those to other places are not copied.

        :param places: shape (k,), int64.
        :returns: shape (m, k), float32, oldest image first, +inf for places not compared.
        """
        window = self._window
        return window.at(window.layout.columns_of(places - window.first))

    def _require_one_image(self, features: Any, where: str, dimension: int) -> None:
        expected = 'the LocalFeatures of one image, as of place_map.extractor().extract([image])'
        require_type('features', features, LocalFeatures, expected)
        features.require_fit(self._feature_settings, where, dimension)
        if (count := features.strips.shape[1]) != 1:
            raise InputError(f'features of {count} images: expected one image')
        require_finite(features, 'the image')

    def _match(self, odometry_xy: np.ndarray) -> Match:
        """Match the window and, where it shows nothing, its newest images; NaN = no odometry."""
        window, run = self._window, None
        self._motion.trajectory.append(odometry_xy)
        fill, shown = len(window.images), WindowMatch()
        if fill == window.length:
            window.assess()
            shown = window.match()
            match, run = self._decide(shown.path, self._limits)
        else:
            reason = f'{fill} of {window.length} images in the window'
            match = self._build(shown.path, self._limits, Status.WARMING_UP, reason)
        runs = [run]
        if match.status is not Status.MATCH:
            newest = window.match_newest()
            if newest.path.place >= 0:
                early, run = self._decide(newest.path, self._limits.with_min_probability(EARLY))
                runs.append(run)
                match, shown = (early, newest) if early.accepted else (match, shown)
        # of the first match that images accept; the other one is no other image
        runs.sort(key=lambda run: run is None or run[-1] < 0)
        self._motion.run = runs[0] or self._motion.run
        self._newest, self._sequences = match, shown.sequences
        return match

    def _decide(self, path: Path, limits: Limits) -> tuple[Match, Run | None]:
        """Decide on a path by the limits and by odometry; return the run with it, if compared."""
        if path.place < 0:
            return self._build(path, limits, Status.NO_MATCH, self.no_places), None
        probability, run = path.probability, None
        status, reason = limits.decide(path.distance, probability)
        if len(self._motion.positions) and np.isfinite(self._motion.trajectory[-1][0]):
            accepted, layout = status is Status.MATCH, self._window.layout
            session = layout.session_of(path.place)
            agreed, run = self._motion.agreement(path, accepted, self._window.first, session)
            if agreed < UNUSUAL:
                probability = with_odometry_test(probability, agreed)
                status, reason = limits.decide(1 - probability, probability)
                if accepted and status is not Status.MATCH:
                    reason += ': odometry disagrees with its path'
        return self._build(path, limits, status, reason, probability), run

    def _build(
        self,
        path: Path,
        limits: Limits,
        status: Status,
        reason: str,
        probability: float = math.nan,
        is_oldest: bool = False,
    ) -> Match:
        """Build a match of the images of a path, or of the window."""
        images = self._window.images
        if len(path.pairs):
            images = images[-1 - int(path.pairs[-1, 0]) :]
        has_changes = isinstance(self._window, FilterWindow)
        changes = images['change'] if has_changes else images['change'][:0]
        return Match(
            status,
            reason,
            limits,
            path,
            probability,
            window_stamps=tuple(images['stamp'].tolist()),
            window_changes=tuple(changes.tolist()),
            first_image=self._first_image(len(images)),
            is_oldest=is_oldest,
        )

    def _first_image(self, images: int) -> int:
        """Return the place that the first of the newest images has become; -1 = none."""
        return -1


class PlaceRecognizer(SequenceRecognizer):
    """
    Recognizer of the places of one map, one image at a time.

    The matcher has features of its own, unless they are the map's unchanged (float32, without
    mean centering, on the CPU): then both share the memory. Of a map of
    :func:`stavpr_ros.mapping.open_map`, only the matcher's features are in memory.

    :param place_map: the reference map.
    :param settings: see :class:`RecognizerSettings`.
    :param backend: ``cpu``, ``cuda``, ``auto``, or any device of torch, for mode paper and the
        place filter: :func:`stavpr_ros.devices.choose_backend`.
    :param precision: of the map's features in the matcher, ``float32`` or ``int8``
        (:func:`stavpr_ros.prepare.matcher.make_matcher`); ``auto`` = ``int8`` on the CPU in mode
        robust for 2,000 places and more.
    :raises UnavailableError: no such backend here.
    :raises SettingsError: settings that do not fit the map (xi > W).
    :raises InputError: features of the map are not finite, or an argument of another type.
    """

    def __init__(
        self,
        place_map: Map,
        settings: RecognizerSettings,
        backend: 'str | torch.device' = 'cpu',
        precision: str = 'auto',
    ) -> None:
        maps, expected = 'Map.load(path) or Map.from_images(source)', 'RecognizerSettings(...)'
        require_type('place_map', place_map, Map, maps)
        require_type('settings', settings, RecognizerSettings, expected)
        backend = choose_backend(backend)
        settings = replace(settings, error_risks=place_map.error_risks)
        features, options = place_map.features, settings.applied_options
        kind, strips = place_map.settings.kind, place_map.settings.strips
        constant, cells = evidence_of(kind, strips, features.dimension)
        self._suggested = place_map.threshold
        poses = place_map.poses if place_map.has_poses else None
        super().__init__(
            settings,
            place_map.settings,
            window_of(place_map, settings, backend, constant),
            () if poses is None else poses[:, :2],
        )
        if not isinstance(features, StoredFeatures):  # these are checked whenever they are read
            features.require_fit(place_map.settings, 'the map', features.dimension)
            for _ in convert_blocks(features, partial(require_finite, where='the map')):
                pass
        self._dimension = features.dimension
        is_vertical = settings.applied_spatial.vertical  # cells are made of float32 strips
        if precision == 'auto' and settings.has_probability and backend == 'cpu':
            precision = 'int8' if len(features) >= INT8_PLACES else 'float32'
        precision = 'float32' if is_vertical or precision == 'auto' else precision
        prepared = prepare_map(
            features, precision, options.mean_centering, options.whitening, options.place_filter
        )
        self._centering = prepared.centering
        self._matcher = make_matcher(
            prepared.features, settings.applied_spatial, backend, precision
        )
        numbers = strips * len(features) * self._dimension
        self._is_small = numbers * (1 if precision == 'int8' else 4) < SMALL_MAP
        if isinstance(self._window, FilterWindow):
            layout = self._window.layout
            self._window.change.learn(prepared.changes, layout.starts, layout.changes_from_before)
            if cells is not None:
                of_places, names_of = self._matcher.strips_of, layout.names_of
                is_plain = layout.columns is None  # columns are places
                strips_of = of_places if is_plain else lambda columns: of_places(names_of(columns))
                self._window.cells = CellAgreement(cells, strips_of, settings.sequence.length)
        # of the start, for the log: statistics that were learned again, an error rate that is not
        # kept, and the time of several sessions
        notes = prepared.note, settings.calibration_warning, time_note(place_map)
        self.start_notes = '; '.join(filter(None, notes))

    def set_limits(
        self, threshold: float | None, min_probability: float, max_error: float = 0.0
    ) -> None:
        """
        Change the limits; without a threshold, mode paper takes the map's.

        :raises SettingsError: out of range.
        """
        if threshold is None and not self._settings.has_probability:
            threshold = self._suggested
        super().set_limits(threshold, min_probability, max_error)

    @property
    def is_standstill(self) -> bool:
        """Return whether the newest image equals the one before, up to noise."""
        return self._window.is_standstill

    @property
    def places(self) -> int:
        """Return the number of places n of the map."""
        return self._matcher.places

    def reset(self) -> None:
        """Drop the images of the window, and the running statistics of the query."""
        super().reset()
        if self._centering is not None:
            self._centering.reset()

    def distances(self, features: LocalFeatures) -> np.ndarray:
        """
        Return the distances of images to every place; centered, if at all, by the map's mean.

        :param features: of Q images, strips (W, Q, d), made with the settings of the map.
        :returns: shape (Q, n), float32.
        :raises FeatureMismatchError: made with other settings.
        :raises InputError: features that are not finite.
        """
        features.require_fit(self._feature_settings, 'the map', self._dimension)
        require_finite(features, 'the image')
        if self._centering is not None:
            features = self._centering.places(features)
        return self._matcher.distance_matrix(features.strips, features.weights)

    def update(
        self, features: LocalFeatures, stamp: int = 0, pose: np.ndarray | None = None
    ) -> Match:
        """See :meth:`SequenceRecognizer.update`."""
        odometry_xy = position_of(pose)
        self._require_one_image(features, 'the map', self._dimension)
        strips, weights = features.strips[:, 0], features.weights[:, 0]
        if self._centering is not None:
            strips = self._centering.next_query(strips)
        with one_thread(self._is_small):
            distances = self._matcher.distances(strips, weights)
            self._window.push(distances, strips, stamp)
        if self._centering is not None:
            self._centering.note_standstill(self._window.is_standstill)
        return self._match(odometry_xy)


def position_of(pose: np.ndarray | None) -> np.ndarray:
    """
    Return x and y of a pose, (2,); NaN of none.

    :raises InputError: an invalid pose.
    """
    return np.full(2, np.nan) if pose is None else normalize_pose(pose)[:2]


def require_finite(features: LocalFeatures, where: str) -> None:
    """Reject NaN and infinite numbers, which no sum of unit-norm features hides."""
    if not math.isfinite(features.strips.sum()):
        raise InputError(f'features of {where} are not finite: they are damaged')
