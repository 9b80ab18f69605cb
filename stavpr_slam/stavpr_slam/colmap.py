# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``stavpr map colmap``: the images, image pairs and poses of a map for COLMAP and hloc."""

from collections.abc import Iterator, Sequence
import json
from pathlib import Path

import numpy as np
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.mapping import Map
from stavpr_ros.mapping.camera import Camera
from stavpr_ros.mapping.place_map import encode_jpeg
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_ros.output_file import atomic_folder
from stavpr_ros.sources import open_source

NEIGHBORS = 5  # places before a place that it is paired with
BESIDE = 1  # places beside a recognized place that its query is paired with as well
QUALITY = 95  # of JPEG
ALL = 1000.0  # images per second of a video: all of them


def export(
    place_map: Map,
    folder: str,
    images: Sequence[str] = (),
    topic: str | None = None,
    closures: str = '',
    camera: str | None = None,
) -> str:
    """
    Write a folder of a map: ``images/``, ``pairs.txt``, and with poses and a camera ``sparse/``.

    Each line of ``pairs.txt`` has a query and a place: successive places of a session, places that
    earlier sessions show as well (:attr:`Map.same_as`), and loop closures. ``sparse`` is a
    text model of COLMAP without points, in meters and the frame of the map.

    :param images: folder of images or bag of each session, from which the images are taken, in
        full size; empty = thumbnails.
    :param topic: image topic of the bags.
    :param camera: of the folders with several.
    :param closures: file of ``record --loop-closures``, '' = none.
    :returns: what was written, one line.
    :raises StavprError: a source cannot be read or does not fit, or the folder exists.
    """
    with atomic_folder(folder) as new:
        (new / 'images').mkdir(parents=True)
        sizes = {}
        for place, image in _images(place_map, images, topic, camera):
            height, width = image.shape[:2]
            sizes[place] = width, height
            (new / 'images' / _name(place)).write_bytes(encode_jpeg(image, QUALITY))
        if not sizes:
            raise InputError(
                'the map has no thumbnails: name the folder or bag that it is of (--images)'
                if not images
                else f'no image of {", ".join(images)} is of the map: name the ones that it is of'
            )
        pairs = sorted(p for p in _pairs(place_map, closures) if sizes.keys() >= set(p))
        text = ''.join(f'{_name(query)} {_name(place)}\n' for query, place in pairs)
        (new / 'pairs.txt').write_text(text)
        posed = [place for place in sizes if place_map.pose(place) is not None]
        if posed and place_map.camera is not None:
            (new / 'sparse').mkdir()
            for name, lines in _model(place_map, place_map.camera, posed, sizes).items():
                (new / 'sparse' / name).write_text(''.join(f'{line}\n' for line in lines))
            model = f'{len(posed)} poses'
        else:
            model = 'no poses: the map has no ' + ('camera' if posed else 'poses')
    return f'{folder}: {len(sizes)} images of {len(place_map)} places, {len(pairs)} pairs, {model}'


def _name(place: int) -> str:
    return f'{place:06d}.jpg'


def _images(
    place_map: Map, paths: Sequence[str], topic: str | None, camera: str | None
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield places and their images, RGB (h, w, 3)."""
    if not paths:
        for place in range(len(place_map)):
            thumbnail = place_map.thumbnail(place)
            if thumbnail is not None:
                yield place, thumbnail
        return
    count = max(len(place_map.sessions), 1)
    if len(paths) != count:
        raise SettingsError(f'{len(paths)} --images for {count} sessions: name one of each')
    for number, path in enumerate(paths):
        index = place_map.session_index
        own = np.arange(len(place_map)) if index is None else np.flatnonzero(index == number)
        ids = {place_map.ids[place]: place for place in own.tolist()}
        stamps = {int(place_map.stamps[place]): place for place in own.tolist()}
        for frame in open_source(path, topic, fps=ALL, camera=camera):
            match = stamps.get(frame.stamp) if frame.stamp else ids.get(frame.identifier)
            if match is not None:
                yield match, frame.image


def _pairs(place_map: Map, closures: str) -> set[tuple[int, int]]:
    """Return pairs of places, the later one first."""
    n, index, same_as = len(place_map), place_map.session_index, place_map.same_as
    session = np.zeros(n, int) if index is None else index
    neighbors = [(i, j) for i in range(n) for j in range(max(0, i - NEIGHBORS), i)]
    pairs = {(i, j) for i, j in neighbors if session[i] == session[j]}
    matched = [] if same_as is None else [(i, int(j)) for i, j in enumerate(same_as) if i != j]
    if closures:
        place_of = {int(stamp): i for i, stamp in enumerate(place_map.stamps) if stamp}
        stamped = [[place_of.get(stamp, -1) for stamp in pair] for pair in read_closures(closures)]
        matched += [(max(pair), min(pair)) for pair in stamped if min(pair) >= 0]
    for query, place in matched:
        for beside in range(max(0, place - BESIDE), min(n, place + BESIDE + 1)):
            if session[beside] == session[place] and beside < query:
                pairs.add((query, beside))
    return pairs


def read_closures(path: str) -> list[tuple[int, int]]:
    """
    Return the stamps of query and place of recorded loop closures, ns.

    :raises InputError: the file cannot be read, or is of something else.
    """
    try:
        rows = [json.loads(line) for line in Path(path).read_text().splitlines()]
        return [(int(row['query_stamp']), int(row['place_stamp'])) for row in rows]
    except (OSError, ValueError, LookupError, TypeError, OverflowError, RecursionError) as error:
        raise InputError(
            f'{path}: {type(error).__name__}: {error}; expected a file of record --loop-closures'
        ) from error


def _model(
    place_map: Map, camera: Camera, posed: list[int], sizes: dict[int, tuple[int, int]]
) -> dict[str, list[str]]:
    """Return the files of a text model by their names; COLMAP, doc/format.rst."""
    numbers = {size: i for i, size in enumerate(sorted({sizes[place] for place in posed}), 1)}
    cameras = [f'{number} {_camera(camera, *size)}' for size, number in numbers.items()]
    poses = matrices(np.array([place_map.pose(place) for place in posed]))
    # COLMAP has the pose of the world in the camera's frame (z ahead, y down)
    world = to_poses(inverse(poses @ matrices(np.array(camera.mount))))
    images = []
    for place, (x, y, z, qx, qy, qz, qw) in zip(posed, world.tolist(), strict=True):
        pose = ' '.join(f'{value:.12g}' for value in (qw, qx, qy, qz, x, y, z))
        images += [f'{place + 1} {pose} {numbers[sizes[place]]} {_name(place)}', '']  # no points
    return {'cameras.txt': cameras, 'images.txt': images, 'points3D.txt': []}


def _camera(camera: Camera, width: int, height: int) -> str:
    """Return the intrinsics of images of a size; the center of their first pixel is (0.5, 0.5)."""
    camera.require_fitting(width, height)
    scale = np.array([width / camera.width, height / camera.height])
    values = [*(camera.focal * scale), *((np.array(camera.center) + 0.5) * scale)]
    model = 'PINHOLE'
    if any(camera.distortion):
        model = 'OPENCV_FISHEYE' if camera.model == 'equidistant' else 'FULL_OPENCV'
        extra = [*camera.distortion, *[0.0] * 8]
        values += extra[: 4 if model == 'OPENCV_FISHEYE' else 8]
    return f'{model} {width} {height} ' + ' '.join(f'{value:.12g}' for value in values)
