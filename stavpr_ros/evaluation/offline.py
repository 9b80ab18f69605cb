"""Running the recogniser over a whole sequence without ROS, as the node does it frame by frame."""

from tqdm import tqdm

from stavpr_ros.evaluation.metrics import WindowAnswer
from stavpr_ros.features import LocalFeatures
from stavpr_ros.recognition import Recogniser, Recognition


def recognise_all(
    recogniser: Recogniser, features: LocalFeatures, progress: bool = False
) -> list[Recognition]:
    """
    Feed every image of a sequence to a recogniser, whose window is emptied first.

    :param features: of N images.
    :returns: N answers, one an image.
    """
    recogniser.reset()
    images = tqdm(range(len(features)), desc='recognising', unit='image', disable=None if progress else True)
    return [recogniser.add(features[i : i + 1]) for i in images]


def window_answers(recognitions: list[Recognition]) -> list[WindowAnswer | None]:
    """Reduce recognitions to what :func:`stavpr_ros.evaluation.metrics.frame_answers` wants."""
    return [WindowAnswer(r.nearest.middle, r.score, r.path) if r.nearest else None for r in recognitions]
