# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The matcher in torch operations: the features of the map stay on the device."""

import numpy as np
from stavpr_ros.alignment.cpu.int8 import round_queries
from stavpr_ros.alignment.device import spatial_alignment
from stavpr_ros.alignment.settings import SpatialSettings
from stavpr_ros.device_graph import DeviceGraph, HostCopy
from stavpr_ros.features import LocalFeatures
from stavpr_ros.prepare.blocks import Int8Features
import torch

WIDENED = 2**23  # most int8 values that are float32 at a time: 32 MiB, which fit into a cache


class DeviceMatcher:
    """
    Twin of :class:`stavpr_ros.prepare.matcher.CpuMatcher`; distances are tensors on the device.

    :param features: those of the map; unit norm, strips (W, n, d), weights (W, n). If they are
        int8, queries are rounded as well; strip distances are those of the CPU, bit for bit.
    :param spatial: how two images are compared.
    :raises SettingsError: xi > W.
    """

    def __init__(
        self,
        features: LocalFeatures,
        spatial: SpatialSettings,
        device: torch.device,
    ) -> None:
        W, n, d = features.strips.shape
        self._lengths: torch.Tensor | None = None
        self.places = at_once = n
        if isinstance(features, Int8Features):
            lengths = features.strips.reciprocals[:, :n]
            strips, self._lengths = features.strips.codes(), torch.from_numpy(lengths).to(device)
            at_once = max(1, WIDENED // (W * d))
        else:
            strips = np.ascontiguousarray(features.strips, np.float32)
        # a piece of the map each, (W, at_once, d)
        self._pieces = [
            torch.from_numpy(strips[:, first : first + at_once]).to(device).contiguous()
            for first in range(0, n, max(1, at_once))
        ]
        self._query = torch.zeros(W, d + 2, device=device)  # strip, its length if int8, weight
        self._sent = HostCopy(self._query)
        self._row = torch.empty(n, device=device)
        self._align = None
        if spatial.strategy == 'none':
            self._weights = torch.from_numpy(features.weights).T.to(device)
        else:
            self._align = spatial_alignment(W, spatial, device)
        self._graph = DeviceGraph(device, self._compute)
        for _ in range(2 if n else 0):  # the second one captures the graph
            self.distances(np.zeros((W, d), np.float32), np.zeros(W, np.float32))

    def strips_of(self, places: np.ndarray) -> np.ndarray:
        """Return the strips of places, (W, m, d), float32; in int8, rounded ones."""
        size = self._pieces[0].shape[1]
        strips = [self._pieces[place // size][:, place % size] for place in places.tolist()]
        rows = torch.stack(strips, 1).float()
        if self._lengths is not None:
            rows *= self._lengths[:, torch.from_numpy(places).to(rows.device), None]
        return rows.cpu().numpy()

    def distances(self, strips: np.ndarray, weights: np.ndarray) -> torch.Tensor:
        """Return the distances of one image to every place, (n,), on the device."""
        if self.places:
            self._sent.wait()
            query, lengths = strips, np.float32(1)
            if self._lengths is not None:
                query, lengths = (part[0] for part in round_queries(strips[:, None]))
            self._sent.numpy[:, :-2], self._sent.numpy[:, -2] = query, lengths
            self._sent.numpy[:, -1] = weights
            self._sent.send()
            self._graph()
        return self._row.clone()

    def distance_matrix(self, strips: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the distances of Q images to every place, (Q, n)."""
        rows = np.empty((strips.shape[1], self.places), np.float32)
        for x, row in enumerate(rows):
            row[:] = self.distances(strips[:, x], weights[:, x]).cpu().numpy()
        return rows

    def _compute(self) -> None:
        d = self._strip_distances()
        if self._align is not None:
            self._row.copy_(self._align(d))
        else:
            similarity = (1 - d.diagonal()) * self._weights  # (n, W)
            self._row.copy_(1 - similarity @ self._query[:, -1])

    def _strip_distances(self) -> torch.Tensor:
        """Return the distances of the query's strips to all strips of the map, (W, W, n)."""
        W, n = len(self._query), self.places
        negative = -self._query[:, :-2]
        if self._lengths is None:
            products = negative @ self._pieces[0].view(W * n, -1).T
            return products.add_(1).view(W, W, n)
        out, first = torch.empty((W, W, n), device=self._query.device), 0
        for strips in self._pieces:  # whole numbers: products and sums are exact
            products = (negative @ strips.float().view(W * strips.shape[1], -1).T).view(W, W, -1)
            here = slice(first, first + strips.shape[1])
            torch.mul(products, self._lengths[:, here], out=out[:, :, here])
            first = here.stop
        return out.mul_(self._query[:, None, -2:-1]).add_(1)
