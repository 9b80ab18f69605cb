# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Candidates of a window: the nearest places after non-maximum suppression."""

import math

import numpy as np
from stavpr_ros.alignment.lm_dtw import SequenceMatch
from stavpr_ros.errors import InputError
from stavpr_ros.recognition.match import Candidate
from stavpr_ros.recognition.robust.hysteresis import evidence, score


def ranked_candidates(
    nearest: SequenceMatch | None,
    sequences: tuple[np.ndarray, np.ndarray],
    count: int,
    nms_radius: int,
    relative: bool,
) -> list[Candidate]:
    """
    Rank places by non-maximum suppression: around a place that is taken no other one is.

    The first is the nearest sequence, the second its second best. O(count x n).

    :param nearest: the nearest sequence as it was matched; None if there is none.
    :param sequences: costs of all sequences, shape (n,), +inf where there is none, and their
        places, shape (n,), whole numbers, in any order; of equal costs the first is taken.
    :param count: most candidates, at least 0.
    :param nms_radius: candidates are more than so many places from each other.
    :param relative: the distance of the nearest is a score of mode robust; those of the others are
        then scores of their evidence against the nearest.
    :raises InputError: count below 0.
    """
    if count < 0:
        raise InputError(f'count = {count} candidates: expected at least 0')
    if nearest is None or not count:
        return []
    costs, places = sequences[0].copy(), sequences[1]
    best = float(costs.min())
    found = [Candidate(nearest.middle, nearest.distance)]
    while len(found) < count:
        costs[np.abs(places - found[-1].place) <= nms_radius] = np.inf
        at = int(np.argmin(costs))
        cost = float(costs[at])
        if math.isinf(cost):
            break
        distance = score(evidence(cost, best)) if relative else cost
        found.append(Candidate(int(places[at]), distance))
    return found


def distinct_places(
    distances: np.ndarray, places: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the nearest distinct places, nearest first (the lowest index on a tie).

    :param distances: of each sequence, shape (m,); +inf where there is none.
    :param places: its middle, shape (m,).
    :returns: places and distances, at most ``count`` of each.
    """
    order = np.argsort(distances, kind='stable')
    order = order[np.isfinite(distances[order])]
    _, first = np.unique(places[order], return_index=True)
    order = order[np.sort(first)[:count]]
    return places[order].astype(np.int64), distances[order]
