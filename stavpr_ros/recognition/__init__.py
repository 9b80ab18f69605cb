# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recognition, image by image: query window, matcher, match."""

from stavpr_ros.recognition.match import Candidate, Match, Status
from stavpr_ros.recognition.recognizer import PlaceRecognizer
from stavpr_ros.recognition.settings import RecognizerSettings

__all__ = ['Candidate', 'Match', 'PlaceRecognizer', 'RecognizerSettings', 'Status']
