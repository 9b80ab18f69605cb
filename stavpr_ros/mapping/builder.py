# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Building a map from a sequence of images."""

from collections.abc import Generator, Iterable, Iterator, Sized
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from stavpr_ros.checks import require_at_least, require_shape, require_type
from stavpr_ros.errors import InputError, JournalError, SettingsError
from stavpr_ros.features import FeatureExtractor, LocalFeatures
from stavpr_ros.mapping.journal import Base, JournalPlace, JournalReader, SUFFIX
from stavpr_ros.mapping.journal_writer import JournalWriter
from stavpr_ros.mapping.keyframes import KeyframeSelector, KeyframeSettings
from stavpr_ros.mapping.place_map import (
    encode_thumbnail,
    Map,
    Place,
    plain_text,
    THUMBNAIL_WIDTH,
)
from stavpr_ros.mapping.trajectory import normalize_pose, Trajectory
from stavpr_ros.progress import Progress
from stavpr_ros.sources.arrays import Images
from stavpr_ros.sources.files import RANGE_IMAGES, RangeFinder, scale
from stavpr_ros.sources.frame import Frame

BATCH = 16  # images extracted at a time


class _Place(NamedTuple):
    """An image that becomes a place, and its number in the source."""

    number: int
    image: np.ndarray
    place: Place
    thumbnail: bytes


def fit_value_range(source: Any, extractor: FeatureExtractor) -> None:
    """
    Let a source convert images of 16 bits as the map of an extractor does.

    The first images of a new map decide by the range of their values.

    :param source: a folder or a bag; anything else is unchanged.
    """
    if not hasattr(source, 'to_bytes'):
        return
    if extractor.is_new:
        finder, on_error = RangeFinder(), source.on_error
        source.to_bytes, source.on_error = finder, lambda error: None
        for _ in source:
            if finder.images in (0, RANGE_IMAGES):
                break
        source.on_error = on_error
        extractor.set_value_range(finder.value_range)
    source.to_bytes = scale(extractor.settings.value_range)


def extract_features(
    frames: Iterable[Frame | np.ndarray], extractor: FeatureExtractor, progress: bool = True
) -> LocalFeatures:
    """
    Extract the features of every image of a sequence, in batches.

    :param frames: a sequence of frames; its length, if it has one, scales the progress bar.
    :returns: local features of all images.
    :raises InputError: no images.
    """
    return build_map(frames, extractor, thumbnails=False, progress=progress).features


def build_map(
    frames: Iterable[Frame | np.ndarray],
    extractor: FeatureExtractor,
    poses: np.ndarray | Trajectory | None = None,
    thumbnails: bool = True,
    progress: bool = True,
    keyframes: KeyframeSettings | None = None,
    thumbnail_width: int = THUMBNAIL_WIDTH,
) -> Map:
    """
    Make a map with one place for each image, or for each keyframe.

    The next images are decoded by another thread during the extraction of the last ones.

    :param frames: images in the order of the route: a source, :func:`stavpr_ros.images`, or frames
        or arrays, RGB (h, w, 3) uint8.
    :param extractor: extractor of their features; the map records its settings.
    :param poses: pose of each image, shape (images, 7), see :class:`Map`; or by their stamps.
    :param thumbnails: keep a small image of each place.
    :param progress: show a progress bar.
    :param keyframes: minimum differences between places; None = every image is one.
    :param thumbnail_width: pixels.
    :raises InputError: no images, no places, poses that do not fit, or another type of argument.
    :raises SettingsError: a rule of motion without poses.
    """
    images: object = frames
    if isinstance(images, (str, bytes)) or not isinstance(images, Iterable):
        raise InputError(f'frames is {images!r}: expected open_source(path), or another sequence')
    if getattr(images, 'ndim', 4) != 4:
        raise InputError(f'frames is one {type(images).__name__}: expected a list of images')
    require_type('extractor', extractor, FeatureExtractor, 'a FeatureExtractor(...)')
    if isinstance(frames, Images):
        frames = frames.source
    fit_value_range(frames, extractor)
    features: list[LocalFeatures] = []
    rows: list[tuple[Place, bytes]] = []
    options = keyframes, thumbnail_width if thumbnails else None
    with closing(_extract(frames, extractor, poses, *options, progress)) as batches:
        for batch, extracted in batches:
            features.append(extracted)
            rows += [(row.place, row.thumbnail) for row in batch]
    places, encoded = zip(*rows, strict=True)
    unknown = np.full(7, np.nan)
    pose_rows = np.array([unknown if place.pose is None else place.pose for place in places])
    return Map(
        features=LocalFeatures.concatenate(features),
        projection=extractor.projection,
        stamps=np.array([place.stamp for place in places], np.int64),
        ids=tuple(place.identifier for place in places),
        poses=None if np.isnan(pose_rows).all() else pose_rows,
        thumbnails=encoded if thumbnails else (),
    )


def build_journal(
    frames: Iterable[Frame | np.ndarray],
    extractor: FeatureExtractor,
    target: str | Path,
    source: str,
    poses: np.ndarray | Trajectory | None = None,
    thumbnails: bool = True,
    progress: bool = True,
    keyframes: KeyframeSettings | None = None,
    thumbnail_width: int = THUMBNAIL_WIDTH,
) -> Path:
    """
    Make a journal of the places that :func:`build_map` finds, in bounded memory.

    An interrupted work is continued: images up to the last place in the journal are not extracted
    again.

    :param target: file that the map will be saved to; the journal is beside it.
    :param source: name of the images and the options; another one is not continued.
    :returns: the journal, complete.
    :raises JournalError: the journal is of another work, in use, or cannot be written.
    """
    writer, last = _resume(Path(f'{target}{SUFFIX}'), extractor, source)
    options = keyframes, thumbnail_width if thumbnails else None
    try:
        with closing(_extract(frames, extractor, poses, *options, progress, last)) as batches:
            for batch, features in batches:
                if writer is None:
                    template = Map(
                        features[:1], extractor.projection, np.zeros(1, np.int64), ('',)
                    )
                    writer = JournalWriter.create(target, Base(), template, _ignore, source)
                for i, (number, _, place, thumbnail) in enumerate(batch):
                    writer.append(JournalPlace(number, place, features[i : i + 1], thumbnail))
                if writer.failed:
                    raise JournalError(
                        f'{writer.path} cannot be written: make room, and run the same again: it '
                        'continues'
                    )
    finally:
        if writer is not None:
            writer.close()
    assert writer is not None
    return writer.path


def _resume(
    journal: Path, extractor: FeatureExtractor, source: str
) -> tuple[JournalWriter | None, int]:
    """Return the writer of a journal to be continued, and the number of its last image."""
    if not journal.exists():
        return None, -1
    reader = JournalReader(journal)
    if reader.source != source or reader.template.settings != extractor.settings:
        reader.close()
        raise JournalError(
            f'{journal} is of other images or options: run build_map with those to continue it, '
            'make a map of it by `stavpr map recover`, or delete it'
        )
    return JournalWriter.resume(reader, _ignore)


def _ignore(error: str) -> None:
    """Leave an error of the journal to :func:`build_journal`."""


def _extract(
    frames: Iterable[Frame | np.ndarray],
    extractor: FeatureExtractor,
    poses: np.ndarray | Trajectory | None,
    keyframes: KeyframeSettings | None,
    thumbnail_width: int | None,
    progress: bool,
    last: int = -1,
) -> Generator[tuple[list[_Place], LocalFeatures], None, None]:
    """Yield batches of places behind the image of number ``last``, with their features."""
    selector = KeyframeSelector(keyframes or KeyframeSettings())
    if selector.settings.needs_poses and poses is None:
        raise SettingsError(
            'keyframe distance or angle without poses: give poses, or leave them out'
        )
    if thumbnail_width is not None:
        require_at_least('thumbnail width', thumbnail_width, 1, 'pixel')
    source: Any = getattr(frames, 'source', frames)  # a part of a source has the whole
    if hasattr(source, 'min_size'):  # as in the node
        source.min_size = extractor.needed_size(thumbnail_width or 0)
    total = len(frames) if isinstance(frames, Sized) else None
    places = _places(_with_poses(frames, poses), selector, thumbnail_width, last)
    with (
        closing(_batches_ahead(places)) as batches,
        Progress(total=total, unit='image', desc='extracting', disable=not progress) as bar,
    ):
        for batch in batches:
            yield batch, extractor.extract([row.image for row in batch])
            bar.update(batch[-1].number + 1 - bar.n)


def _batches_ahead(places: Generator[_Place, None, None]) -> Generator[list[_Place], None, None]:
    """Yield batches; one other thread makes the next batch in the meantime."""

    def take() -> list[_Place]:
        return list(islice(places, BATCH))

    with ThreadPoolExecutor(1, 'decoding') as pool:
        try:
            following = pool.submit(take)
            while batch := following.result():
                following = pool.submit(take)
                yield batch
        finally:
            # a bag's database must be closed by the thread that opened it
            pool.submit(places.close).result()


def _places(
    frames: Iterable[tuple[Frame, np.ndarray | None]],
    selector: KeyframeSelector,
    thumbnail_width: int | None,
    last: int,
) -> Generator[_Place, None, None]:
    """Choose the images that become places, behind the last place of an earlier run, -1 = none."""
    images, places, reason = 0, int(last >= 0), ''
    for number, (frame, pose) in enumerate(frames):
        images += 1
        if number < last:
            continue
        if number > last:
            reason = selector.too_soon(frame.stamp, pose) or selector.too_alike(frame.image)
            if reason:
                continue
        if selector.settings.any:
            selector.accept(frame.stamp, pose, frame.image)
        if number > last:
            places += 1
            place = Place(frame.stamp, plain_text(frame.identifier), pose)
            thumbnail = encode_thumbnail(frame.image, thumbnail_width) if thumbnail_width else b''
            yield _Place(number, frame.image, place, thumbnail)
    if not images:
        raise InputError('no images to build a map from: the source is empty')
    if not places:
        raise InputError(f'none of {images} images became a place; the last one: {reason}')


def _with_poses(
    images: Iterable[Frame | np.ndarray], poses: np.ndarray | Trajectory | None
) -> Iterator[tuple[Frame, np.ndarray | None]]:
    frames = (_frame(image, number) for number, image in enumerate(images))
    if poses is None:
        yield from ((frame, None) for frame in frames)
    elif isinstance(poses, Trajectory):
        yield from ((frame, poses.at(frame.stamp)) for frame in frames)
    else:
        require_type('poses', poses, np.ndarray, 'an array (images, 7), or a Trajectory')
        require_shape('poses', poses, 'images 7')
        count = 0
        for count, frame in enumerate(frames, 1):
            if count <= len(poses):
                yield frame, _pose(poses[count - 1], f'image {count - 1} {frame.identifier!r}')
        if count != len(poses):
            raise InputError(f'{len(poses)} poses for {count} images: expected one each')


def _frame(image: Frame | np.ndarray, number: int) -> Frame:
    """Return an image as a frame; its stamp and its name are those that the array carries."""
    if isinstance(image, Frame):
        return image
    name = getattr(image, 'name', f'image {number}')
    try:
        return Frame(image, getattr(image, 'stamp', 0), name)
    except InputError as error:
        raise InputError(f'image {number}: {error}') from error


def _pose(row: np.ndarray, name: str) -> np.ndarray | None:
    if np.isnan(row).all():
        return None
    try:
        return normalize_pose(row)
    except InputError as error:
        raise InputError(f'{name}: {error}') from error
