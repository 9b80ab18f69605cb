# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The place filter on the CPU: level, speed and place of all states change with an image.

:mod:`stavpr_ros.filter.place_filter` describes the memory. For each block of a part,
``_mix`` lets level and speed of its states and of the ``reach`` columns before it change, where
reach is more than the largest step and one place; ``_move`` moves them on and weighs them by the
image::

    mixed    (K, V, reach + BLOCK)  |<-- reach -->|<--------- BLOCK -------->|
    states   (K, V, BLOCK)              |--- step -->|   one place more or less

The origin of a state in speed is kept in the lowest two bits of its mixed probability, which are
below the precision of all results.
"""

import numba as nb
import numpy as np
from stavpr_ros.compilation import kernel, parallel_kernel
from stavpr_ros.filter.paths import BLOCK, ENTERED, is_excluded
from stavpr_ros.simd import (
    bits,
    from_bits,
    LANES,
    LINE,
    load,
    load_bytes,
    load_splat,
    prefetch,
    select,
    splat,
    store,
    store_bytes,
)

F, INT = np.float32, np.int32
PLACES = 2048  # of a part; a multiple of BLOCK
MIN_EXPONENT, MAX_EXPONENT = -87.0, 80.0  # exponents whose powers are finite float32 numbers
NEAR_INFINITY = -1e30  # z below it is of a gap


@kernel
def exp(x):
    """Return e^x, within 2e-7 relative; 0 below MIN_EXPONENT, and x at most MAX_EXPONENT."""
    clamped = select(splat(F(MIN_EXPONENT)) < x, x, splat(F(MIN_EXPONENT)))
    clamped = select(clamped < splat(F(MAX_EXPONENT)), clamped, splat(F(MAX_EXPONENT)))
    magic = splat(F(12582912))  # 1.5 * 2^23: adding it rounds to whole numbers
    shifted = clamped * splat(F(1.44269504)) + magic
    whole = shifted - magic
    rest = clamped - whole * splat(F(0.693359375)) - whole * splat(F(-2.12194440e-4))
    power = splat(F(1.9875691500e-4))
    power = power * rest + splat(F(1.3981999507e-3))
    power = power * rest + splat(F(8.3334519073e-3))
    power = power * rest + splat(F(4.1665795894e-2))
    power = power * rest + splat(F(1.6666665459e-1))
    power = power * rest + splat(F(5.0000001201e-1))
    power = power * rest * rest + rest + splat(F(1))
    result = from_bits(bits(power) + (bits(shifted) << splat(INT(23))))
    return select(x < splat(F(MIN_EXPONENT)), splat(F(0)), result)


@kernel
def _likelihoods(z, first, count, weight, mu, likely):
    """Write the likelihood of each level and place, flat (K, BLOCK); 0 from ``count`` on."""
    K = len(mu)
    for x in range(BLOCK):
        likely[x] = z[first + x] if x < count else F(0)
    if weight == 0:
        likely[:] = 1
    else:
        factor = splat(weight)
        for x in range(0, BLOCK, LANES):
            distance = load(likely, x)
            for k in range(K):
                level = load_splat(mu, k)
                off = level * distance - level * level * splat(F(0.5))
                likelihood = exp(factor * off)
                gap = distance < splat(F(NEAR_INFINITY))
                store(likely, k * BLOCK + x, select(gap, splat(F(1)), likelihood))
    for k in range(K):
        for x in range(count, BLOCK):
            likely[k * BLOCK + x] = 0


@kernel
def _mix(source, at, pitch, count, levels, speeds, b, mixed, to, width, sums):
    """
    Let level and speed change, for ``count`` neighboring places, whole vectors.

    :param source, at, pitch: flat states; level j, speed v begin at + (j V + v) pitch.
    :param levels: factor by the level before and after, flat (K, K), neighbors only.
    :param speeds: factors of the speed to stay, of the one below, of the one above, after any, and
        of any before, flat (5, V).
    :param b: (V + 1) LANES, scratch, zero at the end.
    :param mixed: flat, (K, V, width), written from column ``to`` on.
    :param sums: K LANES; sums after the change of level are added.
    """
    V = len(b) // LANES - 1
    K = len(sums) // LANES
    mask = splat(INT(-4))
    for x in range(0, count, LANES):
        for k in range(K):
            lower, upper = max(k - 1, 0), min(k + 1, K - 1)
            # at the ends, a missing neighbor is the level itself, with the factor 0
            from_lower = load_splat(levels, lower * K + k) if k else splat(F(0))
            from_upper = load_splat(levels, upper * K + k) if k + 1 < K else splat(F(0))
            from_same = load_splat(levels, k * K + k)
            at_lower, at_same = at + lower * V * pitch + x, at + k * V * pitch + x
            at_upper = at + upper * V * pitch + x
            anywhere = total = splat(F(0))
            for v in range(V):
                state = from_lower * load(source, at_lower + v * pitch)
                state = state + from_same * load(source, at_same + v * pitch)
                state = state + from_upper * load(source, at_upper + v * pitch)
                store(b, v * LANES, state)
                anywhere = anywhere + state * load_splat(speeds, 4 * V + v)
                total = total + state
            store(sums, k * LANES, load(sums, k * LANES) + total)
            below, current = splat(F(0)), load(b, 0)
            for v in range(V):
                above = load(b, (v + 1) * LANES)
                same = current * load_splat(speeds, v)
                slower = below * load_splat(speeds, V + v)
                faster = above * load_splat(speeds, 2 * V + v)
                target = (same + slower) + (faster + anywhere * load_splat(speeds, 3 * V + v))
                from_below = same < slower
                code = select(from_below, splat(INT(1)), splat(INT(0)))
                code = select(select(from_below, slower, same) < faster, splat(INT(2)), code)
                store(mixed, (k * V + v) * width + to + x, from_bits((bits(target) & mask) | code))
                below, current = current, above


@kernel
def _move(
    mixed, at, slow, count, spread, stay_on, entering, likely, likely_at, a, to, origins,
    to_origin, half, places,
):  # fmt: skip
    """
    Move the states of one level and speed on, and weigh them by the image; see advance.

    :param mixed, at: flat; the states that move on by the step itself begin there.
    :param slow: 1 where states may move on by one place less; 0 where the step is 0.
    :param entering: probability of each state to come from off the map.
    :param half: of the origins' bytes that is written; 0, the lower one, comes first.
    :param places: (BLOCK,), to which the states are added.
    :returns: sums of the states, by lane.
    """
    total = splat(F(0))
    center, aside = splat(F(1) - F(2) * spread), splat(spread)
    staying, entered = splat(stay_on), splat(entering)
    three, six, nine = splat(INT(3)), splat(INT(6)), splat(INT(ENTERED))
    low = splat(INT(3))
    for x in range(0, count, LANES):
        straight_from = load(mixed, at + x)
        faster_from = load(mixed, at + x - 1)
        slower_from = load(mixed, at + x + slow)
        straight = center * straight_from
        faster, slower = aside * faster_from, aside * slower_from
        arrived = (straight + faster + slower) * staying
        state = (arrived + entered) * load(likely, likely_at + x)
        store(a, to + x, state)
        store(places, x, load(places, x) + state)
        total = total + state
        fast = straight < faster
        most = select(fast, faster, straight)
        code = select(fast, (bits(faster_from) & low) + three, bits(straight_from) & low)
        code = select(most < slower, (bits(slower_from) & low) + six, code)
        code = select(entered < arrived, code, nine)
        if half:
            code = (code << splat(INT(4))) | load_bytes(origins, to_origin + x)
        store_bytes(origins, to_origin + x, code)
    return total


@kernel
def _lost(row, step, spread):
    """Return the loss of a row, which ends with the map, over the end of the map."""
    end = len(row)
    slow = step - 1 if step > 0 else 0
    by_step = by_more = by_less = F(0)
    for x in range(end - step - 1, end):
        by_more += row[x]
        by_step += row[x] if x >= end - step else F(0)
        by_less += row[x] if x >= end - slow else F(0)
    return (F(1) - F(2) * spread) * by_step + spread * (by_more + by_less)


@kernel
def _sum_of_lanes(values, at):
    total = 0.0
    for lane in range(LANES):
        total += values[at + lane]
    return total


@kernel
def _copy_sums(places, count, by_place, first):
    """Write the sums of a block's places; return the largest."""
    largest = F(0)
    for x in range(count):
        by_place[first + x] = places[x]
        largest = max(largest, places[x])
    return largest


@kernel
def _add_up(totals, in_gaps, entering, states, off, leave, enter):
    """
    Update the probabilities of being off the map, by level, (K,); return the sum of all states.

    :param totals: of all blocks, of :func:`advance`.
    :param in_gaps: sums of so many states of a level between sessions, by level, (K,).
    """
    total_off = on_map = 0.0
    for k in range(len(off)):
        before = over_end = after = 0.0
        for block in range(len(totals)):
            before, over_end = before + totals[block, 0, k], over_end + totals[block, 1, k]
            after += totals[block, 2, k]
        # likelihoods are 1 between sessions, and entering from off the map is no loss
        lost = over_end + (in_gaps[k] - entering[k] * F(states)) / (1 - leave)
        off[k] = off[k] * (1 - enter) + (before - lost) * leave + lost
        total_off, on_map = total_off + off[k], on_map + (after - in_gaps[k])
    for k in range(len(off)):
        off[k] /= total_off + on_map
    return total_off + on_map


@kernel
def speed_factors(weights, likelihoods, keep):
    """
    Return the factors of the speeds, (5, V), float32.

    To stay, from the speed below, from the one above, of all by the speed after, and from any by
    the speed before. They include the likelihood of the speed after.

    :param weights: relative probability of each speed for this image, (V,), float64.
    :param likelihoods: of each speed by the latest images, relative to off the map, (V,), float64.
    :param keep: probability of keeping the speed.
    """
    V = len(weights)
    near, far = (1 - keep) * 0.4, (1 - keep) * 0.2 / V
    sum_of_weights, total, factors = 0.0, np.empty(V), np.zeros((5, V), F)
    for v in range(V):
        sum_of_weights += weights[v]
    for v in range(V):
        total[v] = keep * weights[v] + far * sum_of_weights
        total[v] += near * weights[v - 1] if v else 0.0
        total[v] += near * weights[v + 1] if v + 1 < V else 0.0
    for v in range(V):
        factors[0, v], factors[3, v] = keep * weights[v] / total[v], weights[v]
        factors[1, v] = near * weights[v] / total[v - 1] if v else 0.0
        factors[2, v] = near * weights[v] / total[v + 1] if v + 1 < V else 0.0
        factors[4, v] = far / total[v]
        for row in range(4):
            factors[row, v] = factors[row, v] * likelihoods[v]
    return factors


@kernel
def _scratch(size):
    """Return zeros, (size,), that begin with a cache line."""
    memory = np.zeros(size + LINE, np.float32)
    first = -memory.ctypes.data % (LINE * memory.itemsize) // memory.itemsize
    return memory[first : first + size]


@kernel
def _copy_halo(states, part, rows, reach, halos):
    """Copy the last columns before a part."""
    for row in range(rows):
        before = ((part * PLACES // BLOCK - 1) * rows + row + 1) * BLOCK - reach
        for x in range(0, reach, LANES):
            store(halos, (part * rows + row) * reach + x, load(states, before + x))


@kernel
def _inputs(level_changes, scale, off, enter, states, speeds, count, steps):
    """
    Return the changes of level of scaled states, flat, and the probability to enter each, (K,).

    :param states: of a level; steps: (V,), written; others: of :func:`advance`.
    """
    K = len(off)
    levels, entering = np.empty(K * K, F), np.empty(K, F)
    for v in range(len(steps)):
        steps[v] = np.rint(speeds[v] * (count + 1)) - np.rint(speeds[v] * count)
    for k in range(K):
        entering[k] = off[k] * enter / states
        for j in range(K):
            levels[k * K + j] = level_changes[k, j] * F(scale)
    return levels, entering


@parallel_kernel
def advance(
    a, n, z, weight, mu, level_changes, scale, speeds, speed_weights, speed_likelihoods, count,
    keep_speed, spread, leave, enter, off, gaps, halos, origins, steps, by_place, maxima,
):  # fmt: skip
    """
    Advance all states by one image.

    :param a: states, (blocks, K, V, BLOCK), read and written; 0 from place n on.
    :param n: places, at least 1.
    :param z, weight, mu: z-normalized distances (n,), alpha, and mean of right places by level;
        blocks without states, whose places are all excluded by +inf, are skipped.
    :param level_changes: of :func:`_mix`; scale: factor that makes probabilities of the states.
    :param speeds: places an image, (V,), float64, and count: number of the image.
    :param speed_weights, speed_likelihoods, keep_speed: of :func:`speed_factors`.
    :param spread: probability of one place more, and of one less, never back.
    :param leave, enter: probabilities of leaving the map, and of returning.
    :param off: probability of being off the map before, by level, (K,), float64; updated.
    :param gaps: columns between sessions, ascending, (m,).
    :param halos: (parts, K, V, reach), scratch; zeros in the first. Reach is of whole vectors.
    :param origins: of this image, (blocks, K, (V + 1) // 2, BLOCK), uint8, written; steps: places
        that each speed moves on, (V,), likewise.
    :param by_place: sum of the states of each place, (n or more,), and maxima: the largest of each
        block, (blocks,); read and written.
    :returns: sum of the states and of ``off``, not normalized.
    """
    _, K, V, _ = a.shape
    entries = V * max(n - len(gaps), 1)
    levels, entering = _inputs(level_changes, scale, off, enter, entries, speeds, count, steps)
    factors, stay_on = speed_factors(speed_weights, speed_likelihoods, keep_speed), F(1 - leave)
    reach, halves, parts = halos.shape[3], origins.shape[2], (n + PLACES - 1) // PLACES
    width, size = reach + BLOCK, K * V * BLOCK
    # sums before the motion, of states that moved over the end of the map, and with the image
    totals = np.empty(((n + BLOCK - 1) // BLOCK, 3, K))
    states, flat_halos, flat_origins = a.reshape(-1), halos.reshape(-1), origins.reshape(-1)
    for part in range(1, parts):  # too little work to share
        _copy_halo(states, part, K * V, reach, flat_halos)
    for part in nb.prange(parts):
        mixed, places = _scratch(K * V * width), _scratch(BLOCK)
        likely, b = _scratch(K * BLOCK), _scratch((V + 1) * LANES)
        sums, lanes = _scratch(K * LANES), np.empty(LANES, np.float32)
        blocks = (min(n - part * PLACES, PLACES) + BLOCK - 1) // BLOCK
        for block in range(blocks - 1, -1, -1):
            first = part * PLACES + block * BLOCK
            length, at = min(BLOCK, n - first), first // BLOCK
            whole = (length + LANES - 1) // LANES * LANES
            is_empty = weight != 0 and maxima[at] == 0 and first + length < n
            if is_empty and is_excluded(z, first, first + length):
                totals[at] = 0
                continue
            _likelihoods(z, first, length, weight, mu, likely)
            for own in range(2):  # the columns before the block, and its own
                source, pitch, from_, mixed_at, columns = states, BLOCK, at * size, reach, whole
                if not own:
                    from_, mixed_at, columns = (at - 1) * size + BLOCK - reach, 0, reach
                    if not block:
                        source, pitch, from_ = flat_halos, reach, part * K * V * reach
                sums[:] = 0
                _mix(
                    source, from_, pitch, columns, levels, factors, b, mixed, mixed_at, width, sums
                )
            places[:] = 0
            for k in range(K):
                totals[at, 0, k], totals[at, 1, k] = _sum_of_lanes(sums, k * LANES), 0
                total = splat(F(0))
                for v in range(V):
                    row, step = (k * V + v) * width, steps[v]
                    following = (max(at - 1, 0) * K * V + k * V + v) * BLOCK
                    for line in range(following, following + BLOCK, LINE):
                        prefetch(states, line)
                    if first + length == n:
                        ending = mixed[row : row + reach + length]
                        totals[at, 1, k] += _lost(ending, step, F(spread))
                    total = total + _move(
                        mixed, row + reach - step, 1 if step > 0 else 0, whole, F(spread), stay_on,
                        entering[k], likely, k * BLOCK, states,
                        at * size + (k * V + v) * BLOCK, flat_origins,
                        ((at * K + k) * halves + v // 2) * BLOCK, v % 2, places,
                    )  # fmt: skip
                store(lanes, 0, total)
                totals[at, 2, k] = _sum_of_lanes(lanes, 0)
            maxima[at] = _copy_sums(places, length, by_place, first)
    in_gaps = clear_gaps(a, gaps, by_place, maxima)
    return _add_up(totals, in_gaps, entering, V * len(gaps), off, leave, enter)


@kernel
def clear_gaps(a, gaps, by_place, maxima):
    """
    Set the states of columns between sessions to 0.

    :param a, by_place, maxima: as of :func:`advance`.
    :param gaps: the columns, ascending, (m,).
    :returns: their sums until then, by level, (K,).
    """
    sums = np.zeros(a.shape[1])
    for i in range(len(gaps)):
        block, x = gaps[i] // BLOCK, gaps[i] % BLOCK
        for k in range(a.shape[1]):
            for v in range(a.shape[2]):
                sums[k] += a[block, k, v, x]
                a[block, k, v, x] = 0
        by_place[gaps[i]] = 0
        if i + 1 == len(gaps) or gaps[i + 1] // BLOCK > block:
            maxima[block] = 0
            for y in range(block * BLOCK, (block + 1) * BLOCK):
                maxima[block] = max(maxima[block], by_place[y])
    return sums
