# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A map whose places are elsewhere: what was fetched of them is known."""

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np
from stavpr_fleet.store import PlaceStore, sample_places
from stavpr_ros.features import LocalFeatures
from stavpr_ros.mapping import Map, Place


class RemoteFeatures(LocalFeatures):
    """Features that are fetched on use."""

    def __init__(self, store: PlaceStore) -> None:
        self._store = store
        sample = store.index.sample
        for name, value in (('settings', sample.settings), ('cells', sample.features.cells)):
            object.__setattr__(self, name, value)

    def __setattr__(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return self._store.index.places

    def __repr__(self) -> str:
        return f'RemoteFeatures({len(self)} places, {self.settings})'

    def __getitem__(self, images: slice | np.ndarray) -> LocalFeatures:
        return self._store.fetch(np.arange(len(self))[images])[0].features

    @property
    def dimension(self) -> int:
        """Return the number d of dimensions of a strip."""
        return self._store.index.sample.dimension

    @property
    def strips(self) -> np.ndarray:
        """Return the features of all places, (W, n, d)."""
        return self[:].strips

    @property
    def weights(self) -> np.ndarray:
        """Return the weights of all places, (W, n)."""
        return self[:].weights


@dataclass(frozen=True, eq=False)
class CityMap(Map):
    """
    A map in a :class:`PlaceStore`. Stamps, poses and identifiers are known of fetched places.

    Without thumbnails: the geometric check is not available.
    """

    partial: ClassVar[bool] = True
    store: PlaceStore = field(kw_only=True)
    fetched_ids: dict[int, str] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, store: PlaceStore) -> Self:
        """Return the map in a store, with the places of the sample known."""
        index = store.index
        n, sample = index.places, index.sample
        sessions = list(dict.fromkeys(index.sessions))
        of_runs = np.array([sessions.index(session) for session in index.sessions], np.int32)
        session_index = None
        if sessions:
            session_index = np.repeat(of_runs, np.diff(index.firsts, append=n))
        city = cls(
            features=RemoteFeatures(store),
            projection=sample.projection,
            stamps=np.zeros(n, np.int64),
            ids=('',) * n,
            poses=np.full((n, 7), np.nan) if sample.has_poses else None,
            sessions=tuple(sessions),
            session_index=session_index,
            camera=sample.camera,
            map_id=index.map_id,
            store=store,
        )
        city.remember(sample_places(n), sample)
        return city

    def remember(self, places: np.ndarray, fetched: Map) -> None:
        """Keep stamps, poses and identifiers of places that were fetched."""
        self.stamps[places] = fetched.stamps
        if self.poses is not None and fetched.poses is not None:
            self.poses[places] = fetched.poses
        names = zip(places.tolist(), fetched.ids, strict=True)
        self.fetched_ids.update((place, name) for place, name in names if name)

    def place(self, index: int) -> Place:
        """See :meth:`Map.place`; of a place that was not fetched, the session alone."""
        return replace(super().place(index), identifier=self.fetched_ids.get(index, ''))
