"""A starting value for the threshold, from the map alone."""

from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from stavpr_ros.alignment.temporal import best_match, match_sequence
from stavpr_ros.errors import InputError
from stavpr_ros.mapping import PlaceMap
from stavpr_ros.recognition import Recogniser, RecognitionSettings


@dataclass(frozen=True)
class ThresholdSuggestion:
    """
    A threshold and what it rests on.

    :param threshold: the suggested value.
    :param impostors: for each window of the map that was tried, the distance of the nearest sequence
        elsewhere in the map, shape (windows,).
    """

    threshold: float
    impostors: np.ndarray


def suggest_threshold(
    place_map: PlaceMap,
    settings: RecognitionSettings | None = None,
    quantile: float = 0.05,
    windows: int = 100,
    progress: bool = False,
) -> ThresholdSuggestion:
    """
    Ask how near the map's own windows come to *other* places of the map.

    Windows spread over the map are matched with the map without their own neighbourhood: all those
    answers are wrong, so their distances are what a threshold must stay below. The suggestion is a low
    quantile of them. A route driven in other light is farther from its own map than the map is from
    itself, so this is a start; evaluate with real drives where precision matters.

    :param settings: of the recogniser; its threshold is not used.
    :param quantile: share of the wrong answers that would be accepted.
    :param windows: how many windows are tried.
    :raises InputError: the map is too short to have an elsewhere.
    """
    settings = settings or RecognitionSettings(threshold=1.0)
    sequence = settings.sequence
    n, l = len(place_map), sequence.length
    if n < 4 * l:
        raise InputError(f'a map of {n} places is too short for a threshold: at least {4 * l} are needed')
    recogniser = Recogniser(place_map, settings)
    starts = np.unique(np.linspace(0, n - l, min(windows, n - l + 1)).astype(int))
    rows: dict[int, np.ndarray] = {}  # windows overlap in small maps: each row is computed once
    impostors = []
    for start in tqdm(starts, desc='threshold', unit='window', disable=not progress):
        for i in [i for i in rows if i < start]:
            del rows[i]
        for i in range(start, start + l):
            if i not in rows:
                rows[i] = recogniser.distances(place_map.features[i : i + 1])
        elsewhere = np.stack([rows[i] for i in range(start, start + l)])
        elsewhere[:, max(0, start - l) : start + 2 * l] = np.inf
        nearest = best_match(match_sequence(elsewhere, sequence), settings.neighbourhood)
        if nearest is not None:
            impostors.append(nearest.distance)
    return ThresholdSuggestion(float(np.quantile(impostors, quantile)), np.array(impostors))
