# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A geometric verification of one's own, which accepts or refutes a match before it is an edge."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from stavpr_ros import plugins
from stavpr_ros.errors import InputError, SettingsError, UnavailableError
from stavpr_ros.mapping.camera import Camera
from stavpr_ros.mapping.place_map import decode_thumbnail
from stavpr_ros.mapping.trajectory import checked_pose
from stavpr_ros.relative_pose.pair import Edge, MatchedPair, Source

Verifier = Callable[[np.ndarray, np.ndarray, Camera | None, Camera | None, Edge], bool | Edge]
"""
A function (query, place, query_camera, place_camera, edge).

query, place: thumbnails, RGB (h, w, 3) uint8, of parameter ``thumbnail_width``; their cameras have
the intrinsics of the full images (:meth:`Camera.rays` takes pixels of either), None = unknown;
edge: as estimated, possibly without a pose. Returns True to accept the edge as it is, False to
refute the match, or an edge of its own with a pose (``Source.PNP``). Called on the thread of the
edges: images do not wait for it, loop closures do.
"""


def load_verifier(target: str) -> Verifier:
    """
    Import a verifier.

    :param target: ``package.module:function``.
    :raises SettingsError: another form, or it is no function.
    :raises UnavailableError: it cannot be imported.
    """
    module, _, name = target.partition(':')
    if not (module and name):
        raise SettingsError(f'verifier = {target!r}: expected package.module:function')
    try:
        verifier: Verifier = plugins.resolve(target)
    except (ImportError, AttributeError) as error:
        raise UnavailableError(
            f'verifier {target} cannot be imported ({error}): install its package, or correct the '
            'name'
        ) from error
    if not callable(verifier):
        raise SettingsError(f'verifier = {target!r} is {type(verifier).__name__}, no function')
    return verifier


def verified_edge(
    verifier: Verifier,
    pair: MatchedPair,
    query_camera: Camera | None,
    place_camera: Camera | None,
    edge: Edge,
) -> Edge | None:
    """
    Return the edge that a verifier accepts or makes; None = it is refuted.

    A pair without both thumbnails cannot be verified, and counts as refuted.

    :raises InputError: the verifier returned something else, or an invalid edge.
    """
    place = decode_thumbnail(pair.thumbnails.get(pair.place, b''))
    if pair.query is None or place is None:
        return None
    answer = verifier(pair.query, place, query_camera, place_camera, edge)
    if isinstance(answer, bool | np.bool_):
        return edge if answer else None
    if not isinstance(answer, Edge) or answer.source not in (Source.ALIGNED, Source.PNP):
        raise InputError(
            f'the verifier returned {answer!r:.200}: expected True, False, or an Edge with a pose'
        )
    covariance = np.array(answer.covariance, np.float64)
    if (
        covariance.shape != (6, 6)
        or not np.isfinite(covariance).all()
        or np.linalg.eigvalsh((covariance + covariance.T) / 2)[0] <= 0
    ):
        raise InputError(
            f'the covariance of the verifier is {covariance.tolist()}: expected a positive '
            'definite matrix of 6 x 6 finite numbers'
        )
    return replace(answer, pose=checked_pose(answer.pose), covariance=covariance)
