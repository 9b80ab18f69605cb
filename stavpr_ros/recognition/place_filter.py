# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Where the camera is, as a Bayes filter over places and speeds with a state off the map.

After each image the filter holds the probability of every place y, at every speed v (places an
image) and every level k, and of being off the map. The level is how near right places are to
their images on this drive: nearer by day than at night. What is read as evidence is the
z-normalized distance z of the image to each place. At wrong places, and off the map, it has mean 0
and deviation 1; at the right one, mean mu_k, so that the likelihood ratio is

    L[k, y] = exp(alpha (mu_k z[y] - mu_k^2 / 2)).

The exponent alpha < 1 stands for successive images that are not independent: it grows with the
change from the image before, and images of a camera that stands still add nothing. The speed is
predicted from the same change: the map shows how much images of places so far apart differ.

The place of an image is read off a few images later (fixed-lag smoothing): the states of today are
followed back to where they were. After Xu, Sünderhauf and Milford, "Probabilistic Visual Place
Recognition for Hierarchical Localization", RA-L 2021, with speeds, levels and smoothing added.

All states advance in one pass over the places, in place and on all lanes. A thread takes
``PLACES`` places, from the last to the first ``BLOCK`` of them, since states only move up; the
last places before its own are copied beforehand. The states of a block lie together. They are not
normalized: the factor that makes their sum 1 is part of the next image's level changes. Where a
state came from in speed travels in the lowest two bits of its probability, which no answer depends
on; two origins share a byte, those of an even speed and of the next.
"""

from dataclasses import dataclass

import numba as nb
import numpy as np
from stavpr_ros.alignment.cpu.simd import (
    bits,
    from_bits,
    LANES,
    load,
    load_bytes,
    load_splat,
    prefetch,
    select,
    splat,
    store,
    store_bytes,
)
from stavpr_ros.compilation import kernel, parallel_kernel
from stavpr_ros.recognition.robust import FilterSettings
import torch

F, INT = np.float32, np.int32
PLACES = 2048  # that a thread takes at a time
BLOCK = 128  # places whose scratch stays in the cache; divides PLACES, a multiple of all LANES
BORN = 9  # origin of a state that came from off the map; others are 3 * step + speed, each 0..2
NO_PLACE = F(-np.inf)  # z of a gap between sessions, where likelihoods are 1
LEAST, MOST = -87.0, 80.0  # exponents that float32 holds
TOP = 64  # places whose states are followed back
NEGLIGIBLE = 1e-3  # of the most probable state: states below are not followed back
CLOSE = 2  # places: the probability of a place is that of so many to either side, too
LINE = 16  # numbers of a cache line
ALL_BORN = BORN | BORN << 4  # two origins


@dataclass(frozen=True, eq=False)
class Belief:
    """
    Where the camera was some images ago.

    :param places: places to which a way leads, ascending, (m,).
    :param weights: probability of each of them alone, (m,).
    :param ways: the most probable state now and the speed then, (m, 4), int: level, speed, place,
        speed then.
    """

    places: np.ndarray
    weights: np.ndarray
    ways: np.ndarray

    def probabilities(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """
        Return the places of n whose probability, that of close ones included, is not 0.

        :returns: places, ascending, (m,), and their probabilities.
        """
        most = len(self.places) * (2 * CLOSE + 1)
        near, sums = np.empty(most, np.int64), np.empty(most)
        count = _sum_close(self.places, self.weights, n, near, sums)
        return near[:count], sums[:count]


class PlaceFilter:
    """
    The filter over n places; see the module.

    ``count`` is the number of images since the reset.

    It holds 4 bytes for each state of a place and half a byte for each image of the lag: 247 bytes
    a place with the default speeds and levels and a lag of 10.

    :param places: places that there is room for.
    :param lag: most images that states are followed back.
    :param gaps: columns between sessions; a state that enters one leaves the map.
    """

    def __init__(
        self,
        places: int,
        lag: int,
        settings: FilterSettings | None = None,
        gaps: np.ndarray | None = None,
    ) -> None:
        self.settings = settings or FilterSettings()
        self._gaps = np.empty(0, np.int64) if gaps is None else gaps
        self._speeds = np.array(self.settings.speeds, np.float64)
        self._levels = np.array(self.settings.levels, np.float32)
        self._level_changes = self.settings.level_changes()
        self._steps = np.zeros((lag, len(self._speeds)), np.int64)
        self._reach = -(-(int(np.ceil(self._speeds.max())) + 2) // LANES) * LANES
        self._allocate(places)
        self.reset()

    def _allocate(self, room: int) -> None:
        K, V = len(self._levels), len(self._speeds)
        self._room, blocks = room, max(1, -(-room // BLOCK))
        # not normalized: times scale, the states are probabilities
        self._a: np.ndarray = torch.zeros((blocks, K, V, BLOCK)).numpy()
        self._by_place: np.ndarray = np.zeros(blocks * BLOCK, np.float32)  # sums of the states
        self._maxima: np.ndarray = np.zeros(blocks, np.float32)  # of these, by block
        shape = len(self._steps), blocks, K, (V + 1) // 2, BLOCK
        self._origins: np.ndarray = np.full(shape, ALL_BORN, np.uint8)
        self._halos: np.ndarray = np.zeros((-(-room // PLACES), K, V, self._reach), np.float32)

    def reset(self) -> None:
        """Forget where the camera was."""
        self._a[:] = self._by_place[:] = self._maxima[:] = 0
        self._scale = 1.0
        self._off = np.full(len(self._levels), 1 / len(self._levels))
        self._known = self.count = 0

    def grow(self, places: int) -> None:
        """Make room for more places."""
        a, origins, by_place = self._a, self._origins, self._by_place
        self._allocate(places)
        self._a[: len(a)], self._origins[:, : len(a)] = a, origins
        self._set_by_place(by_place)

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up."""
        _move_up(self._a, count, 0)
        for origins in self._origins:
            _move_up(origins, count, ALL_BORN)
        self._set_by_place(self._by_place[count:].copy())

    def _set_by_place(self, by_place: np.ndarray) -> None:
        self._by_place[: len(by_place)], self._by_place[len(by_place) :] = by_place, 0
        self._find_maxima(slice(None))

    def _find_maxima(self, blocks: slice | np.ndarray) -> None:
        self._maxima[blocks] = self._by_place.reshape(-1, BLOCK)[blocks].max(axis=1)

    def places_of_states(self) -> np.ndarray:
        """Return the probability of each place, (room,), float32."""
        return self._by_place[: self._room] * np.float32(self._scale)

    def update(
        self,
        z: np.ndarray,
        weight: float,
        speed_weights: np.ndarray,
        speed_likelihoods: np.ndarray | float = 1.0,
    ) -> None:
        """
        Advance by an image.

        :param z: z-normalized distances to the first m places, (m,), float32; +inf bans a place.
        :param weight: alpha; 0 = the image is no evidence.
        :param speed_weights: relative probability of each speed, (V,).
        :param speed_likelihoods: of each speed relative to that off the map, (V,).
        """
        s, n = self.settings, len(z)
        slot = self.count % len(self._steps)
        moved = np.rint(self._speeds * (self.count + 1)) - np.rint(self._speeds * self.count)
        self._steps[slot] = moved
        real = max(n - len(self._gaps), 1)
        states = len(self._levels) * len(self._speeds) * real
        if not self.count and n:
            self._a[: -(-n // BLOCK)] = s.start / states
            self._off[:] = (1 - s.start) / len(self._levels)
            self._clear_from(n)
            self._a[self._gaps // BLOCK, :, :, self._gaps % BLOCK] = 0
        if n < self._known:
            self._clear_from(n)
        totals = np.zeros((-(-n // BLOCK), len(self._levels), 3))
        off = self._off @ self._level_changes
        births = (off * s.enter / (len(self._speeds) * real)).astype(np.float32)
        if n:
            if len(self._gaps):
                z = z.copy()
                z[self._gaps] = NO_PLACE
            advance(
                self._a, n, np.ascontiguousarray(z), np.float32(weight), self._levels,
                self._level_changes * np.float32(self._scale),
                s.speed_changes(speed_weights, speed_likelihoods), self._steps[slot],
                np.float32(s.spread), np.float32(1 - s.leave), births, self._halos,
                self._origins[slot], totals, self._by_place, self._maxima,
            )  # fmt: skip
        before, lost, seen = totals.sum(axis=0).T if n else np.zeros((3, len(off)))
        if len(self._gaps):  # likelihoods are 1 there
            gaps = self._gaps // BLOCK, slice(None), slice(None), self._gaps % BLOCK
            in_gaps = self._a[gaps].sum(axis=(0, 2), dtype=np.float64)
            born = births * (len(self._speeds) * len(self._gaps))
            lost = lost + (in_gaps - born) / (1 - s.leave)
            seen = seen - in_gaps
            self._a[gaps] = self._by_place[self._gaps] = 0
            self._find_maxima(np.unique(self._gaps // BLOCK))
        off = off * (1 - s.enter) + (before - lost) * s.leave + lost
        total = float(off.sum() + seen.sum())
        self._off, self._scale = off / total, 1 / total
        self._known = n
        self.count += 1

    def _clear_from(self, n: int) -> None:
        """Set states and sums from place n on to 0."""
        self._a[n // BLOCK :, :, :, n % BLOCK :] = 0
        self._a[n // BLOCK + 1 :] = 0
        self._by_place[n:] = self._maxima[-(-n // BLOCK) :] = 0

    def belief(self, n: int, images_ago: int) -> Belief:
        """
        Return where the camera was some images ago, by the images since then, too.

        :param n: places.
        :param images_ago: at most ``lag`` and ``count - 1``.
        """
        top = self._top(n)
        least = NEGLIGIBLE * self._a[top // BLOCK, :, :, top % BLOCK].max(initial=0)
        most = len(top) * len(self._levels) * len(self._speeds)
        ways, states = np.empty((most, 5), np.int64), np.empty(most, np.float32)
        count = followed_back(
            self._a, np.float32(least or 1), top, self._origins, self._steps,
            (self.count - 1) % len(self._steps), images_ago, ways, states,
        )  # fmt: skip
        return belief_of(ways[:count], states[:count].astype(np.float64) * self._scale)

    def _top(self, n: int) -> np.ndarray:
        """Return the ``TOP`` most probable places, int64; they lie in blocks with large maxima."""
        blocks = max(1, -(-n // BLOCK))
        part = np.sort(np.argpartition(self._maxima[:blocks], max(blocks - TOP, 0))[-TOP:])
        places = np.empty(min(TOP, n), np.int64)
        _largest(self._by_place, part, n, places)
        return places

    def probable_blocks(self) -> np.ndarray:
        """Return the first places of the ``TOP`` blocks with the most probable places, (m,)."""
        count = min(TOP, len(self._maxima))
        return np.argpartition(self._maxima, -count)[-count:] * BLOCK

    def most_probable(self, excluded: np.ndarray) -> tuple[int, float]:
        """
        Return the most probable place now and its probability, 0 if all are excluded.

        :param excluded: places that do not count, ascending.
        """
        place, probability = _most_probable(self._by_place, self._maxima, excluded)
        return place, probability * self._scale

    def way(self, state: np.ndarray, images: int) -> np.ndarray:
        """
        Return the places of the most probable way to a state, newest first, (images + 1,).

        :param state: level, speed, place.
        """
        places = np.empty(images + 1, np.int32)
        trace_back(
            *(int(i) for i in state[:3]), self._origins, self._steps,
            (self.count - 1) % len(self._steps), images, places,
        )  # fmt: skip
        return places


def belief_of(ways: np.ndarray, probabilities: np.ndarray) -> Belief:
    """
    Return the belief that some states give.

    :param ways: of each state, (m, 5): place then, level, speed and place now, speed then.
    :param probabilities: of each state, (m,), float64.
    """
    order = np.argsort(ways[:, 0], kind='stable')
    best, weights = np.empty(len(order), np.int64), np.zeros(len(order))
    count = _merge(ways, probabilities, order, best, weights)
    found = ways[best[:count]]
    return Belief(found[:, 0], weights[:count], found[:, 1:])


def _move_up(values: np.ndarray, count: int, none: int) -> None:
    """Drop the first places of (blocks, K, ., BLOCK); ``none`` from the others' new end on."""
    for row in np.ndindex(values.shape[1:3]):
        places = values[:, *row].ravel()  # a copy
        places[:-count], places[-count:] = places[count:].copy(), none
        values[:, *row] = places.reshape(len(values), -1)


# ------------------------------------------------ kernels


@kernel
def exp(x):
    """Return e^x, within 2e-7 relative; 0 below LEAST, e^MOST above MOST."""
    kept = select(splat(F(LEAST)) < x, x, splat(F(LEAST)))
    kept = select(kept < splat(F(MOST)), kept, splat(F(MOST)))
    magic = splat(F(12582912))  # 1.5 * 2^23: adding it rounds to whole numbers
    shifted = kept * splat(F(1.44269504)) + magic
    whole = shifted - magic
    rest = kept - whole * splat(F(0.693359375)) - whole * splat(F(-2.12194440e-4))
    power = splat(F(1.9875691500e-4))
    power = power * rest + splat(F(1.3981999507e-3))
    power = power * rest + splat(F(8.3334519073e-3))
    power = power * rest + splat(F(4.1665795894e-2))
    power = power * rest + splat(F(1.6666665459e-1))
    power = power * rest + splat(F(5.0000001201e-1))
    power = power * rest * rest + rest + splat(F(1))
    found = from_bits(bits(power) + (bits(shifted) << splat(INT(23))))
    return select(x < splat(F(LEAST)), splat(F(0)), found)


@kernel
def _likelihoods(z, first, count, weight, mu, seen):
    """Write the likelihood of each level and place into seen (K, BLOCK); 0 from ``count`` on."""
    K = len(mu)
    flat = seen.reshape(-1)
    if weight == 0:
        seen[:] = 1
    else:
        seen[0, :count] = z[first : first + count]
        seen[0, count:] = 0
        factor = splat(weight)
        for x in range(0, BLOCK, LANES):
            distance = load(flat, x)
            for k in range(K):
                level = load_splat(mu, k)
                off = level * distance - level * level * splat(F(0.5))
                likelihood = exp(factor * off)
                gap = distance < splat(F(-1e30))
                store(flat, k * BLOCK + x, select(gap, splat(F(1)), likelihood))
    seen[:, count:] = 0


@kernel
def _mix(source, at, pitch, count, levels, speeds, b, mixed, to, width, sums):
    """
    Let level and speed change, for ``count`` neighboring places, whole vectors.

    :param source, at, pitch: flat states; level j, speed v begin at + (j V + v) pitch.
    :param levels: factor by the level before and after, (K, K), neighbors only.
    :param speeds: factors of the speed to stay, of the one below, of the one above, after any, and
        of any before, flat (5, V).
    :param b: (V + 1) LANES, scratch, zero at the end.
    :param mixed: flat, (K, V, width), written from column ``to`` on.
    :param sums: K LANES; sums after the change of level are added.
    """
    K = len(levels)
    V = len(b) // LANES - 1
    changes = levels.reshape(-1)
    mask = splat(INT(-4))
    for x in range(0, count, LANES):
        for k in range(K):
            lower, upper = max(k - 1, 0), min(k + 1, K - 1)
            # at the ends, the level itself stands for its missing neighbor, and counts 0
            from_lower = load_splat(changes, lower * K + k) if k else splat(F(0))
            from_upper = load_splat(changes, upper * K + k) if k + 1 < K else splat(F(0))
            from_same = load_splat(changes, k * K + k)
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
    mixed, at, slow, count, spread, stay_on, birth, seen, seen_at, a, to, origins, to_origin, half,
    places,
):  # fmt: skip
    """
    Move the states of one level and speed on, and weigh them by the image; see advance.

    :param mixed, at: flat; the states that arrive without a place more or less begin there.
    :param slow: 1 where states may arrive from one place fewer; 0 where that is none.
    :param half: which half of the origins' bytes is written; 0 comes first.
    :param places: (BLOCK,), to which the states are added.
    :returns: sums of the states, by lane.
    """
    total = splat(F(0))
    center, aside = splat(F(1) - F(2) * spread), splat(spread)
    staying, born = splat(stay_on), splat(birth)
    three, six, nine = splat(INT(3)), splat(INT(6)), splat(INT(BORN))
    low = splat(INT(3))
    for x in range(0, count, LANES):
        straight_from = load(mixed, at + x)
        faster_from = load(mixed, at + x - 1)
        slower_from = load(mixed, at + x + slow)
        straight = center * straight_from
        faster, slower = aside * faster_from, aside * slower_from
        arrived = (straight + faster + slower) * staying
        state = (arrived + born) * load(seen, seen_at + x)
        store(a, to + x, state)
        store(places, x, load(places, x) + state)
        total = total + state
        fast = straight < faster
        most = select(fast, faster, straight)
        code = select(fast, (bits(faster_from) & low) + three, bits(straight_from) & low)
        code = select(most < slower, (bits(slower_from) & low) + six, code)
        code = select(born < arrived, code, nine)
        if half:
            code = (code << splat(INT(4))) | load_bytes(origins, to_origin + x)
        store_bytes(origins, to_origin + x, code)
    return total


@kernel
def _lost(row, step, spread):
    """Return what a row, whose last place is the map's last, loses over the end of the map."""
    end = len(row)
    slow = step - 1 if step > 0 else 0
    total = (F(1) - F(2) * spread) * row[end - step :].sum()
    return total + spread * (row[end - step - 1 :].sum() + row[end - slow :].sum())


@kernel
def _sum_of_lanes(values, at):
    total = 0.0
    for lane in range(LANES):
        total += values[at + lane]
    return total


@kernel
def _scratch(size):
    """Return zeros, (size,), that begin with a cache line."""
    memory = np.zeros(size + LINE, np.float32)
    first = -memory.ctypes.data % (LINE * memory.itemsize) // memory.itemsize
    return memory[first : first + size]


@parallel_kernel
def advance(
    a, n, z, weight, mu, levels, speeds, steps, spread, stay_on, births, halos, origins, totals,
    by_place, maxima,
):  # fmt: skip
    """
    Advance all states by one image.

    :param a: states, (blocks, K, V, BLOCK), read and written; 0 from place n on.
    :param n: places, at least 1.
    :param z, weight, mu: z-normalized distances (n,), alpha, and mean of right places by level.
    :param levels, speeds: see :func:`_mix`.
    :param steps: places that each speed moves on, (V,).
    :param spread: probability of one place more, and of one less, but never back.
    :param stay_on: probability of staying on the map.
    :param births: probability of each state of a level to come from off the map, (K,).
    :param halos: (parts of PLACES, K, V, reach), scratch; reach in whole vectors, more than a step
        and one place; zeros in the first.
    :param origins: of this image, (blocks, K, (V + 1) // 2, BLOCK), uint8, written.
    :param totals: (blocks, K, 3), written: sums before moving, of what moved over the map's end,
        and with the image.
    :param by_place: sum of the states of each place, (n or more,), and maxima: the largest of each
        block, (blocks,); written.
    """
    _, K, V, _ = a.shape
    reach, halves, parts = halos.shape[3], origins.shape[2], (n + PLACES - 1) // PLACES
    width, size = reach + BLOCK, K * V * BLOCK
    states, flat_halos, flat_origins = a.reshape(-1), halos.reshape(-1), origins.reshape(-1)
    for part in range(1, parts):  # no work worth waking a thread
        for row in range(K * V):
            before = ((part * PLACES // BLOCK - 1) * K * V + row + 1) * BLOCK - reach
            for x in range(0, reach, LANES):
                store(flat_halos, (part * K * V + row) * reach + x, load(states, before + x))
    for part in nb.prange(parts):
        mixed, places = _scratch(K * V * width), _scratch(BLOCK)
        seen, b = _scratch(K * BLOCK).reshape(K, BLOCK), _scratch((V + 1) * LANES)
        sums, lanes = _scratch(K * LANES), np.empty(LANES, np.float32)
        blocks = (min(n - part * PLACES, PLACES) + BLOCK - 1) // BLOCK
        for block in range(blocks - 1, -1, -1):
            first = part * PLACES + block * BLOCK
            count, at = min(BLOCK, n - first), first // BLOCK
            whole = (count + LANES - 1) // LANES * LANES
            _likelihoods(z, first, count, weight, mu, seen)
            if block:
                before = (at - 1) * size + BLOCK - reach
                _mix(states, before, BLOCK, reach, levels, speeds, b, mixed, 0, width, sums)
            else:
                _mix(
                    flat_halos, part * K * V * reach, reach, reach, levels, speeds, b, mixed, 0,
                    width, sums,
                )  # fmt: skip
            sums[:] = 0
            _mix(states, at * size, BLOCK, whole, levels, speeds, b, mixed, reach, width, sums)
            places[:] = 0
            for k in range(K):
                totals[at, k, 0], totals[at, k, 1] = _sum_of_lanes(sums, k * LANES), 0
                total = splat(F(0))
                for v in range(V):
                    row, step = (k * V + v) * width, steps[v]
                    following = (max(at - 1, 0) * K * V + k * V + v) * BLOCK
                    for line in range(following, following + BLOCK, LINE):
                        prefetch(states, line)
                    if first + count == n:
                        ending = mixed[row : row + reach + count]
                        totals[at, k, 1] += _lost(ending, step, spread)
                    total = total + _move(
                        mixed, row + reach - step, 1 if step > 0 else 0, whole, spread, stay_on,
                        births[k], seen.reshape(-1), k * BLOCK, states,
                        at * size + (k * V + v) * BLOCK, flat_origins,
                        ((at * K + k) * halves + v // 2) * BLOCK, v % 2, places,
                    )  # fmt: skip
                store(lanes, 0, total)
                totals[at, k, 2] = _sum_of_lanes(lanes, 0)
            by_place[first : first + count] = places[:count]
            maxima[at] = places[:count].max()


@kernel
def _before(k, v, y, origins, steps):
    """Return speed and place of a state one image before, -1 as place where it was off the map."""
    origin = (origins[y // BLOCK, k, v // 2, y % BLOCK] >> (v % 2 * 4)) & 15
    if origin == BORN:
        return v, -1
    r, step, change = steps[v], origin // 3, origin % 3
    places = r if step == 0 else r + 1 if step == 1 else max(r - 1, 0)
    return v - (change == 1) + (change == 2), y - places


@kernel
def trace_back(k, v, y, origins, steps, newest, count, places):
    """
    Follow the most probable way to a state back.

    :param origins: ring of the last images' origins, (m, blocks, K, (V + 1) // 2, BLOCK), uint8.
    :param steps: ring of their steps, (m, V).
    :param newest: slot of the newest image.
    :param count: images to go back, at most m.
    :param places: (count + 1,), written: the place at each image, newest first; from where the
        way came onto the map on, -1.
    """
    places[0] = y
    for i in range(count):
        slot = (newest - i) % len(origins)
        v, y = _before(k, v, y, origins[slot], steps[slot])
        places[i + 1] = y
        if y < 0:
            places[i + 1 :] = -1
            return


@kernel
def followed_back(a, least, tops, origins, steps, newest, count, ways, probabilities):
    """
    Follow states back to where they were some images ago.

    :param a: states, (blocks, K, V, BLOCK).
    :param least: states below it are left out.
    :param tops: places whose states count, (m,).
    :param count: images to go back; other parameters: see :func:`trace_back`.
    :param ways: (m K V, 5), written: place then, state now (k, v, y), speed then.
    :param probabilities: (m K V,), written: of these states.
    :returns: how many were on the map then.
    """
    found = 0
    for y in tops:
        for k in range(a.shape[1]):
            for v in range(a.shape[2]):
                p = a[y // BLOCK, k, v, y % BLOCK]
                if p >= least:
                    ways[found, 0], ways[found, 1], ways[found, 2] = y, k, v
                    ways[found, 3], ways[found, 4] = y, v
                    probabilities[found] = p
                    found += 1
    _, blocks, _, halves, _ = origins.shape
    flat = origins.reshape(-1)
    for i in range(count):  # all together: each waits for its memory
        slot, left = (newest - i) % len(origins), 0
        earlier = (newest - i - 1) % len(origins) * blocks
        for at in range(found):
            speed, place = _before(
                ways[at, 1], ways[at, 4], ways[at, 0], origins[slot], steps[slot]
            )
            if place >= 0:
                ways[left], probabilities[left] = ways[at], probabilities[at]
                ways[left, 0], ways[left, 4] = place, speed
                row = ((earlier + place // BLOCK) * a.shape[1] + ways[at, 1]) * halves
                prefetch(flat, (row + speed // 2) * BLOCK + place % BLOCK)
                left += 1
        found = left
    return found


@kernel
def _largest(by_place, blocks, n, places):
    """Write the places below n of some blocks that have the largest sums, the largest first."""
    values, last = np.full(len(places), -1, np.float32), len(places) - 1
    for block in blocks:
        for y in range(block * BLOCK, min((block + 1) * BLOCK, n)):
            if by_place[y] <= values[last]:
                continue
            at = last
            while at > 0 and values[at - 1] < by_place[y]:
                values[at], places[at] = values[at - 1], places[at - 1]
                at -= 1
            values[at], places[at] = by_place[y], y


@kernel
def _merge(ways, probabilities, order, best, weights):
    """
    Add up the probabilities of ways that come from the same place.

    :param ways: see :func:`belief_of`; order: of their places, ascending.
    :param best, weights: of each place, its most probable way and its sum, written.
    :returns: how many places there are.
    """
    found = -1
    for i in order:
        if found < 0 or ways[i, 0] != ways[best[found], 0]:
            found += 1
            best[found] = i
        elif probabilities[i] > probabilities[best[found]]:
            best[found] = i
        weights[found] += probabilities[i]
    return found + 1


@kernel
def _sum_close(places, weights, n, near, sums):
    """Write places within ``CLOSE`` of any of these, ascending, and probabilities, at most 1."""
    found = low = end = 0
    for place in places:
        for y in range(max(place - CLOSE, end), min(place + CLOSE + 1, n)):
            while places[low] < y - CLOSE:
                low += 1
            total, i = 0.0, low
            while i < len(places) and places[i] <= y + CLOSE:
                total += weights[i]
                i += 1
            near[found], sums[found] = y, min(total, 1.0)
            found, end = found + 1, y + 1
    return found


@kernel
def _most_probable(by_place, maxima, excluded):
    """Return the most probable place outside ``excluded``, ascending, and its sum, 0 if none."""
    best, at, i = F(-1), 0, 0
    for block in range(len(maxima)):
        while i < len(excluded) and excluded[i] < block * BLOCK:
            i += 1
        if maxima[block] <= best:
            continue
        for y in range(block * BLOCK, (block + 1) * BLOCK):
            while i < len(excluded) and excluded[i] < y:
                i += 1
            value = F(0) if i < len(excluded) and excluded[i] == y else by_place[y]
            if value > best:
                best, at = value, y
    return at, best
