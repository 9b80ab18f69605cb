# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Estimates edges; keypoints and landmarks of the latest places are kept."""

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from functools import partial
import math
from typing import TypeVar

import numpy as np
from stavpr_ros.errors import InputError
from stavpr_ros.mapping import GrowingMap, Map
from stavpr_ros.mapping.camera import Camera
from stavpr_ros.mapping.place_map import decode_thumbnail
from stavpr_ros.mapping.transforms import cross, inverse, matrices, to_poses, turn_pose
from stavpr_ros.relative_pose.landmarks import Landmarks, triangulate, View, view_of
from stavpr_ros.relative_pose.odometry import align
from stavpr_ros.relative_pose.pair import Edge, LANDMARK_RADIUS, MatchedPair, NEIGHBORS, Source
from stavpr_ros.relative_pose.pnp import MIN_INLIERS, PnpPose, solve_pnp

METHODS = ('auto', 'none', 'aligned', 'pnp')
VIEWS, LANDMARKS = 64, 32  # places kept: about 300 kB and 100 kB each
MIN_BASELINE = 0.05  # meters between the place and a neighbor
# Places between independent edges: their errors have views, or odometry, in common.
MIN_PLACES_APART = {Source.PNP: 5, Source.ALIGNED: 10}
MAX_DISTANCE_RATIO = 2.0  # distances from the place of a query and of the farthest neighbor
# Meters: with a larger deviation of the position, keypoints do not determine it. Wrong places that
# reached MIN_INLIERS had 4 m and more; 2 of 1,741 right ones had more than 1 m.
MAX_DEVIATION = 1.0
# The deviation of a keypoint in pixels; and what is added in position (m) and rotation (rad), for
# what all landmarks of a place have in common, such as errors of the motions between its views.
NOISE, SHIFT, TURN = 0.8, 0.03, math.radians(0.05)

Value = TypeVar('Value')


class EdgeEstimator:
    """
    Estimates the relative pose of matched pairs. Belongs to one thread.

    :param method: ``auto``: PnP where it is possible, else aligned by odometry; ``pnp`` and
        ``aligned``: that alone; ``none``.
    """

    def __init__(self, method: str = 'auto') -> None:
        self.method = method
        self._source: tuple[Map | GrowingMap, Camera] | None = None
        self._last: tuple[Map | GrowingMap, np.ndarray] | None = None
        self._views: OrderedDict[int, View | None] = OrderedDict()
        self._landmarks: OrderedDict[int, tuple[Landmarks, float, list[int]]] = OrderedDict()

    def estimate(
        self,
        pair: MatchedPair,
        query_camera: Camera | None,
        place_camera: Camera | None,
        obstacle: str = '',
    ) -> Edge:
        """
        Return the edge of a pair, and whether it is independent of earlier edges.

        Where PnP is possible, nothing else replaces it: an edge that keypoints do not confirm has
        no pose.

        :param query_camera, place_camera: cameras of the two images; None = unknown.
        :param obstacle: why there is no time for PnP; empty = there is.
        """
        edge = self.without_pnp(pair, query_camera, place_camera)
        if edge is None and obstacle:
            edge = Edge(Source.DROPPED, f'PnP: {obstacle}')
        elif edge is None:
            assert query_camera is not None
            assert place_camera is not None
            try:
                edge = self._pnp(pair, query_camera, place_camera)
            except InputError as error:
                edge = self._other(pair, f'PnP: {error}')
        return replace(edge, independent=self._is_independent(pair, edge))

    def _is_independent(self, pair: MatchedPair, edge: Edge) -> bool:
        """Return whether the query has moved far enough since the last independent edge."""
        if not edge.has_pose:
            return False
        base = matrices(pair.pose(pair.place)) @ matrices(edge.pose)
        last = self._last
        if last is not None and last[0] is pair.source:
            distance = float(np.linalg.norm(base[:3, 3] - last[1]))
            if distance < (MIN_PLACES_APART[edge.source] - 0.5) * pair.spacing:
                return False
        self._last = pair.source, base[:3, 3]
        return True

    def without_pnp(
        self, pair: MatchedPair, query_camera: Camera | None, place_camera: Camera | None
    ) -> Edge | None:
        """Return the edge where PnP is not wanted, or lacks something; None = neither."""
        reason = f'parameter relative_pose is {self.method}'
        if self.method in ('auto', 'pnp'):
            missing = _missing_for_pnp(pair, query_camera, place_camera)
            if not missing:
                return None
            reason = f'PnP: {missing}'
        return self._other(pair, reason)

    def _other(self, pair: MatchedPair, reason: str) -> Edge:
        """Return the edge by odometry where the method permits it, else one without a pose."""
        edge = Edge(Source.NONE) if self.method in ('none', 'pnp') else align(pair)
        reason = f'{reason}; {edge.reason}' if edge.reason else reason
        return replace(edge, reason=reason, pose=turn_pose(edge.pose, pair.relative_yaw))

    def _pnp(self, pair: MatchedPair, query_camera: Camera, place_camera: Camera) -> Edge:
        """Return the edge by PnP, or one that it refutes; InputError where it is impossible."""
        query, landmarks, reach = self._query_and_landmarks(pair, query_camera, place_camera)
        result = solve_pnp(query, landmarks)
        if result.matrix is None:
            reason = f'PnP: {result.inliers} inliers are fewer than {MIN_INLIERS}'
        elif np.linalg.norm(result.matrix[:3, 3]) > reach:
            reason = f'PnP: more than {reach:.1f} m from the place'
        else:
            edge = _edge(result, query_camera, place_camera)
            deviation = math.sqrt(np.linalg.eigvalsh(edge.covariance[:3, :3])[-1])
            if deviation <= MAX_DEVIATION:
                return edge
            reason = f'PnP: the keypoints determine the position to {deviation:.1f} m only'
        return Edge(Source.REFUTED, reason, inliers=result.inliers)

    def _query_and_landmarks(
        self, pair: MatchedPair, query_camera: Camera, place_camera: Camera
    ) -> tuple[View, list[Landmarks], float]:
        """Return the query, landmarks in the frame of the place, and how far they serve (m)."""
        assert pair.query is not None
        source = self._source
        if source is None or source[0] is not pair.source or source[1] != place_camera:
            self._source = pair.source, place_camera
            self._views.clear()
            self._landmarks.clear()
        place_landmarks, reach, neighbors = self._landmarks_of(pair, pair.place, place_camera)
        landmarks = [place_landmarks]
        for motion, index in zip(place_landmarks.motions, neighbors, strict=True):
            if abs(index - pair.place) <= LANDMARK_RADIUS:
                beside, _, _ = self._landmarks_of(pair, index, place_camera)
                landmarks.append(beside.transform(inverse(motion)))
        return view_of(pair.query, query_camera), landmarks, reach

    def _landmarks_of(
        self, pair: MatchedPair, place: int, camera: Camera
    ) -> tuple[Landmarks, float, list[int]]:
        make = partial(self._triangulate, pair, place, camera)
        return _get_or_make(self._landmarks, place, LANDMARKS, make)

    def _triangulate(
        self, pair: MatchedPair, place: int, camera: Camera
    ) -> tuple[Landmarks, float, list[int]]:
        """Return the landmarks of a place, how far from it they serve (m), and its neighbors."""
        mount, place_pose = matrices(np.array(camera.mount)), matrices(pair.pose(place))
        neighbors, indices, reach = [], [], 0.0
        for index in range(place - NEIGHBORS, place + NEIGHBORS + 1):
            if index == place or not pair.thumbnails.get(index):
                continue
            pose, view = pair.pose(index), self._view_of(pair, index, camera)
            if view is None or np.isnan(pose).any():
                continue
            motion = inverse(matrices(pose) @ mount) @ place_pose @ mount
            baseline = float(np.linalg.norm(motion[:3, 3]))
            if baseline > MIN_BASELINE:
                neighbors.append((view, motion))
                indices.append(index)
                reach = max(reach, MAX_DISTANCE_RATIO * baseline)
        view = self._view_of(pair, place, camera)
        if view is None or not neighbors:
            raise InputError('the place has no neighbors with poses and thumbnails')
        before = sum(index < place for index in indices)
        return triangulate(view, neighbors, before), reach, indices

    def _view_of(self, pair: MatchedPair, index: int, camera: Camera) -> View | None:
        """Return the view of a place; None if its thumbnail is damaged."""

        def make() -> View | None:
            image = decode_thumbnail(pair.thumbnails[index])
            return None if image is None else view_of(image, camera)

        return _get_or_make(self._views, index, VIEWS, make)


def _missing_for_pnp(
    pair: MatchedPair, query_camera: Camera | None, place_camera: Camera | None
) -> str:
    """Return what PnP needs and is unknown, '' = nothing."""
    if query_camera is None or place_camera is None:
        of = 'the camera' if query_camera is None else 'the camera of the map'
        return f'the intrinsics of {of} are unknown'
    if np.isnan(pair.pose(pair.place)).any():
        return 'the place has no pose'
    if pair.query is None or not pair.thumbnails.get(pair.place):
        return 'query or place has no thumbnail'
    return ''


def _get_or_make(
    values: OrderedDict[int, Value], key: int, size: int, make: Callable[[], Value]
) -> Value:
    """Return the value of a key, made if it is missing; the least recently used one goes."""
    if key not in values:
        values[key] = make()
        if len(values) > size:
            values.popitem(last=False)
    values.move_to_end(key)
    return values[key]


def _edge(result: PnpPose, query_camera: Camera, place_camera: Camera) -> Edge:
    """Return the edge between the bases of the cameras."""
    assert result.matrix is not None
    place_mount = matrices(np.array(place_camera.mount))
    to_base = inverse(matrices(np.array(query_camera.mount)))
    turn = place_mount[:3, :3]
    lever = result.matrix[:3, :3] @ to_base[:3, 3]  # from the query's camera to its base
    change = np.zeros((6, 6))
    change[:3, :3] = change[3:, 3:] = turn
    change[:3, 3:] = -turn @ cross(lever[None])[0]
    covariance = NOISE**2 * change @ result.covariance @ change.T
    covariance += np.diag([SHIFT**2] * 3 + [TURN**2] * 3)
    pose = to_poses(place_mount @ result.matrix @ to_base)
    return Edge(Source.PNP, '', pose, covariance, result.inliers, result.error)
