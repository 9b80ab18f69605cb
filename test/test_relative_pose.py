# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Edges: poses of cameras by PnP, alignment by odometry, cameras, fallbacks."""

from dataclasses import replace
from itertools import pairwise
import math

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from stavpr_ros.errors import InputError
from stavpr_ros.maintenance.same_places import with_same_places
from stavpr_ros.mapping import encode_thumbnail, load_map, merge_maps, save_map, thumbnail_of
from stavpr_ros.mapping.camera import Camera, FORWARD, yaw_of
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_ros.method.verification import mutual_matches
from stavpr_ros.relative_pose import estimator
from stavpr_ros.relative_pose.bundle import odometry_information, SHIFT, TURN
from stavpr_ros.relative_pose.estimator import EdgeEstimator, MIN_PLACES_APART
from stavpr_ros.relative_pose.landmarks import Landmarks, triangulate, View
from stavpr_ros.relative_pose.odometry import align
from stavpr_ros.relative_pose.pair import MatchedPair, Source, TRIANGULATION_RADIUS
from stavpr_ros.relative_pose.pnp import MIN_INLIERS, solve_pnp

SIZE = 320, 240
CAMERA = Camera(*SIZE, (200.0, 200.0), (159.5, 119.5))


def pose(x, y=0.0, yaw=0.0):
    return np.array([x, y, 0, 0, 0, math.sin(yaw / 2), math.cos(yaw / 2)])


def points_ahead(count, seed=0):
    """Return points on both sides of the way ahead, in the base's frame, (count, 3)."""
    rng = np.random.default_rng(seed)
    side = np.where(rng.random(count) < 0.5, -1, 1)
    return np.column_stack(
        [rng.uniform(4, 45, count), side * rng.uniform(1, 9, count), rng.uniform(-1, 5, count)]
    )


def views_of(points, poses, noise=0.0, seed=1):
    """Return ideal views of points with a descriptor each, (m, 3), from poses of the base."""
    rng = np.random.default_rng(seed)
    descriptors = rng.uniform(0, 100, (len(points), 128)).astype(np.float32)
    views = []
    for base in poses:
        seen = in_camera(points, base, CAMERA)
        known = seen[:, 2] > 0.5
        rays = seen[known, :2] / seen[known, 2:]
        views.append(
            View(rays + noise / 200 * rng.normal(size=rays.shape), descriptors[known], 200.0)
        )
    return views


def in_camera(points, base, camera):
    to = inverse(matrices(base) @ matrices(np.array(camera.mount)))
    return points @ to[:3, :3].T + to[:3, 3]


def motions(poses, center):
    mount = matrices(np.array(FORWARD))
    own = matrices(center) @ mount
    return [inverse(matrices(base) @ mount) @ own for base in poses]


def test_triangulate_of_exact_views_returns_the_points():
    poses = [pose(x) for x in (-2, -1, 0, 1, 2)]
    points = points_ahead(200)
    views = views_of(points, poses)
    around = [0, 1, 3, 4]
    neighbors = list(zip([views[i] for i in around], motions([poses[i] for i in around], poses[2]),
                         strict=True))  # fmt: skip
    result = triangulate(views[2], neighbors, 2)
    assert len(result.points) > 140  # others are far ahead, without parallax
    true = in_camera(points, poses[2], CAMERA)
    away = np.linalg.norm(result.points[:, None] - true, axis=2).min(axis=1)
    assert away.max() < 1e-3


@pytest.mark.parametrize('seed', range(2))
def test_deviations_of_landmarks_fit_the_errors_of_their_depths(seed):
    """Of views with a noise of half a pixel, errors of inverse depths are as large as stated."""
    points, noise = points_ahead(200, seed), 0.5
    poses = [pose(x) for x in (0, -3, -2, -1, 1, 2, 3)]
    views = views_of(points, poses, noise)
    neighbors = list(zip(views[1:], motions(poses[1:], poses[0]), strict=True))
    result = triangulate(views[0], neighbors, 3)
    exact = views_of(points, poses)[0]
    rows = [np.flatnonzero((exact.descriptors == own).all(1))[0] for own in result.descriptors]
    true = in_camera(points, poses[0], CAMERA)
    depths = true[true[:, 2] > 0.5][rows, 2]
    errors = (result.points[:, 2] / depths - 1) / result.deviations / noise
    assert len(errors) > 100
    assert 0.5 < np.median(np.abs(errors)) / 0.6745 < 1.5


def test_pnp_with_noisy_depths_is_unbiased_and_its_covariance_fits_the_errors():
    """Errors of the depths must not draw the query to the place: 8 cm of 1 m if left out."""
    dice, focal, noise, sigma = np.random.default_rng(0), 200.0, 0.5, 0.01
    errors, squares = [], []
    for _ in range(60):
        rays = np.column_stack([dice.uniform(-0.6, 0.6, (120, 2)), np.ones(120)])
        rho = 1 / dice.uniform(12, 40, 120)
        moved = rays / rho[:, None] - (1, 0, 0)
        seen = moved[:, :2] / moved[:, 2:] + noise / focal * dice.normal(size=(120, 2))
        measured = np.maximum(rho + noise * sigma * dice.normal(size=120), 0.002)
        points, descriptors = rays / measured[:, None], dice.random((120, 128), np.float32)
        own = Landmarks(points, points, sigma / measured, descriptors, np.empty((0, 4, 4)))
        result = solve_pnp(View(seen, descriptors, focal), [own])
        turn = Rotation.from_matrix(result.matrix[:3, :3]).as_rotvec()
        errors.append(np.concatenate([result.matrix[:3, 3] - (1, 0, 0), turn]))
        squares.append(errors[-1] @ np.linalg.solve(noise**2 * result.covariance, errors[-1]))
    assert np.abs(np.mean(errors, axis=0)[:3]).max() < 0.02
    assert 4 < np.mean(squares) < 8


def test_pnp_counts_each_keypoint_once_and_rejects_other_points():
    points = points_ahead(60)
    center, aside = pose(0), [pose(-2), pose(2)]
    views = views_of(points, [center, *aside])
    around = list(zip(views[1:], motions(aside, center), strict=True))
    landmarks = triangulate(views[0], around, 1)
    query = views_of(points, [pose(0.5, 0.5)])[0]
    once, twice = solve_pnp(query, [landmarks]), solve_pnp(query, [landmarks, landmarks])
    assert once.inliers == twice.inliers > 30
    few = replace(landmarks, points=landmarks.points[:11], descriptors=landmarks.descriptors[:11])
    assert solve_pnp(query, [few, few]).matrix is None
    other = np.random.default_rng(3).permutation(landmarks.points)
    assert solve_pnp(query, [replace(landmarks, points=other)]).inliers < MIN_INLIERS


@pytest.mark.parametrize('seed', range(4))
def test_triangulate_corrects_the_steps_of_poor_odometry(seed):
    """From the side, places are off by less than a third of what the odometry is off."""
    rng = np.random.default_rng(seed)
    poses = [pose(2 * x) for x in range(-4, 5)]
    points = points_ahead(300, seed)
    views = views_of(points, poses, noise=0.3)
    measured = [np.eye(4)]
    for before, after in pairwise(map(matrices, poses)):
        noise = matrices(pose(*rng.normal(0, (0.04, 0.005, 0.012))))
        measured.append(measured[-1] @ inverse(before) @ after @ noise)
    wrong = motions([to_poses(matrix) for matrix in measured], to_poses(measured[4]))
    true = motions(poses, poses[4])
    del views[4:5], wrong[4], true[4]
    place = views_of(points, poses[4:5], noise=0.3, seed=1)[0]
    landmarks = triangulate(place, list(zip(views, wrong, strict=True)), 4)

    def aside(found):  # only odometry knows the length of the way
        steps = np.array(found)[:, :3, 3]
        return np.abs(steps / np.linalg.norm(steps, axis=1)[:, None])[:, 0]

    def turns(found):
        pairs = zip(found, true, strict=True)
        return [Rotation.from_matrix(m[:3, :3] @ own[:3, :3].T).magnitude() for m, own in pairs]

    assert max(aside(landmarks.motions)) < 0.006
    assert np.mean(turns(landmarks.motions)) < np.mean(turns(wrong)) / 3


def test_odometry_information_of_two_steps_is_that_of_their_composition():
    around = np.array(motions([pose(-1), pose(2, 0.5, 0.3), pose(4, 2, 0.8)], pose(0)))
    covariance = np.linalg.inv(odometry_information(around, 1)).reshape(3, 6, 3, 6)
    rng, samples = np.random.default_rng(0), []
    for _ in range(5000):
        last = own = np.eye(4)
        row = []
        for motion in around[1:]:
            step = motion @ inverse(last)
            length = np.linalg.norm(step[:3, 3])
            step[:3, 3] += (SHIFT[0] + SHIFT[1] * length) * rng.normal(size=3)
            turn = TURN * math.sqrt(length) * rng.normal(size=3)
            step[:3, :3] = Rotation.from_rotvec(turn).as_matrix() @ step[:3, :3]
            own, last = step @ own, motion
            off = Rotation.from_matrix(own[:3, :3] @ motion[:3, :3].T).as_rotvec()
            row += [*(own[:3, 3] - motion[:3, 3]), *off]
        samples.append(row)
    expected = covariance[1:, :, 1:].reshape(12, 12)
    scale = np.sqrt(np.diag(expected))
    off = (np.cov(np.array(samples).T) - expected) / np.outer(scale, scale)
    assert np.abs(off).max() < 0.08
    assert not covariance[0, :, 1:].any()  # the other side of the place has other steps


@pytest.mark.parametrize('ratio', [0.6, 0.8, 0.95])
def test_mutual_matches_of_floats_agree_with_opencv(ratio):
    rng = np.random.default_rng(2)
    mine = rng.integers(0, 120, (90, 128)).astype(np.float32)
    theirs = rng.permutation(mine)[:60] + rng.integers(-25, 26, (60, 128)).astype(np.float32)
    theirs[:10] = theirs[10:20] + 1  # not clear
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    ahead, back = matcher.knnMatch(mine, theirs, 2), matcher.knnMatch(theirs, mine, 1)
    expected = [
        (one.queryIdx, one.trainIdx)
        for one, two in ahead
        if one.distance < ratio * two.distance and back[one.trainIdx][0].trainIdx == one.queryIdx
    ]
    result = mutual_matches(mine, theirs, ratio)
    assert list(zip(*(indices.tolist() for indices in result), strict=True)) == expected
    assert 20 < len(expected) < 60


# Edges: from images, alignment by odometry, cameras, fallbacks

SPACING = 1.0  # meters between places
PLACE, PLACES, LENGTH = 10, 21, 11
MATRIX = np.array([[200.0, 0, 159.5], [0, 200, 119.5], [0, 0, 1]])
MOUNTED = replace(CAMERA, mount=(0.4, -0.2, 1.1, *FORWARD[3:]))
DISTORTED = replace(CAMERA, model='plumb_bob', distortion=(-0.2, 0.05, 0.001, -0.001, 0.0))


def project(points, distortion):
    """Return the pixels of points in the camera, (m, 3), by OpenCV, (m, 2)."""
    zero = np.zeros(3)
    return cv2.projectPoints(points, zero, zero, MATRIX, np.array(distortion))[0][:, 0]


def render(points, textures, base, camera):
    """Draw a textured square at each point, the farthest first."""
    width, height = SIZE
    image = np.full((height, width, 3), 90, np.uint8)
    seen = in_camera(points, base, camera)
    for i in np.argsort(-seen[:, 2]):
        z = seen[i, 2]
        if z < 1:
            continue
        flat = project(seen[i][None], camera.distortion or (0.0,) * 5)
        (u, v), side = flat.ravel(), 200 * 0.9 / z
        if not (-50 < u < width + 50 and -50 < v < height + 50):
            continue
        scale = side / 12
        warp = np.array([[scale, 0, u - 5.5 * scale], [0, scale, v - 5.5 * scale]])
        cv2.warpAffine(textures[i], warp, (width, height), image, cv2.INTER_LINEAR,
                       cv2.BORDER_TRANSPARENT)  # fmt: skip
    return image


def scene(camera, query, seed=0):
    """Return the pair of the place PLACE and a query, whose pose is relative to it."""
    rng = np.random.default_rng(seed)
    points = np.add(points_ahead(260, seed), [PLACE * SPACING - 5, 0, 0])
    textures = rng.integers(0, 255, (len(points), 12, 12, 3), dtype=np.uint8)
    poses = np.array([pose(i * SPACING) for i in range(PLACES)])
    near = range(PLACE - TRIANGULATION_RADIUS, PLACE + TRIANGULATION_RADIUS + 1)
    thumbnails = {i: encode_thumbnail(render(points, textures, poses[i], camera)) for i in near}
    true = matrices(poses[PLACE]) @ matrices(query)
    image = thumbnail_of(render(points, textures, to_poses(true), camera))
    return MatchedPair(object(), PLACE, image, *drive(), 0, poses, thumbnails)


def turned_mount(mount, yaw):
    """Return the mounting (7,) of a camera that is turned with its base."""
    return to_poses(matrices(pose(0, yaw=yaw)) @ matrices(np.array(mount)))


def drive(ahead=0.0, speed=1.0, middle=5):
    """
    Return poses of the window, the middle's position, and distances to the places.

    :param ahead: where the middle image was, in places from PLACE.
    :param speed: places an image.
    """
    steps = (np.arange(LENGTH) - middle) * speed
    query_poses = np.array([pose(100 + step * SPACING) for step in steps])
    away = PLACE + ahead + steps[:, None] - np.arange(PLACES)
    return query_poses, middle, np.minimum(np.abs(away), 2) ** 1.5 - 1


@pytest.mark.parametrize('camera', [CAMERA, MOUNTED, DISTORTED])
def test_edge_of_images_is_the_pose_between_the_bases(camera):
    query = pose(0.4, -0.7, math.radians(3))
    pair = scene(camera, query)
    edge = EdgeEstimator().estimate(pair, camera, camera)
    assert (edge.source, edge.reason) == (Source.PNP, '')
    assert edge.inliers >= MIN_INLIERS
    assert 0 < edge.error < 2
    np.testing.assert_allclose(edge.pose[:3], query[:3], atol=0.12)
    turn = Rotation.from_quat(edge.pose[3:]).inv() * Rotation.from_quat(query[3:])
    assert math.degrees(turn.magnitude()) < 0.7
    error = np.concatenate([edge.pose[:3] - query[:3], turn.as_rotvec()])
    assert error @ np.linalg.solve(edge.covariance, error) < 12.6  # 95 % of 6 dimensions
    assert np.linalg.eigvalsh(edge.covariance).min() > 0


@pytest.mark.parametrize('speed', [1.0, -1.0])
def test_edge_of_a_rear_camera_is_turned(speed):
    """It sees from behind, on the way back, what the front camera of the map saw."""
    pair = replace(plain_pair(*drive(0.4, speed), direction=int(speed)), relative_yaw=math.pi)
    for method, source in (('auto', Source.ALIGNED), ('none', Source.NONE)):
        edge = EdgeEstimator(method).estimate(pair, None, None)
        assert edge.source is source
        assert abs(edge.pose[3:] @ pose(0, yaw=math.pi)[3:]) == pytest.approx(1)
        np.testing.assert_allclose(
            edge.pose[:3], [0.4 * SPACING * (source is Source.ALIGNED), 0, 0], atol=0.06
        )
    # by keypoints, with the mountings of both cameras
    pair = scene(CAMERA, pose(0.4, -0.7))
    rear = replace(CAMERA, mount=tuple(turned_mount(CAMERA.mount, math.pi)))
    edge = EdgeEstimator().estimate(pair, rear, CAMERA)
    assert edge.source is Source.PNP
    np.testing.assert_allclose(edge.pose[:3], [0.4, -0.7, 0], atol=0.12)
    assert abs(edge.pose[3:] @ pose(0, yaw=math.pi)[3:]) == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize('method', ['auto', 'pnp'])
def test_edge_that_keypoints_do_not_confirm_has_no_pose(method, set_constants):
    """Images of another place, and a query farther away than the neighbors of the place."""
    other = scene(CAMERA, pose(0), seed=9)
    pair = replace(scene(CAMERA, pose(0)), query=other.query)
    far = scene(CAMERA, pose(0.5))
    set_constants(estimator, MAX_DISTANCE_RATIO=0.1)
    for case, words in ((pair, 'fewer than 14'), (far, 'more than 0.4 m from the place')):
        edge = EdgeEstimator(method).estimate(case, CAMERA, CAMERA)
        assert (edge.source, edge.has_pose, edge.independent) == (Source.REFUTED, False, False)
        assert words in edge.reason
        assert edge.inliers >= 0


def test_edge_that_keypoints_do_not_determine_has_no_pose(set_constants):
    set_constants(estimator, MAX_DEVIATION=0.02)
    edge = EdgeEstimator().estimate(scene(CAMERA, pose(0.5)), CAMERA, CAMERA)
    assert (edge.source, edge.has_pose, edge.inliers >= MIN_INLIERS) == (
        Source.REFUTED, False, True,
    )  # fmt: skip
    assert 'determine the position to 0.0 m only' in edge.reason


def test_edge_with_an_obstacle_is_dropped_only_where_pnp_is_possible():
    pair, estimator = scene(CAMERA, pose(0.3)), EdgeEstimator()
    edge = estimator.estimate(pair, CAMERA, CAMERA, 'a reason')
    assert (edge.source, edge.has_pose, edge.inliers) == (Source.DROPPED, False, -1)
    assert (edge.independent, edge.reason) == (False, 'PnP: a reason')
    assert estimator.estimate(pair, CAMERA, CAMERA).independent
    assert estimator.estimate(pair, None, CAMERA, 'a reason').source is Source.ALIGNED


NO_POSES = {'poses': np.full((PLACES, 7), np.nan)}


@pytest.mark.parametrize(
    ('changes', 'cameras', 'source', 'words'),
    [
        ({}, (None, CAMERA), Source.ALIGNED, 'intrinsics of the camera are unknown'),
        ({}, (CAMERA, None), Source.ALIGNED, 'intrinsics of the camera of the map'),
        ({'query': None}, (CAMERA, CAMERA), Source.ALIGNED, 'no thumbnail'),
        ({'thumbnails': {}}, (CAMERA, CAMERA), Source.ALIGNED, 'no thumbnail'),
        ({'thumbnails': {PLACE: b'damaged'}}, (CAMERA, CAMERA), Source.ALIGNED, 'no neighbors'),
        ({}, (replace(CAMERA, height=320), CAMERA), Source.ALIGNED, 'intrinsics are of 320x320'),
        (NO_POSES, (CAMERA, CAMERA), Source.NONE, 'the place has no pose'),
        (
            {'query_poses': np.full((LENGTH, 7), np.nan), 'query': None},
            (CAMERA, CAMERA), Source.NONE, 'no odometry at the middle',
        ),
    ],
)  # fmt: skip
def test_edge_without_what_pnp_needs_names_it(changes, cameras, source, words):
    flat = np.zeros((144, 192, 3), np.uint8)
    thumbnails = {
        PLACE + i: encode_thumbnail(flat)
        for i in range(-TRIANGULATION_RADIUS, TRIANGULATION_RADIUS + 1)
    }
    poses = np.array([pose(i * SPACING) for i in range(PLACES)])
    pair = MatchedPair(object(), PLACE, flat, *drive(), 0, poses, thumbnails)
    edge = EdgeEstimator().estimate(replace(pair, **changes), *cameras)
    assert edge.source is source
    assert words in edge.reason


def plain_pair(query_poses, middle, distances, poses=None, direction=1):
    poses = np.array([pose(i * SPACING) for i in range(PLACES)]) if poses is None else poses
    return MatchedPair(
        object(), PLACE, None, query_poses, middle, distances, 0, poses, {}, direction
    )


@pytest.mark.parametrize('speed', [0.5, 0.91, 1.0, 1.6, -1.0])
@pytest.mark.parametrize('ahead', [-0.7, 0.0, 0.3, 2.2])
def test_align_finds_the_offset_at_any_speed(speed, ahead):
    edge = align(plain_pair(*drive(ahead, speed), direction=1 if speed > 0 else -1))
    assert (edge.source, edge.reason) == (Source.ALIGNED, '')
    np.testing.assert_allclose(edge.pose[:3], [ahead * SPACING, 0, 0], atol=0.06)
    along, across = edge.covariance[0, 0], edge.covariance[1, 1]
    assert across > 4 * along


def test_align_leaves_out_images_without_odometry_and_places_that_are_not_compared():
    query_poses, middle, distances = drive(0.5)
    query_poses[2:4] = np.nan
    distances[2:4] = -5
    distances[:, :4] = np.inf
    edge = align(plain_pair(query_poses, middle, distances))
    assert edge.pose[0] == pytest.approx(0.5, abs=0.06)
    query_poses[: middle - 1] = np.nan
    query_poses[middle + 1 :] = np.nan
    gaps = align(plain_pair(query_poses, middle, distances))
    assert (gaps.source, 'has gaps' in gaps.reason) == (Source.NONE, True)


def test_align_follows_the_track_of_the_places_in_a_bend():
    turns = np.radians(6) * np.arange(PLACES)
    steps = np.column_stack([np.cos(turns), np.sin(turns)])
    corners = np.concatenate([[[0, 0]], np.cumsum(steps, axis=0)[:-1]])
    poses = np.array([pose(*at, yaw) for at, yaw in zip(corners, turns, strict=True)])
    edge = align(plain_pair(*drive(2.0), poses))
    expected = to_poses(inverse(matrices(poses[PLACE])) @ matrices(poses[PLACE + 2]))
    np.testing.assert_allclose(edge.pose, expected, atol=0.06)
    direction = expected[:3] / np.linalg.norm(expected[:3])
    assert direction @ edge.covariance[:3, :3] @ direction < 0.5


@pytest.mark.parametrize('method', ['auto', 'aligned'])
def test_independent_edges_are_apart(method):
    """Of edges at every place, each tenth is independent."""
    estimator, source, result = EdgeEstimator(method), object(), []
    poses = np.array([pose(i * SPACING) for i in range(60)])
    for place in range(15, 45):
        query_poses, middle, distances = drive()
        near = np.full((LENGTH, 60), 2.0)
        near[:, place - PLACE : place - PLACE + PLACES] = distances
        pair = MatchedPair(source, place, None, query_poses, middle, near, 0, poses, {})
        result.append(estimator.estimate(pair, None, None).independent)
    assert np.flatnonzero(result).tolist() == list(range(0, 30, MIN_PLACES_APART[Source.ALIGNED]))
    assert not EdgeEstimator('none').estimate(pair, None, None).independent


def test_rays_of_a_thumbnail_are_those_of_the_image():
    """Pixel centers of an image of half the size lie between pixel centers of the image."""
    points = np.array([[0.0, 0.0], [79.5, 59.5], [100.25, 10.75]])
    small = CAMERA.rays(points, 160, 120)
    np.testing.assert_allclose(small, CAMERA.rays(points * 2 + 0.5, 320, 240))
    np.testing.assert_allclose(small[1], 0, atol=1e-12)


@pytest.mark.parametrize(
    ('model', 'coefficients'),
    [
        ('plumb_bob', (-0.2, 0.05, 0.001, -0.001, 0.0)),
        ('rational_polynomial', (-0.2, 0.05, 0.001, -0.001, 0.0, 0.1, 0.01, 0.0)),
        ('equidistant', (0.02, -0.01, 0.002, 0.0)),
    ],
)
def test_rays_are_without_distortion(model, coefficients):
    rays = np.array([[0.3, -0.2], [-0.5, 0.1], [0.0, 0.0]])
    if model == 'equidistant':
        pixels = cv2.fisheye.distortPoints(rays[:, None], MATRIX, np.array(coefficients))[:, 0]
    else:
        pixels = project(np.column_stack([rays, np.ones(3)]), coefficients)
    camera = replace(CAMERA, model=model, distortion=coefficients)
    np.testing.assert_allclose(camera.rays(pixels, *SIZE), rays, atol=1e-4)


@pytest.mark.parametrize(
    ('changes', 'words'),
    [
        ({'focal': (0.0, 0.0)}, 'calibrate the camera'),
        ({'center': (math.nan, 1.0)}, 'not finite'),
        ({'model': 'other', 'distortion': (0.1,) * 5}, "model 'other'"),
        ({'model': 'plumb_bob', 'distortion': (0.1,) * 7}, '7 coefficients'),
        ({'mount': (0.0,) * 7}, 'quaternion of norm 0'),
    ],
)
def test_camera_with_invalid_numbers_is_rejected(changes, words):
    with pytest.raises(InputError, match=words):
        replace(CAMERA, **changes)


def test_map_file_holds_the_camera(small_map, tmp_path):
    camera = replace(DISTORTED, mount=MOUNTED.mount)
    for one in (replace(small_map, camera=camera), small_map):
        save_map(one, tmp_path / 'a.stavpr', force=True)
        assert load_map(tmp_path / 'a.stavpr').camera == one.camera
    with_camera = replace(small_map, camera=camera)
    for others, expected in ((with_camera, camera), (small_map, None)):
        assert merge_maps([with_camera, others], ['a', 'b']).camera == expected


def test_map_file_holds_several_cameras(small_map, tmp_path):
    n, rear = len(small_map), replace(CAMERA, mount=tuple(turned_mount(CAMERA.mount, math.pi)))
    assert yaw_of(rear.mount) == pytest.approx(math.pi)
    maps = replace(small_map, camera=CAMERA), replace(small_map, camera=rear)
    merged = merge_maps(maps, ['front', 'rear'], [('front', 0.1), ('rear', None)])
    save_map(merged, tmp_path / 'a.stavpr')
    result = load_map(tmp_path / 'a.stavpr')
    assert result.sessions == merged.sessions
    assert [(session.camera, session.yaw) for session in result.sessions] == [
        ('front', 0.1), ('rear', pytest.approx(math.pi)),
    ]  # fmt: skip
    assert (result.camera_of(n - 1), result.camera_of(n)) == (CAMERA, rear)
    assert with_same_places(result).same_as.tolist() == list(range(2 * n))  # they look elsewhere
    alike = merge_maps(maps, ['front', 'rear'])
    assert alike.camera_of(n) == rear
    assert with_same_places(alike).same_as[n:].tolist() == list(range(n))
    with pytest.raises(InputError, match='1 cameras of 2 maps'):
        merge_maps(maps, ['front', 'rear'], [('front', 0.0)])
