"""What is done beyond the paper, each option a switch; all off is the paper."""

import math
from dataclasses import dataclass, fields

from stavpr_ros.errors import SettingsError

MODES = ('paper', 'robust')


@dataclass(frozen=True)
class RobustOptions:
    """
    RobustOptions of what the paper's method suffers from.

    :param mean_centering: the mean of the map's features is taken off every feature, and of the query's that of
        the query so far: what all images share tells no place from another.
    :param query_znorm: an image's distances to all places get mean 0 and deviation 1: some images
        are far from everything.
    :param reference_znorm: so do a place's distances to the latest images: some places ("hubs") are
        near to everything.
    :param velocity_search: windows are matched at several speeds (:mod:`stavpr_ros.alignment.velocity`) instead of by
        LM-DTW, which lets one place absorb them.
    :param second_best_margin: the nearest sequence is judged by its lead over the second best as well.
    :param hysteresis: what was certain stays so for some images while the matched place moves on steadily
        (with ``contrast`` only).
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
        Return these robust_options but for some.

        :raises SettingsError: no option of that name.
        """
        return self._with(names, False)

    @staticmethod
    def only(*names: str) -> 'RobustOptions':
        """
        Return some robust_options alone.

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

# The evidence that windows from unknown places show as well, in deviations: one in thirty of them and fewer
# show more on every pair of data sets that was tried.
CHANCE = -2.2
THRESHOLD = 1.0  # of mode robust; smaller is stricter
LOOP_THRESHOLD = 0.8  # for loop closure, where every image is a question and a wrong answer bends a map
# The best of few rivals is far: on a short map, or when a route has just begun, chance would have a lead over
# it. It is taken for as near, at least, as the best of many is in windows from unknown places.
FEW_RIVALS = 20
USUAL_RIVAL = -0.8
FADING = 0.05  # deviations that evidence loses an image
BACK, AHEAD = 1, 3  # places that the matched place may move an image, while a track goes on


def evidence(cost: float, other: float) -> float:
    """
    Judge a sequence by its mean cost and its lead over its rival, in deviations; lower is better.

    :param cost: mean calibrated distance of the sequence.
    :param other: that of the nearest sequence elsewhere; NaN if there is none.
    """
    return 2 * cost - (0.0 if math.isnan(other) else other)


def expected_second_best(other: float, rivals: int) -> float:
    """
    Return the cost that a rival should be expected to have.

    :param other: that of the nearest sequence elsewhere; NaN if there is none.
    :param rivals: how many sequences there are elsewhere.
    """
    if rivals >= FEW_RIVALS:
        return other
    return USUAL_RIVAL if math.isnan(other) else min(other, USUAL_RIVAL)


def relative_distance(seen: float) -> float:
    """
    Turn evidence into a distance that means the same on every route.

    1 is as near as windows from unknown places come, and more is not told apart from it; 0 is certain.
    """
    return min(1.0, math.exp(min(seen - CHANCE, 0) / 2))


class Track:
    """Evidence that persists: what the last windows showed, fading, while the matched place moves on."""

    def __init__(self) -> None:
        self._middle: int | None = None
        self._evidence = math.inf

    def follow(self, middle: int, seen: float) -> float:
        """Return the evidence for the newest window's place, with what is left of that before."""
        if self._middle is not None and -BACK <= middle - self._middle <= AHEAD:
            seen = min(seen, self._evidence + FADING)
        self._middle, self._evidence = middle, seen
        return seen


def options_of(mode: str) -> RobustOptions:
    """
    Return the robust_options of a mode.

    :raises SettingsError: no such mode.
    """
    if mode not in MODES:
        raise SettingsError(f'mode {mode!r} is unknown: take one of {", ".join(MODES)}')
    return ROBUST if mode == 'robust' else PAPER
