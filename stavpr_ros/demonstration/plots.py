"""The pictures of a demonstration: chooses what is worth seeing and has it drawn."""

from pathlib import Path

import cv2
import numpy as np

from stavpr_ros.demonstration.sheet import demo_sheet, distance_matrix, distance_over_time
from stavpr_ros.errors import InputError
from stavpr_ros.evaluation.plots import MatchPair, Outcome, match_overview
from stavpr_ros.evaluation.records import TraverseEvaluation
from stavpr_ros.features import LocalFeatures
from stavpr_ros.mapping import PlaceMap
from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings


def outcomes_of(result: TraverseEvaluation) -> list[Outcome]:
    """Return one outcome for each image."""
    if result.true_places is None or result.correct is None:
        return ['match' if accepted else 'no match' for accepted in result.accepted]
    names: list[Outcome] = []
    for accepted, correct, truth in zip(result.accepted, result.correct, result.true_places, strict=True):
        missed: Outcome = 'unseen' if truth < 0 else 'no match'
        names.append(('right' if correct else 'wrong') if accepted else missed)
    return names


def worth_seeing(outcomes: list[Outcome], count: int = 6) -> list[int]:
    """Choose images: one of each outcome, the rest of the commonest, far from those chosen already."""
    chosen: list[int] = []
    for outcome in dict.fromkeys(outcomes):
        same = [i for i, other in enumerate(outcomes) if other == outcome]
        chosen.append(same[len(same) // 2])
    common = max(set(outcomes), key=outcomes.count)
    candidates = np.array([i for i, other in enumerate(outcomes) if other == common])
    while len(chosen) < min(count, len(outcomes)) and len(candidates):
        gaps = np.abs(candidates[:, None] - np.array([0, len(outcomes), *chosen])).min(axis=1)
        chosen.append(int(candidates[gaps.argmax()]))
    return sorted(set(chosen))[:count]


def _caption(result: TraverseEvaluation, image: int) -> str:
    place, distance = result.matched[image], result.matches.distances[image]
    if not np.isfinite(distance):
        return f'image {image}: no answer'
    where = f'place {place}' if place >= 0 else 'no match'
    return f'image {image}: {where}, distance {distance:.3f}'


def _pair(
    result: TraverseEvaluation, image: int, outcome: Outcome, query: PlaceMap, place_map: PlaceMap
) -> MatchPair:
    picture = query.thumbnail(image)
    if picture is None:
        raise InputError('the query was described without thumbnails')
    place = int(result.matched[image])
    shown = place_map.thumbnail(place) if place >= 0 else None
    if shown is not None:
        shown = cv2.resize(shown, (picture.shape[1], picture.shape[0]), interpolation=cv2.INTER_CUBIC)
    return MatchPair(picture, shown, _caption(result, image), outcome)


def _matrix(features: LocalFeatures, place_map: PlaceMap) -> np.ndarray:
    """Distances of every query image to every place, shape (N, n)."""
    return PlaceRecognizer(place_map, RecognizerSettings(threshold=1.0)).distances(features)


def draw_result(
    result: TraverseEvaluation, query: PlaceMap, place_map: PlaceMap, threshold: float, title: str, folder: Path
) -> None:
    """
    Draw the page ``demo.png``, and its parts in pictures of their own.

    :param query: the described query, with thumbnails.
    """
    outcomes = outcomes_of(result)
    matrix = _matrix(query.features, place_map)
    pairs = [_pair(result, i, outcomes[i], query, place_map) for i in worth_seeing(outcomes)]
    truth, best = result.true_places, result.matches.distances
    demo_sheet(
        folder / 'demo.png',
        pairs,
        matrix,
        result.matched,
        truth,
        best,
        threshold,
        outcomes,
        result.tolerance,
        title,
        result.headline,
    )
    match_overview(folder / 'matches.png', pairs)
    distance_matrix(folder / 'distance_matrix.png', matrix, result.matched, truth, result.tolerance)
    unseen = np.zeros(len(outcomes), bool) if truth is None else truth < 0
    distance_over_time(folder / 'distance_over_time.png', best, threshold, outcomes, unseen)
