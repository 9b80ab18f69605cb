"""The matching on a CUDA device: the map stays there, and one small answer comes back for each window."""

from typing import Any

import numpy as np
import torch

from stavpr_ros.alignment.cuda.compilation import Runtime, runtime
from stavpr_ros.alignment.lm_dtw import SequenceDistances, SequenceMatch, trace_sequence
from stavpr_ros.alignment.settings import SequenceSettings, SpatialSettings
from stavpr_ros.alignment.similarity import holistic_distances
from stavpr_ros.alignment.spatial import WINDOW
from stavpr_ros.errors import InputError
from stavpr_ros.features import LocalFeatures

BLOCK_WORDS = 2**26  # most words of products that lie in memory at a time: 256 MiB
QUERIES = 32  # most images of a batch whose products are made at once
PLACES_IN_PIECES = 2**14  # most places widened at a time, where the half-width product is not there


class CudaMatcher:
    """
    See :class:`stavpr_ros.recognition.matcher.Matcher`; this one works on torch's current CUDA device.

    Calls are queued on torch's current stream; only :meth:`match` waits.

    :param features: those of the map, on any device; unit norm, strips (W, n, d), weights (W, n).
    :param spatial: how two images are compared.
    :param sequence: how a window is matched.
    :param precision: ``float32``, or ``float16``: the map is kept in half width and the query is rounded to
        it; products are summed up in float32.
    :raises UnavailableError: no CUDA device here, or the package numba-cuda is missing.
    :raises SettingsError: xi > W.
    :raises InputError: fewer strips than the sliding window has.
    """

    def __init__(
        self,
        features: LocalFeatures,
        spatial: SpatialSettings,
        sequence: SequenceSettings,
        precision: str = 'float32',
    ) -> None:
        self._runtime = runtime()
        device = self._runtime.torch_device
        self._strips = features.strips.to(device, getattr(torch, precision)).contiguous()
        self._weights = features.weights.to(device)
        self._distances = _ImageDistances(self._runtime, self._strips, self._weights, spatial)
        self._window = _Window(self._runtime, self.places, sequence)
        if self.places:
            self._warm_up()

    def _warm_up(self) -> None:
        """Compile the kernels and load the libraries now, so that the first image does not wait for them."""
        W, _, d = self._strips.shape
        self.distances(torch.zeros(W, d), torch.zeros(W))
        self.match(0)

    @property
    def places(self) -> int:
        """Number of places n of the map."""
        return self._strips.shape[1]

    def __len__(self) -> int:
        return len(self._window)

    def reset(self) -> None:
        """Forget the rows of the window."""
        self._window.reset()

    def distances(self, strips: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        """
        Distances of one image to every place.

        :param strips: shape (W, d), float32, on any device.
        :param weights: shape (W,).
        :returns: shape (n,), float32, on the device.
        """
        return self.distance_matrix(strips[:, None], weights[:, None])[0]

    def distance_matrix(self, strips: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        """
        Distances of many images to every place.

        :param strips: shape (W, Q, d), float32, on any device.
        :param weights: shape (W, Q).
        :returns: shape (Q, n), float32, on the device.
        """
        device = self._runtime.torch_device
        return self._distances.matrix(strips.to(device).transpose(0, 1), weights.to(device).T)

    def push(self, row: torch.Tensor) -> None:
        """
        Add the distances of the newest image and drop the oldest.

        :param row: shape (n,), float32.
        """
        self._window.push(row)

    def match(self, nms_radius: int) -> tuple[SequenceMatch | None, np.ndarray]:
        """
        Find the window's sequence in the map.

        :param nms_radius: the second best's midpoint is more than so many places from the nearest one's.
        :returns: the nearest sequence, None if there is none, and its warping path (window row, place), shape
            (m, 2), int32.
        """
        return self._window.match(nms_radius)

    def sequences(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the distances of the sequences matched last and their middle places."""
        return self._window.sequences()


class _ImageDistances:
    """Image distances: products by torch, alignment by the kernel of the strategy."""

    def __init__(
        self, runtime: Runtime, strips: torch.Tensor, weights: torch.Tensor, settings: SpatialSettings
    ) -> None:
        from stavpr_ros.alignment.cuda import dtw

        self._runtime, self._strips, self._weights = runtime, strips, weights
        W = strips.shape[0]
        band = settings.band(W)
        self._block, self._kernel = dtw.BLOCK, None
        self._sigma = np.float32(settings.sigma if settings.strategy == 'adaptive' else 0)
        if settings.strategy == 'sliding_window':
            if W < WINDOW:
                raise InputError(f'W = {W} strips: the sliding window needs at least {WINDOW}')
            self._kernel = dtw.sliding_window(W, WINDOW, band)
        elif settings.strategy != 'none':
            self._kernel = dtw.spatial_dtw(W, band)
        self._half = strips.dtype != torch.float32
        self._in_pieces = self._half and not runtime.half_products
        self._workspace: tuple[torch.Tensor, Any] | None = None

    def matrix(self, strips: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        """Distances (Q, n) of images (Q, W, d)."""
        out = torch.empty((len(strips), self._strips.shape[1]), device=self._strips.device)
        if out.numel() == 0:
            return out
        if self._kernel is None:
            for row, query, query_weights in zip(out, strips, weights, strict=True):
                row.copy_(self._holistic(query, query_weights))
            return out
        view = self._runtime.array(out)
        for query in range(0, len(strips), QUERIES):
            self._align(strips[query : query + QUERIES], query, view)
        return out

    def _align(self, queries: torch.Tensor, first_query: int, out: Any) -> None:
        """Write the rows of some queries, in pieces of the map that keep the products' block small."""
        W, n, _ = self._strips.shape
        vectors = queries.reshape(len(queries) * W, -1).to(self._strips.dtype)
        places = min(n, max(1, BLOCK_WORDS // (len(vectors) * W)))
        if self._in_pieces:
            places = min(places, PLACES_IN_PIECES)
        for first in range(0, n, places):
            last = min(first + places, n)
            products = self._products(vectors, first, last)
            grid = (-(-(last - first) // self._block), len(queries))
            self._runtime.launch(
                self._kernel, grid, self._block, products, self._sigma, first_query, first, out
            )

    def _products(self, vectors: torch.Tensor, first: int, last: int) -> Any:
        """Multiply query strips by those of some places: (Q W, W, last - first), as the kernels take it."""
        W, n, d = self._strips.shape
        rows = len(vectors)
        if last - first == n and not self._in_pieces:  # one product: the map is one matrix, read once
            block, view = self._space((rows, W, n), (0, 1, 2))
            self._multiply(torch.mm, vectors, self._strips.view(W * n, d).T, block.view(rows, W * n))
            return view
        block, view = self._space((W, rows, last - first), (1, 0, 2))
        references = self._strips[:, first:last].transpose(1, 2)
        self._multiply(torch.bmm, vectors.expand(W, rows, d), references, block)
        return view

    def _space(self, shape: tuple[int, ...], order: tuple[int, ...]) -> tuple[torch.Tensor, Any]:
        """Return memory of a shape and the kernel's view of it; that of the last call if it fits."""
        if self._workspace is None or self._workspace[0].shape != shape:
            self._workspace = None  # freed before the next is taken
            block = torch.empty(shape, device=self._strips.device)
            self._workspace = block, self._runtime.array(block.permute(order))
        return self._workspace

    def _multiply(self, product: Any, left: torch.Tensor, right: torch.Tensor, out: torch.Tensor) -> None:
        """Multiply, in half width with a float32 result."""
        if not self._half:
            product(left, right, out=out)
        elif self._in_pieces:  # exact products, summed up in float32: the same answers
            product(left.float(), right.float(), out=out)
        else:
            product(left, right, out_dtype=torch.float32, out=out)

    def _holistic(self, query: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        """Distances (n,) without alignment."""
        if not self._half:
            return holistic_distances(query, weights, self._strips, self._weights)
        W, n, _ = self._strips.shape
        vectors, places = query.to(self._strips.dtype)[:, :, None], n
        similarity = torch.empty((W, n, 1), device=self._strips.device)
        if self._in_pieces:
            places = PLACES_IN_PIECES
        for first in range(0, n, places):
            piece = slice(first, first + places)
            part = torch.empty_like(similarity[:, piece], memory_format=torch.contiguous_format)
            self._multiply(torch.bmm, self._strips[:, piece], vectors, part)
            similarity[:, piece] = part
        return 1 - (similarity[:, :, 0] * weights[:, None] * self._weights).sum(dim=0)


class _Window:
    """
    The rows of the last l images on the device, and their match.

    Every row is written twice, l rows apart, so that the last l rows are consecutive (oldest first).
    """

    def __init__(self, runtime: Runtime, places: int, settings: SequenceSettings) -> None:
        from stavpr_ros.alignment.cuda import lm_dtw, selection

        l, k = int(settings.length), settings.k
        block = lm_dtw.BLOCK
        blocks = -(-places // block)
        self._runtime, self._places, self._length, self._k = runtime, places, l, k
        self._kernel, self._grid, self._block = lm_dtw.lm_dtw(l, k, block), (blocks, 1), block
        device = runtime.torch_device

        def array(count: int, dtype: torch.dtype) -> Any:
            return runtime.array(torch.zeros(max(1, count), dtype=dtype, device=device))

        pitch = lm_dtw.row_pitch(places, k, block)
        self._rows = torch.full((2 * l, pitch), torch.inf, device=device)
        slots = self._rows.view(2, l, pitch)
        self._slots = [slots[:, slot, :places] for slot in range(l)]
        self._window = runtime.array(self._rows)
        self._distances = torch.full((max(1, places),), torch.inf, device=device)
        self._lengths = torch.zeros(max(1, places), dtype=torch.int32, device=device)
        self._scratch = (
            runtime.array(self._distances),
            runtime.array(self._lengths),
            array(blocks, torch.float32),
            array(blocks, torch.int32),
            array(1, torch.int32),
        )
        self._selection = selection.SelectionBuffer(runtime, l, k)
        self._count = 0

    def __len__(self) -> int:
        return min(self._count, self._length)

    def reset(self) -> None:
        """Forget the rows."""
        self._rows.fill_(torch.inf)
        self._count = 0

    def push(self, row: torch.Tensor) -> None:
        """Add a row and drop the oldest."""
        self._slots[self._count % self._length].copy_(row)
        self._count += 1

    def match(self, nms_radius: int) -> tuple[SequenceMatch | None, np.ndarray]:
        """Find the nearest start and its second best, and trace the path on the host."""
        no_path = np.empty((0, 2), np.int32)
        if self._places == 0:
            return None, no_path
        apart = min(nms_radius, self._places)  # no two midpoints are farther apart
        first = self._count % self._length
        self._runtime.launch(
            self._kernel,
            self._grid,
            self._block,
            self._window,
            first,
            apart,
            *self._scratch,
            *self._selection.arguments,
        )
        found = self._selection.fetch()
        if found.start < 0:
            return None, no_path
        path = trace_sequence(found.cells, 0, self._k).path
        path[:, 1] += found.start
        second_best = found.second_best_start >= 0
        middle = (2 * found.second_best_start + found.second_best_length - 1) // 2
        return SequenceMatch(
            first=found.start,
            last=found.start + found.length - 1,
            middle=(2 * found.start + found.length - 1) // 2,
            distance=found.distance,
            second_best_index=middle if second_best else -1,
            second_best_distance=found.second_best_distance if second_best else float('nan'),
        ), path

    def sequences(self) -> tuple[np.ndarray, np.ndarray]:
        """Return distances and middle places of the last match: all are copied back for this."""
        places = self._places
        found = SequenceDistances(
            self._distances[:places].cpu().numpy(), self._lengths[:places].cpu().numpy()
        )
        return found.distances, found.middles
