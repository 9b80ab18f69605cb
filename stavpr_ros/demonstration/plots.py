# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The plots of a localization demonstration: selects the images to show."""

from pathlib import Path

import cv2
import numpy as np
from stavpr_ros.demonstration.sheet import demo_sheet, distance_matrix, distance_over_time
from stavpr_ros.errors import InputError
from stavpr_ros.evaluation.plots import match_overview, MatchPair, Outcome
from stavpr_ros.evaluation.records import TraverseEvaluation
from stavpr_ros.mapping import PlaceMap
from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings


def outcomes_of(result: TraverseEvaluation) -> list[Outcome]:
    """Return one outcome for each image."""
    if result.true_places is None or result.correct is None:
        return ['match' if accepted else 'no match' for accepted in result.accepted]
    outcomes: list[Outcome] = []
    for accepted, correct, place in zip(
        result.accepted, result.correct, result.true_places, strict=True
    ):
        rejected: Outcome = 'unseen' if place < 0 else 'no match'
        outcomes.append(('right' if correct else 'wrong') if accepted else rejected)
    return outcomes


def choose_images(outcomes: list[Outcome], count: int = 6) -> list[int]:
    """Choose one image of each outcome, and others of the most frequent, far from each other."""
    chosen: list[int] = []
    for outcome in dict.fromkeys(outcomes):
        same = [i for i, other in enumerate(outcomes) if other == outcome]
        chosen.append(same[len(same) // 2])
    common = max(set(outcomes), key=outcomes.count)
    candidates = np.array([i for i, other in enumerate(outcomes) if other == common])
    while len(chosen) < min(count, len(outcomes)) and len(candidates):
        others = np.array([0, len(outcomes), *chosen])
        gaps = np.abs(candidates[:, None] - others).min(axis=1)
        chosen.append(int(candidates[gaps.argmax()]))
    return sorted(set(chosen))[:count]


def _caption(result: TraverseEvaluation, image: int) -> str:
    place, distance = result.matched[image], result.matches.distances[image]
    if not np.isfinite(distance):
        return f'image {image}: no window'
    match = f'place {place}' if place >= 0 else 'no match'
    return f'image {image}: {match}, distance {distance:.3f}'


def _pair(
    result: TraverseEvaluation,
    image: int,
    outcome: Outcome,
    query: PlaceMap,
    place_map: PlaceMap,
) -> MatchPair:
    left = query.thumbnail(image)
    if left is None:
        raise InputError('the map of the query has no thumbnails')
    place = int(result.matched[image])
    right = place_map.thumbnail(place) if place >= 0 else None
    if right is not None:
        size = (left.shape[1], left.shape[0])
        right = cv2.resize(right, size, interpolation=cv2.INTER_CUBIC)
    return MatchPair(left, right, _caption(result, image), outcome)


def draw_result(
    result: TraverseEvaluation,
    query: PlaceMap,
    place_map: PlaceMap,
    threshold: float,
    title: str,
    folder: Path,
) -> None:
    """
    Draw the page ``demo.png``, and its parts as plots of their own.

    :param query: a map of the query, with thumbnails.
    """
    outcomes = outcomes_of(result)
    recognizer = PlaceRecognizer(place_map, RecognizerSettings(threshold=1.0))
    matrix = recognizer.distances(query.features)
    pairs = [_pair(result, i, outcomes[i], query, place_map) for i in choose_images(outcomes)]
    matched, true_places, best = result.matched, result.true_places, result.matches.distances
    demo_sheet(
        folder / 'demo.png',
        pairs,
        matrix,
        matched,
        true_places,
        best,
        threshold,
        outcomes,
        result.tolerance,
        title,
        result.headline,
    )
    match_overview(folder / 'matches.png', pairs)
    path = folder / 'distance_matrix.png'
    distance_matrix(path, matrix, matched, true_places, result.tolerance)
    unseen = np.zeros(len(outcomes), bool) if true_places is None else true_places < 0
    distance_over_time(folder / 'distance_over_time.png', best, threshold, outcomes, unseen)
