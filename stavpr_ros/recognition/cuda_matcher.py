# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The matcher on a CUDA device, where the features of the map stay."""

from typing import Any

import numpy as np
from stavpr_ros.alignment.cpu.int8 import rounded_queries
from stavpr_ros.alignment.cuda.compilation import runtime
from stavpr_ros.alignment.settings import SpatialSettings
from stavpr_ros.alignment.similarity import holistic_distances
from stavpr_ros.alignment.spatial import WINDOW
from stavpr_ros.errors import InputError
from stavpr_ros.features import LocalFeatures
from stavpr_ros.recognition.int8_features import Int8Features, rounded
from stavpr_ros.recognition.route_strips import DeviceInt8Route, RouteStrips
import torch

BLOCK_WORDS = 2**26  # most words of products in memory at a time: 256 MiB
QUERIES = 32  # most images of a batch whose products are made at once
AT_ONCE = 1024  # places of a route: the memory of products is the same for so many
PLACES_IN_PIECES = 2**14  # most places of int8 widened at a time


class CudaMatcher:
    """
    See :class:`stavpr_ros.recognition.matcher.Matcher`; on torch's current CUDA device.

    Products by torch, alignment by the kernel of the strategy. Calls are queued on torch's current
    stream.

    :param features: those of the map, on any device; unit norm, strips (W, n, d), weights (W, n).
    :param spatial: how two images are compared.
    :param precision: ``float32``, or ``int8``: map and query are rounded to it; strip distances
        are those of the CPU, bit for bit.
    :raises UnavailableError: no CUDA device here, or the package numba-cuda is missing.
    :raises SettingsError: xi > W.
    :raises InputError: fewer strips than the sliding window has.
    """

    def __init__(
        self,
        features: LocalFeatures | Int8Features,
        spatial: SpatialSettings,
        precision: str = 'float32',
    ) -> None:
        self._runtime = runtime()
        device = self._runtime.torch_device
        if precision == 'int8' and isinstance(features, LocalFeatures):
            features = rounded(features, lambda block: block)
        if isinstance(features, Int8Features):
            lengths = features.strips.reciprocals[:, : len(features)]
            self._set_strips(
                features.strips.rounded().to(device), torch.from_numpy(lengths).to(device)
            )
        else:
            self._set_strips(features.strips.to(device, torch.float32).contiguous(), None)
        self._weights = features.weights.to(device)
        self._workspace: tuple[torch.Tensor, Any] | None = None
        self._choose_kernel(spatial)
        if self.places:  # compiles the kernel and loads the libraries before the first image
            W, _, d = self._strips.shape
            self.distances(torch.zeros(W, d), torch.zeros(W))

    def _set_strips(self, strips: torch.Tensor, reciprocals: torch.Tensor | None) -> None:
        """Compare with these strips; reciprocal lengths are of int8."""
        self._strips, self._reciprocals = strips, reciprocals

    def _choose_kernel(self, spatial: SpatialSettings) -> None:
        from stavpr_ros.alignment.cuda import dtw

        W = self._strips.shape[0]
        band = spatial.band(W)
        self._block, self._kernel = dtw.BLOCK, None
        self._sigma = np.float32(spatial.sigma if spatial.strategy == 'adaptive' else 0)
        if spatial.strategy == 'sliding_window':
            if W < WINDOW:
                raise InputError(f'W = {W} strips: the sliding window needs at least {WINDOW}')
            self._kernel = dtw.sliding_window(W, WINDOW, band)
        elif spatial.strategy != 'none':
            self._kernel = dtw.spatial_dtw(W, band)

    @property
    def places(self) -> int:
        """Return the number of places n of the map."""
        return self._strips.shape[1]

    def distances(self, strips: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        """Return the distances of one image, on any device, to every place, (n,)."""
        return self.distance_matrix(strips[:, None], weights[:, None])[0]

    def distance_matrix(self, strips: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        """Return the distances of Q images, on any device, to every place, (Q, n)."""
        device = self._runtime.torch_device
        strips = strips.transpose(0, 1)
        if self._reciprocals is None:  # others are rounded on the CPU
            strips = strips.to(device)
        out = torch.empty((len(strips), self._strips.shape[1]), device=self._strips.device)
        if out.numel() == 0:
            return out
        if self._kernel is None:
            for row, query, query_weights in zip(out, strips, weights.to(device).T, strict=True):
                row.copy_(self._holistic(query, query_weights))
            return out
        view = self._runtime.array(out)
        for query in range(0, len(strips), QUERIES):
            self._align(strips[query : query + QUERIES], query, view)
        return out

    def _align(self, queries: torch.Tensor, first_query: int, out: Any) -> None:
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

    def _rounded(self, queries: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Return queries (Q, W, d) in the map's type, (Q W, d), and their reciprocal lengths."""
        rows, d = queries.shape[0] * queries.shape[1], queries.shape[2]
        if self._reciprocals is None:
            return queries.reshape(rows, d), None
        whole, lengths = (
            torch.from_numpy(part).to(self._strips.device)
            for part in rounded_queries(queries.transpose(0, 1))
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

    def _holistic(self, query: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        """Distances (n,) without alignment."""
        if self._reciprocals is None:
            return holistic_distances(query, weights, self._strips, self._weights)
        W, n, _ = self._strips.shape
        vectors, lengths = self._rounded(query[None])
        assert lengths is not None
        similarity = torch.empty((W, n, 1), device=self._strips.device)
        for first in range(0, n, PLACES_IN_PIECES):
            piece = slice(first, first + PLACES_IN_PIECES)
            part = torch.empty_like(similarity[:, piece], memory_format=torch.contiguous_format)
            torch.bmm(self._strips[:, piece].float(), vectors[:, :, None].float(), out=part)
            similarity[:, piece] = part
        similarity.mul_(self._reciprocals[:, :, None]).mul_(lengths[:, None, None])
        return 1 - (similarity[:, :, 0] * weights[:, None] * self._weights).sum(dim=0)


class CudaRouteMatcher(CudaMatcher):
    """
    Compares an image with the oldest places of a route that grows on the device.

    :param W: strips of an image.
    :param spatial: strategies ``adaptive`` and ``vanilla``.
    :raises UnavailableError: no CUDA device here, or the package numba-cuda is missing.
    :raises SettingsError: xi > W.
    """

    def __init__(self, W: int, spatial: SpatialSettings) -> None:
        self._runtime = runtime()
        self._set_strips(torch.empty((W, 0, 0)), None)
        self._workspace = None
        self._choose_kernel(spatial)

    @property
    def device(self) -> torch.device:
        """Return where the route lies."""
        return self._runtime.torch_device

    def to_oldest(self, strips: RouteStrips, newest: torch.Tensor, places: int) -> torch.Tensor:
        """
        Return the distances of an image to the oldest places, (places,), on the device.

        Memory for more places is compared with as well, so that its size seldom changes.

        :param strips: of the route; newest: of the image, (W, 1, d), float32.
        """
        ahead = slice(min(strips.shape[1], -(-places // AT_ONCE) * AT_ONCE))
        if isinstance(strips, DeviceInt8Route):
            self._set_strips(strips.whole[:, ahead], strips.reciprocals[:, ahead])
        else:
            assert isinstance(strips, torch.Tensor)
            self._set_strips(strips[:, ahead], None)
        return self.distance_matrix(newest, newest[:, :, 0])[0, :places]
