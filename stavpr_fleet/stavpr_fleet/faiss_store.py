# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A map file on disk with a FAISS index beside it: both stay in their files."""

import math
import os
from pathlib import Path
import tempfile
from typing import Any

import numpy as np
from stavpr_fleet.store import map_vectors, MapIndex
from stavpr_ros.errors import FleetError, OutputTakenError, UnavailableError
from stavpr_ros.mapping import Map, open_map, save_map, select_places

MAX_EXACT = 4096  # places up to which all vectors are compared
PCA_DIMENSIONS = 128  # dimensions that larger maps' vectors are reduced to
PROBES = 32  # lists of such an index that a query is compared with
TRAINING_PLACES = 50_000  # most places that an index is trained with


def _faiss() -> Any:
    try:
        import faiss
    except ImportError as error:
        raise UnavailableError(
            f"an address 'faiss:FILE' requires the package faiss-cpu ({error}): pip install "
            'faiss-cpu'
        ) from error
    return faiss


def _index_path(path: str | Path, map_id: str) -> Path:
    """Return the file of a map's index; the index of another map has another name."""
    return Path(f'{path}.{map_id}.faiss')


class FaissStore:
    """
    A map file whose places are searched by FAISS.

    :param path: map file; ``upload`` has written its index beside it.
    :raises StavprError: no such map, or no index of it.
    """

    def __init__(self, path: str | Path) -> None:
        faiss = _faiss()
        self._map = open_map(path)
        self.index = MapIndex.of(self._map)
        file = _index_path(path, self._map.map_id)
        try:
            self._index = faiss.read_index(str(file), faiss.IO_FLAG_MMAP)
        except RuntimeError as error:
            raise FleetError(
                f'no index of the map in {file}: write it with `map upload {path} faiss:{path}`'
            ) from error
        if self._index.ntotal != len(self._map) or self._index.d != self.index.dimension:
            raise FleetError(f'{file} is not the index of the map {path}: delete and upload again')
        if len(self._map) > MAX_EXACT:
            faiss.extract_index_ivf(self._index).nprobe = PROBES

    def nearest(self, vectors: np.ndarray, count: int) -> np.ndarray:
        """See :class:`stavpr_fleet.store.PlaceStore`."""
        return np.asarray(self._index.search(vectors, count)[1])

    def fetch(self, places: np.ndarray) -> tuple[Map, np.ndarray]:
        """See :class:`stavpr_fleet.store.PlaceStore`."""
        same_as = self._map.same_as
        return select_places(self._map, places), places if same_as is None else same_as[places]


def upload_to_faiss(place_map: Map, path: str, force: bool = False) -> None:
    """
    Write a map and its index; a map that is the file itself gets an index only.

    :raises OutputError: a file is there, and not force; or it cannot be written.
    """
    faiss, target = _faiss(), Path(path)
    source = getattr(getattr(place_map.features, 'file', None), 'path', None)
    if source is None or not (target.exists() and target.samefile(source)):
        save_map(place_map, target, force=force)
    place_map = open_map(target)
    file = _index_path(target, place_map.map_id)
    if file.exists() and not force:
        raise OutputTakenError(f'{file} exists: give --force to replace it')
    vectors = map_vectors(place_map, MapIndex.of(place_map))
    n, dimension = vectors.shape
    kind = 'Flat'
    if n > MAX_EXACT:
        reduced = f'PCA{PCA_DIMENSIONS},' if dimension > PCA_DIMENSIONS else ''
        kind = f'{reduced}IVF{math.isqrt(n)},SQ8'
    index = faiss.index_factory(dimension, kind, faiss.METRIC_INNER_PRODUCT)
    index.train(vectors[:: max(1, n // TRAINING_PLACES)])
    index.add(vectors)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix='.upload-') as folder:
        faiss.write_index(index, f'{folder}/index')
        os.replace(f'{folder}/index', file)
