"""Recognition, image by image: query window, matcher, match."""

from stavpr_ros.recognition.match import Candidate, Match, Status
from stavpr_ros.recognition.recognizer import PlaceRecognizer, RecognizerSettings

__all__ = ['Candidate', 'Match', 'PlaceRecognizer', 'RecognizerSettings', 'Status']
