# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Calibration by hand: bins, expected error, precision at declared levels."""

import numpy as np
import pytest
from stavpr_lab.evaluation.calibration import calibrate

NAN = float('nan')


def test_calibrate_six_images_by_hand():
    """
    Bin .9-1: 1.0 right, .95 right, .94 wrong: mean .9633, 2/3 right. Bin .3-.4: .3 right.

    The fifth image declares nothing, the sixth is not in the map and declares .55.
    Errors: 3 x .2967, 1 x .7 and 1 x .55, of five images: .428.
    """
    probabilities = np.array([1.0, 0.95, 0.94, 0.3, NAN, 0.55])
    correct = np.array([True, True, False, True, True, False])
    has_match = np.array([True, True, True, True, True, False])
    found = calibrate(probabilities, correct, has_match)
    assert found.images.tolist() == [0, 0, 0, 1, 0, 1, 0, 0, 0, 3]
    assert found.declared[[3, 5, 9]] == pytest.approx([0.3, 0.55, 2.89 / 3])
    assert found.right[[3, 5, 9]] == pytest.approx([1, 0, 2 / 3])
    assert np.isnan(found.right[0])
    assert found.expected_error == pytest.approx((2.89 - 2 + 0.7 + 0.55) / 5)
    numbers = found.to_json()
    assert numbers['images'] == 5
    assert numbers['bins'][3] == {
        'from': 0.3, 'to': 0.4, 'images': 1, 'declared': 0.3, 'right': 1.0
    }  # fmt: skip
    levels = {level.pop('probability'): level for level in numbers['levels']}
    assert levels[0.5] == {'matched': 4, 'precision': 1 / 2, 'recall': 1 / 2}  # FN: .3 and none
    assert levels[0.9] == {'matched': 3, 'precision': 2 / 3, 'recall': 1 / 2}
    assert levels[0.95] == {'matched': 2, 'precision': 1.0, 'recall': 2 / 5}
    # above .94 the first two are accepted: two of five
    assert numbers['recall_at_100_precision'] == 2 / 5
    # from .3 on: 3 right, 2 wrong, 1 rejected: 6 / 9
    assert numbers['f1'] == pytest.approx(2 / 3)


def test_calibrate_of_a_level_that_nothing_reaches_has_no_precision():
    found = calibrate(np.array([0.4, 0.2]), np.array([True, False]), np.ones(2, bool))
    level = found.to_json()['levels'][0]
    assert level == {'probability': 0.5, 'matched': 0, 'precision': None, 'recall': 0.0}


def test_calibrate_of_no_probability_is_none():
    assert calibrate(np.full(3, np.nan), np.ones(3, bool), np.ones(3, bool)) is None
