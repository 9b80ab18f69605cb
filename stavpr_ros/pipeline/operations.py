"""The three operations: what becomes of an image once it is described."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from stavpr_ros.features import FeatureExtractor, LocalFeatures
from stavpr_ros.mapping import GrowingMap, PlaceMap, encode_thumbnail
from stavpr_ros.pipeline.settings import PipelineSettings
from stavpr_ros.recognition import Match, PlaceRecognizer, Status
from stavpr_ros.recognition.match import Candidate


@dataclass(frozen=True, eq=False)
class Observed:
    """
    One described image and what is known of it.

    :param features: those of one image.
    :param image: RGB.
    :param stamp: ns, 0 = unknown.
    :param pose: shape (7,), or None.
    :param thumbnail_width: pixels of the picture to be kept, 0 = none.
    """

    features: LocalFeatures
    image: np.ndarray
    stamp: int
    pose: np.ndarray | None
    thumbnail_width: int

    def thumbnail(self) -> bytes:
        """Return the picture to be kept, as JPEG; empty = none."""
        return encode_thumbnail(self.image, self.thumbnail_width) if self.thumbnail_width else b''


class Operation(Protocol):
    """What is done with described images."""

    name: str
    extractor: FeatureExtractor

    @property
    def places(self) -> PlaceMap | GrowingMap:
        """What indices in answers mean."""

    @property
    def full(self) -> bool:
        """No further place can be taken in."""

    @property
    def window_fill(self) -> int:
        """Images in the window."""

    @property
    def newest_place(self) -> int:
        """The place that the newest image has become, -1 = it has not."""

    def update(self, observed: Observed) -> Match:
        """Take in an image."""

    def ranked(self, count: int) -> list[Candidate]:
        """Return the nearest places of the window answered last."""

    def set_threshold(self, threshold: float) -> None:
        """Change the threshold."""

    def reset(self) -> None:
        """Empty the window."""

    def map(self) -> PlaceMap:
        """Return the places as a map of its own."""


class Localization:
    """
    Recognizes places of a fixed map.

    :param place_map: the map.
    :param extractor: that of the map.
    """

    name = 'localization'
    full = False
    newest_place = -1

    def __init__(
        self, place_map: PlaceMap, extractor: FeatureExtractor, settings: PipelineSettings, threshold: float
    ) -> None:
        self.extractor = extractor
        self._map = place_map
        self._recognizer = PlaceRecognizer(
            place_map, settings.recognition(threshold), settings.backend, settings.precision
        )

    @property
    def places(self) -> PlaceMap:
        """The map."""
        return self._map

    @property
    def window_fill(self) -> int:
        """Images in the window."""
        return self._recognizer.window_fill

    def update(self, observed: Observed) -> Match:
        """Recognize the window that ends with an image."""
        return self._recognizer.update(observed.features, observed.stamp)

    def ranked(self, count: int) -> list[Candidate]:
        """Return the nearest places of the window answered last."""
        return self._recognizer.ranked(count)

    def set_threshold(self, threshold: float) -> None:
        """Change the threshold."""
        self._recognizer.set_threshold(threshold)

    def reset(self) -> None:
        """Empty the window."""
        self._recognizer.reset()

    def map(self) -> PlaceMap:
        """Return the map."""
        return self._map


class Mapping:
    """
    Makes every image a place of a growing map.

    :param growing: the map, empty or not.
    :param extractor: that of the map.
    """

    name = 'mapping'
    window_fill = 0

    def __init__(self, growing: GrowingMap, extractor: FeatureExtractor) -> None:
        self.extractor, self._growing = extractor, growing
        self.newest_place = -1

    @property
    def places(self) -> GrowingMap:
        """The map so far."""
        return self._growing

    @property
    def full(self) -> bool:
        """No further place can be taken in."""
        return self._growing.full

    def update(self, observed: Observed) -> Match:
        """Make an image a place."""
        self.newest_place = self._growing.add(
            observed.features, observed.stamp, pose=observed.pose, thumbnail=observed.thumbnail()
        )
        return Match(Status.MAPPED)

    def ranked(self, count: int) -> list[Candidate]:
        """Return nothing: nothing is recognized."""
        return []

    def set_threshold(self, threshold: float) -> None:
        """Do nothing: nothing is recognized."""

    def reset(self) -> None:
        """Do nothing: there is no window, and the places stay."""

    def map(self) -> PlaceMap:
        """Return a map of the places so far."""
        return self._growing.snapshot()


class LoopClosure:
    """
    Recognizes places that the same route has passed before; its oldest ones are forgotten when it is full.

    :param extractor: makes the features of the route.
    """

    name = 'loop_closure'
    full = False

    def __init__(self, extractor: FeatureExtractor, settings: PipelineSettings, threshold: float) -> None:
        self.extractor = extractor
        self._closer = settings.loop_closer(extractor, threshold)
        self._route = GrowingMap(
            extractor.settings,
            extractor.projection,
            settings.max_places,
            held_features=self._closer.features,
        )

    @property
    def places(self) -> GrowingMap:
        """The route so far."""
        return self._route

    @property
    def window_fill(self) -> int:
        """Images in the window."""
        return self._closer.window_fill

    @property
    def newest_place(self) -> int:
        """The place that the newest image has become."""
        return self._route.first + len(self._route) - 1

    def update(self, observed: Observed) -> Match:
        """Make an image a place, and recognize the window that ends with it."""
        thumbnail = observed.thumbnail()  # first, since it may fail: closer and route stay in step
        match = self._closer.update(observed.features, observed.stamp)
        self._route.forget(self._closer.first - self._route.first)
        self._route.add(observed.features, observed.stamp, pose=observed.pose, thumbnail=thumbnail)
        return match

    def ranked(self, count: int) -> list[Candidate]:
        """Return the nearest places of the window answered last."""
        return self._closer.ranked(count)

    def set_threshold(self, threshold: float) -> None:
        """Change the threshold."""
        self._closer.set_threshold(threshold)

    def reset(self) -> None:
        """Empty the window; the route stays."""
        self._closer.reset()

    def map(self) -> PlaceMap:
        """Return a map of the route so far."""
        return self._route.snapshot()
