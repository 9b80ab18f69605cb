# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The probability from which matches keep an error rate, by conformal risk control over drives.

The risk of a drive is its share of wrong matches; on a drive that is nowhere on the map, the share
of its images that are matched. The least probability t for an error rate a is such that

    (sum of the risks of n drives with matches above t + 1) / (n + 1) <= a

(Angelopoulos et al., "Conformal Risk Control", ICLR 2024), rounded up. Each drive is of a route
that the probability was not fitted on; early matches count. benchmarks/results/fit.md has the
drives. The mean over drives like these is controlled, not every single drive.
"""

import numpy as np
from stavpr_ros.errors import SettingsError
from stavpr_ros.mapping.place_map import ErrorRisks

# error rates, descending, and the least probability of matches that keep them
ERRORS = np.array([0.1, 0.05, 0.03, 0.02, 0.01, 0.005])
PROBABILITIES = np.array([0.0001, 0.001, 0.005, 0.03, 0.5, 0.95])


def least_probability(max_error: float, risks: ErrorRisks | None = None) -> float:
    """
    Return the probability above which matches are wrong at a rate of at most ``max_error``.

    Between measured error rates, the logarithm of the odds is interpolated over the logarithm of
    the rate.

    :param max_error: 0.005 to below 1; above 0.1 as 0.1 without risks.
    :param risks: of drives on the map, instead of the measured ones. Where there are too few, or
        too many wrong matches, for the rate: the probability above which the mean of their rates
        is not above it, or the measured probability; the stricter applies.
    :raises SettingsError: out of range.
    """
    if not ERRORS[-1] <= max_error < 1:
        raise SettingsError(
            f'max_error = {max_error}: expected 0 = off, or {ERRORS[-1]:g} to below 1; smaller '
            'rates were not measured'
        )
    logits = np.log(PROBABILITIES / (1 - PROBABILITIES))
    logit = np.interp(-np.log(max_error), -np.log(ERRORS), logits)
    probability = float(1 / (1 + np.exp(-logit)))
    if risks is None:
        return probability
    is_kept = risks.bounds[-1] <= max_error
    rates = risks.bounds if is_kept else np.array(risks.risks) / risks.units
    own = risks.probabilities[int(np.argmax(np.append(rates[:-1] <= max_error, True)))]
    return own if is_kept else max(own, probability)
