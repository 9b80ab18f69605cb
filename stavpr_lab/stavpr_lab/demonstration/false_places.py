# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Wrong places for a share of the loop closures: a test of back ends."""

from collections.abc import Iterable

import numpy as np

RUN = 20  # successive closures that are wrong by the same number of places
NEAR = 30  # places that a wrong one is away at least


class FalsePlaces:
    """
    Chooses the closures that become wrong, and their places.

    :param share: share of the closures that become wrong, 0 to 1.
    :param coherent: wrong in runs that are consistent in themselves, as look-alike streets are.
    """

    def __init__(self, share: float, coherent: bool, seed: int) -> None:
        self._share, self._coherent = share, coherent
        self._dice = np.random.default_rng(seed)
        self._number, self._shift = 0, 0

    def place(self, place: int, candidates: Iterable[int]) -> int:
        """Return the place of the next closure: its own, or a wrong one of the candidates."""
        candidates = sorted(candidates)
        if self._number % (RUN if self._coherent else 1) == 0:
            wrong = self._dice.random() < self._share
            away = [index for index in candidates if abs(index - place) > NEAR]
            self._shift = int(self._dice.choice(away)) - place if wrong and away else 0
        self._number += 1
        if not self._shift:
            return place
        return min(candidates, key=lambda index: abs(index - place - self._shift))
