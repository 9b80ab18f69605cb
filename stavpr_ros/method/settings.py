# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Settings of the recognizers, and the options of mode robust beyond the paper.

Everything is causal: only images that have arrived count. The probability of a match has memory,
and successive ones are correlated.
"""

from dataclasses import asdict, dataclass, field

from stavpr_ros.alignment.settings import SequenceSettings, SpatialSettings
from stavpr_ros.checks import (
    require_above,
    require_at_least,
    require_between,
    require_choice,
    require_number,
)
from stavpr_ros.errors import SettingsError
from stavpr_ros.mapping.place_map import ErrorRisks
from stavpr_ros.method.error_rate import least_probability
from stavpr_ros.parameters import default

DIRECTIONS = ('forward', 'both')
EVIDENCE_VERSION = 4  # of calibrations: raised where probabilities change


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
        map (:mod:`stavpr_ros.method.filter`) instead of matching each window by LM-DTW,
        where one place may absorb a window.
    """

    mean_centering: bool = True
    whitening: bool = True
    query_znorm: bool = True
    place_filter: bool = True


PAPER = RobustOptions(False, False, False, False)
ROBUST = RobustOptions()
MODES = {'paper': PAPER, 'robust': ROBUST}


@dataclass(frozen=True)
class RecognizerSettings:
    """
    Settings of the recognizer.

    :param threshold: mode paper: a window is matched when its distance is below it; > 0. None =
        not set: the map's, else nothing is matched. Mode robust has ``min_probability`` instead.
    :param spatial: how two images are compared; None = ``rigid`` with the place filter on
        a map, else ``adaptive``, as published.
    :param sequence: how a window is matched.
    :param nms_radius: the second best's midpoint is more than this many places from the nearest
        one's.
    :param mode: ``robust``, with all options of
        :class:`stavpr_ros.method.settings.RobustOptions`, or ``paper``, LM-DTW as published; or
        a choice of these options.
    :param odometry_error: of a distance by odometry, as a share of it; where query and places have
        poses, the path of a match is compared with them; 0 = never. See
        :mod:`stavpr_ros.method.relative_motion`.
    :param min_probability: mode robust: a window is matched when its probability is above it;
        above 0, below 1.
    :param max_error: mode robust: rate of wrong matches that chooses this probability instead
        (:func:`stavpr_ros.method.error_rate.least_probability`), 0 = off. A
        ``min_probability`` other than the default applies as well where it is stricter.
    :param direction: mode robust: ``forward``, the camera moves along the map, or ``both``, it may
        move against it as well: a robot that reverses, or whose rear camera made the map.
    :param error_risks: of drives with these settings, for ``max_error``; :class:`PlaceRecognizer`
        takes its map's.
    """

    threshold: float | None = None
    spatial: SpatialSettings | None = None
    sequence: SequenceSettings = field(default_factory=SequenceSettings)
    nms_radius: int = default('nms_radius')
    mode: str | RobustOptions = field(default=default('mode'))
    odometry_error: float = default('odometry_error')
    min_probability: float = default('min_probability')
    max_error: float = default('max_error')
    direction: str = default('direction')
    error_risks: ErrorRisks | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.mode, RobustOptions):
            require_choice('mode', self.mode, tuple(MODES))
        require_number('threshold', 1 if self.threshold is None else self.threshold)
        if self.threshold is not None and not self.threshold > 0:
            raise SettingsError(
                f'threshold = {self.threshold} must be above 0: nothing is nearer than 0'
            )
        if self.threshold is not None and self.has_probability:
            raise SettingsError(
                f'threshold = {self.threshold} applies to mode paper: mode {self.mode} accepts '
                f'matches above min_probability = {self.min_probability}; set min_probability, '
                'and remove threshold'
            )
        require_above('min_probability', self.min_probability, 0, below=1)
        if self.max_error:
            least_probability(self.max_error)  # rejects a rate out of range
        require_at_least('nms_radius', self.nms_radius, 0, 'places')
        require_between('odometry_error', self.odometry_error, 0, 1, '(share of the distance)')
        require_choice('direction', self.direction, DIRECTIONS)
        if self.moves_against and not self.has_probability:
            raise SettingsError(
                f'direction = both is of mode robust: in mode {self.mode}, sequences of the map '
                'are along it; take forward'
            )

    @property
    def applied_options(self) -> RobustOptions:
        """Return the options that are applied."""
        return MODES[self.mode] if isinstance(self.mode, str) else self.mode

    @property
    def applied_spatial(self) -> SpatialSettings:
        """Return how two images are compared."""
        return self.spatial or SpatialSettings('rigid' if self.has_probability else 'adaptive')

    @property
    def has_probability(self) -> bool:
        """Return whether matches have a probability: their distance is 1 - probability then."""
        return self.applied_options.place_filter

    @property
    def moves_against(self) -> bool:
        """Return whether the camera may move against the map."""
        return self.direction == 'both'

    @property
    def applied_threshold(self) -> float | None:
        """Return the distance below which a window is matched; None = not set."""
        return 1 - self.applied_probability if self.has_probability else self.threshold

    @property
    def applied_probability(self) -> float:
        """Return the probability above which mode robust matches a window."""
        if not self.max_error:
            return self.min_probability
        is_set = self.min_probability != RecognizerSettings.min_probability
        probability = least_probability(self.max_error, self._own_risks)
        return max(probability, self.min_probability if is_set else 0)

    @property
    def calibration_key(self) -> str:
        """Return what error risks depend on: ``name=value``, the evidence by its version."""
        mode = self.mode if isinstance(self.mode, str) else 'options'
        values = {'evidence': EVIDENCE_VERSION, 'mode': mode, 'direction': self.direction}
        values |= asdict(self.sequence) | asdict(self.applied_spatial)
        return ' '.join(f'{name}={value}' for name, value in values.items())

    @property
    def calibration_warning(self) -> str:
        """Return why ``max_error`` is not kept by the error risks; '' = it is, or none is set."""
        if not self.max_error or (risks := self.error_risks) is None:
            return ''
        least = risks.bounds[-1]
        if self._own_risks is not None and least <= self.max_error:
            return ''
        return (
            f'max_error = {self.max_error:g} is not kept by the calibration of the map '
            f'({risks.units} blocks, {least:.3g} at least, with {risks.method!a}): the built-in '
            f'table, or stricter, applies (with {self.calibration_key!a})'
        )

    @property
    def _own_risks(self) -> ErrorRisks | None:
        """Return the error risks if they are of these settings."""
        risks = self.error_risks
        return risks if risks is not None and risks.method == self.calibration_key else None

    @property
    def compares_odometry(self) -> bool:
        """Return whether odometry is compared with the paths of matches on places with poses."""
        return self.has_probability and self.odometry_error > 0
