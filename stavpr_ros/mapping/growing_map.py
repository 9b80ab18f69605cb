# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A map that grows by one place at a time."""

from collections.abc import Callable
import itertools

import numpy as np
from stavpr_ros.checks import require_at_least
from stavpr_ros.errors import InputError
from stavpr_ros.features import FeatureSettings, LocalFeatures, Projection
from stavpr_ros.mapping.camera import Camera
from stavpr_ros.mapping.place_map import (
    decode_thumbnail,
    Map,
    Place,
    require_projection,
    Session,
)
from stavpr_ros.mapping.trajectory import normalize_pose

ROOM = 256  # initial capacity in places; doubled when it is full


class GrowingMap:
    """
    Places in the order in which they were added.

    Adding is cheap: memory doubles when it is full, up to ``limit`` places. The oldest places may
    be evicted; place i of the map is place ``first`` + i of all added ones. Not thread-safe.

    :param projection: the random projection of the features, if they have one.
    :param limit: most places kept, at least 1.
    :param held_features: provider of the features of the places, copies, where another object is
        their owner; None = this object is.
    :raises SettingsError: no room for a place.
    :raises InputError: the settings name another projection.
    """

    map_id = ''  # a Map has the id of its file

    def __init__(
        self,
        settings: FeatureSettings,
        projection: Projection | None,
        limit: int,
        held_features: Callable[[], LocalFeatures] | None = None,
    ) -> None:
        require_at_least('limit', limit, 1, 'place')
        require_projection(projection, settings)
        self.settings, self.projection, self.limit = settings, projection, limit
        self._held_features = held_features
        self._cells: tuple[int, int] | None = None  # cells of the strips of the first place
        self.dimension = 0  # d of a strip, once there is a place
        self.first = self._count = 0
        # a row for each place, and for those to come; strips (room, W, d) once there is a place
        self._rows = {'stamps': np.empty(0, np.int64), 'poses': np.empty((0, 7))}
        self.camera: Camera | None = None  # camera of the images, None = unknown
        self.sessions: tuple[Session, ...] = ()  # sessions of the map that is continued
        self._session_index: np.ndarray | None = None
        self._session_id = ''  # session of the added places, '' = not named yet
        self._same_as: np.ndarray | None = None
        self._relations: dict[int, int] = {}  # added places that show the same as an earlier one
        self.ids: list[str] = []  # '' = none
        self.thumbnails: list[bytes] = []  # small JPEGs, an empty one = none

    @classmethod
    def from_map(cls, place_map: Map, limit: int) -> 'GrowingMap':
        """
        Continue a map; its content is copied.

        :raises InputError: it has more places than the limit allows.
        """
        n = len(place_map)
        if n > limit:
            raise InputError(
                f'a map of {n} places does not fit into a limit of {limit}: raise the limit'
            )
        features = place_map.features
        growing = cls(place_map.settings, place_map.projection, limit)
        growing.dimension, growing._cells = features.dimension, features.cells
        growing._make_room(max(n, min(ROOM, limit)), _rows_of(features[:1]))
        for low in range(0, n, ROOM):  # they may be in the map's file
            places = slice(low, min(low + ROOM, n))
            for name, rows in _rows_of(features[places]).items():
                growing._rows[name][places] = rows
        growing._rows['stamps'][:n] = place_map.stamps
        growing._rows['poses'][:n] = np.nan if place_map.poses is None else place_map.poses
        growing.sessions, growing._session_index = place_map.sessions, place_map.session_index
        growing.camera = place_map.camera
        growing._same_as = place_map.same_as
        growing.ids = list(place_map.ids)
        growing.thumbnails = list(place_map.thumbnails) or [b''] * n
        growing._count = n
        return growing

    def begin_session(self, before: str, identifier: str = '') -> None:
        """
        Make the places that are added from now on a session of their own.

        :param before: id of the session that the places of a map without sessions become.
        :param identifier: id of the new session, or of one that goes on; '' = a free one.
        """
        if self._session_index is None:
            self.sessions = (Session(before[:64], start=max(int(self.stamps[0]), 0)),)
            self._session_index = np.zeros(self._count, np.int32)
        own_ids = {session.id for session in self.sessions}
        names = (f'recorded-{number}' for number in itertools.count(1))
        self._session_id = identifier or next(name for name in names if name not in own_ids)

    def relate(self, place: int, earlier: int, replaces: bool = True) -> None:
        """
        Note that an added place shows the same as a place of an earlier session.

        :param replaces: also where the place is related already.
        """
        if replaces or place not in self._relations:
            self._relations[place] = (
                earlier if self._same_as is None else int(self._same_as[earlier])
            )

    def __len__(self) -> int:
        return self._count

    @property
    def full(self) -> bool:
        """Return whether there is no room for another place."""
        return self._count >= self.limit

    @property
    def features(self) -> LocalFeatures:
        """
        Return the features of all places, strips (W, n, d): a view, valid until the map changes.

        Where another object owns the features, a copy.
        """
        if self._held_features is not None:
            return self._held_features()
        rows_of = {name: rows[: self._count] for name, rows in self._rows.items()}
        W = self.settings.strips
        strips = rows_of.get('strips', np.empty((0, W, 0), np.float32)).transpose(1, 0, 2)
        weights = rows_of.get('weights', np.empty((0, W), np.float32)).T
        return LocalFeatures(strips, weights, self.settings, self._cells)

    @property
    def stamps(self) -> np.ndarray:
        """Return the stamps of all places, ns, 0 = unknown: a view, shape (n,), int64."""
        return self._rows['stamps'][: self._count]

    @property
    def poses(self) -> np.ndarray:
        """Return the poses of places, a row of NaN = unknown: a view, shape (n, 7), float64."""
        return self._rows['poses'][: self._count]

    def place(self, index: int) -> Place:
        """Return stamp, identifier, pose and session of a place; counted as by :meth:`add`."""
        i, session = index - self.first, self._session_id
        pose = self.poses[i]
        copy = pose.copy() if np.isfinite(pose).all() else None
        if self._session_index is not None and i < len(self._session_index):
            session = self.sessions[self._session_index[i]].id
        return Place(int(self.stamps[i]), self.ids[i], copy, session)

    def thumbnail(self, index: int) -> np.ndarray | None:
        """Return the thumbnail of a place, RGB (h, w, 3) uint8, or None; counted as by add."""
        return decode_thumbnail(self.thumbnails[index - self.first])

    def add(
        self,
        features: LocalFeatures,
        stamp: int = 0,
        identifier: str = '',
        pose: np.ndarray | None = None,
        thumbnail: bytes = b'',
    ) -> int:
        """
        Add a place; an error changes nothing.

        :param features: features of one image, strips (W, 1, d).
        :param stamp: time of its image, ns; 0 = unknown.
        :param pose: x y z (meters) and quaternion x y z w, shape (7,); None = unknown.
        :param thumbnail: a small JPEG, see :func:`encode_thumbnail`.
        :returns: number of the place, counting all added places.
        :raises FeatureMismatchError: features with other settings, or of another network.
        :raises InputError: the map is full; not one image; values that are not finite.
        """
        rows, n = self._check(features), self._count
        added = {
            'stamps': np.array([stamp], np.int64),
            'poses': np.full((1, 7), np.nan) if pose is None else normalize_pose(pose)[None],
        }
        if self._held_features is not None:
            rows = {}
        if n == len(self._rows['stamps']) or not n:
            self._make_room(min(max(2 * n, ROOM), self.limit), rows)
        self.dimension = features.dimension
        for name, row in (rows | added).items():
            self._rows[name][n] = row[0]
        if not n and not self.first:
            self._cells = features.cells
        self.ids.append(identifier)
        self.thumbnails.append(thumbnail)
        self._count += 1
        return self.first + n

    def forget(self, count: int) -> None:
        """
        Evict the oldest places; the others are moved, so evict many at a time.

        :raises InputError: there are not so many.
        """
        n = self._count
        if not 0 <= count <= n:
            raise InputError(f'{count} places cannot be evicted: expected 0 to {n}')
        for rows in self._rows.values():
            rows[: n - count] = rows[count:n]
        del self.ids[:count], self.thumbnails[:count]
        self.first, self._count = self.first + count, n - count

    def snapshot(self) -> Map:
        """Return the map as it is now, in memory of its own."""
        features = self.features
        if self._held_features is None:
            features = features[np.arange(self._count)]
        sessions, session_index = self._with_session()
        same_as = self._same_as
        if same_as is not None or self._relations:
            roots = np.arange(self._count, dtype=np.int32)
            if same_as is not None:
                roots[: len(same_as)] = same_as
            roots[list(self._relations)] = list(self._relations.values())
            same_as = roots
        return Map(
            same_as=same_as,
            sessions=sessions,
            session_index=session_index,
            camera=self.camera,
            features=features,
            projection=self.projection,
            stamps=self.stamps.copy(),
            ids=tuple(self.ids),
            poses=None if np.isnan(self.poses).all() else self.poses.copy(),
            thumbnails=tuple(self.thumbnails) if any(self.thumbnails) else (),
        )

    def _with_session(self) -> tuple[tuple[Session, ...], np.ndarray | None]:
        """Return the sessions of a continued map, and a session of the added places."""
        index = self._session_index
        if index is None or len(index) == self._count:
            return self.sessions, index
        if not self._session_id:
            self.begin_session('')
        sessions, ids = self.sessions, [session.id for session in self.sessions]
        if self._session_id not in ids:
            start = max(int(self.stamps[len(index)]), 0)
            sessions = (*sessions, Session(self._session_id, start=start))
        number = [session.id for session in sessions].index(self._session_id)
        added = np.full(self._count - len(index), number, np.int32)
        return sessions, np.concatenate([index, added])

    def _check(self, features: LocalFeatures) -> dict[str, np.ndarray]:
        """Return the rows of the features of an image that fits."""
        features.require_fit(self.settings, 'the map', self.dimension)
        if len(features) != 1:
            raise InputError(f'features of {len(features)} images: expected those of one')
        if self.full:
            raise InputError(
                f'the map is full, it has {self.limit} places: raise its limit, evict the oldest '
                'places or save it and start another'
            )
        added = _rows_of(features)
        if not all(np.isfinite(values).all() for values in added.values()):
            raise InputError('the features are not finite: check the network and its input')
        return added

    def _make_room(self, room: int, rows: dict[str, np.ndarray]) -> None:
        """Reallocate every array with a capacity of ``room`` places, of such rows; all or none."""
        larger = {
            name: np.empty((room, *column.shape[1:]), column.dtype)
            for name, column in (rows | self._rows).items()
        }
        for name, column in self._rows.items():
            larger[name][: self._count] = column[: self._count]
        self._rows = larger


def _rows_of(features: LocalFeatures) -> dict[str, np.ndarray]:
    """Return the features of n images: strips (n, W, d), weights (n, W)."""
    return {'strips': features.strips.transpose(1, 0, 2), 'weights': features.weights.T}
