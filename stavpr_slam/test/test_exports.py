# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Exports: trajectories for KITTI's tools, maps for COLMAP and hloc."""

from dataclasses import replace
import json
from pathlib import Path

import cv2
from fixtures import route_images
from map_examples import example_map, PLACES
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from stavpr_ros.commands.map import main
from stavpr_ros.mapping import save_map
from stavpr_ros.mapping.camera import Camera
from stavpr_ros.sources.bag_writer import write_bag
from stavpr_ros.sources.frame import ImageRecord
from stavpr_ros.units import SECOND
from stavpr_slam.pose_graph.files import save_graph
from test_pose_graph import circle, closure, LAP, solve

POINT = np.array([10.0, 1.0, 2.0])  # ahead, to the left, up, in the frame of the base
DISTORTION = (0.1, 0.02, 0.003, 0.004, 0.05)


def test_kitti_file_has_poses_of_tum_file(tmp_path):
    truth = circle()
    _, graph = solve(truth, [closure(truth, q, q - LAP) for q in range(LAP, 2 * LAP)])
    for name in ('a.tum', 'a.kitti'):
        save_graph(graph, str(tmp_path / name))
        save_graph(graph, str(tmp_path / name), force=True)
    tum, kitti = np.loadtxt(tmp_path / 'a.tum'), np.loadtxt(tmp_path / 'a.kitti')
    assert kitti.shape == (len(tum), 12)
    matrices = kitti.reshape(-1, 3, 4)
    np.testing.assert_allclose(matrices[:, :, 3], tum[:, 1:4], atol=1e-6)
    turns = Rotation.from_quat(tum[:, 4:]).as_matrix()
    np.testing.assert_allclose(matrices[:, :, :3], turns, atol=1e-6)


@pytest.fixture
def route(tmp_path, monkeypatch):
    """Return a map of two sessions with a camera of twice the size of its images, saved."""
    place_map, (height, width) = example_map(), route_images(1)[0].shape[:2]
    camera = Camera(
        2 * width, 2 * height, (300.0, 310.0), (width - 3.0, height + 2.0),
        mount=(0.5, 0, 1.0, -0.5, 0.5, -0.5, 0.5),
    )  # fmt: skip
    poses = place_map.poses.copy()
    turns = Rotation.from_euler('z', np.linspace(0, 2, PLACES)[:, None])
    poses[~np.isnan(poses[:, 0]), 3:] = turns.as_quat()[~np.isnan(poses[:, 0])]
    same_as = np.arange(PLACES, dtype=np.int32)
    same_as[20] = 6
    place_map = replace(place_map, camera=camera, poses=poses, same_as=same_as)
    monkeypatch.chdir(tmp_path)
    save_map(place_map, 'route.stavpr')
    return place_map


def read_model(folder: Path) -> tuple[dict, dict]:
    """Return cameras by their numbers and images by their names, of a text model."""
    rows = [line.split() for line in (folder / 'cameras.txt').read_text().splitlines()]
    cameras = {int(row[0]): (row[1], np.array(row[2:], float)) for row in rows}
    lines = (folder / 'images.txt').read_text().splitlines()
    assert not any(lines[1::2])  # points of each image
    images = {}
    for qw, qx, qy, qz, *rest in (line.split()[1:] for line in lines[::2]):
        turn = Rotation.from_quat(np.array([qx, qy, qz, qw], float)).as_matrix()
        images[rest[4]] = turn, np.array(rest[:3], float), cameras[int(rest[3])]
    return cameras, images


def test_colmap_model_projects_known_points(route, capsys):
    assert main(['colmap', 'route.stavpr', 'model']) == 0
    assert '23 images of 24 places' in capsys.readouterr().out
    cameras, images = read_model(Path('model/sparse'))
    assert [model for model, _ in cameras.values()] == ['PINHOLE']
    assert len(images) == PLACES - 2  # one has no thumbnail, one no pose
    for name, (turn, shift, (_, (width, height, fx, fy, cx, cy))) in images.items():
        shape = cv2.imread(f'model/images/{name}').shape
        assert (height, width) == shape[:2]
        x, y, z, *quaternion = route.pose(int(name[:6]))
        in_map = Rotation.from_quat(quaternion).apply(POINT) + np.array([x, y, z])
        right, down, ahead = turn @ in_map + shift
        scale, camera = width / route.camera.width, route.camera
        # the camera is .5 m ahead of the base and 1 m above it
        expected = np.array(camera.center) - np.array(camera.focal) * [1.0 / 9.5, 1.0 / 9.5]
        result = np.array([fx * right / ahead + cx, fy * down / ahead + cy])
        np.testing.assert_allclose(result, (expected + 0.5) * scale, rtol=1e-3)


@pytest.mark.parametrize(
    ('model', 'distortion', 'expected'),
    [
        ('plumb_bob', DISTORTION, ('FULL_OPENCV', [*DISTORTION, 0, 0, 0])),
        ('equidistant', DISTORTION[:4], ('OPENCV_FISHEYE', list(DISTORTION[:4]))),
    ],
)
def test_colmap_model_has_distortion(route, model, distortion, expected):
    camera = replace(route.camera, model=model, distortion=distortion)
    save_map(replace(route, camera=camera), 'distorted.stavpr')
    assert main(['colmap', 'distorted.stavpr', 'model']) == 0
    ((name, values),) = read_model(Path('model/sparse'))[0].values()
    assert (name, values[6:].tolist()) == expected


def test_colmap_pairs_are_neighbors_same_places_and_closures(route):
    stamps = {'query_stamp': 19 * SECOND, 'place_stamp': 2 * SECOND}
    other = {'query_stamp': 999, 'place_stamp': 2 * SECOND}
    Path('closures.jsonl').write_text(''.join(json.dumps(row) + '\n' for row in (stamps, other)))
    assert main(['colmap', 'route.stavpr', 'model', '--closures', 'closures.jsonl']) == 0
    lines = [line.split() for line in Path('model/pairs.txt').read_text().splitlines()]
    pairs = {(int(query[:6]), int(place[:6])) for query, place in lines}
    assert len(pairs) == len(lines)
    assert {(20, 5), (20, 6), (20, 7), (18, 1), (18, 2)} <= pairs
    near = pairs - {(20, 5), (20, 6), (20, 7), (18, 1), (18, 2)}
    assert {query - place for query, place in near} == {1, 2, 3, 4, 5}
    assert all((query < 12) == (place < 12) for query, place in near)
    assert min(place for _, place in pairs) == 1  # place 0 has no image


def test_colmap_images_are_those_of_folder_and_bag(route):
    """By the names of the files, and by the stamps of the messages."""
    images = route_images(PLACES)
    Path('day').mkdir()
    for place in range(12):
        cv2.imwrite(f'day/{place}.png', images[place][..., ::-1])
    night = [ImageRecord.of_image(images[i], (i + 1) * SECOND) for i in range(11, PLACES)]
    write_bag('night', '/image', night)
    ids = tuple(f'{place % 12}.png' for place in range(PLACES))
    save_map(replace(route, ids=ids), 'route.stavpr', force=True)
    assert main(['colmap', 'route.stavpr', 'model', '--images', 'day', 'night']) == 0
    assert len(list(Path('model/images').iterdir())) == PLACES
    for place in (1, 13):
        result = cv2.imread(f'model/images/{place:06d}.jpg').astype(int)[..., ::-1]
        assert np.argmin([np.abs(result - image).mean() for image in images]) == place


@pytest.mark.parametrize(
    ('options', 'code', 'expected'),
    [
        (['--images', 'day'], 2, '1 --images for 2 sessions'),
        (['--images', 'day', 'missing'], 1, 'missing does not exist'),
        (['--closures', 'route.stavpr'], 1, 'expected a file of record --loop-closures'),
        (['--closures', 'missing'], 1, 'missing: FileNotFoundError'),
    ],
)
def test_colmap_of_invalid_input_leaves_no_folder(route, options, code, expected, capsys):
    Path('day').mkdir()
    cv2.imwrite('day/0.png', route_images(1)[0])
    assert main(['colmap', 'route.stavpr', 'model', *options]) == code
    assert expected in capsys.readouterr().err
    assert not Path('model').exists()


def test_colmap_of_map_without_images_or_camera_names_what_is_missing(route, capsys):
    save_map(replace(route, camera=None), 'blind.stavpr')
    assert main(['colmap', 'blind.stavpr', 'pairs']) == 0
    assert 'no poses: the map has no camera' in capsys.readouterr().out
    assert not Path('pairs/sparse').exists()
    assert main(['colmap', 'blind.stavpr', 'pairs']) == 1
    assert 'pairs exists already' in capsys.readouterr().err
    save_map(replace(route, thumbnails=()), 'empty.stavpr')
    assert main(['colmap', 'empty.stavpr', 'model']) == 1
    assert 'the map has no thumbnails' in capsys.readouterr().err
