# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Conversions between messages and the types of the library; no publishers."""

import array
from copy import copy
from dataclasses import dataclass
import importlib.util
import math
from pathlib import Path
import re

from builtin_interfaces.msg import Time
from geometry_msgs.msg import (
    Pose,
    PoseWithCovariance,
    PoseWithCovarianceStamped,
    TransformStamped,
)
from nav_msgs.msg import Odometry
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
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import GrowingMap, PlaceMap
from stavpr_ros.mapping.camera import Camera
from stavpr_ros.mapping.map_version2 import VERSION
from stavpr_ros.mapping.transforms import turned
from stavpr_ros.method import Match, Status
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
class PoseFrames:
    """
    Names of frames, '' = unknown.

    :param frame: of the poses of the places.
    :param child: of the base, whose poses they are.
    :param odometry: of the poses of the odometry.
    """

    frame: str = ''
    child: str = ''
    odometry: str = ''


NO_FRAMES = PoseFrames()
# copied and shared, never changed: rosidl makes all messages of a message to construct it
NO_EDGE = RelativePose(query_index=-1, place_index=-1, inliers=-1, reprojection_error=math.nan)
_NO_MATCH = PlaceMatch(
    sequence_first=-1,
    sequence_last=-1,
    sequence_middle=-1,
    second_best_index=-1,
    second_best_distance=math.nan,
    relative_pose=NO_EDGE,
)


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


def origin(robot_id: str, places: PlaceMap | GrowingMap | None) -> dict[str, str]:
    """Return the fields that name the robot, and the map that indices refer to."""
    return {'robot_id': robot_id, 'map_id': '' if places is None else places.map_id}


def match_message(
    header: Header,
    result: ImageResult,
    places: PlaceMap | GrowingMap | None = None,
    robot_id: str = '',
    edge: Edge | None = None,
    frame: str = '',
) -> PlaceMatch:
    """
    Return the message of a result.

    :param places: the map that the indices of the match refer to.
    :param robot_id: the parameter of this name.
    :param edge: of the middle pair, None = none; frame: of the base.
    """
    match, path = result.match, result.match.path
    message = copy(_NO_MATCH)
    message.header, message.robot_id = header, robot_id
    message.map_id = '' if places is None else places.map_id
    message.status, message.reason = match.status, match.reason
    message.place_index = match.place
    is_mapped = match.status is Status.MAPPED
    message.newest_index = result.image_index if is_mapped else match.newest
    message.distance, message.threshold = match.distance, match.threshold
    message.probability, message.inliers = match.probability, match.inliers
    message.window_first = message.window_middle = message.window_last = header.stamp
    if match.window_stamps:
        stamps = match.window_stamps
        message.window_first = time_message(stamps[0])
        message.window_middle = time_message(stamps[(len(stamps) - 1) // 2])
    if path.place >= 0:
        message.sequence_first, message.sequence_last = path.first, path.last
        message.sequence_middle, message.direction = path.place, path.direction
        message.path_probabilities = match.path_probabilities.tolist()
        message.path = [AlignedPair(query_index=q, place_index=m) for q, m in path.pairs.tolist()]
        message.second_best_index = path.second_best
        message.second_best_distance = path.second_best_distance
    if match.accepted and places is not None:
        place, newest = places.place(match.place), places.place(match.newest)
        message.place_stamp, message.place_id = time_message(place.stamp), place.identifier
        message.session, message.relative_yaw = place.session, result.relative_yaw
        session = places.session(match.place) if isinstance(places, PlaceMap) else None
        message.camera = session.camera if session is not None else ''
        message.newest_stamp, message.newest_id = time_message(newest.stamp), newest.identifier
        if edge is not None:
            message.has_relative_pose = edge.has_pose
            first, length = match.first_image, len(match.window_stamps)
            pair = AlignedPlaces(
                query_index=first + (length - 1) // 2 if first >= 0 else -1,
                query_stamp=message.window_middle,
                place_index=message.place_index,
                place_stamp=message.place_stamp,
            )
            message.relative_pose = relative_pose_message(edge, pair, frame)
    return message


def candidates_message(
    header: Header, result: ImageResult, places: PlaceMap | GrowingMap | None, robot_id: str = ''
) -> PlaceCandidates | None:
    """Return the message of the candidates of a match, None without any."""
    if not result.candidates or places is None:
        return None
    message = PlaceCandidates(
        header=header, **origin(robot_id, places), threshold=result.match.threshold
    )
    message.session_probabilities = list(result.session_probabilities)
    for candidate in result.candidates:
        place = places.place(candidate.place)
        message.candidates.append(
            PlaceCandidate(
                place_index=candidate.place,
                distance=candidate.distance,
                probability=candidate.probability,
                place_stamp=time_message(place.stamp),
                place_id=place.identifier,
                session=place.session,
            )
        )
    return message


def loop_closure_message(
    header: Header,
    match: Match,
    places: PlaceMap | GrowingMap | None,
    robot_id: str = '',
    frames: PoseFrames = NO_FRAMES,
    query_pose: np.ndarray | None = None,
) -> LoopClosure | None:
    """
    Return the loop closure of a match, without its edge; None without a match.

    :param places: the route, whose places the images of the window are, or a map.
    :param robot_id: the parameter of this name; sessions of several robots' maps are named so.
    :param query_pose: of the odometry, at the image that matched, shape (7,); for maps only, a
        route has it.
    """
    if not match.accepted or places is None:
        return None
    first = match.first_image
    is_route = first >= 0
    stamps = match.window_stamps
    pairs = [
        AlignedPlaces(
            query_index=first + q if is_route else -1,
            query_stamp=time_message(places.place(first + q).stamp if is_route else stamps[q]),
            place_index=m,
            place_stamp=time_message(places.place(m).stamp),
            query_change=match.window_changes[q] if match.window_changes else math.nan,
        )
        for q, m in match.path.pairs.tolist()
    ]
    middle = match.position
    query_stamp, query_frame = stamps[middle], frames.odometry
    place = places.place(match.place)
    if is_route:
        own = places.place(first + middle)
        query_stamp, query_pose, query_frame = own.stamp, own.pose, frames.frame
    message = LoopClosure(
        header=header,
        **origin(robot_id, places),
        query_index=first + middle if is_route else -1,
        query_stamp=time_message(query_stamp),
        is_late=match.is_late,
        query_session=robot_id,
        place_session=robot_id if is_route else place.session,
        place_index=match.place,
        place_stamp=time_message(place.stamp),
        distance=match.distance,
        threshold=match.threshold,
        probability=match.probability,
        inliers=match.inliers,
        relative_pose=NO_EDGE,
        pairs=pairs,
    )
    if query_pose is not None and place.pose is not None:
        message.has_poses = True
        message.pose_frame, message.pose_child_frame = frames.frame, frames.child
        message.query_pose_frame = query_frame
        message.query_pose, message.place_pose = pose_message(query_pose), pose_message(place.pose)
    return message


def relative_pose_message(
    edge: Edge, pair: AlignedPlaces | LoopClosure, frame: str
) -> RelativePose:
    """Return an edge as a message, with the indices and stamps of a pair; frame: of the base."""
    message = copy(NO_EDGE)
    message.source, message.reason, message.frame = edge.source, edge.reason, frame
    message.query_index, message.query_stamp = pair.query_index, pair.query_stamp
    message.place_index, message.place_stamp = pair.place_index, pair.place_stamp
    message.is_independent, message.inliers = edge.independent, edge.inliers
    message.reprojection_error = edge.error
    if edge.has_pose or edge.pose[6] != 1:  # the mountings may turn one without a pose
        covariance = edge.covariance.ravel()
        message.pose = PoseWithCovariance(pose=pose_message(edge.pose), covariance=covariance)
    return message


def newest_pose(result: ImageResult, places: PlaceMap | GrowingMap) -> np.ndarray | None:
    """Return the pose of the robot at the place of the newest image, (7,); None = unknown."""
    pose = places.place(result.match.newest).pose if result.match.accepted else None
    return None if pose is None else turned(pose, result.relative_yaw)


def matched_pose_message(
    header: Header, result: ImageResult, places: PlaceMap | GrowingMap | None, frame: str
) -> PoseWithCovarianceStamped | None:
    """
    Return the pose of the place of the newest image; None without a match or a known pose.

    It is turned by the mountings of the cameras, where the map states them. The covariance has the
    variances over the poses of the two places before and after it in its session, rotation vectors
    about the axes of the map, at least (0.1 m)^2 and (0.1 rad)^2, and, across the path, the
    variance of the lateral offset from it, which is not observed.

    :param frame: of the poses of the map.
    """
    if not result.match.accepted or places is None:
        return None
    newest, pose = result.match.newest, newest_pose(result, places)
    if pose is None:
        return None
    first = places.first if isinstance(places, GrowingMap) else 0
    around = range(max(first, newest - 2), min(first + len(places), newest + 3))
    session, near_by = places.place(newest).session, [places.place(i) for i in around]
    near = np.array([p.pose for p in near_by if p.pose is not None and p.session == session])
    from scipy.spatial.transform import Rotation

    own = turned(pose, -result.relative_yaw)  # of the place
    turns = Rotation.from_quat(near[:, 3:]) * Rotation.from_quat(own[3:]).inv()
    variances = np.append(np.var(near[:, :3], axis=0), np.var(turns.as_rotvec(), axis=0))
    message = PoseWithCovarianceStamped()
    message.header.stamp, message.header.frame_id = header.stamp, frame
    message.pose.pose = pose_message(pose)
    covariance = np.diag(np.maximum(variances, MIN_VARIANCE))
    x, y = near[-1, :2] - near[0, :2]
    if math.hypot(x, y) < SHORT:  # the robot was at rest: across the view
        x, y = Rotation.from_quat(own[3:]).apply((1.0, 0.0, 0.0))[:2]
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
    message = Image(
        header=Header(stamp=time_message(record.stamp_ns), frame_id=record.frame_id),
        height=record.height,
        width=record.width,
        encoding=record.encoding,
        is_bigendian=int(record.is_bigendian),
        step=record.step,
    )
    data = array.array('B')  # the one type that rclpy does not check byte by byte
    data.frombytes(memoryview(record.data).cast('B'))
    message.data = data
    return message


def odometry_pose(message: Odometry) -> np.ndarray:
    """Return the pose of an odometry message, shape (7,), float64."""
    p, o = message.pose.pose.position, message.pose.pose.orientation
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


def map_info_message(
    operation: str,
    state: str,
    path: str,
    places: PlaceMap | GrowingMap | None,
    extractor: FeatureExtractor | None,
    stamp: Time,
    robot_id: str = '',
) -> MapInfo:
    """Return the description of the map in use."""
    message = MapInfo(
        header=Header(stamp=stamp),
        **origin(robot_id, places),
        operation=operation,
        state=state,
        path=path,
        format_version=VERSION,
    )
    if extractor is not None:
        settings = extractor.settings
        message.features, message.settings = settings.kind, settings.to_json()
        message.feature_version = settings.feature_version
        message.strips = settings.strips
        message.projected = settings.projection is not None
    if places is not None:
        message.places = len(places)
        message.sessions = [session.id for session in places.sessions]
        if len(places):
            message.dimension = places.dimension
        message.has_stamps, message.has_ids = bool(np.any(places.stamps)), any(places.ids)
        message.has_poses = places.poses is not None and bool(np.isfinite(places.poses).any())
        thumbnails = places.thumbnails  # a map's stay in its file, which is not read here
        is_map = isinstance(places, PlaceMap)
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
