# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Where the camera is: a Bayes filter over places and speeds, with a state off the map.

A state is a column y of the map and a speed v, places an image. From image to image it advances by
its speed, one place more or less with the probability ``spread``, its speed becomes a neighboring
one with ``change``, and it leaves the map with ``leave``, or over an end of it. Off the map, it
enters anywhere with ``enter``. The evidence of an image are its z-normalized distances z, with
mean 0 at wrong places and mu at right ones::

    a'[v, y] = L[y] / c (sum_w P(v after w) sum_r P(r | w) a[w, y - r] + enter off / (V n))
    L[y] = exp(alpha (mu min(z[y], most) - mu^2 / 2)),    c: all probabilities add up to 1

The place of an image is read when later images have come (fixed-lag smoothing), by the message

    b[w, y] = (leave b'[off] + sum_r P(r | w) sum_v P(v after w) L[y + r] b'[v, y + r]) / c

from the newest image, where it is 1, back to that one: its places have the probability
sum_v a[v, y] b[v, y]. After Xu, Sünderhauf and Milford, "Probabilistic Visual Place Recognition
for Hierarchical Localization", RA-L 2021, with speeds and smoothing added.

All states advance with each image; only paths through the most probable ``BLOCKS`` are followed
back, from every ``SPACING``-th image, whose states are kept. Memory of a place: 4 V bytes for the
states of each of 2 + ceil((l - 1) / SPACING) + 1 images, and z of l + SPACING - 1 images.
"""

from abc import abstractmethod
from collections import deque
from typing import Any, NamedTuple, Protocol

import numba as nb
import numpy as np
from stavpr_ros import checks
from stavpr_ros.compilation import kernel, parallel_kernel
from stavpr_ros.errors import InputError
from stavpr_ros.memory import aligned_zeros
from stavpr_ros.method.model import MODEL, Model
from stavpr_ros.method.path import best_straight, PART
from stavpr_ros.threads import one_thread

NO_PLACES: np.ndarray = np.empty(0, np.int64)
SPACING = 7  # images from one whose states are kept to the next
BLOCK = 32  # columns of a block
BLOCKS = 4  # of an image that are followed, at most
NEGLIGIBLE = 1e-3  # probability of a block that is not followed
ABOVE = 16  # columns above a block that its paths may reach
STEEPEST = 20.0  # exponent of a likelihood, and of its inverse, at most
F = np.float32


class Beliefs(NamedTuple):
    """
    Probabilities of columns for the latest images; other columns are improbable.

    :param columns: ascending, (m,), int64.
    :param probabilities: oldest image first, (images, m), float64.
    """

    columns: np.ndarray
    probabilities: np.ndarray


class Filter(Protocol):
    """
    Probability of each place after each image: the interface between a window and its filter.

    ``count`` is the number of updates since the reset; ``length``, l, the latest ones that are
    kept. Columns are places, with gaps between tracks.
    """

    count: int
    length: int

    @abstractmethod
    def update(self, z: Any, weight: float = 1.0) -> None:
        """
        Advance by an image.

        :param z: z-normalized distances to the first m columns, (m,), float32, an array or a
            tensor on the filter's device; +inf excludes a column.
        :param weight: of the image among others; 0 = it is no evidence.
        """

    @abstractmethod
    def by_place(self) -> np.ndarray:
        """Return the probability of each column now, (width,), float32."""

    @abstractmethod
    def beliefs(self, images: int) -> Beliefs:
        """Return the probabilities of columns for the latest images, given all of them."""

    @abstractmethod
    def z(self, columns: np.ndarray, images: int) -> np.ndarray:
        """
        Return the distances of the latest images to columns, oldest first, (images, m), float32.

        :param columns: (m,) or (images, m), int64.
        """

    @abstractmethod
    def best_straight(
        self, steps: np.ndarray, span: slice, excluded: np.ndarray
    ) -> tuple[float, np.ndarray]:
        """
        Return the largest mean of -z of straight paths of the latest images, and its path.

        The z of an image is the least of its column and the two beside it.

        :param steps: of each speed, the largest last, from the column of the path to the image's,
            (S, images), int64.
        :param span: columns of the paths that count, but for those ``excluded``, slices (k, 2).
        :returns: -inf and no path where no column counts.
        """

    @abstractmethod
    def move_back(self, columns: slice, count: int) -> None:
        """Add the states of columns to those ``count`` columns before, also of past images."""

    @abstractmethod
    def reset(self) -> None:
        """Forget where the camera was."""

    @abstractmethod
    def grow(self, columns: int) -> None:
        """Make room for more columns."""

    @abstractmethod
    def evict(self, count: int) -> None:
        """Drop the oldest columns; the others move up."""


class Image(NamedTuple):
    """
    What the filter keeps of an image beside its z.

    :param weight: alpha.
    :param entering: probability of each state that came from off the map, before L.
    :param scale: 1 / c, the factor of the states after it.
    :param compared: number of states that it was compared with.
    :param blocks: first columns of its probable blocks.
    """

    weight: float
    entering: float
    scale: float
    compared: int
    blocks: np.ndarray


class Snapshot(NamedTuple):
    """States after an image, (V, width), not normalized, the factor, and its number."""

    states: Any
    scale: float
    number: int


class PlaceFilter(Filter):
    """
    The filter of the module, on the CPU; a filter of a device overrides what advances its states.

    States, sums and z are arrays of NumPy, or tensors, on whose slices the same operators work.

    :param columns: that there is room for.
    :param length: images of a window, l.
    :param gaps: columns between tracks, ascending; a state that enters one leaves the map.
    :raises SettingsError: no window, or columns below 0.
    :raises InputError: arguments of any method that do not fit.
    """

    def __init__(
        self, columns: int, length: int, model: Model = MODEL, gaps: np.ndarray = NO_PLACES
    ) -> None:
        checks.require_whole('columns', columns, 0)
        checks.require_whole('length', length, 2, 'images')
        checks.require_ascending('gaps', gaps, columns)
        self.model, self.length, self._gaps = model, length, gaps
        self._steps = model.steps() * F(1 - model.leave)
        self._reach = (length - 1) * model.reach  # columns that a path advances, at most
        self._rows, snapshots = length + SPACING - 1, (length - 2) // SPACING + 2
        self._buffers = snapshots + 2
        self._snapshots: deque[Snapshot] = deque(maxlen=snapshots)
        self._images: deque[Image] = deque(maxlen=self._rows)
        self._allocate(columns)
        self.reset()

    def _zeros(self, shape: tuple[int, ...]) -> Any:
        """Return zeros, float32, an array or a tensor."""
        return aligned_zeros(shape)

    def _on_host(self, values: Any) -> np.ndarray:
        """Return values of the device as an array."""
        array: np.ndarray = values
        return array

    def _vector(self, z: Any) -> Any:
        """Return z as float32 vector; raise InputError where it does not fit."""
        return checks.float32_vector('z', z, int(self._gaps.max(initial=-1)) + 1, self._width)

    def _read(self) -> None:
        """Wait for what the newest image gave, if need be."""

    def _allocate(self, width: int) -> None:
        self._width = width
        shape = len(self.model.speeds), width
        self._free = [self._zeros(shape) for _ in range(self._buffers)]
        self._now = self._free.pop()
        self._z = self._zeros((self._rows, width))  # a ring
        self._sums = self._zeros((width,))  # of the states of each column

    def reset(self) -> None:
        """Forget where the camera was."""
        self._read()
        self._free += [snapshot.states for snapshot in self._snapshots]
        self._snapshots.clear()
        self._images.clear()
        self._now[:], self._sums[:] = 0, 0
        self._off, self.count = 1.0, 0

    def update(self, z: Any, weight: float = 1.0) -> None:
        """See :meth:`Filter.update`."""
        z = self._vector(z)
        checks.require_at_least('weight', weight, 0)
        self._read()
        s = self.model
        states = len(s.speeds) * max(len(z) - len(self._gaps), 1)
        entering, scale = s.start / states, 0.0
        if self.count:
            entering, scale = s.enter * self._off / states, self._images[-1].scale
        self._advance(z, Image(weight * s.weight, entering, 0.0, states, NO_PLACES), scale)
        self.count += 1

    def _advance(self, z: Any, image: Image, scale: float) -> None:
        """
        Add z to the ring and advance all states; :meth:`_read` follows sooner or later.

        :param image: without its scale and its blocks; scale: of the states before it.
        """
        s, alpha, n, before = self.model, image.weight, len(z), self._now
        row = self._z[self.count % self._rows]
        row[:n], row[n:] = z, np.inf
        row[self._gaps] = np.inf
        self._now = self._free.pop()
        arrived, on_map = advance(
            before, row, alpha * s.level, alpha * s.level**2 / 2, s.most, self._steps, s.change,
            image.entering, scale, self._now, self._sums,
        )  # fmt: skip
        if self.count % SPACING == 1:
            self._take_snapshot(before, scale)
        else:
            self._free.append(before)
        scale = self._normalize(arrived, on_map)
        blocks = probable_blocks(self._sums[:n], scale)
        self._images.append(image._replace(scale=scale, blocks=blocks))

    def _take_snapshot(self, states: Any, scale: float) -> None:
        """Keep the states after the newest image."""
        if len(self._snapshots) == self._snapshots.maxlen:
            self._free.append(self._snapshots.popleft().states)
        self._snapshots.append(Snapshot(states, scale, self.count - 1))

    def _normalize(self, arrived: float, on_map: float) -> float:
        """Return 1 / c, by the probabilities that arrived on the map and their sum times L."""
        away = max(1 - arrived, 0.0)  # it is rounded
        self._off = away / (away + on_map)
        return 1 / (away + on_map)

    def by_place(self) -> np.ndarray:
        """See :meth:`Filter.by_place`."""
        self._read()
        scale = self._images[-1].scale if self.count else 0.0
        return self._on_host(self._sums)[: self._width] * F(scale)

    def z(self, columns: np.ndarray, images: int) -> np.ndarray:
        """See :meth:`Filter.z`."""
        self._require_images(images)
        checks.require_indices('columns', columns, self._width)
        checks.require_shape('columns', columns, 'm' if columns.ndim == 1 else f'{images} m')
        flat = self._ring(images)[:, None] * self._z.shape[1] + columns
        return self._on_host(self._z.reshape(-1)[flat])

    def _require_images(self, images: int) -> None:
        checks.require_whole('images', images, 1)
        checks.require_indices('images', images, min(self.count, self.length) + 1)

    def _ring(self, images: int) -> np.ndarray:
        """Return the rows of the latest images, oldest first."""
        return (self.count - images + np.arange(images)) % self._rows

    def beliefs(self, images: int) -> Beliefs:
        """See :meth:`Filter.beliefs`."""
        self._require_images(images)
        self._read()
        s, newest = self.model, self._images[-1]
        since = Snapshot(self._now, newest.scale, self.count - 1)
        for snapshot in self._snapshots if images > 1 else ():
            if snapshot.number <= self.count - images:
                since = snapshot
        later = self.count - 1 - since.number
        latest = list(self._images)[len(self._images) - later :]
        numbers = np.array([image[:4] for image in latest])
        starts = np.concatenate([newest.blocks, self._images[-1 - images // 2].blocks])
        bounds = regions(np.sort(starts), self._reach, self._width)
        columns, parts = [NO_PLACES], [np.empty((images, 0))]
        for low, end in bounds:
            columns.append(np.arange(low, end))
            states = self._on_host(since.states[:, low:end]) * np.float64(since.scale)
            z = self._on_host(self._z[:, low:end][self._ring(later)])
            is_end = low == 0, end == self._width
            parts.append(smooth(
                states, z, numbers.reshape(-1, 4), s.level, s.most, self._steps, s.change,
                s.leave, s.enter, is_end, images,
            ))  # fmt: skip
        return Beliefs(np.concatenate(columns), np.concatenate(parts, axis=1))

    def best_straight(
        self, steps: np.ndarray, span: slice, excluded: np.ndarray
    ) -> tuple[float, np.ndarray]:
        """See :meth:`Filter.best_straight`."""
        self._require_images(steps.shape[-1])
        checks.require_shape('steps', steps, 'S images', 'int64')
        checks.require_shape('excluded', excluded, 'k 2', 'int64')
        lowest, highest = min(steps[-1, 0], 0), max(steps[-1, -1], 0)
        if steps.min() < lowest or steps.max() > highest:
            raise InputError(
                f'steps {steps.min()} to {steps.max()}: expected {lowest} to {highest}, from the '
                'first image to the last one of the last row, the largest speed'
            )
        low, end = max(span.start, 0), min(span.stop, self._width)
        arrays = np.ascontiguousarray(steps), np.ascontiguousarray(excluded)
        return self._best_straight(self._ring(steps.shape[1]), low, end, *arrays)

    def _best_straight(
        self, rows: np.ndarray, low: int, end: int, steps: np.ndarray, excluded: np.ndarray
    ) -> tuple[float, np.ndarray]:
        """See :func:`best_straight`."""
        with one_thread(end - low <= PART):
            score, path = best_straight(self._z, rows, low, end, steps, excluded)
        return score, path

    def move_back(self, columns: slice, count: int) -> None:
        """See :meth:`Filter.move_back`."""
        y = np.arange(columns.start, columns.stop)
        checks.require_indices('columns', [*y, *(y - count)], self._width)
        checks.require_whole('count', count, len(y), 'columns')
        self._read()
        first, end = columns.start, columns.stop
        snapshots = [snapshot.states for snapshot in self._snapshots]
        for states in (self._now, self._sums[None], *snapshots):
            states[:, first - count : end - count] += states[:, columns]
            states[:, columns] = 0
        for i, image in enumerate(self._images):
            starts = image.blocks
            ends = np.minimum(starts + BLOCK, self._width)
            stay = starts[(starts < first) | (ends > end)]
            moved = starts[(starts < end) & (ends > first)] - count
            blocks = np.concatenate([stay, np.maximum(moved, 0)])
            self._images[i] = image._replace(blocks=blocks)

    def grow(self, columns: int) -> None:
        """See :meth:`Filter.grow`."""
        checks.require_whole('columns', columns, self._width)
        self._resize(columns, 0)

    def evict(self, count: int) -> None:
        """See :meth:`Filter.evict`."""
        checks.require_indices('count', count, self._width + 1)
        self._resize(self._width, count)
        self._gaps = self._gaps[self._gaps >= count] - count
        for image in self._images:
            image.blocks[:] = np.maximum(image.blocks - count, 0)

    def _resize(self, width: int, first: int) -> None:
        """Take room for columns from ``first`` on."""
        now, sums, z, m = self._now, self._sums, self._z, self._width - first
        self._allocate(width)
        self._now[:, :m], self._sums[:m] = now[:, first:], sums[first:]
        self._z[:, :m], self._z[:, m:] = z[:, first:], np.inf
        for i, snapshot in enumerate(self._snapshots):
            self._snapshots[i] = snapshot._replace(states=self._free.pop())
            self._snapshots[i].states[:, :m] = snapshot.states[:, first:]


# ------------------------------------------------ kernels


@kernel
def power(x, doublings=6):  # type: ignore[no-untyped-def]
    """
    Return e^x by e^|x| - 1, doubled so many times.

    Relative errors are below 5e-6 for x from -10 to 10, below 7e-5 from -20 to 20; with 8 in
    float64, below 1e-7.
    """
    t = min(abs(x), F(STEEPEST)) * (F(1) / F(1 << doublings))
    more = t * (F(1) + t * (F(1 / 2) + t * (F(1 / 6) + t * (F(1 / 24) + t * F(1 / 120)))))
    for _ in range(doublings):
        more *= F(2) + more
    return F(1) + more if x > 0 else F(1) / (F(1) + more)


@parallel_kernel
def advance(  # type: ignore[no-untyped-def]
    states, z, slope, offset, most, steps, change, entering, scale, new, sums
):
    """
    Write the states one image later, and their sums by column, before they are normalized.

    :param states, new: (V, width), float32; scale: factor of the former.
    :param z: (width,), float32, +inf where no state can be.
    :param slope, offset: L = exp(slope min(z, most) - offset).
    :param steps: of :meth:`Model.steps`, times 1 - leave.
    :param entering: probability of each state that comes from off the map.
    :returns: sums of those that arrived on the map, and of the new ones.
    """
    V, width = states.shape
    parts = (width + PART - 1) // PART
    totals = np.zeros((parts, 2))
    stay, go, factor = F((1 - change) * scale), F(change / 2 * scale), F(entering)
    slope, offset, most = F(slope), F(offset), F(most)
    for part in nb.prange(parts):
        first = part * PART
        m = min(PART, width - first)
        moved = _step(states, steps, first, m)
        likelihoods, valid = np.empty(m, F), np.empty(m, F)
        for i in range(m):
            value = z[first + i]
            is_valid = value < F(np.inf)
            valid[i] = F(1) if is_valid else F(0)
            likelihoods[i] = valid[i] * power(slope * min(value, most) - offset)
        own, came, arrived, total = sums[first : first + m], np.zeros(m, F), 0.0, 0.0
        own[:] = 0
        for v in range(V):
            same, below, above = moved[v], moved[max(v - 1, 0)], moved[min(v + 1, V - 1)]
            out = new[v, first : first + m]
            for i in range(m):
                mixed = stay * same[i] + go * (below[i] + above[i]) + factor
                came[i] += mixed
                out[i] = mixed * likelihoods[i]
                own[i] += out[i]
        for i in range(m):
            arrived += valid[i] * came[i]
            total += own[i]
        totals[part] = arrived, total
    arrived, total = 0.0, 0.0
    for part in range(parts):  # not totals.sum(), whose order depends on the number of threads
        arrived, total = arrived + totals[part, 0], total + totals[part, 1]
    return arrived, total


@kernel
def probable_blocks(sums: np.ndarray, scale: float) -> np.ndarray:
    """Return the first columns of the most probable blocks, (m,), int64."""
    firsts, masses, count = np.zeros(BLOCKS, np.int64), np.zeros(BLOCKS), 0
    for first in range(0, len(sums), BLOCK):
        mass = 0.0
        for y in range(first, min(first + BLOCK, len(sums))):
            mass += sums[y]
        at = int(masses.argmin()) if count == BLOCKS else count
        if mass * scale > NEGLIGIBLE and mass > masses[at]:
            firsts[at], masses[at], count = first, mass, max(count, at + 1)
    return firsts[:count]


def regions(starts: np.ndarray, below: int, width: int) -> list[tuple[int, int]]:
    """Return first columns and ends of all that paths of blocks may reach, without overlap."""
    bounds: list[tuple[int, int]] = []
    for start in starts.tolist():
        low, end = max(start - below, 0), min(start + BLOCK + ABOVE, width)
        if bounds and low <= bounds[-1][1]:
            low = bounds.pop()[0]
        bounds.append((low, end))
    return bounds


@kernel
def _change_speed(states, change):  # type: ignore[no-untyped-def]
    """Return states (V, m) with the speed changed to a neighboring one; the ends stay."""
    mixed, last = np.empty_like(states), len(states) - 1
    for v in range(len(states)):
        below, above = states[max(v - 1, 0)], states[min(v + 1, last)]
        for y in range(states.shape[1]):
            mixed[v, y] = (1 - change) * states[v, y] + change / 2 * (below[y] + above[y])
    return mixed


@kernel
def _step(states, steps, first, m):  # type: ignore[no-untyped-def]
    """Return what states (V, width) become by their speeds, at m columns from ``first`` on."""
    (V, width), moved = states.shape, np.zeros((len(states), m), states.dtype)
    for v in range(V):
        for s in range(steps.shape[1]):
            share, step = steps[v, s], s - 1
            low, end = max(first, step), min(first + m, width + step)
            if share > 0 and low < end:
                to, since = moved[v, low - first : end - first], states[v, low - step : end - step]
                for i in range(len(to)):
                    to[i] += share * since[i]
    return moved


@kernel
def _step_back(messages, steps, minimum, outside):  # type: ignore[no-untyped-def]
    """Return the mean of messages (V, m) that states meet, ``outside`` at both ends, + minimum."""
    (V, m), out = messages.shape, np.full(messages.shape, minimum)
    lowest, highest = outside
    for v in range(V):
        for s in range(steps.shape[1]):
            share, step = steps[v, s], s - 1
            if share > 0:
                first, end = min(max(-step, 0), m), max(min(m - step, m), 0)
                to, since = out[v, first:end], messages[v, first + step : end + step]
                for i in range(len(to)):
                    to[i] += share * since[i]
                for y in range(first):
                    out[v, y] += share * lowest
                for y in range(end, m):
                    out[v, y] += share * highest
    return out


@kernel
def _forward(  # type: ignore[no-untyped-def]
    states, z, numbers, level, most, steps, change, images
):
    """Return the states (images, V, m) of the latest images, and factors (later, m), L / c."""
    (later, m), V = z.shape, len(states)
    forward, likelihoods = np.empty((images, V, m)), np.zeros((later, m))
    if later < images:
        forward[0] = states
    for image in range(later):
        weight, entering, scale = numbers[image, 0], numbers[image, 1], numbers[image, 2]
        slope, offset = weight * level, weight * level**2 / 2
        for y in range(m):
            factor = scale if z[image, y] < np.inf else 0.0
            likelihoods[image, y] = power(slope * min(z[image, y], most) - offset, 8) * factor
        states = _change_speed(_step(states, steps, 0, m), change)
        for v in range(V):
            for y in range(m):
                states[v, y] = (states[v, y] + entering) * likelihoods[image, y]
        if image >= later - images:
            forward[image - later + images] = states
    return forward, likelihoods


@kernel
def smooth(  # type: ignore[no-untyped-def]
    states, z, numbers, level, most, steps, change, leave, enter, is_end, images
):
    """
    Return the probability of each column of a region for the latest images, (images, m).

    :param states: probability of states after an image, (V, m), float64.
    :param z: of the images that followed, (later, m), later >= images - 1.
    :param numbers: of each of these, the first four of :class:`Image`, (later, 4).
    :param is_end: whether the columns before and behind the region are off the map.
    :param others: see :func:`advance` and :class:`Model`.
    """
    (later, m), V = z.shape, len(states)
    forward, likelihoods = _forward(states, z, numbers, level, most, steps, change, images)
    out = np.zeros((images, m))
    messages, off = np.ones((V, m)), 1.0
    for image in range(images - 1, -1, -1):
        for v in range(V):
            for y in range(m):
                out[image, y] += forward[image, v, y] * messages[v, y]
        if not image:
            break
        row = later - images + image
        off *= numbers[row, 2]  # from here on, of the image before
        weighed, sums = messages, np.zeros(m)
        for v in range(V):
            for y in range(m):
                weighed[v, y] *= likelihoods[row, y]
                sums[y] += weighed[v, y]
        total = sums.sum()
        mixed = _change_speed(weighed, change)
        for y in range(m):
            if not z[row, y] < np.inf:
                mixed[:, y] = off
        outside = off * is_end[0], off * is_end[1]
        messages = _step_back(mixed, steps, leave * off, outside)
        off = (1 - enter) * off + enter * total / numbers[row, 3]
    return out
