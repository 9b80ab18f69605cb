# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Features and maps of synthetic places, without images."""

import numpy as np
from stavpr_ros.features import FeatureSettings, LocalFeatures
from stavpr_ros.mapping import Map


def route_strips(seed, places, dimension=24):
    """Return strips of a route, each place like its neighbors, (7, places, dimension)."""
    strips = np.random.default_rng(seed).standard_normal((7, places + 3, dimension))
    return sum(strips[:, i : i + places] for i in range(4))


def features_of(strips, noise=0.0, seed=0):
    """Return features of strips (W, n, d) with noise; their norm is 1, or 0 of zeros."""
    strips = strips + noise * np.random.default_rng(seed).standard_normal(strips.shape)
    strips = strips / np.maximum(np.linalg.norm(strips, axis=2, keepdims=True), 1e-12)
    settings = FeatureSettings('gradient', None, len(strips))
    return LocalFeatures(
        strips.astype(np.float32), np.ones(strips.shape[:2], np.float32), settings
    )


def poses_at(xs):
    """Return poses at these x, (m, 7)."""
    poses = np.zeros((len(xs), 7))
    poses[:, 0], poses[:, 6] = xs, 1
    return poses


def map_of(features, poses=None, **parts):
    """Return a map of features."""
    n = len(features)
    return Map(features, None, np.zeros(n, np.int64), ('',) * n, poses, **parts)


def recognize_all(recognizer, features):
    """Return the matches of all images of a sequence, starting with an empty window."""
    recognizer.reset()
    return [recognizer.update(features[i : i + 1]) for i in range(len(features))]
