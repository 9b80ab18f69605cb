# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The recursion of both alignments, row by row, on all lanes at once.

Between rows the *edge* holds S and C of the row above: flat, slot x + 1 is column x, slot 0 the corner
(-1, -1), whose S = C = 0 makes the first cell an ordinary diagonal step of weight 1. Infinite S mark what
may not be used. The diagonal is taken only when strictly smallest; vertical wins a tie over horizontal.
No ``fastmath``: the answers are the oracle's bit for bit.
"""

import numpy as np
from stavpr_ros.alignment.cpu.simd import LANES, load, select, splat, store
from stavpr_ros.compilation import kernel

SLOT = 2 * LANES  # S, then C


@kernel
def open_edge(edge, columns):
    """Make the edge above the first row."""
    zero = splat(edge.dtype.type(0))
    infinity = splat(edge.dtype.type(np.inf))
    for slot in range(columns + 1):
        store(edge, slot * SLOT, infinity)
        store(edge, slot * SLOT + LANES, zero)
    store(edge, 0, zero)


@kernel
def step(
    x, x_diagonal, S_vertical, C_vertical, S_horizontal, C_horizontal, S, C, one, diagonal_cost
):
    """S and C of one cell from its three predecessors; the last S and C are the diagonal one's."""
    vertical = x + S_vertical
    horizontal = x + S_horizontal
    diagonal = x_diagonal + S
    sideways = horizontal < vertical
    straight = select(sideways, horizontal, vertical)
    cost = select(sideways, C_horizontal, C_vertical) + one
    slanted = diagonal < straight
    return select(slanted, diagonal, straight), select(slanted, C + diagonal_cost, cost)


@kernel
def sweep_row(d, at, stride, first, last, edge, weight):
    """
    Advance the edge by one row, columns first..last-1.

    :param d, at, stride: flat distances; column x of the row lies at + x * stride.
    :param weight: vector, what a diagonal step multiplies x with and costs.
    """
    one = splat(edge.dtype.type(1))
    S, C = splat(edge.dtype.type(np.inf)), one
    S_corner, C_corner = load(edge, first * SLOT), load(edge, first * SLOT + LANES)
    store(edge, 0, S)  # the corner serves the first row only
    for x in range(first, last):
        slot = (x + 1) * SLOT
        S_above, C_above = load(edge, slot), load(edge, slot + LANES)
        cell = load(d, at + x * stride)
        S, C = step(cell, weight * cell, S_above, C_above, S, C, S_corner, C_corner, one, weight)
        S_corner, C_corner = S_above, C_above
        store(edge, slot, S)
        store(edge, slot + LANES, C)


@kernel
def sweep_four_rows(d, at, pitch, columns, edge):
    """Advance the edge by four rows, ``pitch`` apart, with a = 1; in between, registers hold it."""
    one = splat(edge.dtype.type(1))
    S0 = S1 = S2 = S3 = splat(edge.dtype.type(np.inf))
    C0 = C1 = C2 = C3 = one
    S, C = load(edge, 0), load(edge, LANES)
    store(edge, 0, S0)  # the corner serves the first row only
    for x in range(columns):
        slot = (x + 1) * SLOT
        S_above, C_above = load(edge, slot), load(edge, slot + LANES)
        cell = load(d, at + x)
        Sa, Ca = step(cell, cell, S_above, C_above, S0, C0, S, C, one, one)
        cell = load(d, at + pitch + x)
        Sb, Cb = step(cell, cell, Sa, Ca, S1, C1, S0, C0, one, one)
        cell = load(d, at + 2 * pitch + x)
        Sc, Cc = step(cell, cell, Sb, Cb, S2, C2, S1, C1, one, one)
        cell = load(d, at + 3 * pitch + x)
        Sd, Cd = step(cell, cell, Sc, Cc, S3, C3, S2, C2, one, one)
        S, C, S0, C0, S1, C1, S2, C2, S3, C3 = S_above, C_above, Sa, Ca, Sb, Cb, Sc, Cc, Sd, Cd
        store(edge, slot, S3)
        store(edge, slot + LANES, C3)
