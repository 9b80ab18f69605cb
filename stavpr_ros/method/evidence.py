# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The probability of the place of a window, by quantities without a unit.

z at right places has another mean for each kind of features, each map and each light. These do not
depend on it:

- the **belief** p: probability of the place by the filter; its log odds count up to ``CERTAIN``,
  less what two checks of the path say: at right places, z varies little (:func:`unevenness` s),
  and images change as the map does at the speed of the path (its **excess** e)::

      odds = ln(p / (1 - p)) - 10 s - 25 max(0, e - 0.04)

- the **lead** d = max(0, m - max(0, m')): m is the largest mean of -z along straight paths within
  ``CLOSE`` places, m' beyond ``APART`` places: how much nearer it is than its look-alikes, in this
  window and light;
- by how many **cells** c the path agrees better than that path elsewhere, its competitor
  (:mod:`stavpr_ros.method.cells`);
- the **creep** g: how much more the images change than the map does at the speed of the path, by
  neighbors alone and by the map around the path (:meth:`.motion.ImageChange.creep`);
- the number l of images: a window, or the newest images alone;
- r, the **recent** windows of the drive: whether this drive is on the map at all.

The probability is 1 / (1 + exp(-x)), with::

    x = own + 5 min(0, ln(r / (1 - r)))
    own = K + 0.5 odds + 1.5 ln(1 + l d) + 2 ln(1 + max(c, 0)) - 2 g

K is of the kind of features, with its cells or without
(:class:`stavpr_ros.features.registry.Kind`). r is the share of the latest windows
whose own is above 0; it goes back so far that a drive may come to the map late.
"""

import math
from typing import NamedTuple

import numpy as np
from stavpr_ros.compilation import kernel
from stavpr_ros.method.model import (
    BELIEF,
    CELLS,
    CERTAIN,
    CREEP,
    EVEN,
    EVEN_SHARE,
    EXCESS,
    EXCESS_WEIGHT,
    LAST,
    LEAD,
    RECENT,
    UNEVEN_WEIGHT,
)

LIMIT = 9.21  # log odds beyond which they do not grow, 1e-4
MIN_PLACES = 3  # of a path whose deviation is meaningful


class RecentWindows:
    """The share r of a drive's latest windows that are matches by themselves: .5 at first."""

    def __init__(self) -> None:
        self.share, self._count = 0.5, 1

    def add(self, own: float) -> None:
        """Count another window by its own evidence."""
        self._count = min(self._count + 1, LAST)
        self.share += ((own > 0) - self.share) / self._count


class Quantities(NamedTuple):
    """
    What the evidence of a window is made of.

    :param belief: p; uneven: s; excess: e, logarithm of the change of the images over the map's.
    :param lead: d; images: l; cells: c, 0 = not compared; creep: g.
    """

    belief: float
    uneven: float = 0.0
    excess: float = 0.0
    lead: float = 0.0
    images: int = 1
    cells: float = 0.0
    creep: float = 0.0

    @property
    def odds(self) -> float:
        """Return the log odds of the belief after the checks of the path."""
        odds = max(min(log_odds(self.belief), CERTAIN), -CERTAIN)
        excess = min(max(self.excess - EXCESS, 0.0), 1.0)
        return max(odds - UNEVEN_WEIGHT * self.uneven - EXCESS_WEIGHT * excess, -LIMIT)

    def own(self, constant: float) -> float:
        """Return the evidence of the window alone; K is of the kind of features."""
        lead, cells = math.log1p(self.images * self.lead), math.log1p(max(self.cells, 0.0))
        own = BELIEF * self.odds + LEAD * lead + CELLS * cells - CREEP * self.creep
        return constant + own


def probability_of(own: float, recent: float) -> float:
    """
    Return the probability of a place.

    :param own: of :meth:`Quantities.own`.
    :param recent: r, of :class:`RecentWindows`.
    """
    x = own + RECENT * min(log_odds(recent), 0.0)
    return 1 / (1 + math.exp(-x))


def log_odds(probability: float) -> float:
    """Return the logarithm of the odds of a probability, at most ``LIMIT``."""
    probability = min(max(probability, 1e-4), 1 - 1e-4)
    return math.log(probability / (1 - probability))


@kernel
def unevenness(path: np.ndarray, z: np.ndarray) -> float:
    """
    Return by how much z varies more along a path than it may at right places, 0 if it does not.

    Each place counts once, with its nearest image: a map of few places has none between them.

    :param path: place of each image, ascending, (l,), int64.
    :param z: z-normalized distance of each image to its place, (l,), float32; infinite ones do
        not count.
    """
    nearest, count, place = np.empty(len(path)), 0, path[0]
    for i in range(len(path)):
        if z[i] < np.inf:
            if not count or path[i] != place:
                place, nearest[count] = path[i], np.inf
                count += 1
            nearest[count - 1] = min(nearest[count - 1], z[i])
    if count < MIN_PLACES:
        return 0.0
    nearest = nearest[:count]
    mean = nearest.sum() / count
    deviation = np.sqrt(((nearest - mean) ** 2).sum() / count)
    return max(deviation - max(EVEN, -EVEN_SHARE * mean), 0.0)
