# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A map that grows by one place at a time."""

from collections.abc import Callable
import dataclasses
import itertools

import numpy as np
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.features import FeatureSettings, LocalFeatures, Projection
from stavpr_ros.mapping.camera import Camera
from stavpr_ros.mapping.place_map import (
    decode_thumbnail,
    Place,
    PlaceMap,
    require_projection,
    Session,
)
from stavpr_ros.mapping.trajectory import checked_pose
import torch

ROOM = 256  # initial capacity in places; doubled when it is full


class GrowingMap:
    """
    Places in the order in which they were added.

    Adding is cheap: memory doubles when it is full, up to ``limit`` places. The oldest places may
    be evicted; place i of the map is place ``first`` + i of all added ones. Not thread-safe.

    :param projection: the random projection of the features, if they have one.
    :param limit: most places kept, at least 1.
    :param cells: see :class:`LocalFeatures`; taken from the first place if not given.
    :param held_features: returns the features of the places held, in memory of their own, where
        another object is their owner; None = they are held here.
    :raises SettingsError: no room for a place.
    :raises InputError: the projection is not that of the settings.
    """

    map_id = ''  # that of a PlaceMap is of its file

    def __init__(
        self,
        settings: FeatureSettings,
        projection: Projection | None,
        limit: int,
        cells: tuple[int, int] | None = None,
        held_features: Callable[[], LocalFeatures] | None = None,
    ) -> None:
        if limit < 1:
            raise SettingsError(f'limit = {limit} must be at least 1 place')
        require_projection(projection, settings)
        self.settings, self.projection, self.limit = settings, projection, limit
        self._cells, self._held_features = cells, held_features
        self.dimension = 0  # d of a strip, once there is a place
        self.first = self._count = 0
        self._strips = np.empty((settings.strips, 0, 0), np.float32)
        self._weights = np.empty((settings.strips, 0), np.float32)
        self._vectors: np.ndarray | None = None  # (room, D), once there is a place with one
        self._stamps = np.empty(0, np.int64)
        self._poses = np.empty((0, 7))
        self.camera: Camera | None = None  # of the images, None = unknown
        self.sessions: tuple[Session, ...] = ()  # of the map that is continued
        self._session_index: np.ndarray | None = None
        self._same_as: np.ndarray | None = None
        self.ids: list[str] = []  # '' = none
        self.thumbnails: list[bytes] = []  # small JPEGs, an empty one = none

    @classmethod
    def from_map(cls, place_map: PlaceMap, limit: int) -> 'GrowingMap':
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
        growing = cls(place_map.settings, place_map.projection, limit, features.cells)
        growing.dimension = features.dimension
        growing._vectors = _room_of(features[:1])
        growing._make_room(max(n, min(ROOM, limit)))
        for low in range(0, n, ROOM):  # they may be in the map's file
            places = slice(low, min(low + ROOM, n))
            some = features[places]
            growing._strips[:, places] = some.strips.cpu().numpy()
            if growing._vectors is not None and some.vectors is not None:
                growing._vectors[places] = some.vectors.cpu().numpy()
        growing._weights[:, :n] = features.weights.cpu().numpy()
        growing._stamps[:n] = place_map.stamps
        growing._poses[:n] = np.nan if place_map.poses is None else place_map.poses
        growing.sessions, growing._session_index = place_map.sessions, place_map.session_index
        growing.camera = place_map.camera
        growing._same_as = place_map.same_as
        growing.ids = list(place_map.ids)
        growing.thumbnails = list(place_map.thumbnails) or [b''] * n
        growing._count = n
        return growing

    def __len__(self) -> int:
        return self._count

    @property
    def full(self) -> bool:
        """There is no room for another place."""
        return self._count >= self.limit

    @property
    def features(self) -> LocalFeatures:
        """
        Return the features of all places, strips (W, n, d): a view, valid until the map changes.

        Where another object holds the features, a copy.
        """
        n = self._count
        vectors = None if self._vectors is None else torch.from_numpy(self._vectors[:n])
        if self._held_features is not None:
            vectors = None if vectors is None else vectors.clone()
            return dataclasses.replace(self._held_features(), vectors=vectors)
        strips, weights = (
            torch.from_numpy(self._strips[:, :n]),
            torch.from_numpy(self._weights[:, :n]),
        )
        return LocalFeatures(strips, weights, self.settings, self._cells, vectors)

    @property
    def stamps(self) -> np.ndarray:
        """Stamp of each place, ns, 0 = unknown: a view, shape (n,), int64."""
        return self._stamps[: self._count]

    @property
    def poses(self) -> np.ndarray:
        """Pose of each place, a row of NaN = unknown: a view, shape (n, 7), float64."""
        return self._poses[: self._count]

    def place(self, index: int) -> Place:
        """Return stamp, identifier and pose of a place; counted as by :meth:`add`."""
        i = index - self.first
        pose = self._poses[i]
        known = pose.copy() if np.isfinite(pose).all() else None
        return Place(int(self._stamps[i]), self.ids[i], known)

    def thumbnail(self, index: int) -> np.ndarray | None:
        """Return the thumbnail of a place, RGB (h, w, 3) uint8, or None; counted likewise."""
        return decode_thumbnail(self.thumbnails[index - self.first])

    @property
    def memory(self) -> int:
        """Bytes held, the room for places to come included."""
        arrays = (self._strips, self._weights, self._stamps, self._poses)
        texts = sum(map(len, self.thumbnails)) + sum(map(len, self.ids))
        vectors = 0 if self._vectors is None else self._vectors.nbytes
        return sum(array.nbytes for array in arrays) + vectors + texts

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

        :param features: those of one image, strips (W, 1, d).
        :param stamp: time of its image, ns; 0 = unknown.
        :param pose: x y z (meters) and quaternion x y z w, shape (7,); None = unknown.
        :param thumbnail: a small JPEG, see :func:`encode_thumbnail`.
        :returns: number of the place, counting all added places.
        :raises FeatureMismatchError: features with other settings.
        :raises InputError: the map is full; not one image; values that are not finite.
        """
        strips, weights, vector = self._checked(features)
        row = np.full(7, np.nan) if pose is None else checked_pose(pose)
        n = self._count
        self.dimension = self.dimension or strips.shape[1]
        if self._vectors is None and not n:
            self._vectors = _room_of(features, len(self._stamps))
        if n == len(self._stamps):
            self._make_room(min(max(2 * n, ROOM), self.limit))
        if self._held_features is None:
            self._strips[:, n], self._weights[:, n] = strips, weights
        if self._vectors is not None:
            self._vectors[n] = vector
        self._stamps[n], self._poses[n] = stamp, row
        if not n and not self.first and self._cells is None:
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
        features = (*self._strips, *self._weights) if self._held_features is None else ()
        vectors = () if self._vectors is None else (self._vectors,)
        for array in (*features, *vectors, self._stamps, self._poses):
            array[: n - count] = array[count:n]
        del self.ids[:count], self.thumbnails[:count]
        self.first, self._count = self.first + count, n - count

    def snapshot(self) -> PlaceMap:
        """Return the map as it is now, in memory of its own."""
        features = self.features
        if self._held_features is None:
            features = features[np.arange(self._count)]
        sessions, session_index = self._with_session()
        same_as = self._same_as
        if same_as is not None:
            added = np.arange(len(same_as), self._count, dtype=np.int32)
            same_as = np.concatenate([same_as, added])
        return PlaceMap(
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
        """Return the sessions of a continued map that has some, and one of the places added."""
        index = self._session_index
        if index is None or len(index) == self._count:
            return self.sessions, index
        taken = {session.id for session in self.sessions}
        names = (f'recorded-{number}' for number in itertools.count(1))
        name = next(name for name in names if name not in taken)
        recorded = Session(name, start=max(int(self.stamps[len(index)]), 0))
        added = np.full(self._count - len(index), len(self.sessions), np.int32)
        return (*self.sessions, recorded), np.concatenate([index, added])

    def _checked(
        self, features: LocalFeatures
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Return the strips (W, d), weights (W,) and vector (D,) of an image that fits."""
        features.require_same_settings(self.settings, 'the map')
        if len(features) != 1:
            raise InputError(f'features of {len(features)} images: expected those of one')
        if self.full:
            raise InputError(
                f'the map is full, it has {self.limit} places: raise its limit, evict the oldest '
                'places or '
                'save it and start another'
            )
        strips, weights = features.strips[:, 0].cpu().numpy(), features.weights[:, 0].cpu().numpy()
        d = self.dimension
        if d and strips.shape[1] != d:
            raise InputError(f'strips of {strips.shape[1]} dimensions: the map has {d}')
        vector = None if features.vectors is None else features.vectors[0].cpu().numpy()
        if self._vectors is not None and (
            vector is None or vector.shape != self._vectors.shape[1:]
        ):
            found = 'no vector' if vector is None else f'a vector of {len(vector)} dimensions'
            raise InputError(f'{found}: places of the map have one of {self._vectors.shape[1]}')
        for values in (strips, weights) if vector is None else (strips, weights, vector):
            if not np.isfinite(values).all():
                raise InputError('the features are not finite: check the network and its input')
        return strips, weights, vector

    def _make_room(self, room: int) -> None:
        """Reallocate every array with a capacity of ``room`` places; all or none."""
        n, W = self._count, self.settings.strips
        stamps, poses = np.empty(room, np.int64), np.empty((room, 7))
        stamps[:n], poses[:n] = self._stamps[:n], self._poses[:n]
        if self._held_features is None:
            strips = np.empty((W, room, self.dimension), np.float32)
            weights = np.empty((W, room), np.float32)
            if n:
                strips[:, :n], weights[:, :n] = self._strips[:, :n], self._weights[:, :n]
            self._strips, self._weights = strips, weights
        if self._vectors is not None:
            vectors = np.empty((room, self._vectors.shape[1]), np.float32)
            vectors[:n] = self._vectors[:n]
            self._vectors = vectors
        self._stamps, self._poses = stamps, poses


def _room_of(features: LocalFeatures, room: int = 0) -> np.ndarray | None:
    """Return room for the vectors of places as these, None if they have none."""
    vectors = features.vectors
    return None if vectors is None else np.empty((room, vectors.shape[1]), np.float32)
