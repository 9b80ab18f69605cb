"""Between messages and the library's own types; no node in here."""

import array
import math

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from stavpr_msgs.msg import (
    AlignedImages,
    AlignedPair,
    Candidate,
    Candidates,
    LoopClosure,
    MapInfo,
    PlaceMatch,
)
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import GrowingMap, PlaceMap, place_at
from stavpr_ros.mapping.map_file import VERSION
from stavpr_ros.recognition import Candidate as RankedPlace
from stavpr_ros.recognition import Match, Status

SECOND = 1_000_000_000


def time_message(nanoseconds: int) -> Time:
    """Return a time; 0 is 'unknown' wherever this package uses it."""
    return Time(sec=int(nanoseconds) // SECOND, nanosec=int(nanoseconds) % SECOND)


def nanoseconds(time: Time) -> int:
    """Return a time as nanoseconds."""
    return int(time.sec) * SECOND + int(time.nanosec)


def pose_message(pose: np.ndarray) -> Pose:
    """Return x y z and quaternion x y z w, shape (7,), as a message."""
    message = Pose()
    message.position.x, message.position.y, message.position.z = map(float, pose[:3])
    o = message.orientation
    o.x, o.y, o.z, o.w = map(float, pose[3:])
    return message


def odometry_pose(message: Odometry) -> np.ndarray:
    """Return the pose of an odometry message, shape (7,), float64."""
    p, o = message.pose.pose.position, message.pose.pose.orientation
    return np.array([p.x, p.y, p.z, o.x, o.y, o.z, o.w])


def match_message(
    header: Header, match: Match, places: PlaceMap | GrowingMap | None = None
) -> PlaceMatch:
    """
    Return the match as a message.

    :param header: of the image.
    :param places: the map that the indices of the match refer to.
    """
    message = PlaceMatch(
        header=header,
        status=match.status,
        reason=match.reason,
        place_index=match.place_index,
        newest_index=match.image_index if match.status is Status.MAPPED else match.newest_index,
        distance=match.distance,
        threshold=match.threshold,
        sequence_first=-1,
        sequence_last=-1,
        sequence_middle=-1,
        window_first=header.stamp,
        window_middle=header.stamp,
        window_last=header.stamp,
        second_best_index=-1,
        second_best_distance=math.nan,
        inliers=match.inliers,
    )
    if match.window_stamps:
        stamps = match.window_stamps
        message.window_first = time_message(stamps[0])
        message.window_middle = time_message(stamps[(len(stamps) - 1) // 2])
    if match.sequence is not None:
        sequence = match.sequence
        message.sequence_first, message.sequence_last = sequence.first, sequence.last
        message.sequence_middle = sequence.middle
        message.path = [AlignedPair(query_index=q, map_index=m) for q, m in match.path.tolist()]
        message.second_best_index = sequence.second_best_index
        message.second_best_distance = sequence.second_best_distance
    if match.accepted and places is not None:
        place, newest = place_at(places, match.place_index), place_at(places, match.newest_index)
        message.place_stamp, message.place_id = time_message(place.stamp), place.identifier
        message.newest_stamp, message.newest_id = time_message(newest.stamp), newest.identifier
    return message


def candidate_messages(places: PlaceMap | GrowingMap, ranked: list[RankedPlace]) -> list[Candidate]:
    """Return nearest places as messages."""
    messages = []
    for candidate in ranked:
        facts = place_at(places, candidate.place)
        messages.append(
            Candidate(
                place_index=candidate.place,
                distance=candidate.distance,
                place_stamp=time_message(facts.stamp),
                place_id=facts.identifier,
            )
        )
    return messages


def candidates_message(
    header: Header, match: Match, places: PlaceMap | GrowingMap | None
) -> Candidates | None:
    """Return the nearest places of a window, None where it has none."""
    if not match.candidates or places is None:
        return None
    listed = candidate_messages(places, list(match.candidates))
    return Candidates(header=header, threshold=match.threshold, candidates=listed)


def loop_closure_message(
    header: Header, match: Match, route: PlaceMap | GrowingMap | None
) -> LoopClosure | None:
    """Return the loop that a match on the growing route closes; None if it is no such match."""
    first = match.first_image_index
    if not match.accepted or first < 0 or route is None or match.sequence is None:
        return None
    pairs = []
    for q, m in match.path.tolist():
        later, earlier = first + q, int(m)
        pairs.append(
            AlignedImages(
                query_index=later,
                query_stamp=time_message(place_at(route, later).stamp),
                place_index=earlier,
                place_stamp=time_message(place_at(route, earlier).stamp),
            )
        )
    middle = first + (len(match.window_stamps) - 1) // 2
    query, place = place_at(route, middle), place_at(route, match.place_index)
    message = LoopClosure(
        header=header,
        query_index=middle,
        query_stamp=time_message(query.stamp),
        place_index=match.place_index,
        place_stamp=time_message(place.stamp),
        distance=match.distance,
        threshold=match.threshold,
        inliers=match.inliers,
        pairs=pairs,
    )
    if query.pose is not None and place.pose is not None:
        message.has_poses = True
        message.query_pose, message.place_pose = pose_message(query.pose), pose_message(place.pose)
    return message


def matched_pose_message(
    header: Header, match: Match, places: PlaceMap | GrowingMap | None, frame: str
) -> PoseWithCovarianceStamped | None:
    """
    Return the pose of the place where the newest image was taken; None without a match or a known pose.

    The covariance is diagonal: the variance of each coordinate over the poses of the two places before and
    after it, since a match may be a place off, and at least (0.1 m)^2 and (0.1 rad)^2. A lateral offset of
    the camera from the mapped route is not observable by place recognition and not part of it.

    :param frame: of the map's poses.
    """
    if not match.accepted or places is None:
        return None
    newest = match.newest_index
    pose = place_at(places, newest).pose
    if pose is None:
        return None
    first = places.first if isinstance(places, GrowingMap) else 0
    around = range(max(first, newest - 2), min(first + len(places), newest + 3))
    near = [other for other in (place_at(places, i).pose for i in around) if other is not None]
    message = PoseWithCovarianceStamped()
    message.header.stamp, message.header.frame_id = header.stamp, frame
    message.pose.pose = pose_message(pose)
    spread = np.var([other[:3] for other in near], axis=0)
    turns = np.var([_rotation_between(pose, other) for other in near], axis=0)
    message.pose.covariance[::7] = np.maximum(np.append(spread, turns), 0.01)
    return message


def _rotation_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the rotation from a to b about the axes of the map, radians, shape (3,); for small angles."""
    ax, ay, az, aw = a[3:]
    bx, by, bz, bw = b[3:]
    w = aw * bw + ax * bx + ay * by + az * bz
    v = np.array(
        [
            aw * bx - ax * bw + ay * bz - az * by,
            aw * by - ax * bz - ay * bw + az * bx,
            aw * bz + ax * by - ay * bx - az * bw,
        ]
    )
    length = float(np.linalg.norm(v))
    angle = 2 * math.atan2(length, abs(w)) * (1 if w >= 0 else -1)
    return v * (angle / length) if length > 1e-12 else np.zeros(3)


def image_message(header: Header, image: np.ndarray) -> Image:
    """Return an image, RGB (h, w, 3) uint8, as a message."""
    height, width = image.shape[:2]
    message = Image(header=header, height=height, width=width, encoding='rgb8', step=width * 3)
    message.data = array.array('B', np.ascontiguousarray(image).tobytes())
    return message


def map_info_message(
    operation: str,
    state: str,
    path: str,
    places: PlaceMap | GrowingMap | None,
    extractor: FeatureExtractor | None,
    stamp: Time,
) -> MapInfo:
    """
    Describe the map that is in use.

    :param state: see the message.
    """
    message = MapInfo(
        header=Header(stamp=stamp), operation=operation, state=state, path=path, format_version=VERSION
    )
    if extractor is not None:
        settings = extractor.settings
        message.features, message.settings = settings.kind, settings.to_json()
        message.strips = settings.strips
        message.projected = settings.projection is not None
    if places is not None:
        message.places = len(places)
        if len(places):
            message.dimension = places.dimension
        message.has_stamps, message.has_ids = places.has_stamps, places.has_ids
        message.has_poses = places.has_poses
        message.has_thumbnails = any(places.thumbnails)
    return message
