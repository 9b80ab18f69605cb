# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What is made once per map, and with it the distances of an image to all places.

Unit-norm strips x_i of an image and y_j of a place have the distance 1 - <x_i, y_j>; the spatial
alignment of :mod:`stavpr_ros.alignment` makes one distance of the W x W strip distances. Before:

1. centering: the part that all images of a drive share distinguishes no places, so the mean of the
   map is subtracted from its places, and the running mean of the query from its images;
2. whitening: the directions in which places vary most are shrunk (:mod:`.centering`);
3. after the alignment, z-normalization over all places (:mod:`.centering`).

A matcher has the prepared places in its memory (:mod:`.matcher`),
in float32 or int8 (:class:`.blocks.Int8Features`), or the places of a route that grows
(:mod:`.route_features`). Passes over a map go block by block (:mod:`.blocks`), since it may
exceed the memory:

>>> import numpy as np
>>> from stavpr_ros.alignment import SpatialSettings
>>> from stavpr_ros.features import FeatureSettings, LocalFeatures
>>> from stavpr_ros.prepare.centering import z_normalized
>>> from stavpr_ros.prepare.matcher import make_matcher
>>> from stavpr_ros.prepare.prepared_map import prepare_map
>>> strips = np.random.default_rng(0).standard_normal((7, 50, 24)).astype(np.float32)
>>> strips /= np.linalg.norm(strips, axis=2, keepdims=True)
>>> weights = np.full((7, 50), 7**-0.5, np.float32)
>>> places = LocalFeatures(strips, weights, FeatureSettings('gradient', None, 7))
>>> prepared = prepare_map(places, 'float32')
>>> matcher = make_matcher(prepared.features, SpatialSettings(), 'cpu', 'float32')
>>> image = prepared.centering.next_query(strips[:, 20])
>>> z = z_normalized(matcher.distances(image, weights[:, 20]))
>>> int(z.argmin()), bool(z.min() < -5)
(20, True)
"""
