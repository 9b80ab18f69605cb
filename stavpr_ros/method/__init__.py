# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The method: from the features of an image to a place with a probability.

:mod:`.localizer` is the chain, :mod:`.model` its numbers, :mod:`.filter` the Bayes filter over
places and speeds, :mod:`.window` what the latest images show, :mod:`.evidence` the probability of
their place. Loop closure (:mod:`.loop_closer`) is the same on the route so far; mode paper matches
windows by LM-DTW (:mod:`.lm_dtw_window`).

>>> import numpy as np
>>> from stavpr_ros.features import FeatureSettings, LocalFeatures
>>> from stavpr_ros.mapping import Map
>>> from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
>>> strips = np.random.default_rng(0).standard_normal((7, 60, 24)).astype(np.float32)
>>> strips /= np.linalg.norm(strips, axis=2, keepdims=True)
>>> weights = np.full((7, 60), 7**-0.5, np.float32)
>>> features = LocalFeatures(strips, weights, FeatureSettings('gradient', None, 7))
>>> place_map = Map(features, None, np.arange(60), ('',) * 60)
>>> recognizer = PlaceRecognizer(place_map, RecognizerSettings(mode='robust'))
>>> for image in range(10, 50):
...     match = recognizer.update(features[image : image + 1])
>>> match.status.name, match.place, match.newest, match.probability > 0.9
('MATCH', 39, 49, True)
"""

from stavpr_ros.method.filter import Filter, PlaceFilter
from stavpr_ros.method.localizer import PlaceRecognizer
from stavpr_ros.method.match import Candidate, Match, Path, Status
from stavpr_ros.method.model import Model
from stavpr_ros.method.settings import RecognizerSettings

__all__ = [
    'Candidate', 'Filter', 'Match', 'Model', 'Path', 'PlaceFilter', 'PlaceRecognizer',
    'RecognizerSettings', 'Status',
]  # fmt: skip
