# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The place filter in torch operations: its states stay on the device; a copy an image returns."""

from typing import Any

import numpy as np
from stavpr_ros import checks
from stavpr_ros.device_graph import DeviceGraph, HostCopy
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.method.filter import (
    BLOCK,
    BLOCKS,
    Image,
    NEGLIGIBLE,
    PlaceFilter,
    SPACING,
    STEEPEST,
)
from stavpr_ros.method.straight import FAR
import torch
from torch.nn.functional import conv1d, max_pool1d, pad

PLACES_AT_ONCE = 1 << 17  # columns of straight paths


class DevicePlaceFilter(PlaceFilter):
    """
    A :class:`stavpr_ros.method.filter.PlaceFilter` whose states are on a device of torch.

    Probabilities differ from those of the CPU in the last digits: sums are formed in another
    order. Only the first question about an image waits for the device. Values of z that are
    tensors are not checked, which would wait for it.

    :param device: of torch; others: see :class:`stavpr_ros.method.filter.PlaceFilter`.
    """

    def __init__(self, *arguments: Any, device: torch.device | str, **options: Any) -> None:
        self._device = torch.device(device)
        self._graph = DeviceGraph(self._device, self._compute)
        self._image: Image | None = None  # the newest one, until its results were read
        super().__init__(*arguments, **options)

    def _zeros(self, shape: tuple[int, ...]) -> torch.Tensor:
        return torch.zeros(shape, device=self._device)

    def _allocate(self, width: int) -> None:
        super()._allocate(max(width, 1))
        self._width, (V, n) = width, self._now.shape
        # the probability that the speed changes, by the one after it and the one before
        changes = np.eye(V) * (1 - self.model.change)
        for neighbor in (-1, 1):
            before = np.clip(np.arange(V) + neighbor, 0, V - 1)
            np.add.at(changes, (np.arange(V), before), self.model.change / 2)
        self._changes = torch.from_numpy(changes).float().to(self._device)
        taps = np.ascontiguousarray(self._steps[:, None, ::-1])
        self._taps = torch.from_numpy(taps).to(self._device)
        self._gap_columns = torch.from_numpy(self._gaps).long().to(self._device)
        self._row = self._zeros((n,))  # z of the newest image
        self._inputs = self._zeros((5,))  # row of the ring, slope, offset, entering, scale
        self._blocks = min(BLOCKS, -(-n // BLOCK))
        # sums of the states that arrived and of the new ones; of blocks; their first columns
        out = torch.zeros(2 + 2 * self._blocks, dtype=torch.float64, device=self._device)
        self._out, self._sent, self._received = out, HostCopy(self._inputs), HostCopy(out)

    def _on_host(self, values: torch.Tensor) -> np.ndarray:
        return values.cpu().numpy()

    def _vector(self, z: Any) -> torch.Tensor:
        if not isinstance(z, torch.Tensor):
            return torch.from_numpy(super()._vector(z))
        checks.require_shape('z', z, 'n')
        least = int(self._gaps.max(initial=-1)) + 1
        if not (z.is_floating_point() and least <= len(z) <= self._width):
            expected = f'expected {least} to {self._width}, floating-point'
            raise InputError(f'z of {len(z)} places, {z.dtype}: {expected}')
        return z

    def _advance(self, z: torch.Tensor, image: Image, scale: float) -> None:
        s, alpha = self.model, image.weight
        if self.count % SPACING == 1:
            self._keep(self._free.pop().copy_(self._now), scale)
        self._row[: len(z)], self._row[len(z) :] = z, torch.inf
        slope, offset = alpha * s.level, alpha * s.level**2 / 2
        self._sent.numpy[:] = self.count % self._rows, slope, offset, image.entering, scale
        self._sent.send()
        self._graph()
        self._received.receive()
        self._image = image

    def _compute(self) -> None:
        """Advance the states by the inputs, and collect what the host reads."""
        slot, slope, offset, entering, scale = self._inputs.split(1)
        (V, n), reach = self._now.shape, self.model.reach
        row = self._row.index_fill_(0, self._gap_columns, torch.inf)
        self._z.index_copy_(0, slot.long(), row[None])
        valid = row < torch.inf
        exponents = torch.addcmul(-offset, slope, row.clamp(max=self.model.most))
        likelihoods = exponents.clamp_(-STEEPEST, STEEPEST).exp_()
        moved = conv1d(self._now[None], self._taps, padding=reach, groups=V)[0, :, :n]
        came = torch.addcmul(entering, self._changes @ moved, scale)
        came.masked_fill_(~valid, 0)
        torch.mul(came, torch.where(valid, likelihoods, 0), out=self._now)
        torch.sum(self._now, dim=0, out=self._sums)
        totals = [each.sum(dtype=torch.float64) for each in (came.sum(dim=0), self._sums)]
        masses = pad(self._sums, (0, -n % BLOCK)).view(-1, BLOCK).sum(dim=1)
        top, blocks = masses.topk(self._blocks)
        torch.cat([torch.stack(totals), top.double(), BLOCK * blocks.double()], out=self._out)

    def _read(self) -> None:
        if self._image is None:
            return
        self._received.wait()
        arrived, on_map = self._received.numpy[:2].tolist()
        scale = self._normalize(arrived, on_map)
        masses, blocks = np.split(self._received.numpy[2:], 2)
        blocks = blocks[masses * scale > NEGLIGIBLE].astype(np.int64)
        self._images.append(self._image._replace(scale=scale, blocks=blocks))
        self._image = None

    def _best_straight(
        self, rows: np.ndarray, low: int, end: int, steps: np.ndarray, excluded: np.ndarray
    ) -> tuple[float, np.ndarray]:
        reach, far = max(-int(steps.min()), int(steps.max()), 0), float(FAR)
        z = self._z[torch.from_numpy(rows).to(self._device)]
        near = -max_pool1d(-z, 3, stride=1, padding=1)  # the least of three
        near = pad(torch.where(near.isfinite(), near, far), (reach, reach), value=far)
        shifts = torch.from_numpy(steps.T + reach).to(self._device)
        best, path = np.inf, np.empty(0, np.int64)
        for first in range(low, end, PLACES_AT_ONCE):
            m = min(end - first, PLACES_AT_ONCE)
            sums = self._zeros((len(steps), m))
            for image, shift in zip(near, shifts, strict=True):
                sums += image[first : first + m + 2 * reach].unfold(0, m, 1)[shift]
            for start, stop in np.maximum(excluded - first, 0).tolist():
                sums[:, start:stop] = torch.inf
            at = sums.argmin()
            least, number = torch.stack([sums.view(-1)[at].double(), at.double()]).tolist()
            if least < best:
                best, (speed, place) = least, divmod(int(number), m)
                path = np.clip(first + place + steps[speed], 0, self._width - 1)
        return -best / steps.shape[1], path

    def grow(self, columns: int) -> None:
        """Reject columns of a route: it is filtered on the CPU."""
        raise SettingsError("the filter of a device has one map: take backend 'cpu' for a route")

    def evict(self, count: int) -> None:
        """See :meth:`grow`."""
        self.grow(-count)
