"""The matcher of the CPU: one pass over the map for a frame, all cores."""

import numpy as np
import torch

from stavpr_ros.alignment.cpu import dot
from stavpr_ros.alignment.lm_dtw import (
    SequenceDistances,
    SequenceMatch,
    best_match,
    match_padded,
    trace_sequence,
)
from stavpr_ros.alignment.path import NO_PATH
from stavpr_ros.alignment.settings import SequenceSettings, SpatialSettings
from stavpr_ros.alignment.similarity import tiled
from stavpr_ros.alignment.spatial import adaptive_weights, image_distances
from stavpr_ros.errors import InputError
from stavpr_ros.features import LocalFeatures
from stavpr_ros.recognition.sequence_buffer import DistanceWindow

CACHE_LINE = 64  # bytes; vectors across two of them are read at half the speed


def cut_cells(strips: torch.Tensor, cells: tuple[int, int]) -> torch.Tensor:
    """
    Cut strips into their cells, unit norm each; zero cells stay zero.

    :param strips: shape (W, n, d); each is (channels, H, columns), flattened.
    :param cells: H and columns.
    :returns: shape (W H, n, channels * columns), strip by strip, each from the top.
    """
    W, n, d = strips.shape
    H, columns = cells
    cut = strips.reshape(W, n, d // (H * columns), H, columns).permute(0, 3, 1, 2, 4)
    cut = cut.reshape(W * H, n, d // H)
    return cut / cut.norm(dim=2, keepdim=True).clamp_(min=1e-12)


class CpuMatcher:
    """
    See :class:`stavpr_ros.recognition.matcher.Matcher`.

    :param features: those of the map; float32 ones that lie well in memory are shared, not copied.
    """

    def __init__(
        self,
        features: LocalFeatures,
        spatial: SpatialSettings,
        sequence: SequenceSettings,
        precision: str = 'float32',
    ) -> None:
        self._spatial, self._sequence = spatial, sequence
        self._cells = features.cells if spatial.vertical else None
        strips = features.strips.cpu()
        if spatial.vertical:
            if features.cells is None:
                raise InputError(
                    'vertical alignment needs the cells of the strips: make the map anew, without projection'
                )
            strips = cut_cells(strips, features.cells)
            self._cell_a = adaptive_weights(features.cells[0], spatial, np.dtype(np.float32))
        strips = strips.to(getattr(torch, precision)).contiguous()
        if strips.data_ptr() % CACHE_LINE:
            strips = strips.clone()
        self._map = (strips if precision == 'float32' else strips.view(torch.int16)).numpy()
        self._weights = features.weights.cpu()
        W = len(features.strips)
        self._band = spatial.band(W)
        self._matches = SequenceDistances(np.empty(0, np.float32), np.empty(0, np.int32))
        self._a = adaptive_weights(W, spatial, np.dtype(np.float32))
        self.reset()

    @property
    def places(self) -> int:
        """Number of places n."""
        return self._map.shape[1]

    def __len__(self) -> int:
        return len(self._window)

    def reset(self) -> None:
        """Empty the window."""
        self._window = DistanceWindow(self._sequence.length, self.places, self._sequence.k)

    def push(self, row: torch.Tensor) -> None:
        """Take the newest row in."""
        self._window.push(row.numpy())

    def distances(self, strips: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        """Distances of one image to every place, (n,)."""
        return self.distance_matrix(strips[:, None], weights[:, None])[0]

    def distance_matrix(self, strips: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        """Distances of Q images to every place, (Q, n)."""
        queries = tiled(strips if self._cells is None else cut_cells(strips.cpu(), self._cells))
        out = np.empty((len(queries), self.places), np.float32)
        if self._cells is not None:
            dot.vertical_image_distances(self._map, queries, self._cell_a, self._a, self._band, out)
        elif self._spatial.strategy in ('adaptive', 'vanilla'):
            dot.image_distances(self._map, queries, self._a, self._band, out)
        else:
            for x, query in enumerate(queries):
                out[x] = self._compared(query, weights[:, x])
        return torch.from_numpy(out)

    def _compared(self, query: np.ndarray, weights: torch.Tensor) -> np.ndarray:
        """Distances of one image without DTW, (n,)."""
        W, n, _ = self._map.shape
        d = np.empty((len(query), W, n), np.float32)
        dot.strip_distances(self._map, query, d)
        if self._spatial.strategy == 'sliding_window':
            return image_distances(d[:W], self._spatial)
        similarity = 1 - torch.from_numpy(d).diagonal()[:, :W]  # (n, W)
        return (1 - (similarity * self._weights.T) @ weights).numpy()

    def match(self, nms_radius: int) -> tuple[SequenceMatch | None, np.ndarray]:
        """Return the nearest sequence and its warping path."""
        window = self._window.rows()
        self._matches = matches = match_padded(window, self.places, self._sequence.k)
        nearest = best_match(matches, nms_radius)
        if nearest is None:
            return None, NO_PATH
        return nearest, trace_sequence(window[:, : self.places], nearest.first, self._sequence.k).path

    def sequences(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the distances of the sequences matched last and their middle places."""
        return self._matches.distances, self._matches.middles
