# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Wrong matches of drives on a map, which ``max_error`` is kept by; docs/map_format.md."""

from dataclasses import dataclass

import numpy as np
from stavpr_ros.errors import InputError


@dataclass(frozen=True)
class ErrorRisks:
    """
    Rates of wrong matches of drives on a map, by the probability above which it is matched.

    :param method: settings of recognition that they were measured with.
    :param units: blocks of images n that were driven, at least 1.
    :param probabilities: above which images are matched, ascending, between 0 and 1, k of them.
    :param risks: for each of these, the sum of the n blocks' rates; never ascending, k.
    :param recordings: hashes of the queries that were driven.
    :raises InputError: other values.
    """

    method: str
    units: int
    probabilities: tuple[float, ...]
    risks: tuple[float, ...]
    recordings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        p, risks = np.array(self.probabilities, float), np.array(self.risks, float)
        valid = p.shape == risks.shape and (np.diff(p) > 0).all() and (np.diff(risks) <= 0).all()
        # compared so that NaN is rejected
        if not (valid and p.size and 0 < p[0] <= p[-1] < 1 and risks[-1] >= 0):
            raise InputError(
                'error risks: expected ascending probabilities between 0 and 1, and as many '
                'risks, at least 0, none above the one before'
            )
        if not risks[0] <= self.units or self.units < 1:
            raise InputError(f'error risks {risks[0]} of {self.units} blocks: at most 1 each')

    @property
    def bounds(self) -> np.ndarray:
        """
        Return the rate that each probability keeps, shape (k,), by conformal risk control.

        For a block exchangeable with the n, the expected rate of wrong matches is below it.
        """
        return (np.array(self.risks) + 1) / (self.units + 1)
