# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Mode robust: options beyond the paper, each a switch against one failure mode.

Everything is causal: only images that have arrived count. The probability of a match has memory,
and successive ones are correlated.
"""

from dataclasses import dataclass, fields, replace

from stavpr_ros.checks import require_choice

MODES = ('paper', 'robust')


@dataclass(frozen=True)
class RobustOptions:
    """
    Failure modes of the paper's method and their mitigations.

    :param mean_centering: subtract the mean of the map's features from its features, and the
        running mean of the query from the query's: the part shared by all images distinguishes no
        places.
    :param whitening: shrink the directions in which the map's places vary most
        (:class:`Whitening`): a direction that many places share distinguishes few of them.
    :param query_znorm: z-normalize the distances of an image to all places (:func:`z_normalized`):
        certain images are far from all places.
    :param place_filter: follow place and speed with a Bayes filter with a state off the
        map (:mod:`stavpr_ros.filter.place_filter`) instead of matching each window by LM-DTW,
        where one place may absorb a window.
    """

    mean_centering: bool = True
    whitening: bool = True
    query_znorm: bool = True
    place_filter: bool = True

    @property
    def any(self) -> bool:
        """At least one is on."""
        return any(getattr(self, field.name) for field in fields(self))

    def without(self, *names: str) -> 'RobustOptions':
        """
        Return these options without certain ones.

        :raises SettingsError: no option of that name.
        """
        options = [field.name for field in fields(self)]
        for name in names:
            require_choice('option', name, options)
        return replace(self, **dict.fromkeys(names, False))


PAPER = RobustOptions(False, False, False, False)
ROBUST = RobustOptions()


def options_of(mode: str) -> RobustOptions:
    """
    Return the options of a mode.

    :raises SettingsError: no such mode.
    """
    require_choice('mode', mode, MODES)
    return ROBUST if mode == 'robust' else PAPER
