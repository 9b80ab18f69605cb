"""The reference map: the local features of the places of a route, and what is known about each place."""

from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np

from stavpr_ros.errors import InputError
from stavpr_ros.features import Describer, FeatureSettings, LocalFeatures, Projection


@dataclass(frozen=True)
class PlaceMap:
    """
    Places in the order in which they were passed; place i is column i of everything.

    :param features: local features of n places, strips (W, n, d).
    :param projection: the random projection of the features, if they have one.
    :param stamps: when each place was seen, ns, shape (n,), int64; 0 = unknown.
    :param ids: external identifiers, n strings; '' = none.
    :param poses: x y z (metres) and quaternion x y z w of each place, shape (n, 7), float64, or None.
    :param thumbnails: a small JPEG of each place, n byte strings; empty = none kept.
    """

    features: LocalFeatures
    projection: Projection | None
    stamps: np.ndarray
    ids: tuple[str, ...]
    poses: np.ndarray | None = None
    thumbnails: tuple[bytes, ...] = field(default=(), repr=False)

    def __post_init__(self) -> None:
        n = len(self.features)
        if n != len(self.stamps) or n != len(self.ids):
            raise InputError(
                f'{n} places, {len(self.stamps)} stamps, {len(self.ids)} ids: expected one a place'
            )
        if self.poses is not None and self.poses.shape != (n, 7):
            raise InputError(f'poses have shape {self.poses.shape}: expected ({n}, 7)')
        if self.poses is not None and not np.isfinite(self.poses).all():
            raise InputError('poses hold NaN or infinite numbers: expected metres and quaternions')
        if len(self.thumbnails) not in (0, n):
            raise InputError(f'{len(self.thumbnails)} thumbnails for {n} places: expected all or none')
        identity = self.projection.identity if self.projection else None
        if identity != self.settings.projection:
            raise InputError(f'projection {identity} is not that of the features, {self.settings.projection}')

    def __len__(self) -> int:
        return len(self.features)

    @property
    def settings(self) -> FeatureSettings:
        """How the features were made."""
        return self.features.settings

    @cached_property
    def has_stamps(self) -> bool:
        """Any place has a stamp."""
        return bool(np.any(self.stamps))

    @cached_property
    def has_ids(self) -> bool:
        """Any place has an external identifier."""
        return any(self.ids)

    def describer(self, device: str = 'cpu', model: str = '') -> Describer:
        """
        Make the describer for queries: the one that this map's features were made with.

        :param model: where the network's file lies now, if it is not where it was.
        :raises FeatureMismatchError: the file is not the map's.
        """
        return Describer.from_settings(self.settings, self.projection, device, model=model)

    def thumbnail(self, place: int) -> np.ndarray | None:
        """Return the small picture of a place, RGB (h, w, 3) uint8, or None."""
        if not self.thumbnails:
            return None
        picture = cv2.imdecode(np.frombuffer(self.thumbnails[place], np.uint8), cv2.IMREAD_COLOR)
        return None if picture is None else cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


def encode_thumbnail(image: np.ndarray, width: int = 192) -> bytes:
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
