# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The reference map: local features, stamps, identifiers, poses, thumbnails of places."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
import math
from pathlib import Path
from typing import Any, ClassVar, TYPE_CHECKING

import cv2
import numpy as np
from stavpr_ros import former
from stavpr_ros.checks import require_at_least, require_shape, require_type, rgb_image
from stavpr_ros.errors import InputError, MapFileError
from stavpr_ros.features import FeatureExtractor, FeatureSettings, LocalFeatures, Projection
from stavpr_ros.mapping.camera import Camera
from stavpr_ros.mapping.jpeg import jpeg_pixels, MAX_THUMBNAIL_PIXELS
from stavpr_ros.sources import open_source
from stavpr_ros.units import SECOND

if TYPE_CHECKING:
    from stavpr_ros.output_file import Force

THUMBNAIL_WIDTH = 192  # pixels
MAX_SECONDS = 2**31  # stamp, since 1970: the range of ROS messages
MAX_ID = 4096  # characters


@dataclass(frozen=True)
class ErrorRisks:
    """
    Rates of wrong matches of drives on a map, by the probability above which it is matched.

    ``max_error`` is kept by them; docs/map_format.md.

    :param method: settings of recognition that they were measured with.
    :param units: blocks of images n that were driven, at least 1.
    :param probabilities: above which images are matched, ascending, between 0 and 1, k of them.
    :param risks: for each of these, the sum of the n blocks' rates; never ascending, k.
    :param recordings: hashes of the queries that were driven.
    :raises InputError: other values.
    """

    method: str
    units: int
    probabilities: tuple[float, ...]
    risks: tuple[float, ...]
    recordings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        p, risks = np.array(self.probabilities, float), np.array(self.risks, float)
        valid = p.shape == risks.shape and (np.diff(p) > 0).all() and (np.diff(risks) <= 0).all()
        # compared so that NaN is rejected
        if not (valid and p.size and 0 < p[0] <= p[-1] < 1 and risks[-1] >= 0):
            raise InputError(
                'error risks: expected ascending probabilities between 0 and 1, and as many '
                'risks, at least 0, none above the one before'
            )
        if not risks[0] <= self.units or self.units < 1:
            raise InputError(f'error risks {risks[0]} of {self.units} blocks: at most 1 each')

    @property
    def bounds(self) -> np.ndarray:
        """
        Return the rate that each probability keeps, shape (k,), by conformal risk control.

        For a block exchangeable with the n, the expected rate of wrong matches is below it.
        """
        return (np.array(self.risks) + 1) / (self.units + 1)


@dataclass(frozen=True)
class Session:
    """
    One drive of several in a map, or one camera of a drive with several.

    :param id: unique in the map.
    :param name: for people, '' = none.
    :param robot: id of the robot, '' = unknown.
    :param start: time of its first image, ns, 0 = unknown.
    :param camera: name of the camera, such as ``rear``, '' = unknown.
    :param yaw: yaw of its optical axis in the base of the robot, radians to the left (REP-103),
        pi = backward; None = unknown.
    :param intrinsics: its camera, where the cameras of the map differ; None = the map's.
    """

    id: str
    name: str = ''
    robot: str = ''
    start: int = 0
    camera: str = ''
    yaw: float | None = None
    intrinsics: Camera | None = None


@dataclass(frozen=True)
class Place:
    """
    Stamp, pose and names of a place.

    :param stamp: ns, 0 = unknown.
    :param identifier: external identifier, '' = none.
    :param pose: x y z (meters) and quaternion x y z w, shape (7,), or None.
    :param session: id of its session, '' = unknown.
    """

    stamp: int = 0
    identifier: str = ''
    pose: np.ndarray | None = None
    session: str = ''


@dataclass(frozen=True)
class Map:
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
    :param sessions: the drives that the places are of; empty = one drive, nothing known of it.
    :param session_index: number of each place's session, shape (n,), int32; None without sessions.
    :param camera: camera of its images; None = unknown, or each session has another.
    :param same_as: of each place, itself, or the place of an earlier session, or of the start of a
        closed route, that shows the same, shape (n,), int32; None = unknown. By
        :mod:`stavpr_ros.maintenance.same_places`.
    :param threshold: distance below which mode paper matches where its own is not set, above 0; as
        :func:`stavpr_ros.maintenance.threshold.suggest_threshold` returns it; None = unknown.
    :param map_id: first 16 hexadecimal digits of the hash of its file's content, '' = it was not
        read from a file.
    :param error_risks: rates of drives on this map, for ``max_error``; None = unknown.
    """

    partial: ClassVar[bool] = False  # places are fetched from elsewhere on use
    features: LocalFeatures
    projection: Projection | None
    stamps: np.ndarray
    ids: tuple[str, ...]
    poses: np.ndarray | None = None
    thumbnails: Sequence[bytes] = ()
    sessions: tuple[Session, ...] = ()
    session_index: np.ndarray | None = None
    camera: Camera | None = None
    same_as: np.ndarray | None = None
    threshold: float | None = None
    map_id: str = ''
    error_risks: ErrorRisks | None = None

    def __post_init__(self) -> None:
        n = len(self.features)
        require_shape('stamps', self.stamps, f'{n}', 'int64')
        if len(self.ids) != n:
            raise InputError(f'{len(self.ids)} ids for {n} places: expected one a place')
        if self.poses is not None:
            require_shape('poses', self.poses, f'{n} 7')
            _require_whole_rows(self.poses)
        if len(self.thumbnails) not in (0, n):
            raise InputError(
                f'{len(self.thumbnails)} thumbnails for {n} places: expected all or none'
            )
        seconds = self.stamps // SECOND
        if n and not -MAX_SECONDS <= seconds.min() <= seconds.max() < MAX_SECONDS:
            raise InputError('a stamp is out of range: expected ns of at most 2**31 seconds')
        _require_texts(self.ids)
        _require_sessions(self.sessions, self.session_index, n)
        _require_same_as(self.same_as, n)
        if self.threshold is not None and not 0 < self.threshold < math.inf:
            raise InputError(f'threshold = {self.threshold}: expected a distance above 0')
        require_projection(self.projection, self.settings)

    # What makes and stores maps imports this module: it is imported on use.

    @staticmethod
    def from_images(
        source: str | Path | Iterable[Any],
        features: str | FeatureSettings | FeatureExtractor = 'auto',
        **options: Any,
    ) -> 'Map':
        """
        Make a map of the images of a route, a place each; each of several laps is a session.

        :param source: path of a folder of images, a video or a bag; :func:`stavpr_ros.images` of
            it, which has options; or RGB arrays (h, w, 3), uint8.
        :param features: their kind, such as ``gradient``, or ``auto``: ``hybrid`` where its
            network is there; or the settings of another map's; or an extractor.
        :param options: see :func:`stavpr_ros.mapping.build_map`, such as ``poses``, ``keyframes``.
        :raises InputError: no images, or an item that is no image, and how to convert it.
        :raises SourceError: the source cannot be read, or has no images.
        """
        from stavpr_ros.maintenance.same_places import with_repeats
        from stavpr_ros.mapping.builder import build_map

        kinds = (str, FeatureSettings, FeatureExtractor)
        require_type('features', features, kinds, "a kind, such as 'gradient', or an extractor")
        if isinstance(features, FeatureSettings):
            features = FeatureExtractor.from_settings(features, None)
        elif isinstance(features, str):
            features = FeatureExtractor(features)
        frames: Any = open_source(source) if isinstance(source, (str, Path)) else source
        return with_repeats(build_map(frames, features, **options))

    @staticmethod
    def load(path: str | Path) -> 'Map':
        """Read a map from its file: :func:`stavpr_ros.mapping.load_map`."""
        from stavpr_ros.mapping.map_file import load_map

        return load_map(path)

    def save(self, path: str | Path, storage: str = '', force: 'Force' = False) -> str:
        """Write the map to a file, return its id: :func:`stavpr_ros.mapping.save_map`."""
        from stavpr_ros.mapping.map_file import save_map

        return save_map(self, path, storage, force)

    def __len__(self) -> int:
        return len(self.features)

    def __repr__(self) -> str:
        parts = {
            'poses': self.has_poses,
            'thumbnails': len(self.thumbnails),
            'sessions': len(self.sessions),
        }
        names = ''.join(f', {name}' for name, value in parts.items() if value)
        return f'Map({len(self)} places, {self.features!r}{names})'

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
        """Return whether any place has a pose."""
        return self.poses is not None and not bool(np.isnan(self.poses[:, 0]).all())

    def pose(self, place: int) -> np.ndarray | None:
        """Return the pose of a place, shape (7,), or None where it is unknown."""
        if self.poses is None or np.isnan(self.poses[place, 0]):
            return None
        return self.poses[place]

    def place(self, index: int) -> Place:
        """Return stamp, identifier, pose and session of a place."""
        session = self.session(index)
        return Place(
            int(self.stamps[index]),
            self.ids[index],
            self.pose(index),
            session.id if session is not None else '',
        )

    @property
    def seam(self) -> int | None:
        """Return the place that the last one of a closed route shows, None of another map."""
        if self.same_as is None or len(self.sessions) > 1 or not len(self):
            return None
        place = int(self.same_as[-1])
        return place if 2 * place < len(self) - 1 else None

    def session(self, place: int) -> Session | None:
        """Return the session that a place is of, None without sessions."""
        return None if self.session_index is None else self.sessions[self.session_index[place]]

    def camera_of(self, place: int) -> Camera | None:
        """Return the camera of a place's image, None = unknown."""
        session = self.session(place)
        return (session.intrinsics if session is not None else None) or self.camera

    def extractor(self, device: str = 'cpu', model: str = '') -> FeatureExtractor:
        """
        Make the extractor for queries, with the settings of this map.

        :param model: the network's file, or a folder with it; '' = in the models folder.
        :raises FeatureMismatchError: the file is not the map's.
        :raises UnavailableError: the file is not there.
        """
        return FeatureExtractor.from_settings(self.settings, self.projection, device, model)

    def thumbnail(self, place: int) -> np.ndarray | None:
        """Return the thumbnail of a place, RGB (h, w, 3) uint8, or None."""
        try:
            return decode_thumbnail(self.thumbnails[place]) if len(self.thumbnails) else None
        except MapFileError:  # the file has been overwritten since it was opened
            return None


def descriptor_map(features: LocalFeatures, poses: np.ndarray | None = None) -> Map:
    """
    Make a map of features whose images are unknown, such as descriptors from a file.

    :param poses: shape (n, 7), see :class:`Map`.
    """
    n = len(features)
    return Map(features, None, np.zeros(n, np.int64), ('',) * n, poses)


def require_projection(projection: Projection | None, settings: FeatureSettings) -> None:
    """Raise InputError if the settings of the features name another projection."""
    identity = projection.identity if projection else None
    if identity != settings.projection:
        raise InputError(
            f'projection {identity} is another than the features have, {settings.projection}'
        )


def _require_whole_rows(poses: np.ndarray) -> None:
    """Reject rows of poses that are only partly known."""
    bad = np.flatnonzero(~(np.isfinite(poses).all(axis=1) | np.isnan(poses).all(axis=1)))
    if len(bad):
        raise InputError(
            f'the pose of place {bad[0]} (and {len(bad) - 1} others) is {poses[bad[0]].tolist()}: '
            'expected 7 finite numbers, or 7 times NaN where it is unknown'
        )
    bad = np.flatnonzero(abs(np.linalg.norm(poses[:, 3:], axis=1) - 1) > 0.01)
    if len(bad):
        raise InputError(
            f'the quaternion of place {bad[0]} is {poses[bad[0], 3:].tolist()}: expected norm 1'
        )


def _require_texts(ids: tuple[str, ...]) -> None:
    """Reject identifiers that cannot be published."""
    for place, identifier in enumerate(ids):
        if identifier and (len(identifier) > MAX_ID or identifier != plain_text(identifier)):
            raise InputError(
                f'the identifier of place {place} is {identifier[:80]!a}: expected at most '
                f'{MAX_ID} characters, without NUL and lone surrogates'
            )


def plain_text(text: str) -> str:
    """Replace what cannot be published in a text: NUL, and bytes of a name that is not UTF-8."""
    return text.replace('\0', '?').encode(errors='replace').decode()


def _require_sessions(sessions: tuple[Session, ...], index: np.ndarray | None, n: int) -> None:
    if not sessions and index is None:
        return
    if index is None:
        raise InputError(f'{len(sessions)} sessions without a session index: give one, ({n})')
    require_shape('session index', index, f'{n}', 'int32')
    if n and not 0 <= index.min() <= index.max() < len(sessions):
        raise InputError(f'the session index is not between 0 and {len(sessions) - 1}')
    ids = [session.id for session in sessions]
    if not all(ids) or len(set(ids)) < len(ids):
        raise InputError(f'sessions have the ids {ids[:8]}: expected different ones, none empty')


def _require_same_as(same_as: np.ndarray | None, n: int) -> None:
    if same_as is None:
        return
    require_shape('same_as', same_as, f'{n}', 'int32')
    if n and (same_as.min() < 0 or (same_as > np.arange(n)).any()):
        raise InputError('same_as: expected of each place itself or an earlier one')
    if (same_as[same_as] != same_as).any():
        raise InputError('same_as names a place that is the same as another one, not as itself')


def thumbnail_of(image: np.ndarray, width: int = THUMBNAIL_WIDTH) -> np.ndarray:
    """
    Return an image at the size of a thumbnail.

    :param image: RGB (h, w, 3) uint8.
    :param width: pixels; narrower images keep their size.
    :raises InputError: another image.
    """
    image = rgb_image(image)
    require_at_least('width of thumbnails', width, 1, 'pixel')
    max_scale = math.sqrt(MAX_THUMBNAIL_PIXELS / 2 / (image.shape[0] * image.shape[1]))
    scale = min(1.0, width / image.shape[1], max_scale)
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def resized(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return an image at a width and a height; its pixels are averaged where it is wider."""
    shrinks = image.shape[1] > size[0]
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def encode_thumbnail(image: np.ndarray, width: int = THUMBNAIL_WIDTH) -> bytes:
    """Return :func:`thumbnail_of` an image as a JPEG."""
    return encode_jpeg(thumbnail_of(image, width), 85)


def encode_jpeg(image: np.ndarray, quality: int) -> bytes:
    """Return an image, RGB (h, w, 3) uint8, as a JPEG."""
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    return cv2.imencode('.jpg', bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def decode_thumbnail(content: bytes) -> np.ndarray | None:
    """Return the image of a thumbnail, RGB (h, w, 3) uint8; None of an empty or damaged one."""
    data = np.frombuffer(content, np.uint8)
    if not 0 < jpeg_pixels(data, np.array([len(data)]))[0] <= MAX_THUMBNAIL_PIXELS:
        return None
    image = cv2.imdecode(data, cv2.IMREAD_COLOR)
    return None if image is None else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


if not TYPE_CHECKING:
    __getattr__ = former.classes(__name__)
