# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A threshold to start with, from the map alone."""

import cv2
import numpy as np
from stavpr_ros.alignment.lm_dtw import best_match, match_sequence
from stavpr_ros.errors import InputError
from stavpr_ros.mapping import Map
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.progress import Progress

WINDOWS = 24  # altered windows


def alter_image(image: np.ndarray, variant: int, rng: np.random.Generator) -> np.ndarray:
    """
    Alter an image as another day and another lane might.

    It is shifted, lit and exposed otherwise, duller, noisy.

    :param image: RGB (h, w, 3) uint8.
    :param variant: 0..3: shifted to one side or the other, darker or brighter.
    """
    height, width = image.shape[:2]
    shift = round(0.15 * width)
    visible = image[:, shift:] if variant % 2 else image[:, : width - shift]
    value: np.ndarray = (
        cv2.resize(visible, (width, height), interpolation=cv2.INTER_LINEAR).astype(np.float32)
        / 255
    )
    value **= 1.6 if variant // 2 % 2 else 0.6
    shade = cv2.resize(rng.normal(0, 0.4, (4, 5)), (width, height), interpolation=cv2.INTER_CUBIC)
    value *= np.exp(shade)[:, :, None].astype(np.float32)
    value = cv2.GaussianBlur(value, (0, 0), width / 320) * 0.6 + 0.25
    value += rng.normal(0, 0.02, value.shape).astype(np.float32)
    return (np.clip(value, 0, 1) * 255).astype(np.uint8)


def suggest_threshold(place_map: Map, model: str = '') -> float:
    """
    Estimate the distances of wrong matches from altered windows of the map.

    Windows spread over the map are altered (:func:`alter_image`, on the thumbnails) and matched
    with the places outside their own nms_radius. All these matches are false positives; the
    suggestion is the median of their distances. It is a start: where precision matters, evaluate
    with a second real drive.

    :param model: file of the network, see :meth:`Map.extractor`.
    :raises InputError: the map has no thumbnails, or has no place outside nms_radius.
    """
    settings = RecognizerSettings(mode='paper')
    sequence = settings.sequence
    n, l = len(place_map), sequence.length
    if n < 4 * l:
        raise InputError(
            f'a map of {n} places is too short for a threshold: at least {4 * l} are needed'
        )
    if not place_map.thumbnails:
        raise InputError('the map was built without thumbnails: a threshold cannot be tried on it')
    recognizer = PlaceRecognizer(place_map, settings)
    extractor = place_map.extractor(model=model)
    rng = np.random.default_rng(0)
    distances = []
    starts = np.unique(np.linspace(0, n - l, min(WINDOWS, n - l + 1)).astype(int))
    for variant, start in enumerate(Progress(starts, desc='estimating threshold', unit='window')):
        images = [place_map.thumbnail(place) for place in range(start, start + l)]
        altered = [alter_image(image, variant, rng) for image in images if image is not None]
        features = extractor.extract(altered)
        window = recognizer.distances(features)
        window[:, max(0, start - l) : start + 2 * l] = np.inf
        nearest = best_match(match_sequence(window, sequence), settings.nms_radius)
        if nearest is not None:
            distances.append(nearest.distance)
    return float(np.median(distances))
