# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The window of the query, and the search of mode robust over it."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from stavpr_ros.alignment.lm_dtw import padded_width, SequenceMatch
from stavpr_ros.alignment.path import NO_PATH
from stavpr_ros.checks import no_nan
from stavpr_ros.compilation import kernel
from stavpr_ros.recognition.map_change import ImageChange
from stavpr_ros.recognition.match import NO_SHARES
from stavpr_ros.recognition.place_filter import CLOSE, NEGLIGIBLE, PlaceFilter
from stavpr_ros.recognition.robust import FilterSettings
from stavpr_ros.recognition.sessions import Sequences, SessionLayout
import torch

STANDS = 0.05  # relative probability of a standstill, below which the camera moves
BAND = 5  # places to either side of the filter's path that its refinement considers
START_DEVIATION = 3.0  # places, of the path at the oldest image of the window
STEPS = np.array([0.03, 0.12, 0.7, 0.12, 0.03])  # probability of 2 places less than the path, ...


class SequenceBuffer:
    """
    A ring of the last l rows.

    Rows are checked when they are pushed; the searches over the buffer trust them.

    :param length: rows l.
    :param places: places n of the map.
    :param k: places that one start of LM-DTW sees.
    :param row_width: words from row to row for n places and k; the padding that a kernel needs
        behind the places is +inf.
    :param device: of the memory.
    :param copies: times that each row is written, l rows apart. 2 = the last l rows are always one
        slice of the memory, oldest row first, as LM-DTW takes them; 1 = half the memory.
    """

    def __init__(
        self,
        length: int,
        places: int,
        k: int,
        row_width: Callable[[int, int], int] = padded_width,
        device: torch.device | str = 'cpu',
        copies: int = 2,
    ) -> None:
        self.length, self.k, self._copies = int(length), k, copies
        self._row_width = row_width
        self.first = 0  # index of the first place that is not evicted
        self.known = 0  # places with an entry in any row of the window; all others are +inf
        self._count = 0
        self._stamps: deque[int] = deque(maxlen=self.length)
        self._allocate(places, torch.device(device))

    def _allocate(self, places: int, device: torch.device) -> None:
        self.places = places
        self.memory = torch.full(
            (self._copies * self.length, self._row_width(places, self.k)), torch.inf, device=device
        )
        copies = self.memory.view(self._copies, self.length, -1)
        self._slots = [copies[:, slot, :places] for slot in range(self.length)]

    def __len__(self) -> int:
        return min(self._count, self.length)

    @property
    def full(self) -> bool:
        """As many rows as the window is long have been pushed."""
        return self._count >= self.length

    @property
    def stamps(self) -> tuple[int, ...]:
        """Stamps of the images in the window, ns, oldest first."""
        return tuple(self._stamps)

    @property
    def oldest(self) -> int:
        """Row of ``memory`` where the window begins."""
        return self._count % self.length

    def push(self, row: torch.Tensor, stamp: int = 0) -> None:
        """
        Add the distances of the newest image and drop the oldest.

        :param row: shape (m,), float32, of the first m <= n places; the others become +inf. On the
            buffer's device.
        :param stamp: of the image, ns; 0 = unknown.
        :raises InputError: NaN or -inf in the row; the buffer is unchanged. Not checked on a CUDA
            device, which would have to be waited for.
        """
        slot, m = self._slots[self._count % self.length], len(row)
        if row.is_cuda:
            slot[:, :m], slot[:, m:] = row, torch.inf
        else:  # by NumPy: torch wakes a thread for a row of 32,768 places
            values, entries = row.numpy(), slot.numpy()
            if not values.sum() > -np.inf:
                no_nan(values, 'image distances')
            entries[:, :m], entries[:, m:] = values, np.inf
        self.known = max(self.known, m)
        self._stamps.append(stamp)
        self._count += 1

    def rows(self) -> torch.Tensor:
        """Return the window, (l, n + padding), float32; padding is +inf. A view of two copies."""
        if self._copies == 1:
            return self.memory.roll(-self.oldest, dims=0)
        return self.memory[self.oldest : self.oldest + self.length]

    def newest(self) -> torch.Tensor:
        """Return the row of the newest image, (n,), a view."""
        return self._slots[self.oldest - 1][0]

    def at(self, columns: np.ndarray) -> np.ndarray:
        """Return entries of the window, oldest row first, by their columns, (l, m) each."""
        rows = (self.oldest + np.arange(self.length)) % self.length
        found = self.memory[torch.from_numpy(rows[:, None]), torch.from_numpy(columns)]
        return found.cpu().numpy()

    def clear(self) -> None:
        """Empty the window."""
        self.memory.fill_(torch.inf)
        self._stamps.clear()
        self.known = self._count = 0

    def grow(self, places: int) -> None:
        """Make room for more places; in the rows of the window they are +inf."""
        rows, before = self.memory, self.places
        self._allocate(places, rows.device)
        self.memory[:, :before] = rows[:, :before]

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up, and new ones have room behind them."""
        kept = self.places - count
        self.memory[:, :kept] = self.memory[:, count : self.places].clone()
        self.memory[:, kept : self.places] = torch.inf
        self.known = max(0, self.known - count)
        self.first += count


def _no_sequences() -> Sequences:
    return np.empty(0, np.float32), np.empty(0, np.int64)


@dataclass(frozen=True, eq=False)
class WindowMatch:
    """
    The nearest sequence of a window, and all others.

    :param nearest: with the second best; None where no sequence is possible.
    :param path: its warping path, shape (m, 2), int32: position in the window, place.
    :param shares: probability of each place of the path and those close to it, if the sequence is
        right, (m,); empty in mode paper.
    :param sequences: returns the costs of all sequences, shape (n,), +inf where there is none,
        and their middle places, shape (n,); valid until the next search.
    """

    nearest: SequenceMatch | None = None
    path: np.ndarray = field(default_factory=lambda: NO_PATH)
    sequences: Callable[[], Sequences] = _no_sequences
    shares: np.ndarray = field(default_factory=lambda: NO_SHARES)

    def path_ratios(self, position: int) -> np.ndarray:
        """Return the shares over that of the place of one image of the window, (m,)."""
        return self.shares / max(self.shares[position], 1e-9) if self.shares.size else self.shares


Search = Callable[[int], WindowMatch]
"""Matches a full window; the argument is the radius in places of the non-maximum suppression."""


@kernel
def _window_likelihoods(
    z: np.ndarray, path: np.ndarray, exponents: np.ndarray, images: np.ndarray, n: int,
    likelihoods: np.ndarray, moves: np.ndarray,
) -> None:  # fmt: skip
    """
    Write what :func:`_smooth` reads.

    :param z: z-normalized distances of each image to the places near the path, (l, S).
    :param path: place of each image, (l,).
    :param exponents: of their likelihoods: alpha times the mean of right places, (l,).
    :param images: the filter's image of each, (l,): none moves that is that of the one before.
    :param n: places.
    """
    for i in range(len(path)):
        for s in range(z.shape[1]):
            inside = 0 <= path[i] + s - BAND < n and np.isfinite(z[i, s])
            likelihoods[i, s] = np.exp(exponents[i] * z[i, s]) if inside else 0
        step = path[i] - path[i - 1] if i else 0
        moves[i] = np.where(np.arange(step - 2, step + 3) >= 0, STEPS, 0)
        if i and images[i] == images[i - 1]:
            moves[i] = 0, 0, 1, 0, 0


@kernel
def _smooth(likelihoods: np.ndarray, moves: np.ndarray, masses: np.ndarray) -> None:
    """
    Write the probability of each offset from a path at each image, by all images of the window.

    The forward-backward algorithm. Images that no offset explains give no evidence.

    :param likelihoods: of each image at each offset, (l, S).
    :param moves: probability that the offset becomes 2 less, ..., 2 more before an image, (l, 5).
    :param masses: (l, S), written; its first row holds the probabilities before all images.
    """
    l, S = likelihoods.shape
    for i in range(l):
        for s in range(S):
            if i:
                masses[i, s] = 0
                for d in range(max(-2, s - S + 1), min(2, s) + 1):
                    masses[i, s] += masses[i - 1, s - d] * moves[i, d + 2]
            masses[i, s] *= likelihoods[i, s]
        total = masses[i].sum()
        if total > 0:
            masses[i] /= total
        else:
            masses[i] = 1 / S
    later, seen = np.ones(S), np.empty(S)
    for i in range(l - 2, -1, -1):
        seen[:] = later * likelihoods[i + 1]
        for s in range(S):
            later[s] = 0
            for d in range(max(-2, -s), min(2, S - 1 - s) + 1):
                later[s] += moves[i + 1, d + 2] * seen[s + d]
        total = later.sum()
        later[:] = later / total if total > 0 else np.ones(S)
        combined = masses[i] * later
        if combined.sum() > 0:
            masses[i] = combined / combined.sum()


class FilterSearch:
    """
    A :class:`PlaceFilter` fed image by image, and read at the middle of the window.

    The distance of a match is 1 less the probability that its place is right.

    :param buffer: the window.
    :param layout: of the places of several sessions in the columns of the buffer.
    :param to_oldest: states are followed back to the oldest image of the window, instead of the
        middle one: :meth:`at` any image.
    :param on_device: the filter is computed on the CUDA device where the buffer is.
    """

    def __init__(
        self,
        buffer: SequenceBuffer,
        settings: FilterSettings | None = None,
        layout: SessionLayout | None = None,
        to_oldest: bool = False,
        on_device: bool = False,
    ) -> None:
        self.buffer, self._layout, self.on_device = buffer, layout, on_device
        settings = settings or FilterSettings()
        self._middle = (buffer.length - 1) // 2
        gaps, places = None, buffer.places
        if layout is not None:
            gaps, places = layout.gaps, len(layout.columns)
        lag = buffer.length - 1 - (0 if to_oldest else self._middle)
        filter_class: Any = PlaceFilter
        if on_device:
            from stavpr_ros.recognition.cuda_filter import CudaPlaceFilter

            filter_class = CudaPlaceFilter
        self.filter = filter_class(buffer.places, lag, settings, gaps)
        self.change = ImageChange(places, settings)
        self._speeds, self._levels = settings.speeds, settings.levels
        self._images: deque[int] = deque(maxlen=buffer.length)  # the filter's image of each
        self._weights: deque[float] = deque(maxlen=buffer.length)  # exponent alpha of each

    def reset(self) -> None:
        """Forget the query."""
        self.filter.reset()
        self.change.reset()
        self._images.clear()
        self._weights.clear()

    def grow(self, places: int) -> None:
        """Make room for more places."""
        self.filter.grow(places)
        self.change.grow(places)

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up."""
        self.filter.evict(count)
        self.change.evict(count)

    def update(self, z: np.ndarray | torch.Tensor, change: float) -> None:
        """
        Advance by an image.

        An image of a camera that stands adds nothing. Where the map's own images are equal, in a
        dark tunnel, it may move: the filter goes on at its speed, without evidence.

        :param z: z-normalized distances to the places, (m,), float32; on the filter's device.
        :param change: of the image, from :class:`ImageChange`.
        """
        weight = 0.0
        if not (self.filter.count and self.change.is_standstill(change)):
            weight = self.change.weight(change)
            weights = likelihoods = np.ones(len(self._speeds))
            if self.filter.count:  # of the first image no change is known
                weights = self.change.speed_weights(change)
                likelihoods = self.change.speed_likelihoods(change)
            if weights[0] < STANDS * weights.max():
                z = self._moving(z)
            self.filter.update(z, weight, weights, likelihoods)
        else:
            by_place = self.filter.places_of_states()[: len(z)]
            if self._layout is not None:
                by_place = by_place[self._layout.columns]
            if self.change.is_dark_stretch(by_place):
                self.filter.update(z, 0.0, *np.ones((2, len(self._speeds))))
        self._images.append(self.filter.count - 1)
        self._weights.append(weight)

    def _moving(self, z: np.ndarray | torch.Tensor) -> np.ndarray | torch.Tensor:
        """Return z, of a moving camera: places where the map's camera stood are not near it."""
        stood = self.change.stood()
        if self._layout is not None:
            places, stood = stood, np.zeros(self._layout.width, bool)
            stood[self._layout.columns] = places
        stood = stood[: len(z)]
        if isinstance(z, torch.Tensor):
            return torch.where(torch.from_numpy(stood).to(z.device), z.clamp(min=0), z)
        return np.where(stood, np.maximum(z, 0), z) if stood.any() else z

    def __call__(self, nms_radius: int) -> WindowMatch:
        return self.at(self._middle, nms_radius)

    def at(self, position: int, nms_radius: int) -> WindowMatch:
        """
        Return the match of an image by all images of the window.

        :param position: of the image in the window, not before the lag of the filter.
        :param nms_radius: see :data:`Search`.
        """
        n, first = self.buffer.known, self.buffer.first
        if not n:
            return WindowMatch()
        newest = self._images[-1]
        belief = self.filter.belief(n, newest - self._images[position])
        places, probabilities = belief.probabilities(n)
        if not places.size:
            return self._nowhere(n, first)
        best = int(np.argmax(probabilities))
        if self._layout is not None:
            places, probabilities, best = self._layout.shared(belief, CLOSE)
        apart = np.abs(belief.places - places[best])
        near = apart <= CLOSE
        # that the sequence is right: its path is known within the band
        probable = max(probabilities[best], min(belief.weights[apart <= BAND].sum(), 1))
        way = belief.ways[near][np.argmax(belief.weights[near])]
        refined, shares = self._refined(self._path(way, position), way[0], n)
        middle = int(refined[position])
        second, found = self._second_best(n, places, probabilities, middle, nms_radius)
        path = np.stack([np.arange(len(refined)), refined + first], axis=1).astype(np.int32)
        match = SequenceMatch(
            first=int(path[0, 1]),
            last=int(path[-1, 1]),
            middle=middle + first,
            distance=float(1 - probable * shares[position]),
            second_best_index=second + first if found > 0 else -1,
            second_best_distance=1 - found if found > 0 else float('nan'),
        )
        sequences = partial(self._sequences, n, first, places, probabilities)
        return WindowMatch(match, path, sequences, shares)

    def _refined(self, path: np.ndarray, level: int, n: int) -> tuple[np.ndarray, np.ndarray]:
        """
        Return places near a path that explain the images of the window best, and their shares.

        The speeds of the filter are few, and before the middle its path is a straight line. How
        far each image's place is from the path is a hidden Markov model: the offset changes little
        from image to image, and the evidence is the filter's, at the path's level. The place is at
        the mean of the offset.

        :param path: place of each image, (l,).
        :param level: index of the mean z-normalized distance of right places.
        :returns: places, which never go back, (l,), and probabilities of these and those close to
            them, (l,).
        """
        offsets = np.arange(-BAND, BAND + 1)
        places = path[:, None] + offsets
        inside = places.clip(0, n - 1)
        z = self.buffer.at(inside)
        exponents = np.array(self._weights) * self._levels[level]
        likelihoods, moves = np.empty(places.shape), np.empty((len(path), len(STEPS)))
        images = np.array(self._images)
        _window_likelihoods(z, path, exponents, images, n, likelihoods, moves)
        masses = np.empty(places.shape)
        masses[0] = np.exp(-0.5 * (offsets / START_DEVIATION) ** 2)
        _smooth(likelihoods, moves, masses)
        refined = path + np.rint(masses @ offsets).astype(np.int64)
        refined = np.maximum.accumulate(refined.clip(self._lowest(path[-1]), n - 1))
        close = np.abs(places - refined[:, None]) <= CLOSE
        close |= self._equal(inside, refined[:, None])
        return refined, (masses * close).sum(axis=1)

    def _equal(self, places: np.ndarray, others: np.ndarray) -> np.ndarray:
        """Return which places are in one stretch of equal images with others, as if one place."""
        if self._layout is not None:
            places, others = (self._layout.positions_of(i) for i in (places, others))
        first = min(places.min(), others.min())
        stretches = self.change.stretches(first, max(places.max(), others.max()) + 1)
        equal: np.ndarray = stretches[places - first] == stretches[others - first]
        return equal

    def _second_best(
        self, n: int, places: np.ndarray, probabilities: np.ndarray, middle: int, radius: int
    ) -> tuple[int, float]:
        """Return the most probable place beyond a radius, and its probability, 0 if none."""
        around = np.arange(max(0, middle - radius), min(n, middle + radius + 1))
        now, faint = self.filter.most_probable(np.sort(np.append(around, places)))
        faint *= NEGLIGIBLE
        apart = np.abs(places - middle) > radius
        if apart.any():
            second = int(np.argmax(np.where(apart, probabilities, 0)))
            if probabilities[second] >= faint:
                return int(places[second]), float(probabilities[second])
        return now, faint

    def _sequences(
        self, n: int, first: int, places: np.ndarray, probabilities: np.ndarray
    ) -> Sequences:
        """Return the costs of all places; of improbable ones by the filter's state today."""
        every = self.filter.places_of_states()[:n] * np.float64(NEGLIGIBLE)
        every[places] = probabilities
        return np.where(every > 0, 1 - every, np.inf), np.arange(first, first + n)

    def _nowhere(self, n: int, first: int) -> WindowMatch:
        """Return the place that is most probable now, with the distance 1."""
        nothing = np.empty(0, np.int64)
        place = self.filter.most_probable(nothing)[0] + first
        match = SequenceMatch(place, place, place, 1.0, -1, float('nan'))
        length = self.buffer.length
        path = np.stack([np.arange(length), np.full(length, place)], axis=1).astype(np.int32)
        return WindowMatch(match, path, lambda: self._sequences(n, first, nothing, np.empty(0)))

    def _lowest(self, column: int) -> int:
        """Return the first column of the session that a column is in."""
        return 0 if self._layout is None else self._layout.first_column(column)

    def _path(self, way: np.ndarray, position: int) -> np.ndarray:
        """Return the place of each image, (l,); before the one at a position at one speed."""
        images = np.array(self._images)
        back = images[-1] - images
        lag = int(back[position])
        places = self.filter.way(way, lag)
        slope = (places[0] - places[lag]) / lag if lag else self._speeds[way[3]]
        earlier = np.maximum(back - lag, 0) * slope
        path = places[np.minimum(back, lag)].astype(np.int64) - np.rint(earlier).astype(np.int64)
        return np.maximum(path, self._lowest(places[0]))
