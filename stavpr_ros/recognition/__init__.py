"""Recognition, frame by frame: query window, matcher, verdict."""

from stavpr_ros.recognition.candidates import Candidate
from stavpr_ros.recognition.recogniser import Recogniser, Recognition, RecognitionSettings, Verdict

__all__ = ['Candidate', 'Recogniser', 'Recognition', 'RecognitionSettings', 'Verdict']
