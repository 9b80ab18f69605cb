# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The tuned numbers of the method, each with its unit and meaning; numba's kernels contain them.

``make fit`` fits the weights of the evidence and the constants K, each set left out, and measures
numbers of the filter, the place and the evidence at half and at double of their value, with
``gradient``: benchmarks/results/fit.md. They were chosen on drives of Gardens Point, the walk by
night, the corridor, Nordland and the office. ``ROUTE_IMAGES``, ``CONFIRMED`` and K of a route were
chosen on these routes driven twice, where ``--routes`` measures other values; odometry has no half
and double. Error rates are in :mod:`.error_rate`.
"""

from dataclasses import dataclass

import numpy as np
from stavpr_ros import checks

MAX_SPEED = 16.0  # places an image


@dataclass(frozen=True)
class Model:
    """
    The model of the place filter.

    :param speeds: places an image, ascending.
    :param level: mean z of right places, mu, below 0.
    :param weight: exponent alpha of the likelihood of an image that differs from the one before
        as neighboring places do.
    :param most: z of any place, at most.
    :param change: probability of another speed after an image.
    :param spread: probability of one place more than the speed's, and of one less.
    :param leave, enter, start: probabilities of leaving the map at an image, of entering it, and
        of starting on it.
    :raises SettingsError: values that are no model.
    """

    speeds: tuple[float, ...] = (0.33, 0.5, 0.75, 1.0, 1.33, 2.0, 3.0, 4.5)
    level: float = -2.3
    weight: float = 0.3
    most: float = 3.0
    change: float = 0.03
    spread: float = 0.05
    leave: float = 0.01
    enter: float = 0.006
    start: float = 0.5

    def __post_init__(self) -> None:
        checks.require_monotonic('speeds', self.speeds, 0, MAX_SPEED)
        checks.require_above('level', -self.level, 0)
        checks.require_at_least('weight', self.weight, 0)
        checks.require_at_least('most', self.most, 0)
        checks.require_above('leave', self.leave, 0, 1)  # off the map there is always a state
        for name, most in {'change': 1, 'start': 1, 'spread': 0.5, 'enter': 1}.items():
            checks.require_between(name, getattr(self, name), 0, most)

    @property
    def reach(self) -> int:
        """Return by how many places a state advances from image to image, at most."""
        return int(self.speeds[-1]) + 2

    def steps(self) -> np.ndarray:
        """Return the probability of -1, 0, ... reach places at each speed, (V, reach + 2)."""
        steps = np.zeros((len(self.speeds), self.reach + 2))
        for row, speed in zip(steps, self.speeds, strict=True):
            whole, rest = int(speed), speed % 1
            for step, share in ((whole, 1 - rest), (whole + 1, rest)):
                row[step : step + 3] += share * np.array([self.spread, 0, self.spread])
                row[step + 1] += share * (1 - 2 * self.spread)
        return steps.astype(np.float32)


MODEL = Model()
"""The model of localization and of loop closure."""

# ------------------------------------------------ image change, over that of neighbors

STANDSTILL = 0.1  # below which the camera is at rest
MAX_CHANGE, MIN_CHANGE = 2.0, 0.2  # limits of the weight of an image by its change
OFFSET = 0.02  # added to changes before the logarithm: noise between equal views
MIN_LOCAL = -0.5  # logarithm of the change of neighbors around a path over the mean, at least
MAX_CREEP = 1.0  # logarithm
LOOK_AHEAD = 8  # places within which an unlit stretch may begin
STRETCH = 4  # places in a row, at least, equal each to the one before: an unlit stretch
DARK_PROBABILITY = 0.3  # of such places, above which equal images are no standstill

# ------------------------------------------------ the place of an image

CLOSE = 2  # places to either side that count as the same
LINE, ON_LINE = 5, 1.5  # images to either side of the line, places that they may be off it
MAX_STEP = 6  # places from image to image of a path, at most
APART = 20  # places: paths nearer than that to the path are not elsewhere
STRAIGHT = (1 / 3, 1 / 2, 3 / 4, 1.0, 4 / 3, 2.0, 3.0, 4.5)  # places an image, of straight paths
ON_MAP = 0.9  # probability above which an image is on the map

# ------------------------------------------------ the evidence of a window, log odds

CERTAIN = 4.0  # of the place by the filter, at most
EVEN, EVEN_SHARE = 1.4, 0.45  # deviation of z at right places, and as a share of its mean
UNEVEN_WEIGHT = 10.0  # of the deviation beyond
EXCESS, EXCESS_WEIGHT = 0.04, 25.0  # excess motion of right paths at most, and its weight beyond
BELIEF, LEAD, CELLS, CREEP, RECENT = 0.5, 1.5, 2.0, 2.0, 5.0  # weights; K: features/registry.py
LAST = 50  # windows that the share of recent ones goes back
EARLY = 0.9  # least probability of a match by the newest images alone
MAX_SHIFT, FEW = 3, 10  # columns that cells may be off; images that are all compared

# ------------------------------------------------ odometry

ALONG = 0.5  # places: deviation of a matched place along the track
UNUSUAL = 0.05  # p-value of the trajectory below which probabilities are lowered
LONGEST = 5  # windows of the trajectory that are compared
FARTHEST = 5  # places from image to image

# ------------------------------------------------ loop closure

MEAN_IMAGES, MEAN_PRIOR = 40, 10  # time constant of the mean z of a place; images at 0 before
NEAREST = -1.5  # least z that counts in it: a single image must not determine it
DELAY = 6  # latest images that do not count yet: a slow camera shows a place for as long
AROUND = 30  # places to either side whose mean z is subtracted: a route has several lights
CONFIRMED = 0.93  # probability above which half a window of matches confirms their path
LONGEST_GAP, BAND = 3, 5  # images between two matches of a path, and places per image, at most
ROUTE_IMAGES = 20  # l in the evidence, whatever the length of windows
LONGEST_WAIT = 3  # windows: so many matches of a path wait for its confirmation, at most
