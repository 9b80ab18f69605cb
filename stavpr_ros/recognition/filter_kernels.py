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
from stavpr_ros.compilation import kernel, parallel_kernel

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
        for i in range(width):
            same, lower, upper = row[i] * stay, below[i] * up, above[i] * down
            mixed[v, i] = after * (same + lower + upper + anywhere[i])
            best = np.int8(1) if lower > same else np.int8(0)
            source[v, i] = np.int8(2) if upper > max(same, lower) else best
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
    :param totals: (blocks, K, 3), written: sums before moving, after it, and with the image.
    """
    K, V = a.shape[:2]
    reach = steps.max() + 1
    center = F(1) - F(2) * spread
    for block in nb.prange((n + PLACES - 1) // PLACES):
        first = block * PLACES
        count = min(PLACES, n - first)
        mixed = np.empty((V, reach + count), np.float32)
        source = np.empty((V, reach + count), np.int8)
        for k in range(K):
            before = _mixed(a, k, levels, speeds, first - reach, mixed, source)[reach:].sum()
            moved, after, birth = 0.0, 0.0, births[k]
            seen = likelihood[k, first : first + count]
            for v in range(V):
                at = reach - steps[v]
                slow = at + 1 if steps[v] > 0 else at
                row, change = mixed[v], source[v]
                target, origin = out[k, v, first : first + count], origins[k, v, first:]
                for i in range(count):
                    straight = center * row[at + i]
                    faster, slower = spread * row[at - 1 + i], spread * row[slow + i]
                    s = straight + faster + slower
                    moved += s
                    code = change[at + i]
                    if faster > straight:
                        code = np.int8(3) + change[at - 1 + i]
                    if slower > max(straight, faster):
                        code = np.int8(6) + change[slow + i]
                    s *= stay_on
                    origin[i] = code if s > birth else np.int8(BORN)
                    x = (s + birth) * seen[i]
                    target[i] = x
                    after += x
            totals[block, k, 0], totals[block, k, 1], totals[block, k, 2] = before, moved, after


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
