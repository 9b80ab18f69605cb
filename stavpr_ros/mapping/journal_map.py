# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A map of the places in a journal that does not fit into memory: its features stay on disk."""

from collections.abc import Sequence
import mmap
import os
from pathlib import Path
import tempfile
from typing import overload

import numpy as np
from stavpr_ros.errors import JournalError
from stavpr_ros.mapping.journal import JournalReader
from stavpr_ros.mapping.place_map import PlaceMap
from stavpr_ros.mapping.stored_features import MappedFeatures
import torch

PLACES_AT_ONCE = 8192  # whose pages count as memory of this process


class _Thumbnails(Sequence[bytes]):
    """Thumbnails that are read from the journal on every use."""

    def __init__(self, path: Path, ends: list[int], sizes: list[int]) -> None:
        self._file, self._ends, self._sizes = path.open('rb'), ends, sizes

    def __len__(self) -> int:
        return len(self._ends)

    @overload
    def __getitem__(self, index: int) -> bytes: ...
    @overload
    def __getitem__(self, index: slice) -> list[bytes]: ...

    def __getitem__(self, index: int | slice) -> bytes | list[bytes]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        size = self._sizes[index]
        return os.pread(self._file.fileno(), size, self._ends[index] - size)


def journal_map(path: Path) -> PlaceMap:
    """
    Return the places of a journal as a map.

    The features are in a temporary file beside the journal that has no name, the thumbnails stay
    in the journal: both only take memory while they are used.

    :raises JournalError: no journal, or one without places.
    """
    with JournalReader(path) as reader:
        n = sum(1 for _ in reader.places())
    if not n:
        raise JournalError(f'{path} has no places: delete it')
    with JournalReader(path) as reader:
        template = reader.template
        W, d = template.settings.strips, template.dimension
        D = 0 if template.features.vectors is None else template.features.vectors.shape[1]
        with tempfile.TemporaryFile(dir=path.parent) as file:
            file.truncate(4 * n * (W * d + D))
            pages = mmap.mmap(file.fileno(), 0)
        strips = np.frombuffer(pages, np.float32, W * n * d).reshape(W, n, d)
        vectors = np.frombuffer(pages, np.float32, n * D, strips.nbytes).reshape(n, D)
        weights = np.empty((W, n), np.float32)
        stamps, poses = np.empty(n, np.int64), np.full((n, 7), np.nan)
        ids, ends, sizes = [], [], []
        for i, place in enumerate(reader.places()):
            if i % PLACES_AT_ONCE == 0:
                pages.madvise(mmap.MADV_DONTNEED)  # they stay in the file
            strips[:, i], weights[:, i], stamps[i] = place.strips, place.weights, place.stamp
            vectors[i] = place.vector
            if place.pose is not None:
                poses[i] = place.pose
            ids.append(place.identifier)
            ends.append(reader.size)
            sizes.append(len(place.thumbnail))
    features = MappedFeatures(
        torch.from_numpy(strips), torch.from_numpy(weights), template.settings,
        template.features.cells, torch.from_numpy(vectors) if D else None,
    )  # fmt: skip
    object.__setattr__(features, 'pages', pages)
    return PlaceMap(
        features=features,
        projection=template.projection,
        stamps=stamps,
        ids=tuple(ids),
        poses=None if np.isnan(poses).all() else poses,
        camera=template.camera,
        thumbnails=_Thumbnails(path, ends, sizes) if any(sizes) else (),
    )
