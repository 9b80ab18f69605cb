# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Options beyond the paper, each a switch against one failure mode; all off is the paper."""

from dataclasses import dataclass, fields

from stavpr_ros.errors import SettingsError

MODES = ('paper', 'robust')
THRESHOLD = 1.0  # of mode robust; smaller is stricter
LOOP_THRESHOLD = (
    0.8  # for loop closure, where every image is a query and a false match bends a map
)


@dataclass(frozen=True)
class RobustOptions:
    """
    Failure modes of the paper's method and their mitigations.

    :param mean_centering: subtract the mean of the map's features from its features, and the
        running mean of the query from the query's: the part shared by all images distinguishes no
        places.
    :param query_znorm: z-normalize the distances of an image to all places: some images are far
        from all.
    :param reference_znorm: z-normalize the distances of a place to the latest images, against
        hubness: some places are near to all images.
    :param velocity_search: match windows along lines of several velocities
        (:mod:`stavpr_ros.alignment.velocity`) instead of by LM-DTW, where one place may absorb a
        window.
    :param second_best_margin: score the nearest sequence by its margin to the second best as well.
    :param hysteresis: keep evidence for some images while the matched place moves on steadily;
        needs ``second_best_margin``.
    """

    mean_centering: bool = True
    query_znorm: bool = True
    reference_znorm: bool = True
    velocity_search: bool = True
    second_best_margin: bool = True
    hysteresis: bool = True

    @property
    def any(self) -> bool:
        """At least one is on."""
        return any(getattr(self, field.name) for field in fields(self))

    def without(self, *names: str) -> 'RobustOptions':
        """
        Return these options with some switched off.

        :raises SettingsError: no option of that name.
        """
        return self._with(names, False)

    @staticmethod
    def only(*names: str) -> 'RobustOptions':
        """
        Return some options alone.

        :raises SettingsError: no option of that name.
        """
        return PAPER._with(names, True)

    def _with(self, names: tuple[str, ...], on: bool) -> 'RobustOptions':
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        for name in names:
            if name not in values:
                raise SettingsError(f'option {name!r} is unknown: take one of {", ".join(values)}')
            values[name] = on
        return RobustOptions(**values)


PAPER = RobustOptions(False, False, False, False, False, False)
ROBUST = RobustOptions()


def options_of(mode: str) -> RobustOptions:
    """
    Return the options of a mode.

    :raises SettingsError: no such mode.
    """
    if mode not in MODES:
        raise SettingsError(f'mode {mode!r} is unknown: take one of {", ".join(MODES)}')
    return ROBUST if mode == 'robust' else PAPER
