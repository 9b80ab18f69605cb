# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The vocabulary of the checks: borders, and errors that name value and expectation."""

import math
import re

import numpy as np
import pytest
from stavpr_ros import checks
from stavpr_ros.errors import InputError, SettingsError


@pytest.mark.parametrize(
    ('check', 'arguments', 'text'),
    [
        ('choice', ('d', 'abc'), "x = 'd' is unknown: take one of a, b, c"),
        ('at_least', (1, 2, 'pixels'), 'x = 1 must be at least 2 pixels'),
        ('at_least', (math.nan, 0), 'x = nan must be at least 0'),
        ('at_least', (math.inf, 0), 'x = inf must be at least 0'),
        ('between', (1.1, 0, 1), 'x = 1.1 must be 0 to 1'),
        ('between', (math.nan, 0, 1), 'x = nan must be 0 to 1'),
        ('above', (0, 0), 'x = 0 must be above 0'),
        ('above', (1, 0, 1), 'x = 1 must be above 0 and below 1'),
        ('above', (math.inf, 0), 'x = inf must be above 0'),
        ('whole', (2, 3), 'x = 2 must be at least 3'),
        ('whole', (3.5, 3), 'x = 3.5 must be a whole number'),
    ],
)
def test_values_out_of_range_are_rejected(check, arguments, text):
    with pytest.raises(SettingsError, match=f'^{re.escape(text)}$'):
        getattr(checks, f'require_{check}')('x', *arguments)


@pytest.mark.parametrize(
    ('axes', 'dtypes', 'expected'),
    [
        ('W n', (), '(W, n)'),
        ('W W', (), '(W, W)'),
        ('W 2 N', (), '(W, 2, N)'),
        ('W 3 n', ('float64',), '(W, 3, n) float64'),
        ('W 2 n', ('float32', 'uint8'), '(W, 2, n) float32 or uint8'),
        ('n n n', (), '(n, n, n)'),
    ],
)
def test_other_shape_or_type_is_rejected_with_both(axes, dtypes, expected):
    text = f'x: shape (2, 2, 0) float64, expected {expected}'
    with pytest.raises(InputError, match=f'^{re.escape(text)}$'):
        checks.require_shape('x', np.ones((2, 2, 0)), axes, *dtypes)
