# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Gaussian random projection (GRP) of local features to fewer dimensions (section 3)."""

from dataclasses import dataclass
from functools import cached_property
import hashlib

import numpy as np
from stavpr_ros.checks import require_at_least, require_shape


@dataclass(frozen=True, eq=False)
class Projection:
    """
    A fixed linear map of local features; map files store its matrix.

    :param matrix: shape (d, dimension), float32.
    :param name: description of its origin.
    """

    matrix: np.ndarray
    name: str

    @classmethod
    def gaussian(cls, dimension_in: int, dimension: int = 512, seed: int = 0) -> 'Projection':
        """
        Draw a Gaussian matrix, entries of variance 1 / dimension: norms are kept on average.

        :raises SettingsError: a dimension below 1, or a negative seed.
        """
        require_at_least('dimension of the features', dimension_in, 1)
        require_at_least('dimension of the projection', dimension, 1)
        require_at_least('seed of the projection', seed, 0)
        matrix = np.random.default_rng(seed).standard_normal((dimension_in, dimension))
        return cls(
            np.ascontiguousarray(matrix / np.sqrt(dimension), np.float32),
            f'gaussian {dimension_in} -> {dimension}, seed {seed}',
        )

    @cached_property
    def identity(self) -> str:
        """Name and hash of the matrix; equal for equal projections only."""
        digest = hashlib.sha256(np.ascontiguousarray(self.matrix).tobytes()).hexdigest()
        return f'{self.name}, sha256 {digest[:16]}'

    def apply(self, strips: np.ndarray) -> np.ndarray:
        """
        Project local features.

        :param strips: shape (W, n, d), float32.
        :returns: shape (W, n, dimension), float32.
        :raises InputError: another d than the matrix has rows.
        """
        require_shape('local features', strips, f'W n {len(self.matrix)}')
        return strips @ self.matrix
