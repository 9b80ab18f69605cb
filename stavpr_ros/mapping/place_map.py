# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The reference map: local features, stamps, identifiers, poses, thumbnails of places."""

from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from stavpr_ros.errors import InputError
from stavpr_ros.features import FeatureExtractor, FeatureSettings, LocalFeatures, Projection

THUMBNAIL_WIDTH = 192  # pixels


@dataclass(frozen=True)
class Place:
    """
    Stamp, identifier and pose of a place.

    :param stamp: ns, 0 = unknown.
    :param identifier: external identifier, '' = none.
    :param pose: x y z (meters) and quaternion x y z w, shape (7,), or None.
    """

    stamp: int = 0
    identifier: str = ''
    pose: np.ndarray | None = None


@dataclass(frozen=True)
class PlaceMap:
    """
    Places in the order of the route; place i is column i of everything.

    :param features: local features of n places, strips (W, n, d); in memory, or in the map's file
        (:func:`stavpr_ros.mapping.open_map`).
    :param projection: the random projection of the features, if they have one.
    :param stamps: time of its image, ns, shape (n,), int64; 0 = unknown.
    :param ids: external identifiers, n strings; '' = none.
    :param poses: x y z (meters) and quaternion x y z w of each place, shape (n, 7), float64; a row
        of NaN = unknown for that place; None = unknown for all.
    :param thumbnails: a small JPEG of each place, n byte strings, an empty one = none of that
        place; empty = none kept.
    :param map_id: first 16 hexadecimal digits of the hash of the content of its file, '' = it was
        not read from a file.
    """

    features: LocalFeatures
    projection: Projection | None
    stamps: np.ndarray
    ids: tuple[str, ...]
    poses: np.ndarray | None = None
    thumbnails: tuple[bytes, ...] = field(default=(), repr=False)
    map_id: str = ''

    def __post_init__(self) -> None:
        n = len(self.features)
        if n != len(self.stamps) or n != len(self.ids):
            raise InputError(
                f'{n} places, {len(self.stamps)} stamps, {len(self.ids)} ids: expected one a place'
            )
        if self.poses is not None and self.poses.shape != (n, 7):
            raise InputError(f'poses have shape {self.poses.shape}: expected ({n}, 7)')
        if self.poses is not None:
            _require_whole_rows(self.poses)
        if len(self.thumbnails) not in (0, n):
            raise InputError(
                f'{len(self.thumbnails)} thumbnails for {n} places: expected all or none'
            )
        require_projection(self.projection, self.settings)

    def __len__(self) -> int:
        return len(self.features)

    @property
    def settings(self) -> FeatureSettings:
        """Return the settings of the features."""
        return self.features.settings

    @property
    def dimension(self) -> int:
        """Return the number d of dimensions of a strip."""
        return self.features.dimension

    @cached_property
    def has_poses(self) -> bool:
        """Any place has a pose."""
        return self.poses is not None and not bool(np.isnan(self.poses[:, 0]).all())

    def pose(self, place: int) -> np.ndarray | None:
        """Return the pose of a place, shape (7,), or None where it is unknown."""
        if self.poses is None or np.isnan(self.poses[place, 0]):
            return None
        return self.poses[place]

    def place(self, index: int) -> Place:
        """Return stamp, identifier and pose of a place."""
        return Place(int(self.stamps[index]), self.ids[index], self.pose(index))

    def extractor(self, device: str = 'cpu', model: str = '') -> FeatureExtractor:
        """
        Make the extractor for queries, with the settings of this map.

        :param model: path of the network's file, if it has moved.
        :raises FeatureMismatchError: the file is not the map's.
        """
        return FeatureExtractor.from_settings(self.settings, self.projection, device, model=model)

    def thumbnail(self, place: int) -> np.ndarray | None:
        """Return the thumbnail of a place, RGB (h, w, 3) uint8, or None."""
        return decode_thumbnail(self.thumbnails[place]) if self.thumbnails else None


def require_projection(projection: Projection | None, settings: FeatureSettings) -> None:
    """
    Reject another projection than that of the features.

    :raises InputError: names both.
    """
    identity = projection.identity if projection else None
    if identity != settings.projection:
        raise InputError(
            f'projection {identity} is not that of the features, {settings.projection}'
        )


def _require_whole_rows(poses: np.ndarray) -> None:
    """Reject rows of poses that are only partly known."""
    bad = np.flatnonzero(~(np.isfinite(poses).all(axis=1) | np.isnan(poses).all(axis=1)))
    if len(bad):
        raise InputError(
            f'the pose of place {bad[0]} (and {len(bad) - 1} others) is {poses[bad[0]].tolist()}: '
            'expected 7 '
            'finite numbers, or 7 times NaN where it is unknown'
        )


def encode_thumbnail(image: np.ndarray, width: int = THUMBNAIL_WIDTH) -> bytes:
    """
    Return a small JPEG of an image.

    :param image: RGB (h, w, 3) uint8.
    :param width: pixels; narrower images keep their size.
    """
    scale = min(1.0, width / image.shape[1])
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    done, encoded = cv2.imencode(
        '.jpg', cv2.cvtColor(small, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 85]
    )
    if not done:
        raise InputError(f'no JPEG could be made of an image of shape {image.shape}')
    return encoded.tobytes()


def decode_thumbnail(content: bytes) -> np.ndarray | None:
    """Return the image of a thumbnail, RGB (h, w, 3) uint8; None of an empty or damaged one."""
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR) if content else None
    return None if image is None else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
