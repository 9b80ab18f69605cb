"""The three operations: what becomes of an image once it is described."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from stavpr_ros.features import Describer, LocalFeatures
from stavpr_ros.mapping import GrowingMap, PlaceMap, encode_thumbnail
from stavpr_ros.operation.settings import EngineSettings
from stavpr_ros.recognition import Recogniser, Recognition
from stavpr_ros.recognition.candidates import Candidate


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
    describer: Describer

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

    def add(self, observed: Observed) -> Recognition | None:
        """Take in an image; None where nothing is recognised, in mapping."""

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
    Recognises places of a fixed map.

    :param place_map: the map.
    :param describer: that of the map.
    """

    name = 'localization'
    full = False
    newest_place = -1

    def __init__(
        self, place_map: PlaceMap, describer: Describer, settings: EngineSettings, threshold: float
    ) -> None:
        self.describer = describer
        self._map = place_map
        self._recogniser = Recogniser(
            place_map, settings.recognition(threshold), settings.backend, settings.precision
        )

    @property
    def places(self) -> PlaceMap:
        """The map."""
        return self._map

    @property
    def window_fill(self) -> int:
        """Images in the window."""
        return self._recogniser.window_fill

    def add(self, observed: Observed) -> Recognition:
        """Recognise the window that ends with an image."""
        return self._recogniser.add(observed.features)

    def ranked(self, count: int) -> list[Candidate]:
        """Return the nearest places of the window answered last."""
        return self._recogniser.ranked(count)

    def set_threshold(self, threshold: float) -> None:
        """Change the threshold."""
        self._recogniser.set_threshold(threshold)

    def reset(self) -> None:
        """Empty the window."""
        self._recogniser.reset()

    def map(self) -> PlaceMap:
        """Return the map."""
        return self._map


class Mapping:
    """
    Makes every image a place of a growing map.

    :param growing: the map, empty or not.
    :param describer: that of the map.
    """

    name = 'mapping'
    window_fill = 0

    def __init__(self, growing: GrowingMap, describer: Describer) -> None:
        self.describer, self._growing = describer, growing
        self.newest_place = -1

    @property
    def places(self) -> GrowingMap:
        """The map so far."""
        return self._growing

    @property
    def full(self) -> bool:
        """No further place can be taken in."""
        return self._growing.full

    def add(self, observed: Observed) -> None:
        """Make an image a place."""
        self.newest_place = self._growing.add(
            observed.features, observed.stamp, pose=observed.pose, thumbnail=observed.thumbnail()
        )

    def ranked(self, count: int) -> list[Candidate]:
        """Return nothing: nothing is recognised."""
        return []

    def set_threshold(self, threshold: float) -> None:
        """Do nothing: nothing is recognised."""

    def reset(self) -> None:
        """Do nothing: there is no window, and the places stay."""

    def map(self) -> PlaceMap:
        """Return a map of the places so far."""
        return self._growing.snapshot()


class LoopClosure:
    """
    Recognises places that the same route has passed before; its oldest ones are forgotten when it is full.

    :param describer: makes the features of the route.
    """

    name = 'loop_closure'
    full = False

    def __init__(self, describer: Describer, settings: EngineSettings, threshold: float) -> None:
        self.describer = describer
        self._closer = settings.loop_closer(describer, threshold)
        self._route = GrowingMap(describer.settings, describer.projection, settings.max_places)

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

    def add(self, observed: Observed) -> Recognition:
        """Make an image a place, and recognise the window that ends with it."""
        thumbnail = observed.thumbnail()  # first, since it may fail: closer and route stay in step
        recognition = self._closer.add(observed.features, observed.stamp)
        self._route.forget(self._closer.first - self._route.first)
        self._route.add(observed.features, observed.stamp, pose=observed.pose, thumbnail=thumbnail)
        return recognition

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
