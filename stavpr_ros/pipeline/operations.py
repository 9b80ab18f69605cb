# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The three operations: each updates its places, its recognizer, or both with one image."""

from dataclasses import dataclass, replace

import numpy as np
from stavpr_ros.features import FeatureExtractor, LocalFeatures
from stavpr_ros.mapping import encode_thumbnail, GrowingMap, PlaceMap
from stavpr_ros.recognition import Match, Status
from stavpr_ros.recognition.loop_closer import LoopCloser
from stavpr_ros.recognition.recognizer import SequenceRecognizer


@dataclass(frozen=True, eq=False)
class Observation:
    """
    One image and its features.

    :param features: of one image.
    :param thumbnail: RGB, uint8, shape (h, w, 3); None where none is needed.
    :param stamp: ns, 0 = unknown.
    :param pose: shape (7,), or None.
    """

    features: LocalFeatures
    thumbnail: np.ndarray | None
    stamp: int
    pose: np.ndarray | None


@dataclass(eq=False)
class Localization:
    """Recognizes places of a fixed map."""

    extractor: FeatureExtractor
    places: PlaceMap
    recognizer: SequenceRecognizer

    def update(self, observation: Observation) -> Match:
        """Match the window that ends with an image."""
        return self.recognizer.update(observation.features, observation.stamp, observation.pose)


@dataclass(eq=False)
class Mapping:
    """Adds every image to a growing map as a place, with its thumbnail if it has one."""

    extractor: FeatureExtractor
    places: GrowingMap
    recognizer: None = None

    def update(self, observation: Observation) -> Match:
        """Add an image as a place."""
        thumbnail = _encoded(observation)
        return Match(Status.MAPPED, image_index=_add(self.places, observation, thumbnail))


@dataclass(eq=False)
class LoopClosing:
    """
    Recognizes places that the route has passed before; a full route evicts its oldest places.

    :param places: the route, with the places of the recognizer.
    """

    extractor: FeatureExtractor
    places: GrowingMap
    recognizer: LoopCloser

    def update(self, observation: Observation) -> Match:
        """Add an image as a place, and match the window that ends with it."""
        # first, since it may fail: recognizer and route stay in step
        thumbnail = _encoded(observation)
        match = self.recognizer.update(observation.features, observation.stamp, observation.pose)
        self.places.forget(self.recognizer.first - self.places.first)
        index = _add(self.places, observation, thumbnail)
        late = match.late and replace(match.late, image_index=index)
        return replace(match, image_index=index, late=late)


Operation = Localization | Mapping | LoopClosing


def _encoded(observation: Observation) -> bytes:
    """Return the thumbnail as JPEG; empty = none."""
    return b'' if observation.thumbnail is None else encode_thumbnail(observation.thumbnail)


def _add(places: GrowingMap, observation: Observation, thumbnail: bytes) -> int:
    return places.add(
        observation.features, observation.stamp, pose=observation.pose, thumbnail=thumbnail
    )
