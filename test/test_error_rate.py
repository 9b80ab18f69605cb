# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The probability that an error rate chooses."""

import numpy as np
import pytest
from stavpr_ros.errors import SettingsError
from stavpr_ros.recognition.error_rate import ERRORS, least_probability, PROBABILITIES


def test_measured_error_rates_have_their_probabilities():
    for rate, probability in zip(ERRORS, PROBABILITIES, strict=True):
        assert least_probability(rate) == pytest.approx(probability)
    assert least_probability(0.5) == pytest.approx(PROBABILITIES[0])


def test_smaller_error_rates_choose_greater_probabilities():
    found = [least_probability(rate) for rate in np.geomspace(0.1, 0.005, 30)]
    assert (np.diff(found) > 0).all()


@pytest.mark.parametrize('rate', [0.0, 0.001, 1.0, -0.1, float('nan')])
def test_error_rates_that_were_not_measured_are_rejected(rate):
    with pytest.raises(SettingsError, match=r'max_error = .*: expected 0 = off'):
        least_probability(rate)
