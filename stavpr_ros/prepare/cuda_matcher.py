# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The matcher on a CUDA device, where the features of the map stay."""

from typing import Any

import numpy as np
from stavpr_ros.alignment.cpu.int8 import rounded_queries
from stavpr_ros.alignment.cuda.compilation import runtime
from stavpr_ros.alignment.settings import SpatialSettings
from stavpr_ros.alignment.spatial import WINDOW
from stavpr_ros.features import LocalFeatures
from stavpr_ros.prepare.int8_features import Int8Features
import torch

BLOCK_WORDS = 2**26  # most words of products in memory at a time: 256 MiB
QUERIES = 32  # most images of a batch whose products are made at once
PLACES_IN_PIECES = 2**14  # most places of int8 widened at a time


class CudaMatcher:
    """
    See :class:`stavpr_ros.prepare.matcher.Matcher`; on torch's current CUDA device.

    Products by torch, alignment by the kernel of the strategy. Calls are queued on torch's current
    stream.

    :param features: those of the map; unit norm, strips (W, n, d), weights (W, n). If they are
        int8, queries are rounded as well; strip distances are those of the CPU, bit for bit.
    :param spatial: how two images are compared.
    :raises UnavailableError: no CUDA device here, or the package numba-cuda is missing.
    :raises SettingsError: xi > W.
    """

    def __init__(
        self,
        features: LocalFeatures | Int8Features,
        spatial: SpatialSettings,
    ) -> None:
        self._runtime = runtime()
        device = self._runtime.torch_device
        if isinstance(features, Int8Features):
            lengths = features.strips.reciprocals[:, : len(features)]
            self._strips = torch.from_numpy(features.strips.rounded()).to(device)
            self._reciprocals: torch.Tensor | None = torch.from_numpy(lengths).to(device)
        else:
            strips = np.ascontiguousarray(features.strips, np.float32)
            self._strips, self._reciprocals = torch.from_numpy(strips).to(device), None
        self._weights = torch.from_numpy(features.weights).to(device)
        self._workspace: tuple[torch.Tensor, Any] | None = None
        self._choose_kernel(spatial)
        if self.places:  # compiles the kernel and loads the libraries before the first image
            W, _, d = self._strips.shape
            self.distances(np.zeros((W, d), np.float32), np.zeros(W, np.float32))

    def _choose_kernel(self, spatial: SpatialSettings) -> None:
        from stavpr_ros.alignment.cuda import dtw

        W = self._strips.shape[0]
        band = spatial.band(W)
        self._block, self._kernel = dtw.BLOCK, None
        self._sigma = np.float32(spatial.sigma if spatial.strategy == 'adaptive' else 0)
        if spatial.strategy == 'sliding_window':
            self._kernel = dtw.sliding_window(W, WINDOW, band)
        elif spatial.strategy != 'none':
            self._kernel = dtw.spatial_dtw(W, band)

    @property
    def places(self) -> int:
        """Return the number of places n of the map."""
        return self._strips.shape[1]

    def distances(self, strips: np.ndarray, weights: np.ndarray) -> torch.Tensor:
        """Return the distances of one image to every place, (n,), on the device."""
        return self._rows(strips[:, None], weights[:, None])[0]

    def distance_matrix(self, strips: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the distances of Q images to every place, (Q, n)."""
        rows: np.ndarray = self._rows(strips, weights).cpu().numpy()
        return rows

    def _rows(self, strips: np.ndarray, weights: np.ndarray) -> torch.Tensor:
        device = self._runtime.torch_device
        queries = np.ascontiguousarray(strips.transpose(1, 0, 2))
        out = torch.empty((len(queries), self.places), device=device)
        if out.numel() == 0:
            return out
        if self._kernel is None:
            of_device = torch.from_numpy(np.ascontiguousarray(weights.T)).to(device)
            for row, query, query_weights in zip(out, queries, of_device, strict=True):
                row.copy_(self._holistic(query, query_weights))
            return out
        view = self._runtime.array(out)
        for query in range(0, len(queries), QUERIES):
            self._align(queries[query : query + QUERIES], query, view)
        return out

    def _align(self, queries: np.ndarray, first_query: int, out: Any) -> None:
        """Write the rows of queries, a piece of the map at a time: products stay small."""
        W, n, _ = self._strips.shape
        vectors, lengths = self._rounded(queries)
        places = min(n, max(1, BLOCK_WORDS // (len(vectors) * W)))
        if self._reciprocals is not None:
            places = min(places, PLACES_IN_PIECES)
        for first in range(0, n, places):
            last = min(first + places, n)
            products = self._products(vectors, lengths, first, last)
            grid = (-(-(last - first) // self._block), len(queries))
            self._runtime.launch(
                self._kernel, grid, self._block, products, self._sigma, first_query, first, out
            )

    def _rounded(self, queries: np.ndarray) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Return queries (Q, W, d) in the map's type, (Q W, d), and their reciprocal lengths."""
        rows, d = queries.shape[0] * queries.shape[1], queries.shape[2]
        device = self._strips.device
        if self._reciprocals is None:
            return torch.from_numpy(queries.reshape(rows, d)).to(device), None
        whole, lengths = (
            torch.from_numpy(part).to(device)
            for part in rounded_queries(queries.transpose(1, 0, 2))
        )
        return whole.reshape(rows, d), lengths.reshape(rows)

    def _products(
        self, vectors: torch.Tensor, lengths: torch.Tensor | None, first: int, last: int
    ) -> Any:
        """Multiply query strips by those of places: (Q W, W, last - first), for kernels."""
        W, n, d = self._strips.shape
        rows = len(vectors)
        is_whole = last - first == n and self._reciprocals is None
        if is_whole and self._strips.is_contiguous():  # the map is one matrix, read once
            block, view = self._space((rows, W, n), (0, 1, 2))
            references = self._strips.view(W * n, d).T.float()
            torch.mm(vectors.float(), references, out=block.view(rows, W * n))
            return view
        block, view = self._space((W, rows, last - first), (1, 0, 2))
        # products of whole numbers and their sums are exact in float32
        references = self._strips[:, first:last].transpose(1, 2).float()
        torch.bmm(vectors.expand(W, rows, d).float(), references, out=block)
        if self._reciprocals is not None and lengths is not None:
            block.mul_(self._reciprocals[:, None, first:last]).mul_(lengths[:, None])
        return view

    def _space(self, shape: tuple[int, ...], order: tuple[int, ...]) -> tuple[torch.Tensor, Any]:
        """Return memory of a shape and the kernel's view of it; the last call's if it fits."""
        if self._workspace is None or self._workspace[0].shape != shape:
            self._workspace = None  # freed before the next is taken
            block = torch.empty(shape, device=self._strips.device)
            self._workspace = block, self._runtime.array(block.permute(order))
        return self._workspace

    def _holistic(self, query: np.ndarray, weights: torch.Tensor) -> torch.Tensor:
        """Distances (n,) without alignment."""
        W, n, _ = self._strips.shape
        vectors, lengths = self._rounded(query[None])
        if lengths is None or self._reciprocals is None:
            similarity = torch.bmm(self._strips, (vectors * weights[:, None])[:, :, None])
            return 1 - (similarity[:, :, 0] * self._weights).sum(dim=0)
        similarity = torch.empty((W, n, 1), device=self._strips.device)
        for first in range(0, n, PLACES_IN_PIECES):
            piece = slice(first, first + PLACES_IN_PIECES)
            part = torch.empty_like(similarity[:, piece], memory_format=torch.contiguous_format)
            torch.bmm(self._strips[:, piece].float(), vectors[:, :, None].float(), out=part)
            similarity[:, piece] = part
        similarity.mul_(self._reciprocals[:, :, None]).mul_(lengths[:, None, None])
        return 1 - (similarity[:, :, 0] * weights[:, None] * self._weights).sum(dim=0)
