# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The recordings of a demonstration: a synthetic street, written as bags, or the user's own."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
import shutil

import numpy as np
from stavpr_lab.demonstration.street.traverses import (
    AFTERNOON,
    first_traverse,
    nearest_places,
    second_traverse,
    Traverse,
    World,
)
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_ros.errors import ImageError, SettingsError, SourceError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import build_map, save_map
from stavpr_ros.progress import Progress
from stavpr_ros.sources import is_folder, open_source
from stavpr_ros.sources.bag import BagSource
from stavpr_ros.sources.bag_path import is_bag, METADATA
from stavpr_ros.sources.bag_writer import write_bag
from stavpr_ros.sources.folder import FolderSource
from stavpr_ros.sources.frame import ImageRecord
from stavpr_ros.sources.video import is_video, require_video, VideoSource

TOPIC = '/camera/image_raw'
OnError = Callable[[ImageError], None]


@dataclass(frozen=True)
class Recording:
    """
    A traverse in a folder of images, a video or a bag.

    :param topic: image topic of a bag; None = the only one, or no bag.
    :param fps: images per second that are taken of a video; None = the default, or no video.
    :param camera: name of one camera of a folder with several; None = the only one, or no folder.
    """

    path: str
    topic: str | None = None
    fps: float | None = None
    camera: str | None = None

    def open(self, on_error: OnError | None = None) -> FolderSource | VideoSource | BagSource:
        """Open its images; see :func:`stavpr_ros.sources.open_source`."""
        return open_source(self.path, self.topic, on_error, self.fps, self.camera)

    def save_feature_settings(self, extractor: FeatureExtractor, path: Path) -> None:
        """Write a map of one image, which sets the features of a node that closes loops."""
        images = islice(self.open(lambda _: None), 1)
        save_map(build_map(images, extractor, thumbnails=False, progress=False), path, force=True)


@dataclass(frozen=True)
class TraversePair:
    """
    A traverse for the map and another one for the query.

    :param true_places: place of each query image, -1 = not in the map; None = unknown.
    """

    reference: Recording
    query: Recording
    true_places: np.ndarray | None
    title: str


@dataclass(frozen=True)
class LoopTraverse:
    """
    A traverse of N images that passes places again.

    :param ground_truth: its loop closures; None = unknown.
    """

    recording: Recording
    N: int
    ground_truth: GroundTruth | None
    title: str


def synthetic_pair(folder: Path) -> TraversePair:
    """
    Traverse a synthetic street twice and write a bag of each traverse.

    :raises SourceError: a bag cannot be written.
    """
    bags = folder / 'first_traverse', folder / 'second_traverse'
    for bag in bags:
        remove_earlier_bag(bag)
    world = World()
    first, second = first_traverse(world), second_traverse(world)
    for traverse, bag in zip((first, second), bags, strict=True):
        write_bag(bag, TOPIC, _records(traverse, bag.name.replace('_', ' ')))
    reference, query = (Recording(str(bag), TOPIC) for bag in bags)
    title = 'A synthetic street, by day and in the rain at dusk'
    return TraversePair(reference, query, nearest_places(first, second), title)


def synthetic_loop(folder: Path, exclude: int, tolerance: int) -> LoopTraverse:
    """
    Traverse a synthetic street twice, in the afternoon on the other lane, and write one bag.

    :param exclude: latest places that an image is not compared with.
    :param tolerance: tolerance of the ground truth, images.
    :raises SourceError: the bag cannot be written.
    """
    bag = folder / 'loop'
    remove_earlier_bag(bag)
    world = World()
    first, second = first_traverse(world), second_traverse(world, conditions=AFTERNOON)
    epoch = int(first.stamps[-1] + first.stamps[1] - first.stamps[0])
    both = chain(_records(first, 'first time'), _records(second, 'second time', epoch))
    write_bag(bag, TOPIC, both)
    places = nearest_places(first, second)
    again = np.flatnonzero(places >= 0)
    N = len(first) + len(second)
    truth = GroundTruth.from_pairs(again + len(first), places[again], N, N, tolerance)
    truth = truth.loop_closures(exclude - 1)
    return LoopTraverse(Recording(str(bag), TOPIC), N, truth, 'A synthetic street, twice')


def own_recordings(
    paths: Sequence[str], topic: str | None, fps: float | None, camera: str | None = None
) -> list[Recording]:
    """
    Name the user's traverses, each with the options that are for its kind.

    :param topic: image topic of the bags, if they have several.
    :param fps: images per second that are taken of the videos.
    :param camera: name of the camera of the folders, if they have several.
    :raises SettingsError: an option is for none of them.
    """
    require_video(fps, paths)
    bags = [is_bag(Path(path)) for path in paths]
    if topic is not None and not any(bags):
        raise SettingsError(f'--topic {topic}: no recording is a bag; leave it out')
    return [
        Recording(
            path,
            topic if bag else None,
            fps if is_video(path) else None,
            camera if is_folder(path) else None,
        )
        for path, bag in zip(paths, bags, strict=True)
    ]


def own_pair(
    reference: Recording, query: Recording, identity: bool, sequence_length: int
) -> TraversePair:
    """
    Open the user's traverses.

    :param identity: image i of the query shows place i.
    :raises StavprError: they cannot be read, or do not fit the options.
    """
    places, images = len(reference.open()), len(query.open())
    if images < sequence_length:
        raise SettingsError(
            f'{query.path} has {images} images: the window needs {sequence_length}'
        )
    if identity and images > places:
        raise SettingsError(f'--truth identity: {images} query images on a map of {places} places')
    title = f'{Path(query.path).name} recognized on the map of {Path(reference.path).name}'
    return TraversePair(reference, query, np.arange(images) if identity else None, title)


def own_loop(
    recording: Recording, ground_truth: str | None, exclude: int, tolerance: int
) -> LoopTraverse:
    """
    Open the user's traverse.

    :param ground_truth: file of its loop closures; None = unknown.
    :param exclude: latest places that an image is not compared with.
    :param tolerance: tolerance of the ground truth, images.
    :raises StavprError: it cannot be read.
    """
    N, truth = len(recording.open()), None
    if ground_truth is not None:
        truth = GroundTruth.from_file(ground_truth, N, N, tolerance).loop_closures(exclude - 1)
    return LoopTraverse(
        recording, N, truth, f'{Path(recording.path).resolve().name}: loop closures'
    )


def remove_earlier_bag(bag: Path) -> None:
    """
    Remove the bag of an earlier demonstration.

    :raises SourceError: something else is there; it is kept.
    """
    try:
        if {file.name for file in bag.iterdir()} <= {METADATA, f'{bag.name}.db3'}:
            shutil.rmtree(bag)
            return
    except FileNotFoundError:
        return
    except OSError as error:
        raise SourceError(f'{bag} cannot be replaced: {error}; choose another --output') from error
    raise SourceError(
        f'{bag} exists and is no bag of an earlier demo: it is kept; choose another --output'
    )


def _records(traverse: Traverse, name: str, epoch: int | None = None) -> Iterator[ImageRecord]:
    """
    Render a traverse.

    :param epoch: stamp of its first image, ns; None = the traverse's own.
    """
    later = 0 if epoch is None else epoch - int(traverse.stamps[0])
    for frame in Progress(traverse, desc=name, unit='image'):
        yield ImageRecord.of_image(frame.image, frame.stamp + later, frame_id='camera')
