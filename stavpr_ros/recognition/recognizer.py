# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Frame by frame: distances of the newest image, nearest sequence of the window, status."""

from abc import ABC, abstractmethod
from collections import deque
from dataclasses import replace
import math
import time
from typing import TYPE_CHECKING

import numpy as np
from stavpr_ros.alignment.lm_dtw import SequenceMatch
from stavpr_ros.devices import choose_backend
from stavpr_ros.errors import FeatureMismatchError, InputError, SettingsError
from stavpr_ros.features import FeatureSettings, LocalFeatures
from stavpr_ros.mapping import PlaceMap
from stavpr_ros.mapping.stored_features import StoredFeatures
from stavpr_ros.mapping.trajectory import checked_pose
from stavpr_ros.recognition.blocks import blocks
from stavpr_ros.recognition.held_map import hold
from stavpr_ros.recognition.int8_features import Int8Features
from stavpr_ros.recognition.lm_dtw_search import LmDtwSearch
from stavpr_ros.recognition.match import (
    Candidate,
    distinct_places,
    improbable,
    Match,
    ranked_candidates,
    Status,
)
from stavpr_ros.recognition.matcher import make_matcher
from stavpr_ros.recognition.relative_motion import Positions, RelativeMotion
from stavpr_ros.recognition.robust import FilterSettings, MeanCentering, z_normalized
from stavpr_ros.recognition.sequence_search import (
    FilterSearch,
    Search,
    SequenceBuffer,
    WindowMatch,
)
from stavpr_ros.recognition.sessions import layout_of, SessionLayout
from stavpr_ros.recognition.settings import RecognizerSettings
import torch

if TYPE_CHECKING:
    from stavpr_ros.recognition.first_stage import FirstStage

TIMED = 3  # images, to compare the time of one with the time budget


class SequenceRecognizer(ABC):
    """
    The window of a query and its match; base of :class:`PlaceRecognizer` and ``LoopCloser``.

    :param settings: see :class:`RecognizerSettings`.
    :param feature_settings: how the features are made.
    :param places: number of places n.
    :param layout: of a map of several sessions.
    :param to_oldest: see :class:`stavpr_ros.recognition.sequence_search.FilterSearch`.
    :param model: of the filter.
    :param backend: where the window and the filter are, ``cpu`` or ``cuda``; without a filter, on
        the CPU.

    ``problem`` is why places of the map cannot be reached, empty while they can; ``stages`` what
    a time budget chose, empty without one.
    """

    problem = ''
    stages = ''
    _around = 0  # see z_normalized

    def __init__(
        self,
        settings: RecognizerSettings,
        feature_settings: FeatureSettings,
        places: int,
        layout: SessionLayout | None = None,
        to_oldest: bool = False,
        model: FilterSettings | None = None,
        backend: str = 'cpu',
    ) -> None:
        sequence = settings.sequence
        self._settings, self._feature_settings = settings, feature_settings
        self._options = settings.applied_options
        self._layout = layout
        columns = places if layout is None else layout.width
        on_device = backend == 'cuda' and self._options.place_filter
        device = torch.device('cpu')
        if on_device:
            from stavpr_ros.alignment.cuda.compilation import runtime

            device = runtime().torch_device
        copies = 1 if self._options.place_filter else 2
        self._buffer = SequenceBuffer(
            sequence.length, columns, sequence.k, device=device, copies=copies
        )
        self._filter = None
        if self._options.place_filter:
            self._filter = FilterSearch(self._buffer, model, layout, to_oldest, on_device)
        self._search: Search = self._filter or LmDtwSearch(self._buffer)
        # x and y of each place, or of the places held; empty = unknown
        self._positions: Positions = ()
        self._motion: RelativeMotion | None = None
        self._window = WindowMatch()  # of the newest image
        self._nearest: SequenceMatch | None = None
        self._changes: deque[float] = deque(maxlen=sequence.length)  # of the window

    @abstractmethod
    def update(
        self, features: LocalFeatures, stamp: int = 0, pose: np.ndarray | None = None
    ) -> Match:
        """
        Add the next image and match the window that ends with it.

        An error leaves everything as it was.

        :param features: those of one image, strips (W, 1, d).
        :param stamp: when it was taken, ns; 0 = unknown.
        :param pose: by odometry, shape (7,), z is up; None = unknown.
        :raises FeatureMismatchError: made with other settings than the places.
        :raises InputError: not one image, features that are not finite, or an invalid pose.
        """

    @abstractmethod
    def reset(self) -> None:
        """Drop the images of the window."""

    @property
    def window_fill(self) -> int:
        """Images in the window, up to l."""
        return len(self._buffer)

    def set_threshold(self, threshold: float) -> None:
        """
        Change the threshold from the next image on.

        :raises SettingsError: not above 0.
        """
        self._settings = replace(self._settings, threshold=threshold)

    def candidates(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """
        Return the nearest places of the newest window, nearest first, each once.

        :returns: places, int64, and the costs of their sequences, at most ``count`` of each.
        """
        return distinct_places(*self._window.sequences(), count)

    def ranked(self, count: int) -> list[Candidate]:
        """
        Rank places for the newest window, no two of them neighbors, nearest first.

        The first is the nearest place of the match, accepted or not, with its distance, the second
        its second best.

        :param count: most candidates, at least 0.
        :returns: none before the first full window.
        :raises InputError: count below 0.
        """
        settings = self._settings
        return ranked_candidates(
            self._nearest,
            self._window.sequences(),
            count,
            settings.nms_radius,
            *(() if self._layout is None else (self._layout.positions,)),
        )

    def newest_row(self) -> np.ndarray:
        """
        Return the distances of the newest image to every place, z-normalized as they are matched.

        :returns: shape (n,), float32; lower is nearer.
        """
        row = self._buffer.newest().cpu().numpy()
        return row if self._layout is None else row[self._layout.columns]

    def window_columns(self, places: np.ndarray) -> np.ndarray:
        """
        Return the distances of the images in the window, as :meth:`newest_row`, to some places.

        Those to other places are not copied.

        :param places: shape (k,), int64.
        :returns: shape (m, k), float32, oldest image first, +inf for places not compared.
        """
        columns = places - self._buffer.first
        if self._layout is not None:
            columns = self._layout.columns[columns]
        return self._buffer.at(columns[None])[self._buffer.length - len(self._buffer) :]

    def _clear_window(self) -> None:
        self._buffer.clear()
        if self._filter is not None:
            self._filter.reset()
        if self._motion is not None:
            self._motion.reset()
        self._window, self._nearest = WindowMatch(), None
        self._changes.clear()

    def _require_one_image(self, features: LocalFeatures, where: str) -> None:
        features.require_same_settings(self._feature_settings, where)
        if len(features) != 1:
            raise InputError(f'features of {len(features)} images came: expected those of one')
        require_finite(features, 'the image')

    def _match(
        self, row: torch.Tensor, strips: torch.Tensor, stamp: int, position: np.ndarray
    ) -> Match:
        """
        Push the distances of the newest image; match the window, if it is full.

        :param strips: the image's features, centered, shape (W, d).
        :param position: of the image by odometry, (2,).
        """
        on_device = self._filter is not None and self._filter.on_device
        if self._options.query_znorm:
            row = self._z_normalized(row, on_device)
        if self._layout is not None:
            row = self._layout.spread(row)
        self._buffer.push(row.to(self._buffer.memory.device), stamp)
        if self._motion is not None:
            self._motion.way.append(position)
        if self._filter is not None:
            change = self._filter.change.next_query(strips.cpu().numpy())
            self._filter.update(row if on_device else row.cpu().numpy(), change)
            self._changes.append(change)
        return self._compared(self._match_window(), position)

    def _enable_odometry_check(self, positions: Positions) -> None:
        """Compare matches with odometry, if odometry_error > 0, by the positions of places."""
        error, length = self._settings.odometry_error, self._settings.sequence.length
        if error and self._filter is not None:
            self._positions, self._motion = positions, RelativeMotion(length, error)

    def _compared(self, match: Match, position: np.ndarray) -> Match:
        """Return a match of the window, less probable if odometry disagrees with its path."""
        if not (self._motion is None or match.sequence is None or np.isnan(position[0])):
            first = self._buffer.first
            session = first, first + len(self._positions)
            if self._layout is not None:
                session = self._layout.session_of(match.sequence.middle)
            match = self._motion.compared(match, self._positions, first, session)
        self._nearest = match.sequence
        return replace(
            match, window_stamps=self._buffer.stamps, window_changes=tuple(self._changes)
        )

    def _z_normalized(self, row: torch.Tensor, on_device: bool) -> torch.Tensor:
        """Return the row, z-normalized in each session by the places that count."""
        n = len(row)
        counted = np.ones(n, bool) if self._filter is None else self._filter.change.distinct(n)
        runs = [slice(None)] if self._layout is None else self._layout.runs
        around = self._around
        if on_device:
            from stavpr_ros.recognition.cuda_filter import z_normalized_on_device

            known = torch.from_numpy(counted).to(row.device)
            return torch.cat([z_normalized_on_device(row[i], around, known[i]) for i in runs])
        values = row.cpu().numpy()
        return torch.from_numpy(
            np.concatenate([z_normalized(values[i], around, counted[i]) for i in runs])
        )

    def _match_window(self) -> Match:
        threshold, length = self._settings.threshold, self._settings.sequence.length
        if not self._buffer.full:
            reason = f'{len(self._buffer)} of {length} images in the window'
            return Match(Status.WARMING_UP, reason, threshold)
        self._window = self._search(self._settings.nms_radius)
        window = self._window
        if self._layout is not None and window.nearest is not None:
            in_places = self._layout.in_places(window.nearest, window.path, window.sequences)
            self._window = WindowMatch(*in_places, window.shares)
        self._nearest = nearest = self._window.nearest
        if nearest is None:
            return Match(Status.NO_MATCH, 'the map is empty', threshold)
        relative = self._filter is not None
        probability = 1 - nearest.distance if relative else math.nan
        status, reason = Status.MATCH, ''
        if not nearest.distance < threshold:
            status = Status.NO_MATCH
            reason = (
                improbable(probability, threshold)
                if relative
                else f'nearest distance {nearest.distance:.4f} is not below the threshold '
                f'{threshold:.4f}'
            )
        path, ratios = self._window.path, self._window.path_ratios((length - 1) // 2)
        return Match(status, reason, threshold, nearest, path, relative, probability, ratios)


class PlaceRecognizer(SequenceRecognizer):
    """
    Recognizes places of one map, one image at a time.

    The matcher holds features of its own, unless they are the map's unchanged (float32, without
    mean centering, on the CPU): then both share the memory. For a map of
    :func:`stavpr_ros.mapping.open_map`, the matcher's are the only ones in memory.

    :param place_map: the reference map.
    :param settings: see :class:`RecognizerSettings`.
    :param backend: where it is computed: ``cpu``, ``cuda``, or ``auto``. On ``cuda``, mode robust
        requires its place filter; of other options, LM-DTW runs on the CPU.
    :param precision: of the map's features in the matcher, ``float32`` or ``int8``; see
        :func:`stavpr_ros.recognition.matcher.make_matcher`.
    :raises UnavailableError: no such backend here.
    :raises SettingsError: settings that do not fit the map (xi > W).
    :raises InputError: features of the map are not finite.
    """

    def __init__(
        self,
        place_map: PlaceMap,
        settings: RecognizerSettings,
        backend: str = 'cpu',
        precision: str = 'float32',
    ) -> None:
        backend = choose_backend(backend)
        layout = layout_of(place_map, settings.nms_radius)
        super().__init__(settings, place_map.settings, len(place_map), layout, backend=backend)
        if place_map.poses is not None and place_map.has_poses:
            self._enable_odometry_check(place_map.poses[:, :2])
        features = place_map.features
        if not isinstance(features, StoredFeatures):  # these are checked whenever they are read
            for _, some in blocks(features):
                require_finite(some, 'the map')
        self._dimension = features.dimension
        # cells are made of float32 strips
        held_map = hold(
            features, self._options, 'float32' if settings.spatial.vertical else precision
        )
        self._centering, held = held_map.centering, held_map.features
        self._matcher = make_matcher(held, settings.spatial, backend, precision)
        if self._filter is not None:
            firsts = (0,) if layout is None else layout.firsts
            self._filter.change.learn(held_map.changes, firsts)
        if backend == 'cuda' and not self._options.any:
            from stavpr_ros.recognition.cuda_search import CudaLmDtwSearch

            search = CudaLmDtwSearch(self._buffer.places, settings.sequence)
            self._search, self._buffer = search, search.buffer
        # where a first stage compares vectors of whole images: it, and their centering
        self._vectors: tuple[FirstStage, MeanCentering] | None = None
        # of the start, for the log: statistics that were learned again, and the time budget
        self.stages = held_map.note
        if settings.time_budget_ms and len(features):
            if backend == 'cuda':
                raise SettingsError(
                    f"time_budget_ms = {settings.time_budget_ms} with backend 'cuda': the first "
                    "stage is of backend 'cpu'; take that, or 0"
                )
            self._keep_time_budget(held, features)

    def _keep_time_budget(
        self, held: LocalFeatures | Int8Features, features: LocalFeatures
    ) -> None:
        image, options = features[:1], self._options
        budget, exact = self._settings.time_budget_ms, self._milliseconds(image)
        text = f'exact matching takes {exact:.3g} ms an image, time_budget_ms = {budget:g}'
        if exact > budget:
            from stavpr_ros.recognition.cpu_matcher import CpuMatcher
            from stavpr_ros.recognition.first_stage import FirstStage

            assert isinstance(self._matcher, CpuMatcher)
            if (vectors := features.vectors) is not None:
                whole = LocalFeatures(
                    vectors[None], torch.ones(1, len(vectors)), features.settings
                )
                centering = MeanCentering(whole, options.mean_centering, options.whitening)
                held = centering.places(whole)
                require_finite(held, 'the map')
            self._matcher = stage = FirstStage(self._matcher, held, self._probable_places)
            if vectors is not None:
                self._vectors = stage, centering
            of = ' of vectors' if self._vectors is not None else ''
            text += f': with a first stage{of} {self._milliseconds(image):.3g} ms'
        self.stages = '; '.join(filter(None, [self.stages, text]))

    def _milliseconds(self, image: LocalFeatures) -> float:
        """Return the least time of a few updates by an image, after one that compiles."""
        self.reset()
        seconds = []
        for _ in range(1 + TIMED):
            began = time.perf_counter()
            self.update(image)
            seconds.append(time.perf_counter() - began)
        self.reset()
        return 1e3 * min(seconds[1:])

    def _probable_places(self) -> np.ndarray:
        """Return the first places of the most probable blocks of the filter."""
        assert self._filter is not None
        columns = self._filter.filter.probable_blocks()
        return columns if self._layout is None else self._layout.columns.searchsorted(columns)

    @property
    def places(self) -> int:
        """Return the number of places n of the map."""
        return self._matcher.places

    def reset(self) -> None:
        """Drop the images of the window, and the running statistics of the query."""
        self._clear_window()
        for centering in self._centerings:
            centering.reset()

    @property
    def _centerings(self) -> list[MeanCentering]:
        """Return the running means of the query."""
        own = [] if self._centering is None else [self._centering]
        return own if self._vectors is None else [*own, self._vectors[1]]

    def distances(self, features: LocalFeatures) -> np.ndarray:
        """
        Return the distances of images to every place; centered, if at all, by the map's mean.

        :param features: those of Q images, strips (W, Q, d), made with the settings of the map.
        :returns: shape (Q, n), float32.
        :raises FeatureMismatchError: made with other settings.
        :raises InputError: features that are not finite.
        """
        features.require_same_settings(self._feature_settings, 'the map')
        self._require_dimension(features)
        require_finite(features, 'the image')
        if self._centering is not None:
            features = self._centering.places(features)
        return self._matcher.distance_matrix(features.strips, features.weights).cpu().numpy()

    def _require_dimension(self, features: LocalFeatures) -> None:
        """Reject what a map states wrongly about its network; the kernels trust it."""
        if features.dimension != self._dimension:
            raise FeatureMismatchError(
                f'strips of {features.dimension} dimensions, the map has {self._dimension}: it '
                'was not made with this network; build it again'
            )
        if features.vectors is None and self._vectors is not None:
            raise FeatureMismatchError(
                'features without a vector of the whole image, the map has them: extract the '
                'query with the settings of the map'
            )

    def update(
        self, features: LocalFeatures, stamp: int = 0, pose: np.ndarray | None = None
    ) -> Match:
        """See :meth:`SequenceRecognizer.update`."""
        position = position_of(pose)
        self._require_one_image(features, 'the map')
        self._require_dimension(features)
        strips = features.strips[:, 0]
        if self._centering is not None:
            strips = self._centering.next_query(strips)
        weights = features.weights[:, 0]
        if self._vectors is None or features.vectors is None:
            row = self._matcher.distances(strips, weights)
        else:
            stage, centering = self._vectors
            row = stage.distances(strips, weights, centering.next_query(features.vectors))
        match = self._match(row, strips, stamp, position)
        if self._filter is not None:
            is_standing = self._filter.change.is_standstill(self._changes[-1])
            for centering in self._centerings:
                centering.note_standstill(is_standing)
        return match


def position_of(pose: np.ndarray | None) -> np.ndarray:
    """
    Return x and y of a pose, (2,); NaN of none.

    :raises InputError: an invalid pose.
    """
    return np.full(2, np.nan) if pose is None else checked_pose(pose)[:2]


def require_finite(features: LocalFeatures, where: str) -> None:
    """Reject NaN and infinite numbers, which no sum of unit-norm features hides."""
    if not math.isfinite(features.strips.sum()):
        raise InputError(f'features of {where} are not finite: they are damaged')
