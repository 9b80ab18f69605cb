# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The windows of a query on a device of torch: twins of those on the CPU, with rows as tensors."""

from functools import partial
from typing import Any

import numpy as np
from stavpr_ros.alignment.device import lm_dtw, nearest_starts
from stavpr_ros.alignment.lm_dtw import SequenceDistances, trace_sequence
from stavpr_ros.alignment.settings import SequenceSettings
from stavpr_ros.device_graph import DeviceGraph, HostCopy
from stavpr_ros.method.columns import ColumnLayout
from stavpr_ros.method.device_filter import DevicePlaceFilter
from stavpr_ros.method.match import Path, WindowMatch, WindowSequences
from stavpr_ros.method.window import FilterWindow, QueryWindow
from stavpr_ros.prepare.normalization import MIN_DEVIATION
import torch


def z_normalized_on_device(row: torch.Tensor, counted: torch.Tensor) -> torch.Tensor:
    """Return a row as :func:`stavpr_ros.prepare.normalization.z_normalized`, without waiting."""
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
        self._layout = layout
        self._counted = None if counted is None else torch.from_numpy(counted).to(device)
        columns = torch.from_numpy(layout.columns_of(np.arange(layout.passes(places))))
        self._columns = columns.to(device)
        self._places = torch.from_numpy(layout.of_passes(np.arange(places))).to(device)
        self._row = torch.zeros(places, device=device)
        self._out = torch.full((layout.width(places),), torch.inf, device=device)
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
            runs = self._layout.runs
            row = torch.cat([z_normalized_on_device(row[run], counted[run]) for run in runs])
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
            counted = self.change.distinct(n)
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
