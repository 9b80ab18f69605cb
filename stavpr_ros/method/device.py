# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The place filter and the windows of a query on a device of torch: twins of those on the CPU.

States and rows of distances are tensors that stay on the device.
"""

from functools import partial
from typing import Any

import numpy as np
from stavpr_ros import checks
from stavpr_ros.alignment.device import lm_dtw, nearest_starts
from stavpr_ros.alignment.lm_dtw import SequenceDistances, trace_sequence
from stavpr_ros.alignment.settings import SequenceSettings
from stavpr_ros.device_graph import DeviceGraph, HostCopy
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.method.columns import ColumnLayout
from stavpr_ros.method.filter import (
    BLOCK,
    BLOCKS,
    Image,
    NEGLIGIBLE,
    PlaceFilter,
    SPACING,
    STEEPEST,
)
from stavpr_ros.method.match import Path, WindowMatch, WindowSequences
from stavpr_ros.method.path import FAR
from stavpr_ros.method.window import FilterWindow, QueryWindow
from stavpr_ros.prepare.centering import MIN_DEVIATION
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
            self._take_snapshot(self._free.pop().copy_(self._now), scale)
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
        totals = [sums.sum(dtype=torch.float64) for sums in (came.sum(dim=0), self._sums)]
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


def z_normalized_on_device(row: torch.Tensor, counted: torch.Tensor) -> torch.Tensor:
    """Return a row as :func:`stavpr_ros.prepare.centering.z_normalized`, without waiting."""
    known = torch.isfinite(row) & counted
    count = known.sum().clamp(min=1)
    off = row - torch.where(known, row, 0).sum(dtype=torch.float64) / count
    variance = torch.where(known, off, 0).square().sum() / count
    return (off / variance.sqrt().clamp(min=MIN_DEVIATION)).float()


class RowColumns:
    """
    Distances to places as a row of a window's columns, normalized, on the device.

    :param counted: places that count for mean and deviation of a row, (n,), bool; None: distances
        are not normalized.
    :param layout: of the places.
    """

    def __init__(
        self, counted: np.ndarray | None, layout: ColumnLayout, places: int, device: torch.device
    ) -> None:
        self._cuts = layout.starts[1:].tolist()
        self._counted = None if counted is None else torch.from_numpy(counted).to(device)
        sources = layout.to_columns(np.arange(float(places)))
        columns = np.flatnonzero(np.isfinite(sources))
        self._columns = torch.from_numpy(columns).to(device)
        self._places = torch.from_numpy(sources[columns].astype(np.int64)).to(device)
        self._row = torch.zeros(places, device=device)
        self._out = torch.full((len(sources),), torch.inf, device=device)
        self._graph = DeviceGraph(device, self._compute)

    def __call__(self, row: torch.Tensor) -> torch.Tensor:
        """Return the row of columns; valid until the next call."""
        if len(row):
            self._row.copy_(row)
            self._graph()
        return self._out

    def _compute(self) -> None:
        row = self._row
        if (counted := self._counted) is not None:
            parts = row.tensor_split(self._cuts), counted.tensor_split(self._cuts)
            row = torch.cat(list(map(z_normalized_on_device, *parts)))
        self._out.index_copy_(0, self._columns, row[self._places])


class DeviceFilterWindow(FilterWindow):
    """
    A :class:`FilterWindow` whose rows and filter are on a device.

    :param device: of torch; other parameters: see :class:`FilterWindow`.
    """

    def __init__(self, *arguments: Any, device: torch.device, **options: Any) -> None:
        self._device = device
        self._row_columns: RowColumns | None = None
        self.filter_class = partial(DevicePlaceFilter, device=device)
        super().__init__(*arguments, **options)

    def newest_row(self) -> np.ndarray:
        """Return the row of the newest image, (n,), copied from the device."""
        row: Any = self._newest
        return row.cpu().numpy() if isinstance(row, torch.Tensor) else super().newest_row()

    def _z(self, row: torch.Tensor) -> torch.Tensor:
        if self._row_columns is None:  # the map has been learned
            n = len(row)
            counted = self.change.distinct(self.layout.along(n))
            self._row_columns = RowColumns(counted, self.layout, n, self._device)
        return self._row_columns(row)


class DeviceLmDtwWindow(QueryWindow):
    """
    LM-DTW on a device; only a match waits for it. Rows are not checked, which would, too.

    :param sequence: l and k.
    :param places: number of places n.
    :param layout: of the places.
    """

    def __init__(
        self,
        sequence: SequenceSettings,
        places: int,
        layout: ColumnLayout,
        device: torch.device,
    ) -> None:
        super().__init__(sequence.length, layout)
        n, l, k = layout.width(places), sequence.length, sequence.k
        self._k, self._width = k, n
        self._row_columns = RowColumns(None, layout, places, device)
        self._rows = torch.full((l, n + k - 1), torch.inf, device=device)  # oldest image first
        self._distances = torch.full((n,), torch.inf, device=device)
        self._lengths = torch.zeros(n, dtype=torch.int64, device=device)
        radius = min(layout.nms_radius, n)  # no two midpoints are farther apart
        self._radius = torch.tensor(radius, device=device)
        # of the nearest start and the nearest elsewhere: s, m and q; and the cells of the nearest
        self._out = torch.zeros(6 + l * k, dtype=torch.float64, device=device)
        self._received = HostCopy(self._out)
        self._graph = DeviceGraph(device, self._compute)

    def push(self, row: torch.Tensor, strips: np.ndarray, stamp: int) -> None:
        """See :meth:`QueryWindow.push`; the row is on the device."""
        self._rows.copy_(self._rows.roll(-1, 0))
        self._rows[-1, : self._width] = self._row_columns(row)
        self._append(stamp)

    def newest_row(self) -> np.ndarray:
        """See :meth:`QueryWindow.newest_row`; copied from the device."""
        return self._rows[-1, : self._width].cpu().numpy()

    def at(self, columns: np.ndarray) -> np.ndarray:
        """See :meth:`QueryWindow.at`; copied from the device."""
        rows = self._rows[self.length - len(self.images) :]
        return rows[:, torch.from_numpy(columns).to(rows.device)].cpu().numpy()

    def reset(self) -> None:
        """Drop all images."""
        super().reset()
        self._rows.fill_(torch.inf)

    def _compute(self) -> None:
        k = self._k
        distances, lengths = lm_dtw(self._rows, k)
        self._distances.copy_(distances)
        self._lengths.copy_(lengths)
        starts, nearest = nearest_starts(distances, lengths, self._radius)
        columns = starts[:1] + torch.arange(k, device=starts.device)
        cells = self._rows.index_select(1, columns).view(-1)
        parts = starts, lengths.index_select(0, starts), nearest, cells
        torch.cat([part.double() for part in parts], out=self._out)

    def match(self) -> WindowMatch:
        """Find the nearest start and its second best on the device; trace the path on the host."""
        if not self._width:
            return WindowMatch()
        self._graph()
        self._received.receive()
        self._received.wait()
        start, second, length, second_length = self._received.numpy[:4].astype(np.int64).tolist()
        distance, second_distance = self._received.numpy[4:6].tolist()
        if not np.isfinite(distance):
            return WindowMatch()
        cells = self._received.numpy[6:].astype(np.float32).reshape(self.length, self._k)
        pairs = trace_sequence(cells, 0, self._k)
        pairs[:, 1] += start
        has_second = np.isfinite(second_distance)
        path = Path(
            pairs,
            (2 * start + length - 1) // 2,
            distance,
            second_best=(2 * second + second_length - 1) // 2 if has_second else -1,
            second_best_distance=second_distance if has_second else float('nan'),
        )
        return self.layout.in_places(WindowMatch(path, self._sequences), True)

    def _sequences(self) -> WindowSequences:
        """Copy distances and lengths of all starts to the host."""
        matches = SequenceDistances(self._distances.cpu().numpy(), self._lengths.cpu().numpy())
        return WindowSequences(matches.distances, matches.middles)
