# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The model of the place filter: states, how they change, and the evidence of an image."""

from dataclasses import dataclass

import numpy as np
from stavpr_ros import checks

MAX_SPEED, MIN_LEVEL = 126, -1000  # a step and one place more are within a block of the filter
MAX_SHARE = 1 - 1e-9  # of states that keep their speed, and that enter the map: the others remain


@dataclass(frozen=True)
class FilterSettings:
    """
    Model of the filter; tuned on the data sets named in benchmarks/results/robust_mode.md.

    :param speeds: places that the query passes an image, ascending, at most ``MAX_SPEED``;
        between two, a path costs evidence.
    :param levels: mean z-normalized distance of right places, below 0, descending: from bad to
        good conditions.
    :param weight: alpha of an image that differs from the one before as neighboring places of the
        map do.
    :param most_change, least_change: limits of the change, over the change of neighboring places,
        that alpha is multiplied by.
    :param standstill: change, over the change of neighboring places, below which the camera is
        at rest.
    :param keep_level: probability of keeping the level.
    :param keep_speed: probability of keeping the speed.
    :param spread: probability of one place more than the speed's, and of one less.
    :param leave: probability of leaving the map at an image, and enter: of returning to it.
    :param start: probability of starting on the map.
    :param change_deviation: of the logarithm of the change at one speed.
    :param speed_weight: exponent of the likelihood of a speed. Below 1, since successive changes,
        means of five, are not independent.
    :raises SettingsError: values that are no model.
    """

    speeds: tuple[float, ...] = (0.0, 0.25, 0.33, 0.5, 0.75, 1.0, 1.33, 2.0, 3.0, 4.5)
    levels: tuple[float, ...] = (-1.4, -2.3, -3.4)
    weight: float = 0.28
    most_change: float = 2.0
    least_change: float = 0.2
    standstill: float = 0.1
    keep_level: float = 0.9995
    keep_speed: float = 0.98
    spread: float = 0.05
    leave: float = 0.01
    enter: float = 0.006
    start: float = 0.9
    change_deviation: float = 0.5
    speed_weight: float = 0.25

    def __post_init__(self) -> None:
        checks.require_monotonic('speeds', self.speeds, 0, MAX_SPEED)
        checks.require_monotonic('levels', self.levels, 0, MIN_LEVEL)
        for name in ('weight', 'least_change', 'standstill', 'speed_weight'):
            checks.require_at_least(name, getattr(self, name), 0)
        checks.require_at_least('most_change', self.most_change, self.least_change)
        checks.require_above('change_deviation', self.change_deviation, 0)
        checks.require_above('leave', self.leave, 0, 1)  # off the map there is always a state
        most = {'keep_level': 1, 'start': 1, 'spread': 0.5, 'keep_speed': MAX_SHARE}
        for name in (*most, 'enter'):
            checks.require_between(name, getattr(self, name), 0, most.get(name, MAX_SHARE))

    def level_changes(self) -> np.ndarray:
        """Return the probability of each level by the one before, (K, K), float32."""
        K = len(self.levels)
        changes = np.zeros((K, K), np.float32)
        for k in range(K):
            neighbors = [j for j in (k - 1, k + 1) if 0 <= j < K]
            changes[k, k] = self.keep_level if neighbors else 1
            changes[k, neighbors] = (1 - changes[k, k]) / max(len(neighbors), 1)
        return changes


MODEL = FilterSettings()
"""The model of localization; loop closure has its own."""
