# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of the two alignments, in the paper's symbols and with its defaults."""

from dataclasses import dataclass
import math

from stavpr_ros.checks import require_above, require_at_least, require_choice, require_whole
from stavpr_ros.errors import SettingsError

STRATEGIES = ('adaptive', 'vanilla', 'rigid', 'sliding_window', 'none')
MAX_SHIFT = 2  # strips that ``rigid`` shifts an image without xi


@dataclass(frozen=True)
class SpatialSettings:
    """
    Settings of the distance of two images, from the distances of their strips.

    :param strategy: ``adaptive`` (weight a on diagonal steps), ``vanilla`` DTW (a = 1),
        ``rigid`` (the best shift of the whole image, by whole strips,
        each of which costs 1 / 32), ``sliding_window`` (the
        best four strips in a row), ``none`` (whole images, no alignment).
    :param sigma: how strongly the viewpoint change raises ``a = sqrt(1 + sigma |I_c - c|)``; >= 0.
    :param xi: restricted alignment: strips i and j with ``|i - j| >= xi`` are never aligned;
        1 <= xi <= W, None = no restriction, in ``rigid`` 3: shifts by two strips at most.
    :param vertical: the distance of two strips is the distance of their cells, aligned from top to
        bottom by the same alignment (the paper's remark on drones), instead of their cosine
        distance; ``adaptive``, ``vanilla``.
    """

    strategy: str = 'adaptive'
    sigma: float = 1.0
    xi: int | None = None
    vertical: bool = False

    def __post_init__(self) -> None:
        require_choice('strategy', self.strategy, STRATEGIES)
        require_at_least('sigma', self.sigma, 0)
        if self.xi is not None:
            require_whole('xi', self.xi, 1, 'strip')
        if self.vertical and self.strategy not in ('adaptive', 'vanilla'):
            raise SettingsError(
                f'strategy {self.strategy!r} has no vertical alignment: take adaptive or vanilla'
            )

    @property
    def aligns_strips(self) -> bool:
        """Return whether strips are aligned as they are, in one go with their distances."""
        return self.strategy in ('adaptive', 'vanilla', 'rigid') and not self.vertical

    def band(self, W: int) -> int:
        """Return the half width of the allowed band, xi or W; refuse xi > W."""
        if self.xi is None:
            return min(W, MAX_SHIFT + 1) if self.strategy == 'rigid' else W
        if self.xi > W:
            raise SettingsError(
                f'xi = {self.xi} exceeds the number of strips W = {W}: choose 1 <= xi <= {W}'
            )
        return int(self.xi)


@dataclass(frozen=True)
class SequenceSettings:
    """
    Settings of the matching of a window of query images with the map (LM-DTW).

    :param length: images in the window, l >= 2.
    :param beta: map images considered per query image, > 1: each start searches k = ceil(beta l).
    """

    length: int = 20
    beta: float = 2.0

    def __post_init__(self) -> None:
        require_whole('sequence length l', self.length, 2, 'images')
        require_above('beta', self.beta, 1)

    @property
    def k(self) -> int:
        """Return the map images that one start searches: ceil(beta l), 55 for 1.1 * 50 as well."""
        return math.ceil(self.beta * self.length - 1e-9)
