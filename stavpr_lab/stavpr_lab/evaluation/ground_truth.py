# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Ground truth: which places of the map are correct for each query image."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np
from scipy.spatial import KDTree
from stavpr_lab.evaluation.ground_truth_files import Names, read_pairs
from stavpr_ros.checks import require_shape
from stavpr_ros.errors import InputError
from stavpr_ros.sources.folder import text_of

LISTED = 10  # images that an error names
MAX_SHARE = 0.5  # share of the places that is accepted for an image


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """
    The accepted places of each query; made by one of the constructors.

    Tolerances are part of it: every place that counts as correct is an accepted one.

    :param N: number of query images.
    :param n: number of places of the map.
    :param keys: query * n + place of each accepted pair, sorted, each once, shape (M,), int64.
    :param kind: where the pairs come from; '' = there is no ground truth.
    :param stated: whether the truth of a query is known, shape (N,), bool; None = of all. Other
        queries count neither as in the map nor as off it.
    """

    N: int
    n: int
    keys: np.ndarray
    kind: str = 'pairs'
    stated: np.ndarray | None = None

    @classmethod
    def unknown(cls, N: int, n: int) -> Self:
        """Return the absence of a ground truth: without pairs and without a kind."""
        return cls(N, n, np.zeros(0, np.int64), '')

    @classmethod
    def from_pairs(
        cls, queries: np.ndarray, places: np.ndarray, N: int, n: int, tolerance: int = 0
    ) -> Self:
        """
        Accept the given pairs.

        :param queries: shape (M,), integers 0 .. N - 1, in any order.
        :param places: shape (M,), integers 0 .. n - 1; -1 = the query is not in the map.
        :param tolerance: places before and after an accepted one that are accepted as well.
        :raises InputError: a pair outside N queries and n places.
        """
        queries, places = np.asarray(queries, np.int64), np.asarray(places, np.int64)
        if N < 1 or n < 1:
            raise InputError(
                f'ground truth of {N} queries in {n} places: expected at least one of each'
            )
        outside = (queries < 0) | (queries >= N) | (places < -1) | (places >= n)
        if outside.any():
            first = int(np.argmax(outside))
            raise InputError(
                f'ground truth pairs query {queries[first]} with place {places[first]}: expected '
                f'queries 0 .. {N - 1} and places 0 .. {n - 1}; is it that of other images, or '
                'counted from 1?'
            )
        keys = (queries * n + places)[places >= 0]
        return cls(N, n, np.unique(keys)).widened(tolerance)

    @classmethod
    def identity(cls, N: int, n: int, tolerance: int = 0) -> Self:
        """
        Accept the same index: image i of both traverses shows the same place.

        :raises InputError: N and n differ.
        """
        if n != N:
            raise InputError(
                f'{N} query images and {n} places: the same index is the ground truth only of '
                'equally many; give a file of accepted pairs (--truth FILE), or no ground truth'
            )
        return replace(
            cls.from_pairs(np.arange(N), np.arange(n), N, n, tolerance), kind='identity'
        )

    @classmethod
    def from_file(
        cls, path: str | Path, N: int, n: int, tolerance: int = 0, names: Names = ((), ())
    ) -> Self:
        """
        Read accepted pairs; queries and places are counted from 0.

        Only a list of pairs may lack queries, whose truth is unknown then.

        * Text (.csv, .tsv, .txt): a line a pair, query and place, with or without a header. A
          single column is the place of query 0, 1, 2 and so on. A place of -1 = not in the map.
          Files of ``names``, of queries and places, may replace their numbers.
        * Array (.npy, .npz with one array or one called ``truth``): shape (N, n), 0 or 1; else
          shape (M, 2), pairs; or shape (N,), the place of each query, -1 = none. ``GTsoft`` of an
          .npz, as VPR_Tutorial publishes it, has the shape (n, N).
        * Black and white image, N high and n wide: white at row i, column j accepts place j for
          query i. For loop closures, where both are one traverse, see :meth:`loop_closures`.

        :raises SourceError: the file cannot be read, or contains objects (pickles).
        :raises InputError: it is of other images: wrong size, or indices outside.
        """
        queries, places = read_pairs(Path(path), N, n, names)
        try:
            truth = cls.from_pairs(queries, places, N, n, tolerance)
        except InputError as error:
            raise InputError(f'{path}: {error}') from error
        stated = np.isin(np.arange(N), queries)
        kind = text_of(Path(path).name)
        return replace(truth, kind=kind, stated=None if stated.all() else stated)

    @classmethod
    def from_poses(
        cls, queries: np.ndarray, places: np.ndarray, meters: float, degrees: float | None = None
    ) -> Self:
        """
        Accept places that are near and have a similar orientation.

        :param queries: x y z (meters), quaternion x y z w of each query, shape (N, 7).
        :param places: the same of each place, (n, 7); a row of NaN = unknown, never accepted.
        :param meters: largest distance, >= 0.
        :param degrees: largest angle between the two orientations, >= 0; None = any.
        :raises InputError: a query without a pose, no place with one, or values that are no poses.
        """
        query, place = _checked_poses(queries, 'query'), _checked_poses(places, 'map')
        unknown = np.flatnonzero(np.isnan(query[:, 0]))
        if len(unknown):
            names = ', '.join(map(str, unknown[:LISTED])) + (
                ' ...' if len(unknown) > LISTED else ''
            )
            raise InputError(
                f'{len(unknown)} of {len(query)} query images have no pose ({names}): give poses '
                'of all, or leave these images out'
            )
        if not meters >= 0 or (degrees is not None and not degrees >= 0):
            raise InputError(f'{meters} meters and {degrees} degrees: expected numbers >= 0')
        with_pose = np.flatnonzero(~np.isnan(place[:, 0]))
        near = KDTree(place[with_pose, :3]).query_ball_point(query[:, :3], meters)
        queries = np.repeat(np.arange(len(query)), [len(row) for row in near])
        places = with_pose[np.concatenate(near).astype(np.int64)]
        if degrees is not None:
            # a quaternion and its negative are the same rotation: the angle is 2 acos |<p, q>|
            cosines = np.abs(np.sum(query[queries, 3:] * place[places, 3:], axis=1))
            angles = 2 * np.degrees(np.arccos(np.minimum(cosines, 1)))
            similar = angles <= degrees + 1e-5  # acos is inexact near 1
            queries, places = queries[similar], places[similar]
        truth = cls.from_pairs(queries, places, len(query), len(place))
        limit = '' if degrees is None else f' and {degrees:g} degrees'
        return replace(truth, kind=f'poses within {meters:g} m{limit}')

    def doubt(self) -> str:
        """Return what is accepted if that can hardly be wrong, or right; '' = neither."""
        if not self.kind or self.N * self.n == 1:
            return ''
        if not len(self.keys):
            return f'no place for any of {self.N} images: are both numbered and posed alike?'
        share = len(self.keys) / (np.count_nonzero(self.has_match) * self.n)
        if share <= MAX_SHARE:
            return ''
        return (
            f'{share:.0%} of the {self.n} places for an image: a guess is right as often; '
            'is the tolerance too large?'
        )

    @property
    def pairs(self) -> np.ndarray:
        """Return the sorted accepted pairs of query and place, shape (M, 2), int64."""
        return np.stack([self.keys // self.n, self.keys % self.n], axis=1)

    @cached_property
    def is_stated(self) -> np.ndarray:
        """Whether the truth of a query is known, shape (N,), bool."""
        return np.ones(self.N, bool) if self.stated is None else self.stated

    @cached_property
    def has_match(self) -> np.ndarray:
        """Whether a query has an accepted place, shape (N,), bool."""
        return self._counts > 0

    @cached_property
    def middles(self) -> np.ndarray:
        """Return the middle of each query's first accepted places, (N,), int64; -1 = none."""
        middles = np.full(self.N, -1, np.int64)
        queries, firsts, lasts = self.runs
        own, at = np.unique(queries, return_index=True)
        middles[own] = (firsts[at] + lasts[at]) // 2
        return middles

    @property
    def runs(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return query, first and last place of each run of accepted places, in order, (R,)."""
        queries, places = self.pairs.T
        is_first = np.diff(places, prepend=-2) != 1
        is_first[1:] |= np.diff(queries) != 0
        is_last = np.append(is_first, True)[1:]
        return queries[is_first], places[is_first], places[is_last]

    @cached_property
    def _counts(self) -> np.ndarray:
        return np.bincount(self.keys // self.n, minlength=self.N)

    def accepted(self, query: int) -> np.ndarray:
        """Return the accepted places of one query, sorted, shape (k,), int64."""
        first, end = np.searchsorted(self.keys, [query * self.n, (query + 1) * self.n])
        return self.keys[first:end] % self.n

    def accepts(self, places: np.ndarray) -> np.ndarray:
        """
        Return which places are correct.

        :param places: the place of each query, shape (N,), or several, shape (N, k); integers,
            -1 = none, which is never correct.
        :returns: bool, of the same shape.
        :raises InputError: a place that the map does not have.
        """
        places = np.asarray(places)
        if places.size and not (places.min() >= -1 and places.max() < self.n):
            raise InputError(
                f'places {places.min()} .. {places.max()}: expected 0 .. {self.n - 1}, -1 = none'
            )
        if not self.keys.size:
            return np.zeros(places.shape, bool)
        queries = np.arange(self.N).reshape(-1, *[1] * (places.ndim - 1))
        keys = queries * self.n + places
        at = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        return (self.keys[at] == keys) & (places >= 0)

    def widened(self, tolerance: int, positions: np.ndarray | None = None) -> Self:
        """
        Accept ``tolerance`` places before and after each accepted one as well.

        :param positions: of each place along the route, (n,), int64; None = 0 .. n - 1.
        :raises InputError: no whole number >= 0.
        """
        if not tolerance >= 0 or not float(tolerance).is_integer():
            raise InputError(f'tolerance {tolerance}: expected a whole number of places >= 0')
        positions = np.arange(self.n) if positions is None else positions
        order, (queries, places) = np.argsort(positions), self.pairs.T
        ends = positions[places] + [[-int(tolerance)], [int(tolerance) + 1]]
        firsts, ends = np.searchsorted(positions, ends, sorter=order)
        keys = np.repeat(queries * self.n, ends - firsts) + order[_ranges(firsts, ends)]
        return replace(self, keys=np.unique(keys))

    def select(self, indices: np.ndarray) -> Self:
        """
        Return the ground truth of selected queries.

        :param indices: query of each row of the result, shape (K,), in any order, repeated or not.
        """
        counts = self._counts[indices]
        firsts = np.searchsorted(self.keys, indices.astype(np.int64) * self.n)
        places = self.keys[_ranges(firsts, firsts + counts)] % self.n
        keys, stated = np.repeat(np.arange(len(indices)) * self.n, counts) + places, self.stated
        stated = None if stated is None else stated[indices]
        return replace(self, N=len(indices), keys=keys, stated=stated)

    def on_places(self, places: np.ndarray) -> Self:
        """
        Return the ground truth on a map of selected places only.

        :param places: ascending, shape (k,); they become 0 .. k - 1.
        """
        number = np.full(self.n, -1, np.int64)
        number[places] = np.arange(len(places))
        queries, numbers = self.keys // self.n, number[self.keys % self.n]
        remains = numbers >= 0
        return replace(self, n=len(places), keys=queries[remains] * len(places) + numbers[remains])

    def loop_closures(self, exclude: int = 0) -> Self:
        """
        Return the ground truth of one traverse on its own past: the later image is the query.

        Images that no pair names close no loop. Either triangle of a square matrix may contain the
        pairs, the lower one (row = query, as RTAB-Map writes it), the upper one or both.

        :param exclude: the latest images before the query that are not part of the map.
        :raises InputError: N and n differ.
        """
        if self.n != self.N:
            raise InputError(
                f'{self.N} queries, {self.n} places: loop closures need one traverse, as many of '
                'both'
            )
        pairs = self.pairs
        later, earlier = pairs.max(axis=1), pairs.min(axis=1)
        past = later - earlier > exclude
        return replace(self, keys=np.unique(later[past] * self.n + earlier[past]), stated=None)


def _ranges(firsts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Return the whole numbers first .. end - 1 of each pair, one range after the other."""
    counts = ends - firsts
    return np.repeat(firsts - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())


def _checked_poses(poses: np.ndarray, name: str) -> np.ndarray:
    """Return poses with quaternions of norm 1; unknown poses stay rows of NaN."""
    poses = np.array(poses, np.float64)
    require_shape(f'{name} poses', poses, 'N 7')
    is_known = ~np.isnan(poses).all(axis=1)
    lengths = np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    if not np.isfinite(poses[is_known]).all() or not lengths.all():
        raise InputError(f'{name} poses: expected finite numbers and quaternions other than 0')
    if not is_known.any():
        raise InputError(f'{name} poses: none of {len(poses)} is known; give others')
    poses[:, 3:] /= lengths
    return poses
