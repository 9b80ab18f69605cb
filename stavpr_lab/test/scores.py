# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A score and a matrix for the tests of evaluation."""

import numpy as np
from stavpr_lab.evaluation.metrics import sweep


def best_f1(distances, correct):
    """Return the counts with the best F1 of queries that all have a place in the map."""
    return max(sweep(distances, correct), key=lambda counts: counts.f1)


def truth_matrix(truth):
    """Return the accepted pairs as a matrix, shape (N, n), bool."""
    matrix = np.zeros((truth.N, truth.n), bool)
    matrix[tuple(truth.pairs.T)] = True
    return matrix
