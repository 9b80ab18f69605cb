"""Building a map from a sequence of images."""

from collections.abc import Iterable, Iterator, Sized
from itertools import islice

import numpy as np
from tqdm import tqdm

from stavpr_ros.errors import InputError
from stavpr_ros.features import Describer, LocalFeatures
from stavpr_ros.mapping.place_map import PlaceMap, encode_thumbnail
from stavpr_ros.sources.frame import Frame

BATCH = 16  # images described at a time


def _batches(frames: Iterable[Frame]) -> Iterator[list[Frame]]:
    iterator = iter(frames)
    while batch := list(islice(iterator, BATCH)):
        yield batch


def describe_frames(frames: Iterable[Frame], describer: Describer, progress: bool = True) -> LocalFeatures:
    """
    Describe every image of a sequence, in batches.

    :param frames: a sequence of frames; its length, if it has one, scales the progress bar.
    :returns: local features of all images.
    :raises InputError: no images.
    """
    return build_map(frames, describer, thumbnails=False, progress=progress).features


def build_map(
    frames: Iterable[Frame],
    describer: Describer,
    poses: np.ndarray | None = None,
    thumbnails: bool = True,
    progress: bool = True,
) -> PlaceMap:
    """
    Make a map with one place for each image.

    :param frames: images in the order in which the route was driven.
    :param describer: makes their features; the map remembers its settings.
    :param poses: shape (n, 7), see :class:`PlaceMap`.
    :param thumbnails: keep a small picture of each place.
    :param progress: show a progress bar.
    :raises InputError: no images, or poses that do not fit.
    """
    features: list[LocalFeatures] = []
    stamps: list[int] = []
    ids: list[str] = []
    pictures: list[bytes] = []
    total = len(frames) if isinstance(frames, Sized) else None
    with tqdm(total=total, unit='image', desc='describing', disable=None if progress else True) as bar:
        for batch in _batches(frames):
            features.append(describer.describe([frame.image for frame in batch]))
            stamps += [frame.stamp for frame in batch]
            ids += [frame.identifier for frame in batch]
            if thumbnails:
                pictures += [encode_thumbnail(frame.image) for frame in batch]
            bar.update(len(batch))
    if not features:
        raise InputError('no images to build a map from: the source is empty')
    return PlaceMap(
        features=LocalFeatures.concatenate(features).to('cpu'),
        projection=describer.projection,
        stamps=np.array(stamps, np.int64),
        ids=tuple(ids),
        poses=poses,
        thumbnails=tuple(pictures),
    )
