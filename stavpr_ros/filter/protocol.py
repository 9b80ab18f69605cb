# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a filter over the places of a map is: the interface between a window and its filter."""

from abc import abstractmethod
from typing import Any, Protocol

import numpy as np
from stavpr_ros.filter.model import FilterSettings
from stavpr_ros.filter.paths import Belief, NO_PLACES


class Filter(Protocol):
    """
    Probability of each place after each image.

    A state is a row of :attr:`Belief.states`; only its filter reads it.

    ``settings`` describe the model; ``count`` is the number of updates since the reset.
    """

    settings: FilterSettings
    count: int

    @abstractmethod
    def update(
        self,
        z: Any,
        weight: float,
        speed_weights: np.ndarray,
        speed_likelihoods: np.ndarray | None = None,
        not_near: np.ndarray = NO_PLACES,
    ) -> None:
        """
        Advance by an image.

        :param z: z-normalized distances to the first m places, (m,), float32, an array or a tensor
            on the filter's device; +inf excludes a place.
        :param weight: alpha; 0 = the image is no evidence.
        :param speed_weights: relative probability of each speed, (V,).
        :param speed_likelihoods: of each speed, relative to off the map, (V,); None = 1.
        :param not_near: places below m whose z counts as 0 at least.
        """

    @abstractmethod
    def move_back(self, places: slice, count: int) -> None:
        """
        Move the states of places, at least ``count``, that many places back, also of past images.

        They are added to the states of these places, which lie before ``places``.
        """

    @abstractmethod
    def places_of_states(self) -> np.ndarray:
        """Return the probability of each place now, (room,), float32."""

    @abstractmethod
    def belief(self, n: int, images_ago: int) -> Belief:
        """
        Return where the camera was a number of images ago, by the images since then, too.

        :param n: places that the filter was updated with.
        :param images_ago: at most the lag and ``count - 1``.
        """

    @abstractmethod
    def path(self, state: np.ndarray, images: int) -> np.ndarray:
        """
        Return the most probable path to a state: a place per image, (images + 1,), int.

        Newest first; -1 before the path came to the map.

        :param images: to go back, at most the lag.
        """

    @abstractmethod
    def most_probable(self, excluded: np.ndarray) -> tuple[int, float]:
        """
        Return the most probable place outside ``excluded`` now, and its probability, 0 if none.

        :param excluded: places, ascending.
        """

    def mean_z(self, state: np.ndarray) -> float:
        """Return the mean z of right places in a state: how near they are on this drive."""
        return self.settings.levels[state[0]]

    def speed(self, state: np.ndarray) -> float:
        """Return the speed of a state at the time of its belief, places an image."""
        return self.settings.speeds[state[3]]

    @abstractmethod
    def reset(self) -> None:
        """Forget where the camera was."""

    @abstractmethod
    def grow(self, places: int) -> None:
        """Make room for more places."""

    @abstractmethod
    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up."""
