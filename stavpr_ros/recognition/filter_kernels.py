# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The arithmetic of :mod:`stavpr_ros.recognition.place_filter`, compiled.

A state is a level k, a speed v and a place y. Its probability before an image is

    m[k, v, y] = sum over w of G[w, v] b[k, w, y]                 the speed changes rarely
    s[k, v, y] = (1 - 2 e) m[k, v, y-r] + e m[k, v, y-r-1] + e m[k, v, y-r+1]    r: steps of v
    x[k, v, y] = ((1 - leave) s[k, v, y] + birth[k]) L[k, y]

with the levels already mixed in b. All values are float32; a step of a state and the speed that
contributed most are kept in one byte, so that the most probable way here can be followed back.
"""

import numba as nb
import numpy as np
from stavpr_ros.compilation import kernel, parallel_kernel, reassociating_kernel

F = np.float32
PLACES = 2048  # that a thread takes at a time
BORN = 9  # origin of a state that came from off the map; others are 3 * step + speed, each 0..2


@kernel
def _mixed(a, k, levels, speeds, low, mixed, source):
    """
    Let level and speed change, for the places from ``low`` on.

    :param a: probabilities, (K, V, n or more).
    :param k: level afterwards; levels: probability of a level by the one before, (K, K).
    :param speeds: probabilities of the speed to stay, to become a neighbor, to become any one, by
        the speed before; factor by the speed after: (4, V).
    :param mixed, source: (V, width), written; where places are below 0, zero. source: 0 = same
        speed, 1 = the one below, 2 = the one above.
    :returns: sum of the probabilities with the levels mixed, by position.
    """
    (K, V), width = a.shape[:2], mixed.shape[1]
    skipped = max(0, -low)
    b = np.zeros((V, width), np.float32)
    anywhere, total = np.zeros(width, np.float32), np.zeros(width, np.float32)
    for v in range(V):
        row = b[v]
        for j in range(K):
            g, before = levels[j, k], a[j, v]
            for i in range(skipped, width):
                row[i] += g * before[low + i]
        share = speeds[2, v]
        for i in range(width):
            anywhere[i] += row[i] * share
            total[i] += row[i]
    for v in range(V):
        below, above = b[max(v - 1, 0)], b[min(v + 1, V - 1)]
        stay, after, row = speeds[0, v], speeds[3, v], b[v]
        up = speeds[1, v - 1] if v > 0 else F(0)
        down = speeds[1, v + 1] if v < V - 1 else F(0)
        target, origin = mixed[v], source[v]
        for i in range(width):
            same, lower, upper = row[i] * stay, below[i] * up, above[i] * down
            target[i] = after * (same + lower + upper + anywhere[i])
            most = same if same > lower else lower
            origin[i] = np.int8(2) if upper > most else np.int8(lower > same)
    return total


@reassociating_kernel
def _sum(values):
    total = np.float32(0)
    for i in range(len(values)):
        total += values[i]
    return total


@kernel
def _lost(mixed, steps, spread):
    """Return what the last block loses over the end of the map, whose last place is its last."""
    total = F(0)
    for v in range(len(steps)):
        r, row = steps[v], mixed[v]
        end = len(row)
        slow = r - 1 if r > 0 else 0
        total += (F(1) - F(2) * spread) * row[end - r :].sum()
        total += spread * (row[end - r - 1 :].sum() + row[end - slow :].sum())
    return total


@parallel_kernel
def advance(
    a, n, likelihood, levels, speeds, steps, spread, stay_on, births, out, origins, totals
):
    """
    Advance all states by one image.

    :param a: probabilities, (K, V, n or more).
    :param n: places.
    :param likelihood: of the image at each place, relative to that off the map, (K, n).
    :param levels, speeds: see :func:`_mixed`.
    :param steps: places that each speed moves on, (V,).
    :param spread: probability of one place more, and of one less, but never back.
    :param stay_on: probability of staying on the map.
    :param births: probability of each state of a level to come from off the map, (K,).
    :param out: written like a, not normalized; origins: (K, V, n or more), int8, written.
    :param totals: (blocks, K, 3), written: sums before moving, of what moved over the map's end,
        and with the image.
    """
    K, V = a.shape[:2]
    reach = steps.max() + 1
    for block in nb.prange((n + PLACES - 1) // PLACES):
        first = block * PLACES
        count = min(PLACES, n - first)
        mixed = np.empty((V, reach + count), np.float32)
        source = np.empty((V, reach + count), np.int8)
        for k in range(K):
            total = _mixed(a, k, levels, speeds, first - reach, mixed, source)
            totals[block, k, 0] = _sum(total[reach:])
            if first + count == n:
                totals[block, k, 1] = _lost(mixed, steps, spread)
            birth, seen = births[k], likelihood[k, first : first + count]
            after = F(0)
            for v in range(V):
                at = reach - steps[v]
                target = out[k, v, first : first + count]
                _move(
                    mixed[v], source[v], at, at + 1 if steps[v] > 0 else at, spread, stay_on,
                    birth, seen, target, origins[k, v, first : first + count],
                )  # fmt: skip
                after += _sum(target)
            totals[block, k, 2] = after


@kernel
def _move(row, change, at, slow, spread, stay_on, birth, seen, target, origin):
    """Move the states of one level and speed on, and weigh them by the image; see advance."""
    count = len(target)
    center = F(1) - F(2) * spread
    straight_row, straight_change = row[at : at + count], change[at : at + count]
    faster_row, faster_change = row[at - 1 : at - 1 + count], change[at - 1 : at - 1 + count]
    slower_row, slower_change = row[slow : slow + count], change[slow : slow + count]
    for i in range(count):
        straight = center * straight_row[i]
        faster, slower = spread * faster_row[i], spread * slower_row[i]
        s = (straight + faster + slower) * stay_on
        target[i] = (s + birth) * seen[i]
    for i in range(count):
        straight = center * straight_row[i]
        faster, slower = spread * faster_row[i], spread * slower_row[i]
        s = (straight + faster + slower) * stay_on
        most = straight if straight > faster else faster
        code = np.int8(3 + faster_change[i]) if faster > straight else straight_change[i]
        code = np.int8(6 + slower_change[i]) if slower > most else code
        origin[i] = code if s > birth else np.int8(BORN)


@kernel
def trace_back(k, v, y, origins, steps, newest, count, places):
    """
    Follow the most probable way to a state back.

    :param origins: ring of the last images' origins, (m, K, V, n or more).
    :param steps: ring of their steps, (m, V).
    :param newest: slot of the newest image.
    :param count: images to go back, at most m.
    :param places: (count + 1,), written: the place at each image, newest first; from where the
        way came onto the map on, -1.
    :returns: speed at the last place.
    """
    m = len(origins)
    places[0] = y
    for i in range(count):
        slot = (newest - i) % m
        origin = origins[slot, k, v, y]
        if origin == BORN:
            places[i + 1 :] = -1
            return v
        step, change = origin // 3, origin % 3
        r = steps[slot, v]
        if step == 0:
            y -= r
        elif step == 1:
            y -= r + 1
        elif r > 0:
            y -= r - 1
        if change == 1:
            v -= 1
        elif change == 2:
            v += 1
        places[i + 1] = y
    return v


@kernel
def middle_probabilities(a, least, tops, origins, steps, newest, count, found, best):
    """
    Sum the probabilities of states by the place where they were some images ago.

    :param a: probabilities, (K, V, n or more).
    :param least: states below it are left out.
    :param tops: places whose states count, (m,).
    :param count: images to go back; other parameters: see :func:`trace_back`.
    :param found: (n,), zeros, written: probability by place.
    :param best: (n, 4), written where found > 0: the most probable state (k, v, y) there, and the
        speed at the place.
    """
    places = np.empty(count + 1, np.int32)
    highest = np.zeros(len(found), np.float32)
    for y in tops:
        for k in range(a.shape[0]):
            for v in range(a.shape[1]):
                p = a[k, v, y]
                if p < least:
                    continue
                speed = trace_back(k, v, y, origins, steps, newest, count, places)
                middle = places[count]
                if middle < 0:
                    continue
                found[middle] += p
                if p > highest[middle]:
                    highest[middle] = p
                    best[middle, 0], best[middle, 1] = k, v
                    best[middle, 2], best[middle, 3] = y, speed
