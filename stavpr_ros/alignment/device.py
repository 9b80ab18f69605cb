# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Both alignments in torch operations, on any device of torch: the twins of ``alignment.cpu``.

The cells (i, j) of an anti-diagonal i + j = t depend on the two before alone. So each operation
advances all of them, for all places, or all starts of LM-DTW, at once. A cell overwrites the one
diagonally before it, (i - 1, j - 1)::

    S, F    (2, half, n)    cell (i, j) is in row r = columns + i - j, which is [r % 2, r // 2]:
                            the cells of an anti-diagonal are one block, the cell above is in row
                            r - 1, the one to the left in row r + 1

The path's cost follows from its number D of diagonal steps, C[i, j] = i + j + 1 + (a - 2) D. Kept
is F = D - t // 2, which a diagonal step, from t - 2 to t, does not change.
"""

from collections.abc import Callable, Iterable

import numpy as np
from stavpr_ros.alignment.cpu.dtw import SHIFT_COST
from stavpr_ros.alignment.settings import SpatialSettings
from stavpr_ros.alignment.spatial import adaptive_weights, WINDOW
import torch

Diagonal = tuple[int, int, int]  # t, i of the first cell, number of cells


def diagonals(rows: int, columns: int, band: int) -> list[Diagonal]:
    """List the anti-diagonals that have cells; those with |i - j| >= band are banned."""
    all_diagonals = []
    for t in range(rows + columns - 1):
        first = max(0, t - columns + 1, (t - band) // 2 + 1)
        all_diagonals.append((t, first, min(rows - 1, t, (t + band - 1) // 2) - first + 1))
    return [diagonal for diagonal in all_diagonals if diagonal[2] > 0]


def accumulate(
    cells: Iterable[tuple[Diagonal, torch.Tensor]],
    rows: int,
    columns: int,
    a: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """
    Accumulate distances along the paths from the cell (0, 0) with the smallest sums.

    :param cells: anti-diagonals and the distances of their cells, (m, n), float32.
    :param a: weight of diagonal steps, (n,); None = 1.
    :returns: S and F by row, (2 half, n), of the cells in the last row and the last column.
    """
    S = F = torch.empty(0)
    for (t, first, m), d in cells:
        if t == 0:
            size = 2, (rows + columns) // 2 + 1, d.shape[1]
            counts = torch.int8 if rows + columns < 256 else torch.int16
            S = torch.full(size, torch.inf, device=d.device)
            F = torch.zeros(size, dtype=counts, device=d.device)
            S[columns % 2, columns // 2] = d[0]
            continue
        q, parity = divmod(columns + 2 * first - t, 2)
        here, above = slice(q, q + m), slice(q - 1 + parity, q - 1 + parity + m)
        left = slice(q + parity, q + parity + m)
        corner, S_before, F_before = S[parity, here], S[1 - parity], F[1 - parity]
        vertical, horizontal = S_before[above] + d, S_before[left] + d
        diagonal = corner + d if a is None else corner.addcmul(d, a)
        straight = torch.minimum(vertical, horizontal)
        steps = torch.where(horizontal < vertical, F_before[left], F_before[above])
        torch.minimum(diagonal, straight, out=corner)
        steps = steps if t % 2 else steps - 1
        torch.where(diagonal < straight, F[parity, here], steps, out=F[parity, here])
    S, F = (table.transpose(0, 1).flatten(0, 1) for table in (S, F))
    return S, F


def spatial_alignment(
    W: int, settings: SpatialSettings, device: torch.device
) -> Callable[[torch.Tensor], torch.Tensor]:
    """
    Return the distance of an image to n others, a function of strip distances (section 2).

    :param settings: any strategy but ``none``.
    :returns: function of d, (W, W, n), float32, that returns (n,).
    """
    band, c = settings.band(W), (W + 1) // 2 - 1
    i, j = np.indices((W - WINDOW + 1,) * 2) if W >= WINDOW else np.zeros((2, 1, 1))
    banned = torch.from_numpy(abs(i - j) >= band)[:, :, None].to(device)
    low, high = max(0, c - band + 1), min(W, c + band)
    changes = np.abs(np.arange(low, high) - c)
    weights = adaptive_weights(W, settings, np.dtype(np.float32))
    a_of_nearest = torch.from_numpy(weights[changes]).to(device)
    parts = diagonals(W, W, band)
    order = [i * W + t - i for t, first, m in parts for i in range(first, first + m)]
    order_of_cells = torch.tensor(order, device=device)

    def sliding_window(d: torch.Tensor) -> torch.Tensor:
        windows = W - WINDOW + 1
        total = d[:windows, :windows]
        for t in range(1, WINDOW):
            total = total + d[t : t + windows, t : t + windows]
        return (total / WINDOW).masked_fill(banned, torch.inf).amin(dim=(0, 1))

    def rigid(d: torch.Tensor) -> torch.Tensor:
        best = torch.full_like(d[0, 0], torch.inf)
        for s in range(1 - band, band):
            pairs = d.diagonal(s)  # (n, W - |s|)
            total = pairs[:, 0]
            for i in range(1, W - abs(s)):
                total = total + pairs[:, i]
            best = torch.minimum(best, total / (W - abs(s)) + SHIFT_COST * abs(s))
        return best

    def warp(d: torch.Tensor) -> torch.Tensor:
        a = None
        if settings.strategy == 'adaptive':
            a = a_of_nearest[d[c, low:high].argmin(dim=0)]
        cells = d.view(W * W, -1).index_select(0, order_of_cells).split([m for *_, m in parts])
        S, F = accumulate(zip(parts, cells, strict=True), W, W, a)
        D = F[W] + (W - 1)
        return S[W] / ((-1 if a is None else a - 2) * D + (2 * W - 1))

    return {'sliding_window': sliding_window, 'rigid': rigid}.get(settings.strategy, warp)


def lm_dtw(window: torch.Tensor, k: int) -> tuple[torch.Tensor, torch.Tensor]:
    """
    Match a window from every start (section 4).

    :param window: image distances, shape (l, n + k - 1), contiguous, float32; whatever lies past
        the map's end is +inf.
    :param k: map images a start searches.
    :returns: q_m of each start, (n,), float32, +inf where no path is finite, and m, (n,), int64, 0
        there.
    """
    l, pitch = window.shape
    n = pitch - k + 1
    cells = (
        (part, window.as_strided((part[2], n), (pitch - 1, 1), part[1] * (pitch - 1) + part[0]))
        for part in diagonals(l, k, l + k)
    )
    S, F = accumulate(cells, l, k)
    t = torch.arange(l + k - 2, l - 2, -1, device=window.device)[:, None]
    C = t + 1 - t // 2 - F[l : l + k]  # of the last row, columns k - 1 to 0
    best, column = (S[l : l + k] / C).flip(0).min(dim=0)
    return best, torch.where(torch.isfinite(best), column + 1, 0)


def nearest_starts(
    distances: torch.Tensor, lengths: torch.Tensor, nms_radius: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """
    Find the nearest start and the nearest one elsewhere, the lowest on a tie.

    :param distances, lengths: see :func:`lm_dtw`.
    :param nms_radius: the second one's midpoint is more than so many places from the first one's.
    :returns: both starts, (2,), int64, and their distances, (2,); +inf of none.
    """
    starts = torch.arange(len(distances), device=distances.device)
    middles = (2 * starts + lengths - 1) // 2
    distance, nearest = distances.min(dim=0, keepdim=True)
    elsewhere = distances.masked_fill(
        (middles - middles[nearest]).abs() <= nms_radius, torch.inf
    ).min(dim=0, keepdim=True)
    return torch.cat([nearest, elsewhere.indices]), torch.cat([distance, elsewhere.values])
