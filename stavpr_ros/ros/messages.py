# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Conversions between messages and the types of the library; no publishers."""

import array
from copy import copy
from dataclasses import dataclass
from functools import cached_property
import importlib.util
import math
from pathlib import Path
import re
from typing import Any, TypeVar

from builtin_interfaces.msg import Time
from geometry_msgs.msg import (
    Pose,
    PoseWithCovariance,
    PoseWithCovarianceStamped,
    TransformStamped,
)
import numpy as np
from sensor_msgs.msg import CameraInfo, Image
from stavpr_msgs.msg import (
    AlignedPair,
    AlignedPlaces,
    LoopClosure,
    MapInfo,
    PlaceCandidate,
    PlaceCandidates,
    PlaceMatch,
    RelativePose,
)
from stavpr_ros.errors import UnavailableError
from stavpr_ros.mapping import GrowingMap, Map, Place
from stavpr_ros.mapping.camera import Camera
from stavpr_ros.mapping.map_version2 import VERSION
from stavpr_ros.mapping.transforms import turn_pose
from stavpr_ros.method import Match
from stavpr_ros.pipeline import Pipeline
from stavpr_ros.pipeline.result import ImageResult
from stavpr_ros.relative_pose.pair import Edge
from stavpr_ros.sources.frame import ImageRecord
from stavpr_ros.units import SECOND, WRAP
from std_msgs.msg import Header

MIN_VARIANCE = 0.01  # of a pose: (0.1 m)^2 and (0.1 rad)^2
SHORT = 0.05  # meters along the path that have no direction
BESIDE = (
    1.75  # deviation of the lateral offset, m: on the other lane, 3.5 m, the place matches too
)


@dataclass(frozen=True)
class Surroundings:
    """
    Frames, pose and camera of an image, beside its message; '' and None = unknown.

    :param frame: of the poses of the places.
    :param child: frame of the base, whose poses they are.
    :param odometry_frame: of the poses of the odometry.
    :param pose: of the base at the stamp of the image, from odometry, shape (7,).
    :param camera: of the image.
    """

    frame: str = ''
    child: str = ''
    odometry_frame: str = ''
    pose: np.ndarray | None = None
    camera: Camera | None = None


NOTHING_KNOWN = Surroundings()
# copied and shared, never changed: rosidl makes all messages of a message to construct it
NO_EDGE = RelativePose(query_index=-1, place_index=-1, inliers=-1, reprojection_error=math.nan)
_NO_MATCH = PlaceMatch(relative_pose=NO_EDGE)

Message = TypeVar('Message')
Places = Map | GrowingMap | None


@dataclass(frozen=True)
class Outcome:
    """
    All that is published of one image.

    :param header: of the image.
    :param places: the map, or the route, that the indices of the match refer to.
    :param about: what is known of the image beside.
    :param robot_id: the parameter of this name.
    :param edge: of the middle pair, None = none.
    """

    header: Header
    result: ImageResult
    places: Places = None
    about: Surroundings = NOTHING_KNOWN
    robot_id: str = ''
    edge: Edge | None = None

    @property
    def match(self) -> Match:
        """Return the match of the image."""
        return self.result.match

    @property
    def map_id(self) -> str:
        """Return the map that indices refer to, '' = it is in no file."""
        return '' if self.places is None else self.places.map_id

    @property
    def place_map(self) -> Map | None:
        """Return the map that the image was matched with; None = a route."""
        return self.places if isinstance(self.places, Map) else None

    @cached_property
    def newest(self) -> Place | None:
        """Return the place of the newest image; None without a match."""
        if self.places is None or not self.match.accepted:
            return None
        return self.places.place(self.match.newest)

    @property
    def newest_pose(self) -> np.ndarray | None:
        """Return the pose of the robot at the place of the newest image, (7,); None = unknown."""
        if self.newest is None or self.newest.pose is None:
            return None
        return turn_pose(self.newest.pose, self.result.relative_yaw)


def fill(message: Message, *sources: object, **fields: Any) -> Message:
    """
    Set the fields of a message, and return it.

    :param sources: objects; a field is the attribute of its name of the first that has one.
    :param fields: the exceptions, by name.
    """
    for name in message.get_fields_and_field_types():  # type: ignore[attr-defined]
        if name in fields:
            setattr(message, name, fields[name])
        elif (source := next((row for row in sources if hasattr(row, name)), None)) is not None:
            setattr(message, name, getattr(source, name))
    return message


def time_message(nanoseconds: int) -> Time:
    """Return a time as a message; 0 means unknown."""
    seconds = (int(nanoseconds) // SECOND + WRAP // 2) % WRAP - WRAP // 2
    return Time(sec=seconds, nanosec=int(nanoseconds) % SECOND)


def nanoseconds(time: Time) -> int:
    """Return a time in nanoseconds."""
    return int(time.sec) % WRAP * SECOND + int(time.nanosec)


def pose_message(pose: np.ndarray) -> Pose:
    """Return x y z and quaternion x y z w, shape (7,), as a message."""
    message = Pose()
    message.position.x, message.position.y, message.position.z = map(float, pose[:3])
    o = message.orientation
    o.x, o.y, o.z, o.w = map(float, pose[3:])
    return message


def match_message(outcome: Outcome) -> PlaceMatch:
    """Return the message of a result."""
    header, match, places = outcome.header, outcome.match, outcome.places
    path, stamps = match.path, match.window_stamps
    middle = (len(stamps) - 1) // 2
    message = fill(
        copy(_NO_MATCH),
        match,
        outcome,
        place_index=match.place,
        newest_index=outcome.result.own_place,
        window_first=time_message(stamps[0]) if stamps else header.stamp,
        window_middle=time_message(stamps[middle]) if stamps else header.stamp,
        window_last=header.stamp,
        sequence_first=path.first,
        sequence_last=path.last,
        sequence_middle=path.place,
        direction=path.direction if path.place >= 0 else 0,
        path_probabilities=match.path_probabilities.tolist(),
        path=[AlignedPair(query_index=q, place_index=m) for q, m in path.pairs.tolist()],
        second_best_index=path.second_best,
        second_best_distance=path.second_best_distance,
        relative_yaw=outcome.result.relative_yaw,
    )
    if (newest := outcome.newest) is None or places is None:
        return message
    session = places.session(match.place) if isinstance(places, Map) else None
    fill(
        message,
        **_names(places.place(match.place)),
        camera='' if session is None else session.camera,
        newest_stamp=time_message(newest.stamp),
        newest_id=newest.identifier,
    )
    if (edge := outcome.edge) is not None:
        message.has_relative_pose = edge.has_pose
        pair = _align(match, places, middle, match.place)
        message.relative_pose = relative_pose_message(edge, pair, outcome.about.child)
    return message


def _align(match: Match, places: Map | GrowingMap, query: int, place: int) -> AlignedPlaces:
    """Return an image of the window with a place; on a route, the image is a place as well."""
    first = match.first_image
    stamp = places.place(first + query).stamp if first >= 0 else match.window_stamps[query]
    return AlignedPlaces(
        query_index=first + query if first >= 0 else -1,
        query_stamp=time_message(stamp),
        place_index=place,
        place_stamp=time_message(places.place(place).stamp),
        query_change=match.window_changes[query] if match.window_changes else math.nan,
    )


def _names(place: Place) -> dict[str, Any]:
    """Return the fields that name a place beside its index."""
    stamp = time_message(place.stamp)
    return {'place_stamp': stamp, 'place_id': place.identifier, 'session': place.session}


def candidates_message(outcome: Outcome) -> PlaceCandidates | None:
    """Return the message of the candidates of a match, None without any."""
    result, places = outcome.result, outcome.places
    if not result.candidates or places is None:
        return None
    candidates = [
        fill(
            PlaceCandidate(),
            candidate,
            place_index=candidate.place,
            **_names(places.place(candidate.place)),
        )
        for candidate in result.candidates
    ]
    return fill(
        PlaceCandidates(), outcome, result.match,
        candidates=candidates, session_probabilities=list(result.session_probabilities),
    )  # fmt: skip


def loop_closure_message(
    outcome: Outcome, match: Match, query_pose: np.ndarray | None = None
) -> LoopClosure | None:
    """
    Return the loop closure of a match, without its edge; None without a match.

    The images of the window are places of a route, or the places are of a map. Sessions of the
    maps of several robots are named by their ``robot_id``.

    :param match: of the image, or one of its late ones.
    :param query_pose: of the odometry, at the image that matched, shape (7,); for maps only, a
        route has it.
    """
    places, about = outcome.places, outcome.about
    if not match.accepted or places is None:
        return None
    header, place, is_route = outcome.header, places.place(match.place), match.first_image >= 0
    if match.is_late:  # its window may be an earlier one
        header = Header(frame_id=header.frame_id, stamp=time_message(match.window_stamps[-1]))
    message = fill(
        LoopClosure(),
        _align(match, places, match.position, match.place),
        match,
        outcome,
        header=header,
        query_session=outcome.robot_id,
        place_session=outcome.robot_id if is_route else place.session,
        relative_pose=NO_EDGE,
        pairs=[_align(match, places, q, m) for q, m in match.path.pairs.tolist()],
    )
    if is_route:
        query_pose = places.place(match.first_image + match.position).pose
    if query_pose is not None and place.pose is not None:
        message.has_poses = True
        message.pose_frame, message.pose_child_frame = about.frame, about.child
        message.query_pose_frame = about.frame if is_route else about.odometry_frame
        message.query_pose, message.place_pose = pose_message(query_pose), pose_message(place.pose)
    return message


def relative_pose_message(
    edge: Edge, pair: AlignedPlaces | LoopClosure, frame: str
) -> RelativePose:
    """Return an edge as a message, with the indices and stamps of a pair; frame: of the base."""
    pose = NO_EDGE.pose
    if edge.has_pose or edge.pose[6] != 1:  # the mountings may turn one without a pose
        covariance = edge.covariance.ravel()
        pose = PoseWithCovariance(pose=pose_message(edge.pose), covariance=covariance)
    return fill(
        copy(NO_EDGE), edge, pair,
        frame=frame, pose=pose, is_independent=edge.independent, reprojection_error=edge.error,
    )  # fmt: skip


def matched_pose_message(outcome: Outcome) -> PoseWithCovarianceStamped | None:
    """
    Return the pose of the place of the newest image; None without a match or a known pose.

    It is turned by the mountings of the cameras, where the map states them. The covariance has the
    variances over the poses of the two places before and after it in its session, rotation vectors
    about the axes of the map, at least (0.1 m)^2 and (0.1 rad)^2, and, across the path, the
    variance of the lateral offset from it, which is not observed.
    """
    place, pose, places = outcome.newest, outcome.newest_pose, outcome.places
    if place is None or place.pose is None or pose is None or places is None:
        return None
    newest, first = outcome.match.newest, getattr(places, 'first', 0)  # of a route
    around = range(max(first, newest - 2), min(first + len(places), newest + 3))
    near_by = [places.place(i) for i in around]
    near = np.array([p.pose for p in near_by if p.pose is not None and p.session == place.session])
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_quat(place.pose[3:])
    turns = Rotation.from_quat(near[:, 3:]) * turn.inv()
    variances = np.append(np.var(near[:, :3], axis=0), np.var(turns.as_rotvec(), axis=0))
    message = PoseWithCovarianceStamped()
    message.header.stamp, message.header.frame_id = outcome.header.stamp, outcome.about.frame
    message.pose.pose = pose_message(pose)
    covariance = np.diag(np.maximum(variances, MIN_VARIANCE))
    x, y = near[-1, :2] - near[0, :2]
    if math.hypot(x, y) < SHORT:  # the robot was at rest: across the view
        x, y = turn.apply((1.0, 0.0, 0.0))[:2]
    across = np.array([-y, x]) / max(math.hypot(x, y), 1e-9)
    covariance[:2, :2] += BESIDE**2 * np.outer(across, across)
    message.pose.covariance = covariance.ravel()
    return message


def image_message(header: Header, image: np.ndarray, encoding: str = 'rgb8') -> Image:
    """Return an image, shape (h, w, channels) in the type of the encoding, as a message."""
    height, width = image.shape[:2]
    message = Image(header=header, height=height, width=width, encoding=encoding)
    message.step = image.nbytes // height
    message.data = array.array('B', image.tobytes())
    return message


def record_message(record: ImageRecord) -> Image:
    """Return the message of a record, with the recorded header."""
    data = array.array('B')  # the one type that rclpy does not check byte by byte
    data.frombytes(memoryview(record.data).cast('B'))
    header = Header(stamp=time_message(record.stamp_ns), frame_id=record.frame_id)
    is_bigendian = int(record.is_bigendian)
    return fill(Image(), record, header=header, is_bigendian=is_bigendian, data=data)


def pose_array(message: Pose) -> np.ndarray:
    """Return a pose message as x y z and quaternion x y z w, shape (7,), float64."""
    p, o = message.position, message.orientation
    return np.array([p.x, p.y, p.z, o.x, o.y, o.z, o.w])


def transform_message(pose: np.ndarray, parent: str, child: str) -> TransformStamped:
    """Return a pose of a frame, shape (7,), as a transform without a stamp."""
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id = parent
    shift = message.transform.translation
    shift.x, shift.y, shift.z = map(float, pose[:3])
    message.transform.rotation = pose_message(pose).orientation
    return message


def camera_of(info: CameraInfo, mount: tuple[float, ...]) -> Camera:
    """
    Return the camera that a message describes, as its images are: binned, and cut out.

    :raises InputError: it is not calibrated, or the numbers are invalid.
    """
    bins, roi, k = (max(info.binning_x, 1), max(info.binning_y, 1)), info.roi, info.k
    has_distortion = any(info.d)
    return Camera(
        width=(roi.width or info.width) // bins[0],
        height=(roi.height or info.height) // bins[1],
        focal=(float(k[0]) / bins[0], float(k[4]) / bins[1]),
        center=(  # centers of pixels are whole numbers
            (float(k[2]) - roi.x_offset + 0.5) / bins[0] - 0.5,
            (float(k[5]) - roi.y_offset + 0.5) / bins[1] - 0.5,
        ),
        model=info.distortion_model if has_distortion else '',
        distortion=tuple(map(float, info.d)) if has_distortion else (),
        mount=mount,
    )


def map_info_message(pipeline: Pipeline, robot_id: str, stamp: Time) -> MapInfo:
    """Return the description of the map in use."""
    operation, places = pipeline.operation, pipeline.places
    message = MapInfo(
        header=Header(stamp=stamp),
        robot_id=robot_id,
        operation=operation.name,
        state=operation.map_state,
        path=pipeline.save_state.path,
        format_version=VERSION,
    )
    if operation.extractor is not None:
        settings = operation.extractor.settings
        fill(message, settings, features=settings.kind, settings=settings.to_json())
        message.projected = settings.projection is not None
    if places is not None:
        message.map_id, message.places = places.map_id, len(places)
        message.sessions = [session.id for session in places.sessions]
        if len(places):
            message.dimension = places.dimension
        message.has_stamps, message.has_ids = bool(np.any(places.stamps)), any(places.ids)
        message.has_poses = places.poses is not None and bool(np.isfinite(places.poses).any())
        thumbnails = places.thumbnails  # a map's stay in its file, which is not read here
        is_map = isinstance(places, Map)
        message.has_thumbnails = bool(len(thumbnails)) if is_map else any(thumbnails)
    return message


def message_class(name: str) -> type:
    """
    Return the class of a message type.

    :param name: such as ``nav_msgs/msg/Odometry``; it may come from a foreign file, so only
        packages with messages are imported.
    :raises UnavailableError: its package is not installed.
    """
    if words := re.fullmatch(r'([a-z][a-z0-9_]*)/msg/([A-Z][A-Za-z0-9]*)', name):
        package, kind = words.groups()
        spec = importlib.util.find_spec(package)  # does not import it
        folders = (spec.submodule_search_locations if spec else None) or []
        if any(Path(folder, 'msg').is_dir() for folder in folders):
            kind_class = getattr(importlib.import_module(f'{package}.msg'), kind, None)
            if isinstance(kind_class, type):
                return kind_class
    raise UnavailableError(
        f'the message type {name} is not installed: install its package and source its '
        'environment, or leave the topic out'
    )
