# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The three operations: each updates its places, its recognizer, or both with one image."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from stavpr_ros.features import FeatureExtractor, LocalFeatures
from stavpr_ros.mapping import encode_thumbnail, GrowingMap, PlaceMap
from stavpr_ros.recognition import Match, PlaceRecognizer, Status
from stavpr_ros.recognition.loop_closer import LoopCloser


@dataclass(frozen=True, eq=False)
class Observation:
    """
    One image and its features.

    :param features: of one image.
    :param image: RGB, uint8, shape (h, w, 3).
    :param stamp: ns, 0 = unknown.
    :param pose: shape (7,), or None.
    """

    features: LocalFeatures
    image: np.ndarray
    stamp: int
    pose: np.ndarray | None


@dataclass(eq=False)
class Localization:
    """Recognizes places of a fixed map."""

    name: ClassVar[str] = 'localization'
    extractor: FeatureExtractor
    places: PlaceMap
    recognizer: PlaceRecognizer

    def update(self, observation: Observation) -> Match:
        """Match the window that ends with an image."""
        return self.recognizer.update(observation.features, observation.stamp)


@dataclass(eq=False)
class Mapping:
    """
    Adds every image to a growing map as a place.

    :param thumbnail_width: pixels, 0 = no thumbnails.
    """

    name: ClassVar[str] = 'mapping'
    extractor: FeatureExtractor
    places: GrowingMap
    thumbnail_width: int
    recognizer: None = None

    def update(self, observation: Observation) -> Match:
        """Add an image as a place."""
        thumbnail = make_thumbnail(observation.image, self.thumbnail_width)
        return Match(Status.MAPPED, image_index=_add(self.places, observation, thumbnail))


@dataclass(eq=False)
class LoopClosing:
    """
    Recognizes places that the route has passed before; a full route evicts its oldest places.

    :param places: the route, with the places of the recognizer.
    :param thumbnail_width: pixels, 0 = no thumbnails.
    """

    name: ClassVar[str] = 'loop_closure'
    extractor: FeatureExtractor
    places: GrowingMap
    recognizer: LoopCloser
    thumbnail_width: int

    def update(self, observation: Observation) -> Match:
        """Add an image as a place, and match the window that ends with it."""
        # first, since it may fail: recognizer and route stay in step
        thumbnail = make_thumbnail(observation.image, self.thumbnail_width)
        match = self.recognizer.update(observation.features, observation.stamp)
        self.places.forget(self.recognizer.first - self.places.first)
        return replace(match, image_index=_add(self.places, observation, thumbnail))


Operation = Localization | Mapping | LoopClosing


def make_thumbnail(image: np.ndarray, width: int) -> bytes:
    """Return a thumbnail as JPEG; empty for width 0."""
    return encode_thumbnail(image, width) if width else b''


def _add(places: GrowingMap, observation: Observation, thumbnail: bytes) -> int:
    return places.add(
        observation.features, observation.stamp, pose=observation.pose, thumbnail=thumbnail
    )
