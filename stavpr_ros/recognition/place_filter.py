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
"""

from dataclasses import dataclass

import numba as nb
import numpy as np
from stavpr_ros.compilation import kernel, parallel_kernel, reassociating_kernel
from stavpr_ros.recognition.robust import FilterSettings

F = np.float32
PLACES = 2048  # that a thread takes at a time
BORN = 9  # origin of a state that came from off the map; others are 3 * step + speed, each 0..2
TOP = 64  # places whose states are followed back
NEGLIGIBLE = 1e-3  # of the most probable state: states below are not followed back
CLOSE = 2  # places: the probability of a place is that of so many to either side, too


@dataclass(frozen=True, eq=False)
class Belief:
    """
    Where the camera was some images ago.

    :param probabilities: of each place, those close to it included, (n,).
    :param ways: for each place with a way to it, the most probable state now and the speed then,
        (n, 4), int: level, speed, place, speed then.
    :param weights: probability of each place alone, (n,).
    """

    probabilities: np.ndarray
    weights: np.ndarray
    ways: np.ndarray


class PlaceFilter:
    """
    The filter over n places; see the module.

    :param places: places that there is room for.
    :param lag: most images that states are followed back.
    :param gaps: places that there are none of, between sessions: who moves there is off the map.
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
        K, V = len(self._levels), len(self._speeds)
        self._steps = np.zeros((lag, V), np.int64)
        self._allocate(places, np.zeros((K, V, 0), np.float32), np.zeros((lag, K, V, 0), np.int8))
        self.reset()

    def _allocate(self, room: int, states: np.ndarray, origins: np.ndarray) -> None:
        shape, n = states.shape[:2], states.shape[2]
        self._a, self._next = (np.zeros((*shape, room), np.float32) for _ in range(2))
        self._origins = np.full((len(origins), *shape, room), BORN, np.int8)
        self._a[:, :, :n], self._origins[..., :n] = states, origins

    def reset(self) -> None:
        """Forget where the camera was."""
        self._a[:] = self._next[:] = 0
        self._off = np.full(len(self._levels), 1 / len(self._levels))
        self._count = self._known = 0

    @property
    def count(self) -> int:
        """Images since the reset."""
        return self._count

    @property
    def off_map(self) -> float:
        """Probability that the camera is off the map."""
        return float(self._off.sum())

    def grow(self, places: int) -> None:
        """Make room for more places."""
        self._allocate(places, self._a, self._origins)

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up."""
        for values, none in ((self._a, 0), (self._origins, BORN)):
            values[..., :-count] = values[..., count:].copy()
            values[..., -count:] = none

    def places_of_states(self) -> np.ndarray:
        """Return the probability of each place, (room,), float32."""
        return self._a.sum(axis=(0, 1))

    def update(self, z: np.ndarray, weight: float, speed_weights: np.ndarray) -> None:
        """
        Advance by an image.

        :param z: z-normalized distances to the first m places, (m,), float32; +inf bans a place.
        :param weight: alpha; 0 = the image is no evidence.
        :param speed_weights: relative probability of each speed, (V,).
        """
        s, n = self.settings, len(z)
        slot = self._count % len(self._steps)
        moved = np.rint(self._speeds * (self._count + 1)) - np.rint(self._speeds * self._count)
        self._steps[slot] = moved
        real = max(n - len(self._gaps), 1)
        states = len(self._levels) * len(self._speeds) * real
        if not self._count and n:
            self._a[:, :, :n], self._off[:] = s.start / states, (1 - s.start) / len(self._levels)
            self._a[:, :, self._gaps] = 0
        blocks = -(-n // PLACES)
        totals = np.zeros((blocks, len(self._levels), 3))
        off = self._off @ self._level_changes
        births = (off * s.enter / (len(self._speeds) * real)).astype(np.float32)
        if n:
            advance(
                self._a, n, self._likelihood(z, weight), self._level_changes,
                s.speed_changes(speed_weights), self._steps[slot], np.float32(s.spread),
                np.float32(1 - s.leave), births, self._next, self._origins[slot], totals,
            )  # fmt: skip
            self._a, self._next = self._next, self._a
        before, lost, seen = totals.sum(axis=0).T if n else np.zeros((3, len(off)))
        if len(self._gaps):  # likelihoods are 1 there
            in_gaps = self._a[:, :, self._gaps].sum(axis=(1, 2), dtype=np.float64)
            born = births * (len(self._speeds) * len(self._gaps))
            lost = lost + (in_gaps - born) / (1 - s.leave)
            seen = seen - in_gaps
            self._a[:, :, self._gaps] = 0
        off = off * (1 - s.enter) + (before - lost) * s.leave + lost
        total = float(off.sum() + seen.sum())
        self._off = off / total
        self._a[:, :, :n] *= np.float32(1 / total)
        if n < self._known:
            self._a[:, :, n:] = self._next[:, :, n:] = 0
        self._known = n
        self._count += 1

    def _likelihood(self, z: np.ndarray, weight: float) -> np.ndarray:
        if not weight:
            return np.ones((len(self._levels), len(z)), np.float32)
        mu = self._levels[:, None]
        likelihood = np.exp(np.float32(weight) * (mu * z - mu * mu / 2))
        likelihood[:, self._gaps] = 1
        return likelihood

    def belief(self, n: int, images_ago: int) -> Belief:
        """
        Return where the camera was some images ago, by the images since then, too.

        :param n: places.
        :param images_ago: at most ``lag`` and ``count - 1``.
        """
        by_place = self._a[:, :, :n].sum(axis=(0, 1))
        top = np.argpartition(by_place, max(n - TOP, 0))[-TOP:]
        least = NEGLIGIBLE * float(self._a[:, :, top].max()) if n else 1.0
        weights, ways = np.zeros(n, np.float32), np.zeros((n, 4), np.int64)
        middle_probabilities(
            self._a, np.float32(least), top, self._origins, self._steps,
            (self._count - 1) % len(self._steps), images_ago, weights, ways,
        )  # fmt: skip
        sums = np.concatenate([[0], np.cumsum(weights, dtype=np.float64)])
        ends = np.arange(n)
        high, low = np.minimum(ends + CLOSE + 1, n), np.maximum(ends - CLOSE, 0)
        return Belief(np.minimum(sums[high] - sums[low], 1), weights, ways)

    def way(self, state: np.ndarray, images: int) -> np.ndarray:
        """
        Return the places of the most probable way to a state, newest first, (images + 1,).

        :param state: level, speed, place.
        """
        places = np.empty(images + 1, np.int32)
        trace_back(
            *(int(i) for i in state[:3]), self._origins, self._steps,
            (self._count - 1) % len(self._steps), images, places,
        )  # fmt: skip
        return places


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
