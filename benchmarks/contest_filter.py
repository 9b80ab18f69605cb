# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The small filter of the contest: place and speed, one level, and five quantities of a window.

A state is a place y and a speed v, or off the map. From image to image a state moves on by its
speed, by one place more or less, its speed changes to a neighboring one, it leaves the map (always
over an end of it), or enters anywhere. The evidence of an image is, with the mean mu of z at right
places,

    L[y] = exp(alpha (mu min(z[y], 3) - mu^2 / 2)).

Forward over all images and backward over the latest ones (fixed-lag smoothing) give the place of
the middle image of a window. Only images that moved are in a window.
"""

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from stavpr_ros.compilation import kernel
from stavpr_ros.filter.evidence import APART, best_elsewhere, lead_of

CLOSE = 2  # places to either side that the belief in a place adds up
LINE, ON_LINE = 5, 1.5  # images to either side of the line, places that they may be off it
MAX_STEP = 6.0  # places from a window to the next that agrees with it; one back is none


@dataclass(frozen=True)
class SmallModel:
    """
    The numbers of the small filter.

    :param speeds: places an image, ascending.
    :param level: mean z of right places, mu; weight: alpha; most: z of any place at most.
    :param change: probability of another speed; spread: of one place more, and of one less.
    :param leave, enter, start: probabilities of leaving, of entering, of starting on the map.
    :param length: images of a window.
    """

    speeds: tuple[float, ...] = (0.33, 0.5, 0.75, 1.0, 1.33, 2.0, 3.0, 4.5)
    level: float = -2.3
    weight: float = 0.3
    most: float = 3.0
    change: float = 0.03
    spread: float = 0.05
    leave: float = 0.01
    enter: float = 0.006
    start: float = 0.5
    length: int = 20

    @property
    def lag(self) -> int:
        """Images behind the middle one of a window."""
        return self.length - 1 - (self.length - 1) // 2

    def steps(self) -> np.ndarray:
        """Return the probability that a speed advances by -1, 0, 1, ... places, (V, S)."""
        steps = np.zeros((len(self.speeds), int(max(self.speeds)) + 4))
        for row, speed in zip(steps, self.speeds, strict=True):
            whole, rest = int(speed), speed % 1
            for step, share in ((whole, 1 - rest), (whole + 1, rest)):
                row[step : step + 3] += share * np.array([self.spread, 0, self.spread])
                row[step + 1] += share * (1 - 2 * self.spread)
        return steps.astype(np.float32)


class SmallWindow(NamedTuple):
    """
    What the newest images show.

    :param place: of the image at ``position``.
    :param belief: probability of the places around it.
    :param lead: of its best straight path over the best one elsewhere, mean -z, of each image the
        nearest of three neighboring places.
    :param path, competitor: place of each image on both, (l,) each, or empty; z: along the path.
    :param share: of the latest windows that follow the one before, .5 for each that is missing.
    """

    place: float
    position: int
    belief: float
    lead: float
    path: np.ndarray
    competitor: np.ndarray
    share: float
    z: np.ndarray

    @property
    def speed(self) -> float:
        """Return places an image, along the path."""
        l = len(self.path)
        return float(self.path[-1] - self.path[0]) / (l - 1) if l > 1 else 0.0


class SmallFilter:
    """
    The filter on n places, image by image.

    :param n: places.
    """

    def __init__(self, n: int, model: SmallModel | None = None) -> None:
        self.model = model = model or SmallModel()
        V, self._steps = len(model.speeds), model.steps()
        states = np.full((V, n), model.start / (V * n), np.float32)
        self._states = deque([(states, 1 - model.start)], model.length)
        self._likelihoods: deque[np.ndarray] = deque(maxlen=model.length)
        self._z = np.full((model.length, n), np.inf, np.float32)  # a ring
        self._near = self._z.copy()  # the least of each place and its two neighbors
        self._last = 0.0  # place of the latest whole window
        self._agree: deque[bool] = deque(maxlen=model.length)
        self.count = 0

    def update(self, z: np.ndarray, weight: float = 1.0) -> None:
        """Add an image that moved, by its z-normalized distances, (n,), and its share of alpha."""
        s, mu = self.model, self.model.level
        likelihoods = mu * np.minimum(z, np.float32(s.most)) - mu * mu / 2
        likelihoods = np.exp(s.weight * weight * likelihoods).astype(np.float32)
        states, off = self._states[-1]
        if self.count:
            states, off = advance(states, off, self._steps, s.change, s.leave, s.enter)
        states = states * likelihoods
        total = float(states.sum(dtype=np.float64)) + off
        self._states.append((states / np.float32(total), off / total))
        self._likelihoods.append(likelihoods)
        self._z[self.count % s.length] = z
        near = self._near[self.count % s.length]
        near[:] = z
        near[1:], near[:-1] = np.minimum(near[1:], z[:-1]), np.minimum(near[:-1], z[1:])
        self.count += 1

    @property
    def by_place(self) -> np.ndarray:
        """Return the probability of each place for the newest image, (n,)."""
        by_place: np.ndarray = self._states[-1][0].sum(axis=0)
        return by_place

    def beliefs(self, lag: int) -> np.ndarray:
        """Return the probability of each place for the image ``lag`` images ago and later ones."""
        s, (states, off) = self.model, self._states[-1]
        messages, elsewhere, rows = np.ones_like(states), 1.0, []
        for back in range(lag + 1):
            if back:
                likelihoods = self._likelihoods[-back]
                messages, elsewhere = go_back(
                    messages, elsewhere, likelihoods, self._steps, s.change, s.leave, s.enter
                )
                states, off = self._states[-1 - back]
            by_place = (states * messages).sum(axis=0)
            rows.append(by_place / (by_place.sum(dtype=np.float64) + off * elsewhere))
        return np.array(rows[::-1])

    def window(self) -> SmallWindow | None:
        """Return what the newest images show, a window at most; None = one alone."""
        l = min(self.count, self.model.length)
        if l < 2:
            return None
        position = (l - 1) // 2
        beliefs = self.beliefs(l - 1)
        places, masses = np.array([_most_probable(belief) for belief in beliefs]).T
        place = self._on_line(places[max(position - LINE, 0) :], min(position, LINE))
        if l == self.model.length:
            last = self._last if self._agree else place
            self._agree.append(masses[position] > 0.5 and -1 <= place - last <= MAX_STEP)
            self._last = place
        n, at = beliefs.shape[1], round(place)
        path = follow(beliefs, position, min(max(at, 0), n - 1))
        rows = (self.count - l + np.arange(l)) % self.model.length
        images = n, np.arange(l), position
        around = np.array([[0, max(at - CLOSE, 0)], [min(at + CLOSE + 1, n), n]])
        apart = np.array([[max(at - APART, 0), min(at + APART + 1, n)]])
        score, _ = best_elsewhere(self._near, rows, *images, around)
        other, _ = best_elsewhere(self._near, rows, *images, apart)
        _, competitor = best_elsewhere(self._z, rows, *images, apart)
        missing = self.model.length - len(self._agree)
        share = (sum(self._agree) + missing / 2) / self.model.length
        lead, z = lead_of(score, other), self._z[rows, path]
        return SmallWindow(place, position, masses[position], lead, path, competitor, share, z)

    def _on_line(self, places: np.ndarray, position: int) -> float:
        """Return the place of an image on the line through those around, if they are near it."""
        around = places[: position + LINE + 1]
        offsets = np.arange(len(around)) - position
        line = np.polynomial.polynomial.polyfit(offsets, around, 1)
        is_even = np.abs(around - line[0] - line[1] * offsets).max() < ON_LINE
        return max(float(line[0]), 0.0) if is_even else float(places[position])


def _most_probable(belief: np.ndarray) -> tuple[float, float]:
    """Return the mean place around the most probable ones, and their probability."""
    around = np.convolve(belief, np.ones(2 * CLOSE + 1), 'same')
    at = int(around.argmax())
    near = slice(max(at - CLOSE, 0), at + CLOSE + 1)
    mass = max(float(belief[near].sum()), 1e-30)
    return float((belief[near] * np.arange(len(belief))[near]).sum()) / mass, float(around[at])


# ------------------------------------------------ kernels


@kernel
def follow(beliefs: np.ndarray, position: int, place: int) -> np.ndarray:
    """
    Return the most probable places that a path through a place can have, (l,), int64.

    :param beliefs: probability of each place for each image, (l, n).
    :param position: of the image at the place.
    """
    l, n = beliefs.shape
    path = np.full(l, place)
    for way in (1, -1):
        for i in range(position + way, l if way > 0 else -1, way):
            before, path[i] = path[i - way], path[i - way]
            for step in range(-1, int(MAX_STEP) + 1):
                y = before + way * step
                if 0 <= y < n and beliefs[i, y] > beliefs[i, path[i]]:
                    path[i] = y
    return path


@kernel
def _with_other_speeds(states, change):  # type: ignore[no-untyped-def]
    """Return states (V, n) after the speed changed to a neighboring one; the ends stay."""
    mixed, last = np.empty_like(states), len(states) - 1
    stay, go = np.float32(1 - change), np.float32(change / 2)
    for v in range(len(states)):
        below, above = states[max(v - 1, 0)], states[min(v + 1, last)]
        for y in range(states.shape[1]):
            mixed[v, y] = stay * states[v, y] + go * (below[y] + above[y])
    return mixed


@kernel
def advance(
    states: np.ndarray, off: float, steps: np.ndarray, change: float, leave: float, enter: float
) -> tuple[np.ndarray, float]:
    """
    Return the states, (V, n), and the probability off the map one image later.

    :param steps: of :meth:`SmallModel.steps`; change, leave, enter: see :class:`SmallModel`.
    """
    V, n = states.shape
    moved, before, arrived = np.zeros_like(states), off, 0.0
    for v in range(V):
        for step in range(-1, steps.shape[1] - 1):
            share = steps[v, step + 1] * np.float32(1 - leave)
            if share > 0:
                for y in range(max(step, 0), min(n + step, n)):
                    moved[v, y] += share * states[v, y - step]
    mixed, entering = _with_other_speeds(moved, change), np.float32(enter * off / (V * n))
    for v in range(V):
        for y in range(n):
            before += states[v, y]
            mixed[v, y] += entering
            arrived += mixed[v, y]
    return mixed, before - arrived


@kernel
def go_back(
    messages: np.ndarray, off: float, likelihoods: np.ndarray, steps: np.ndarray, change: float,
    leave: float, enter: float,
) -> tuple[np.ndarray, float]:  # fmt: skip
    """
    Return how likely the later images are from the states one image before, up to a factor.

    :param messages, off: the same at the image, (V, n) and off the map.
    :param likelihoods: of the image, (n,); others: see :func:`advance`.
    """
    V, n = messages.shape
    weighed, mean, largest = np.empty_like(messages), 0.0, 0.0
    for v in range(V):
        for y in range(n):
            weighed[v, y] = messages[v, y] * likelihoods[y]
            mean += weighed[v, y] / (V * n)
    mixed, back = _with_other_speeds(weighed, change), np.full_like(messages, leave * off)
    for v in range(V):
        for step in range(-1, steps.shape[1] - 1):
            share = steps[v, step + 1] * np.float32(1 - leave)
            if share > 0:
                for y in range(n):
                    inside = 0 <= y + step < n
                    back[v, y] += share * (mixed[v, y + step] if inside else np.float32(off))
    off = (1 - enter) * off + enter * mean
    for v in range(V):
        for y in range(n):
            largest = max(largest, back[v, y])
    scale = max(largest, off)
    return back / np.float32(scale), off / scale
