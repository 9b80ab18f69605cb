"""
The alignment kernels for the CPU: arithmetic only, arrays are trusted.

Both recursions run over *lanes*: neighbouring map images (or starts) side by side in SIMD registers,
blocks of lanes side by side on the cores. The cells of a table are kept on skewed slots: cell (i, j)
lies on slot j - i, so it replaces its diagonal predecessor (i-1, j-1) in place, its vertical
predecessor (i-1, j) is the slot after and its horizontal predecessor (i, j-1) the slot before. A band
|i - j| < xi then is a fixed range of slots, with a wall of infinities on either side.

Of the three sums the diagonal is taken only when strictly smallest; vertical wins a tie over
horizontal. No ``fastmath``: infinities mark what may not be used, and the answers are the oracle's bit
for bit.
"""

import math

import numba as nb
import numpy as np

LANES = 64  # wide enough for LLVM to vectorise the lane loops instead of unrolling them: 10x faster than 32

# Of numba's threading layers, the default's fallback aborts the process when two threads meet in it.
if nb.config.THREADING_LAYER == 'default':
    nb.config.THREADING_LAYER = 'threadsafe'

_kernel = nb.njit(cache=True, nogil=True, error_model='numpy')
_parallel_kernel = nb.njit(cache=True, nogil=True, parallel=True, error_model='numpy')

VERTICAL, HORIZONTAL, DIAGONAL = 0, 1, 2


@_kernel
def _step(state, slot, x, weight):
    """Advance one cell on all lanes; state is (slots, 2, LANES): S and C, x and weight (LANES,)."""
    S_vertical, S_horizontal, S = state[slot + 1, 0], state[slot - 1, 0], state[slot, 0]
    C_vertical, C_horizontal, C = state[slot + 1, 1], state[slot - 1, 1], state[slot, 1]
    for v in range(LANES):
        vertical = x[v] + S_vertical[v]
        horizontal = x[v] + S_horizontal[v]
        diagonal = weight[v] * x[v] + S[v]
        # every operand is loaded before it is chosen from: loads under a condition would not vectorise
        cost_vertical, cost_horizontal, cost_diagonal = C_vertical[v], C_horizontal[v], C[v]
        straight = horizontal if horizontal < vertical else vertical
        cost = (cost_horizontal if horizontal < vertical else cost_vertical) + 1
        C[v] = cost_diagonal + weight[v] if diagonal < straight else cost
        S[v] = diagonal if diagonal < straight else straight


@_kernel
def _step_from(state, slot, origin, x):
    """Advance one cell of the first row or column, which has the one predecessor ``origin``."""
    for v in range(LANES):
        state[slot, 0, v] = x[v] + state[origin, 0, v]
        state[slot, 1, v] = state[origin, 1, v] + 1


@_kernel
def _adaptive_weight(d, first, weights, xi, nearest, weight):
    """Write a of each lane: the weight for |I_c - c|, I_c the strip nearest to the central one, c."""
    W = d.shape[0]
    c = (W + 1) // 2 - 1  # ceil(W / 2), 0-based
    nearest[:] = np.inf
    weight[:] = weights[0]
    for j in range(max(0, c - xi + 1), min(W, c + xi)):
        a = weights[abs(j - c)]
        x = d[c, j, first : first + LANES]
        for v in range(LANES):
            weight[v] = a if x[v] < nearest[v] else weight[v]
            nearest[v] = x[v] if x[v] < nearest[v] else nearest[v]


@_kernel
def _spatial_block(d, first, weight, xi, state):
    """Align LANES map images from ``first``; leaves S and C of cell (W, W) on slot W."""
    W = d.shape[0]
    lanes = slice(first, first + LANES)
    state[:, 0, :] = np.inf
    state[:, 1, :] = 1
    state[W, 0] = d[0, 0, lanes]
    for j in range(1, min(W, xi)):
        _step_from(state, W + j, W + j - 1, d[0, j, lanes])
    for i in range(1, W):
        if i < xi:
            _step_from(state, W - i, W - i + 1, d[i, 0, lanes])
        for j in range(max(1, i - xi + 1), min(W, i + xi)):
            _step(state, W + j - i, d[i, j, lanes], weight)


@_parallel_kernel
def spatial_dtw(d, weights, xi, out):
    """
    Image distances S[W,W] / C[W,W] of one query image to n map images.

    :param d: strip distances, shape (W, W, n), n >= LANES.
    :param weights: a for each |I_c - c|, shape (W,); all 1 for vanilla DTW.
    :param xi: half width of the band, W for none.
    :param out: shape (n,), written.
    """
    W, _, n = d.shape
    for block in nb.prange((n + LANES - 1) // LANES):
        first = min(block * LANES, n - LANES)  # the last block overlaps the one before
        state = np.empty((2 * W + 1, 2, LANES), d.dtype)
        weight = np.empty(LANES, d.dtype)
        _adaptive_weight(d, first, weights, xi, np.empty(LANES, d.dtype), weight)
        _spatial_block(d, first, weight, xi, state)
        for v in range(LANES):
            out[first + v] = state[W, 0, v] / state[W, 1, v]


@_parallel_kernel
def sliding_window(d, width, xi, out):
    """Smallest mean of ``width`` diagonal cells d[p+t, q+t]; windows outside the band are left out."""
    W, _, n = d.shape
    for y in nb.prange(n):
        best = d.dtype.type(np.inf)
        for p in range(W - width + 1):
            for q in range(W - width + 1):
                if abs(p - q) < xi:
                    total = d[p, q, y]
                    for t in range(1, width):
                        total += d[p + t, q + t, y]
                    best = min(best, total / d.dtype.type(width))
        out[y] = best


@_kernel
def _sequence_block(D, first, k, state, best, length):
    """Align the window with LANES starts from ``first``; D is padded with infinities at its end."""
    l = D.shape[0]
    base = l  # slot of cell (i, x) is base + x - i
    state[:, 0, :] = np.inf
    state[:, 1, :] = 1
    ones = np.ones(LANES, D.dtype)
    state[base, 0] = D[0, first : first + LANES]
    for x in range(1, k):
        _step_from(state, base + x, base + x - 1, D[0, first + x : first + x + LANES])
    for i in range(1, l):
        _step_from(state, base - i, base - i + 1, D[i, first : first + LANES])
        for x in range(1, k):
            _step(state, base + x - i, D[i, first + x : first + x + LANES], ones)
    for x in range(k):
        slot = base + x - (l - 1)
        for v in range(LANES):
            q = state[slot, 0, v] / state[slot, 1, v]
            if q < best[v]:
                best[v] = q
                length[v] = x + 1


@_parallel_kernel
def lm_dtw(D, k, distances, lengths):
    """
    Distance q_m and length m of every start (section 4 of the method).

    :param D: image distances, shape (l, N + k - 1 or more) with N = n rounded up to whole blocks of
        LANES; whatever lies past the map's end is +inf.
    :param k: map images a start sees.
    :param distances: shape (N,), written; +inf where no path is finite.
    :param lengths: shape (N,) int32, written; 0 there.
    """
    l = D.shape[0]
    for block in nb.prange(distances.shape[0] // LANES):
        first = block * LANES
        state = np.empty((l + k + 1, 2, LANES), D.dtype)
        best = distances[first : first + LANES]
        length = lengths[first : first + LANES]
        best[:] = np.inf
        length[:] = 0
        _sequence_block(D, first, k, state, best, length)


@_kernel
def accumulate(d, weight, xi, S, C, step):
    """
    Fill the whole tables of one pair, for its warping path.

    :param d: distances, shape (rows, columns).
    :param weight: the adaptive weight a of a diagonal step.
    :param xi: half width of the band; at least rows + columns for none.
    :param S, C, step: shape of d, written: accumulated distance, path cost, the step into each cell.
    """
    rows, columns = d.shape
    S[:] = np.inf
    C[:] = 1
    for i in range(rows):
        for j in range(columns):
            if abs(i - j) >= xi:
                continue
            if i == 0 and j == 0:
                S[0, 0] = d[0, 0]
                continue
            vertical = d[i, j] + S[i - 1, j] if i > 0 else math.inf
            horizontal = d[i, j] + S[i, j - 1] if j > 0 else math.inf
            diagonal = weight * d[i, j] + S[i - 1, j - 1] if i > 0 and j > 0 else math.inf
            if diagonal < vertical and diagonal < horizontal:
                S[i, j], C[i, j], step[i, j] = diagonal, C[i - 1, j - 1] + weight, DIAGONAL
            elif i > 0 and (j == 0 or vertical <= horizontal):
                S[i, j], C[i, j], step[i, j] = vertical, C[i - 1, j] + 1, VERTICAL
            else:
                S[i, j], C[i, j], step[i, j] = horizontal, C[i, j - 1] + 1, HORIZONTAL


@_kernel
def backtrack(step, row, column, path):
    """Follow the steps back from (row, column) to (0, 0) into path (rows + columns, 2); return its length."""
    count = 0
    while True:
        path[count, 0] = row
        path[count, 1] = column
        count += 1
        if row == 0 and column == 0:
            return count
        taken = step[row, column]
        if taken != HORIZONTAL:
            row -= 1
        if taken != VERTICAL:
            column -= 1
