"""Recognition, frame by frame: query window, matcher, verdict."""

from stavpr_ros.recognition.recogniser import Recogniser, Recognition, RecognitionSettings, Verdict

__all__ = ['Recogniser', 'Recognition', 'RecognitionSettings', 'Verdict']
