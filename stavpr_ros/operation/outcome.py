"""What came of one image."""

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np

from stavpr_ros.mapping import GrowingMap, PlaceMap
from stavpr_ros.recognition import Recognition
from stavpr_ros.recognition.candidates import Candidate


class Answer(enum.Enum):
    """What is said of one image; the words are those of ``stavpr_msgs/PlaceMatch``."""

    WARMING_UP = 0
    NO_MATCH = 1
    MATCH = 2
    INVALID_IMAGE = 3
    NOT_READY = 4
    DROPPED = 5
    SKIPPED = 6
    MAPPED = 7


@dataclass(frozen=True)
class Place:
    """
    What is known of a place.

    :param stamp: ns, 0 = unknown.
    :param identifier: external identifier, '' = none.
    :param pose: x y z (metres) and quaternion x y z w, shape (7,), or None.
    """

    stamp: int = 0
    identifier: str = ''
    pose: np.ndarray | None = None


def place_facts(places: PlaceMap | GrowingMap, index: int) -> Place:
    """
    Return what is known of a place.

    :param index: 0-based; in a growing map counted from its start, what it has forgotten included.
    """
    if isinstance(places, GrowingMap):
        index -= places.first
        pose = places.poses[index]
        known = pose.copy() if np.isfinite(pose).all() else None
        return Place(int(places.stamps[index]), places.ids[index], known)
    return Place(int(places.stamps[index]), places.ids[index], places.pose(index))


def place_picture(places: PlaceMap | GrowingMap, index: int) -> np.ndarray | None:
    """Return the picture that is kept of a place, RGB (h, w, 3) uint8, or None; indices as above."""
    if isinstance(places, PlaceMap):
        return places.thumbnail(index)
    content = places.thumbnails[index - places.first]
    if not content:
        return None
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    return None if picture is None else cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


@dataclass(frozen=True)
class Outcome:
    """
    What came of one image.

    :param answer: what is said of it.
    :param reason: why there is no match, in words.
    :param threshold: the one that is set, None = none.
    :param recognition: that of the window; None unless the answer tells of one.
    :param window: stamps (ns) of the images in the window, oldest first, this one the last.
    :param first_image: place of the window's first image on a route that grows with every image, -1 = none.
    :param newest: the place that the image has become (``MAPPED``), -1 = none.
    :param places: what the recognition's indices mean.
    :param inliers: of the geometric check, -1 = not made.
    :param candidates: nearest places, nearest first.
    :param image: the image, RGB.
    :param stages: seconds that each stage took.
    :param cause: why the image is in no window, in two or three words, to be counted; '' = it is in one.
    """

    answer: Answer
    reason: str = ''
    threshold: float | None = None
    recognition: Recognition | None = None
    window: tuple[int, ...] = ()
    first_image: int = -1
    newest: int = -1
    places: PlaceMap | GrowingMap | None = None
    inliers: int = -1
    candidates: tuple[Candidate, ...] = ()
    image: np.ndarray | None = field(default=None, repr=False)
    stages: Mapping[str, float] = field(default_factory=dict)
    cause: str = ''
