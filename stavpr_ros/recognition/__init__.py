# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Recognition, image by image: the window of a query and its match.

A recognizer takes the features of the newest image, adds its distances to all places to the window
(:mod:`.window`: :mod:`.filter_window` with the place filter, :mod:`.lm_dtw_window` in mode paper),
and builds one :class:`Match` with the limits that it applied (:mod:`.recognizer`). It is the place
of the middle image of the window, read half a window later, with a path for all its images.
:mod:`.relative_motion` compares this path with odometry. Loop closure (:mod:`.loop_closer`) is the
same on the route so far.

>>> import numpy as np
>>> from stavpr_ros.features import FeatureSettings, LocalFeatures
>>> from stavpr_ros.mapping import PlaceMap
>>> from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings
>>> strips = np.random.default_rng(0).standard_normal((7, 60, 24)).astype(np.float32)
>>> strips /= np.linalg.norm(strips, axis=2, keepdims=True)
>>> weights = np.full((7, 60), 7**-0.5, np.float32)
>>> features = LocalFeatures(strips, weights, FeatureSettings('gradient', None, 7))
>>> place_map = PlaceMap(features, None, np.arange(60), ('',) * 60)
>>> recognizer = PlaceRecognizer(place_map, RecognizerSettings(mode='robust'))
>>> for image in range(10, 50):
...     match = recognizer.update(features[image : image + 1])
>>> match.status.name, match.place_index, match.newest_index, match.probability > 0.9
('MATCH', 39, 49, True)
"""

from stavpr_ros.recognition.match import Candidate, Match, Status
from stavpr_ros.recognition.recognizer import PlaceRecognizer
from stavpr_ros.recognition.settings import RecognizerSettings

__all__ = ['Candidate', 'Match', 'PlaceRecognizer', 'RecognizerSettings', 'Status']
