"""What is done beyond the paper, each cure a switch; all off is the paper."""

import math
from dataclasses import dataclass, fields

from stavpr_ros.errors import SettingsError

MODES = ('paper', 'robust')


@dataclass(frozen=True)
class Cures:
    """
    Cures of what the paper's method suffers from.

    :param centring: the mean of the map's features is taken off every feature, and of the query's that of
        the query so far: what all images share tells no place from another.
    :param row_normalisation: an image's distances to all places get mean 0 and deviation 1: some images
        are far from everything.
    :param place_calibration: so do a place's distances to the latest images: some places ("hubs") are
        near to everything.
    :param speeds: windows are matched at several speeds (:mod:`stavpr_ros.alignment.speeds`) instead of by
        LM-DTW, which lets one place absorb them.
    :param contrast: the nearest sequence is judged by its lead over the runner-up as well.
    :param persistence: what was certain stays so for some images while the matched place moves on steadily
        (with ``contrast`` only).
    """

    centring: bool = True
    row_normalisation: bool = True
    place_calibration: bool = True
    speeds: bool = True
    contrast: bool = True
    persistence: bool = True

    @property
    def any(self) -> bool:
        """At least one is on."""
        return any(getattr(self, field.name) for field in fields(self))

    def without(self, *names: str) -> 'Cures':
        """
        Return these cures but for some.

        :raises SettingsError: no cure of that name.
        """
        return self._with(names, False)

    @staticmethod
    def only(*names: str) -> 'Cures':
        """
        Return some cures alone.

        :raises SettingsError: no cure of that name.
        """
        return PAPER._with(names, True)

    def _with(self, names: tuple[str, ...], on: bool) -> 'Cures':
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        for name in names:
            if name not in values:
                raise SettingsError(f'cure {name!r} is unknown: take one of {", ".join(values)}')
            values[name] = on
        return Cures(**values)


PAPER = Cures(False, False, False, False, False, False)
ROBUST = Cures()

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


def likely_rival(other: float, rivals: int) -> float:
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


def cures_of(mode: str) -> Cures:
    """
    Return the cures of a mode.

    :raises SettingsError: no such mode.
    """
    if mode not in MODES:
        raise SettingsError(f'mode {mode!r} is unknown: take one of {", ".join(MODES)}')
    return ROBUST if mode == 'robust' else PAPER
