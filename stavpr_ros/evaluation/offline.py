"""Running the recognizer over a whole sequence without ROS, as the node does it frame by frame."""

from tqdm import tqdm

from stavpr_ros.evaluation.metrics import WindowAnswer
from stavpr_ros.features import LocalFeatures
from stavpr_ros.recognition import Match, PlaceRecognizer


def recognize_all(
    recognizer: PlaceRecognizer, features: LocalFeatures, progress: bool = False
) -> list[Match]:
    """
    Feed every image of a sequence to a recognizer, whose window is emptied first.

    :param features: of N images.
    :returns: N answers, one an image.
    """
    recognizer.reset()
    images = tqdm(range(len(features)), desc='recognizing', unit='image', disable=None if progress else True)
    return [recognizer.update(features[i : i + 1]) for i in images]


def window_answers(matches: list[Match]) -> list[WindowAnswer | None]:
    """Reduce recognitions to what :func:`stavpr_ros.evaluation.metrics.frame_answers` wants."""
    return [WindowAnswer(m.sequence.middle, m.score, m.path) if m.sequence else None for m in matches]
