# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recognition on a city's map, over the neighborhoods of the camera: see docs/fleet.md."""

from collections import deque
from concurrent.futures import Future, wait
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from stavpr_fleet.city_map import CityMap
from stavpr_fleet.neighborhoods import Votes
from stavpr_fleet.store import place_vectors, sample_places
from stavpr_ros.alignment.cpu.dot import change_between
from stavpr_ros.errors import SettingsError, StavprError
from stavpr_ros.features import LocalFeatures
from stavpr_ros.features.registry import evidence_of
from stavpr_ros.mapping import Map
from stavpr_ros.memory import aligned_zeros
from stavpr_ros.method import Match, RecognizerSettings, Status
from stavpr_ros.method.cells import CellAgreement
from stavpr_ros.method.columns import ColumnLayout
from stavpr_ros.method.localizer import position_of, SequenceRecognizer
from stavpr_ros.method.model import MODEL
from stavpr_ros.method.motion import ImageChange
from stavpr_ros.method.settings import ROBUST
from stavpr_ros.method.window import FilterWindow
from stavpr_ros.prepare.blocks import MAX_LAG, PlaceChanges
from stavpr_ros.prepare.centering import MIN_DEVIATION
from stavpr_ros.prepare.matcher import CpuMatcher
from stavpr_ros.threads import call_on_thread

CHUNK = 32  # places that are fetched together
CHUNKS = 128  # loaded: 4096 places
NEIGHBORHOODS = 16  # stretches of the map that are compared
BEHIND, AHEAD = 16, 48  # places of a neighborhood before and after its middle
INTERVAL = 5  # images between lookups
VOTERS = 64  # places of an image that vote
HISTORY = 60  # latest images that the filter runs over again
LIKELY = 8  # most probable places whose neighborhoods are kept
MIN_PROBABILITY = 1e-3  # their least probability
TIMEOUT = 0.25  # seconds that an image waits for a lookup


class CityLayout(ColumnLayout):
    """
    Columns for places of a city, with a gap between runs of neighboring ones.

    :param places: ascending, (m,).
    :param firsts, same_as: positions of the first place of each run, and of each same place.
    """

    names_places = True

    def __init__(
        self, places: np.ndarray, firsts: np.ndarray, same_as: np.ndarray, nms_radius: int
    ) -> None:
        super().__init__(firsts, same_as, nms_radius)
        self.loaded = places

    def names_of(self, columns: np.ndarray) -> np.ndarray:
        """See :meth:`ColumnLayout.names_of`."""
        return self.loaded[super().names_of(columns)]

    def positions(self, places: np.ndarray | int) -> np.ndarray:
        """See :meth:`ColumnLayout.positions`; of loaded places."""
        return super().positions(np.searchsorted(self.loaded, places))

    def session_of(self, place: int) -> tuple[int, int]:
        """Return the first loaded place of a run of neighboring ones, and the one behind it."""
        first, end = super().session_of(int(np.searchsorted(self.loaded, place)))
        return int(self.loaded[first]), int(self.loaded[end - 1]) + 1


@dataclass(frozen=True, eq=False)
class _Image:
    """
    An image of the query.

    :param strips, weights: centered features, (W, d) and (W,).
    :param change: from the one before.
    :param mean, deviation: mean and deviation of its distances to the sample.
    :param z: normalized distances to the places in the loaded chunks, by slot.
    """

    strips: np.ndarray
    weights: np.ndarray
    change: float
    stamp: int
    mean: float
    deviation: float
    z: np.ndarray


class _Lookup(NamedTuple):
    """Chunks to load, and the fetched places of chunks that were not loaded."""

    chunks: list[int]
    places: np.ndarray
    fetched: Map | None
    same_as: np.ndarray


class FleetRecognizer(SequenceRecognizer):
    """
    Recognizer of places of a city's map, one image at a time; on the CPU, in float32.

    :param city: the map.
    :param settings: mode robust with all its options.
    :param timeout: seconds that an image waits for the lookup of neighborhoods; it goes on with
        the loaded ones, and new ones are used when they have arrived.
    :raises SettingsError: settings of another mode than robust, or vertical alignment.

    ``problem`` is why the last lookup failed, '' = it did not.
    """

    def __init__(
        self, city: CityMap, settings: RecognizerSettings, timeout: float = TIMEOUT
    ) -> None:
        is_vertical = settings.applied_spatial.vertical
        if settings.applied_options != ROBUST or is_vertical:
            raise SettingsError(
                f'mode {settings.mode}, vertical {is_vertical}: the map of a fleet '
                'is matched in mode robust, without vertical alignment'
            )
        positions = () if city.poses is None else city.poses[:, :2]
        kind, strips = city.settings.kind, city.settings.strips
        self._constant, self._cells = evidence_of(kind, strips, city.dimension)
        self._filter_window = FilterWindow(
            settings.sequence, 0, ColumnLayout(), constant=self._constant
        )
        super().__init__(settings, city.settings, self._filter_window, positions)
        self._city, self._timeout = city, timeout
        index = city.store.index
        self._centering = index.centering()
        sample, places = index.sample.features, sample_places(index.places)
        self._sampled, W, d = len(sample), city.settings.strips, city.dimension
        # the sample, then the chunks: the matcher shares the memory
        self._strips = aligned_zeros((W, self._sampled + CHUNKS * CHUNK, d))
        self._weights: np.ndarray = np.zeros(self._strips.shape[:2], np.float32)
        changes = PlaceChanges(self._sampled, MAX_LAG)
        centered = self._centering.places(sample, changes.add)
        self._strips[:, : self._sampled] = centered.strips
        self._weights[:, : self._sampled] = centered.weights
        self._matcher = CpuMatcher(
            LocalFeatures(self._strips, self._weights, city.settings), settings.applied_spatial
        )
        self._learned = ImageChange(self._sampled, settings.sequence.length)
        self._learned.learn(changes.changes, _firsts(places, index.runs(places)))
        self._chunks = np.full(CHUNKS, -1)  # in each slot
        self._in_use = np.zeros(CHUNKS, bool)  # of this query, or all while the store fails
        self._last_use = np.zeros(CHUNKS, np.int64)  # number of the image that requested it last
        self._places = np.full(CHUNKS * CHUNK, -1)
        self._same_as = self._places.copy()
        self._from_before = np.ones(len(self._places), np.float32)
        self._count = 0
        self.reset()

    @property
    def places(self) -> int:
        """Return the number of places n of the map."""
        return len(self._city)

    @property
    def window_fill(self) -> int:
        """Return the number of images in the window, up to l."""
        return min(len(self._images), self._settings.sequence.length)

    def reset(self) -> None:
        """Drop the images of the query; loaded chunks stay until they are requested again."""
        self._in_use[:] = False
        self._pending: Future[_Lookup] | None = None
        self._centering.reset()
        self._images: deque[_Image] = deque(maxlen=HISTORY)
        self._vectors: deque[tuple[int, np.ndarray]] = deque(maxlen=self._settings.sequence.length)
        self._votes = Votes(self._settings.sequence.length, MODEL.speeds)
        super().reset()
        self._rebuild()

    def update(
        self, features: LocalFeatures, stamp: int = 0, pose: np.ndarray | None = None
    ) -> Match:
        """See :meth:`SequenceRecognizer.update`."""
        odometry_xy = position_of(pose)
        self._require_one_image(features, 'the map', self._city.dimension)
        strips = self._centering.next_query(features.strips[:, 0])
        row = self._matcher.distances(strips, features.weights[:, 0])
        sampled, change = row[: self._sampled][self._learned.distinct(slice(self._sampled))], 1.0
        if self._images:
            change = change_between(strips, self._images[-1].strips)
        self._centering.note_standstill(change < self._learned.standstill)
        mean, deviation = float(sampled.mean()), max(float(sampled.std()), MIN_DEVIATION)
        z = (row[self._sampled :] - np.float32(mean)) / np.float32(deviation)
        image = _Image(strips, features.weights[:, 0], change, stamp, mean, deviation, z)
        self._images.append(image)
        self._count += 1
        self._vectors.append((self._count, place_vectors(strips[:, None])))
        if self._update_neighborhoods():
            self._rebuild()
        elif len(self._order):
            self._push(image)
        if len(self._order):
            return self._match(odometry_xy)
        self._motion.trajectory.append(odometry_xy)
        status = Status.WARMING_UP
        if self.window_fill == self._settings.sequence.length:
            status = Status.NO_MATCH
        reason = self.problem or 'no neighborhood has arrived yet'
        return Match(status, reason, self._limits)

    def newest_row(self) -> np.ndarray:
        """See :meth:`SequenceRecognizer.newest_row`; +inf for places that are not loaded."""
        row = np.full(len(self._city), np.inf, np.float32)
        if self._images:
            row[self._places[self._order]] = self._images[-1].z[self._order]
        return row

    def window_columns(self, places: np.ndarray) -> np.ndarray:
        """See :meth:`SequenceRecognizer.window_columns`; +inf for places that are not loaded."""
        places_in_order = self._places[self._order]
        here = np.isin(places, places_in_order)
        rows = super().window_columns(places_in_order.searchsorted(places[here]))
        columns = np.full((len(rows), len(places)), np.inf, np.float32)
        columns[:, here] = rows
        return columns

    # neighborhoods

    def _update_neighborhoods(self) -> bool:
        """Look neighborhoods up if it is time; return whether other places are loaded."""
        if self._pending is None:
            if len(self._order) and len(self._vectors) < INTERVAL:
                return False
            queries = list(self._vectors)
            self._vectors.clear()
            loaded, likely = set(self._chunks.tolist()), self._likely()
            votes = self._votes  # of this query, if it is reset meanwhile
            self._pending = call_on_thread(
                lambda: self._look_up(queries, votes, loaded, likely), 'neighborhoods'
            )
            wait([self._pending], 0 if self.problem else self._timeout)
        if not self._pending.done():
            return False
        pending, self._pending = self._pending, None
        try:
            lookup = pending.result()
        except StavprError as error:
            self.problem = f'the loaded neighborhoods are used: {error}'
            if is_empty := not len(self._order):
                self._in_use[:] = self._chunks >= 0
            return is_empty and bool(self._in_use.any())
        self.problem = ''
        return self._take(lookup)

    def _look_up(
        self,
        queries: list[tuple[int, np.ndarray]],
        votes: Votes,
        loaded: set[int],
        likely: np.ndarray,
    ) -> _Lookup:
        """Return the neighborhoods of images; on a thread of its own, without this object's."""
        store = self._city.store
        vectors = np.concatenate([vector for _, vector in queries])
        for (number, _), nearest in zip(queries, store.nearest(vectors, VOTERS), strict=True):
            votes.add(number, nearest)
        last = (len(self._city) - 1) // CHUNK
        candidates: dict[int, None] = {}
        for place in np.concatenate([likely, votes.best(NEIGHBORHOODS)]).tolist():
            low, high = max(place - BEHIND, 0) // CHUNK, (place + AHEAD) // CHUNK
            candidates |= dict.fromkeys(range(low, min(high, last) + 1))
        selection = list(candidates)[:CHUNKS]
        chunks = sorted(set(selection) - loaded)
        if not chunks:
            return _Lookup(selection, np.empty(0, np.int64), None, np.empty(0, np.int64))
        places = (np.array(chunks)[:, None] * CHUNK + np.arange(CHUNK)).ravel()
        places = places[places < len(self._city)]
        return _Lookup(selection, places, *store.fetch(places))

    def _likely(self) -> np.ndarray:
        """Return the places that are most probable now."""
        if not len(self._order):
            return np.empty(0, np.int64)
        probabilities = self._filter_window.layout.to_places(self._filter_window.filter.by_place())
        top = np.argsort(-probabilities)[:LIKELY]
        return self._places[self._order][top[probabilities[top] > MIN_PROBABILITY]]

    def _take(self, lookup: _Lookup) -> bool:
        """Put fetched places into the slots that were requested longest ago."""
        requested, before = np.isin(self._chunks, lookup.chunks), self._in_use.sum()
        self._last_use[requested], self._in_use[requested] = self._count, True
        if lookup.fetched is None:
            return bool(self._in_use.sum() > before)
        self._city.remember(lookup.places, lookup.fetched)
        changes = PlaceChanges(len(lookup.places), 1)
        centered = self._centering.places(lookup.fetched.features, changes.add)
        from_before = changes.changes[0]
        from_before[:1] = 1  # of the first place it is unknown
        images = list(self._images)
        distances = CpuMatcher(centered, self._settings.applied_spatial).distance_matrix(
            np.stack([image.strips for image in images], axis=1),
            np.stack([image.weights for image in images], axis=1),
        )
        chunk_of = lookup.places // CHUNK
        free = np.lexsort((self._last_use, self._chunks >= 0)).tolist()
        for slot, chunk in zip(free, np.unique(chunk_of).tolist(), strict=False):
            here = np.flatnonzero(chunk_of == chunk)
            all_of_it = slice(slot * CHUNK, (slot + 1) * CHUNK)
            target = slice(slot * CHUNK, slot * CHUNK + len(here))
            self._chunks[slot], self._last_use[slot] = chunk, self._count
            self._in_use[slot] = True
            self._places[all_of_it] = -1
            self._places[target] = lookup.places[here]
            self._same_as[target] = lookup.same_as[here]
            # of the chunk's first place it is unknown
            self._from_before[target] = from_before[np.maximum(here, here[:2].max())]
            rows = slice(self._sampled + target.start, self._sampled + target.stop)
            self._strips[:, rows] = centered.strips[:, here]
            self._weights[:, rows] = centered.weights[:, here]
            for image, row in zip(images, distances[:, here], strict=True):
                image.z[target] = (row - np.float32(image.mean)) / np.float32(image.deviation)
        return True

    def _rebuild(self) -> None:
        """Run the filter over the latest images again, over the loaded places."""
        filled = np.flatnonzero((self._places >= 0) & np.repeat(self._in_use, CHUNK))
        self._order = filled[np.argsort(self._places[filled])]
        places = self._places[self._order]
        if not len(places):
            return
        firsts = _firsts(places, self._city.store.index.runs(places))
        same_as = np.minimum(places.searchsorted(self._same_as[self._order]), len(places) - 1)
        here = places[same_as] == self._same_as[self._order]
        same_as = np.where(here, same_as, np.arange(len(places)))
        layout = CityLayout(places, firsts, same_as, self._settings.nms_radius)
        share = len(places) / len(self._city)
        model = replace(MODEL, start=MODEL.start * share, enter=MODEL.enter * share)
        sequence = self._settings.sequence
        window = FilterWindow(sequence, len(places), layout, constant=self._constant, model=model)
        if self._cells is not None:
            rows, names_of = self._sampled + self._order, layout.names_of
            window.cells = CellAgreement(
                self._cells,
                lambda columns: self._strips[:, rows[np.searchsorted(places, names_of(columns))]],
                sequence.length,
            )
        window.recent = self._filter_window.recent  # the drive goes on
        from_before = layout.changes_from_before(self._from_before[self._order])
        window.change.copy_statistics(self._learned, from_before)
        self._window = self._filter_window = window
        for image in self._images:
            self._push(image)

    def _push(self, image: _Image) -> None:
        window = self._filter_window
        window.change.next_query(image.strips)
        z = window.layout.to_columns(image.z[self._order])
        window.add(z, image.stamp, image.change, image.strips)


def _firsts(places: np.ndarray, runs: np.ndarray) -> np.ndarray:
    """Return the positions where runs of neighboring places of one session begin."""
    apart = np.diff(places, prepend=-2) != 1
    return np.flatnonzero(apart | (np.diff(runs, prepend=-1) != 0))


class FleetMap(CityMap):
    """A city's map that makes its recognizer, as the pipeline expects of a map in a store."""

    def recognizer(self, settings: RecognizerSettings) -> FleetRecognizer:
        """Return a recognizer of this map; see :class:`FleetRecognizer`."""
        return FleetRecognizer(self, settings)
