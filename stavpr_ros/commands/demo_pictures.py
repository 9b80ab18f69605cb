"""The pictures of a demonstration: chooses what is worth seeing and has it drawn."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stavpr_ros.evaluation import pictures
from stavpr_ros.evaluation.drive import DriveResult
from stavpr_ros.evaluation.pictures import MatchPair, Outcome
from stavpr_ros.features import LocalFeatures
from stavpr_ros.mapping import PlaceMap, describe_frames
from stavpr_ros.recognition import Recogniser, RecognitionSettings


def outcomes_of(result: DriveResult) -> list[Outcome]:
    """Return one outcome for each image."""
    if result.truth is None or result.correct is None:
        return ['match' if accepted else 'no match' for accepted in result.accepted]
    names: list[Outcome] = []
    for accepted, correct, truth in zip(result.accepted, result.correct, result.truth, strict=True):
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


def _caption(result: DriveResult, image: int) -> str:
    place, distance = result.matched[image], result.answers.distances[image]
    if not np.isfinite(distance):
        return f'image {image}: no answer'
    where = f'place {place}' if place >= 0 else 'no match'
    return f'image {image}: {where}, distance {distance:.3f}'


def _pairs(result: DriveResult, images: dict[int, np.ndarray], place_map: PlaceMap) -> list[MatchPair]:
    outcomes = outcomes_of(result)
    pairs = []
    for image, picture in images.items():
        place = int(result.matched[image])
        shown = place_map.thumbnail(place) if place >= 0 else None
        if shown is not None:
            size = (picture.shape[1], picture.shape[0])
            shown = cv2.resize(shown, size, interpolation=cv2.INTER_CUBIC)
        pairs.append(MatchPair(picture, shown, _caption(result, image), outcomes[image]))
    return pairs


def _matrix(features: LocalFeatures, place_map: PlaceMap) -> np.ndarray:
    """Distances of every query image to every place, shape (N, n)."""
    recogniser = Recogniser(place_map, RecognitionSettings(threshold=1.0))
    return np.stack([recogniser.distances(features[i : i + 1]) for i in range(len(features))])


def draw_result(
    result: DriveResult, query: Any, place_map: PlaceMap, threshold: float, title: str, folder: Path
) -> None:
    """
    Draw the page ``demo.png``, and its parts in pictures of their own.

    :param query: the source of the query's images.
    """
    outcomes = outcomes_of(result)
    wanted = worth_seeing(outcomes)
    kept: dict[int, np.ndarray] = {}

    def frames():  # type: ignore[no-untyped-def]
        for i, frame in enumerate(query):
            if i in wanted:
                kept[i] = frame.image
            yield frame

    matrix = _matrix(describe_frames(frames(), place_map.describer()), place_map)
    pairs = _pairs(result, kept, place_map)
    truth = result.truth
    best = result.answers.distances
    pictures.demo_sheet(
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
    pictures.match_overview(folder / 'matches.png', pairs)
    pictures.distance_matrix(folder / 'distance_matrix.png', matrix, result.matched, truth, result.tolerance)
    unseen = np.zeros(len(outcomes), bool) if truth is None else truth < 0
    pictures.distance_over_time(folder / 'distance_over_time.png', best, threshold, outcomes, unseen)
