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
from stavpr_ros.features import Describer
from stavpr_ros.mapping import GrowingMap, PlaceMap
from stavpr_ros.mapping.storage import VERSION
from stavpr_ros.operation import Answer, Outcome, place_facts
from stavpr_ros.recognition.candidates import Candidate as RankedPlace

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


def blank_match(header: Header, answer: Answer, reason: str, threshold: float | None) -> PlaceMatch:
    """Return an answer that names no place."""
    return PlaceMatch(
        header=header,
        verdict=answer.value,
        reason=reason,
        place_index=-1,
        newest_index=-1,
        distance=math.nan,
        threshold=math.nan if threshold is None else threshold,
        sequence_first=-1,
        sequence_last=-1,
        sequence_middle=-1,
        window_first=header.stamp,
        window_middle=header.stamp,
        window_last=header.stamp,
        runner_up_index=-1,
        runner_up_distance=math.nan,
        inliers=-1,
    )


def match_message(header: Header, outcome: Outcome) -> PlaceMatch:
    """
    Return the answer to an image.

    :param header: that of the image.
    """
    message = blank_match(header, outcome.answer, outcome.reason, outcome.threshold)
    message.inliers = outcome.inliers
    if outcome.answer is Answer.MAPPED:
        message.newest_index = outcome.newest
    recognition = outcome.recognition
    if recognition is None:
        return message
    window = outcome.window
    message.window_first = time_message(window[0])
    message.window_middle = time_message(window[(len(window) - 1) // 2])
    nearest = recognition.nearest
    if nearest is None:
        return message
    message.distance = nearest.distance
    message.sequence_first, message.sequence_last = nearest.first, nearest.last
    message.sequence_middle = nearest.middle
    message.path = [AlignedPair(query_index=q, map_index=m) for q, m in recognition.path.tolist()]
    message.runner_up_index, message.runner_up_distance = nearest.runner_up_index, nearest.runner_up_distance
    if outcome.answer is Answer.MATCH and outcome.places is not None:
        message.place_index, message.newest_index = recognition.place, recognition.newest
        place = place_facts(outcome.places, recognition.place)
        newest = place_facts(outcome.places, recognition.newest)
        message.place_stamp, message.place_id = time_message(place.stamp), place.identifier
        message.newest_stamp, message.newest_id = time_message(newest.stamp), newest.identifier
    return message


def candidate_messages(places: PlaceMap | GrowingMap, ranked: list[RankedPlace]) -> list[Candidate]:
    """Return nearest places as messages."""
    messages = []
    for candidate in ranked:
        facts = place_facts(places, candidate.place)
        messages.append(
            Candidate(
                place_index=candidate.place,
                distance=candidate.distance,
                place_stamp=time_message(facts.stamp),
                place_id=facts.identifier,
            )
        )
    return messages


def candidates_message(header: Header, outcome: Outcome) -> Candidates | None:
    """Return the nearest places of a window, None where it has none."""
    if not outcome.candidates or outcome.places is None:
        return None
    threshold = math.nan if outcome.threshold is None else outcome.threshold
    listed = candidate_messages(outcome.places, list(outcome.candidates))
    return Candidates(header=header, threshold=threshold, candidates=listed)


def loop_closure_message(header: Header, outcome: Outcome) -> LoopClosure | None:
    """Return the loop that a match on the growing route closes; None if it is no such match."""
    recognition, route = outcome.recognition, outcome.places
    if outcome.answer is not Answer.MATCH or outcome.first_image < 0:
        return None
    assert recognition is not None
    assert recognition.nearest is not None
    assert route is not None
    pairs = []
    for q, m in recognition.path.tolist():
        later, earlier = outcome.first_image + q, int(m)
        pairs.append(
            AlignedImages(
                query_index=later,
                query_stamp=time_message(place_facts(route, later).stamp),
                place_index=earlier,
                place_stamp=time_message(place_facts(route, earlier).stamp),
            )
        )
    middle = outcome.first_image + (len(outcome.window) - 1) // 2
    query, place = place_facts(route, middle), place_facts(route, recognition.place)
    message = LoopClosure(
        header=header,
        query_index=middle,
        query_stamp=time_message(query.stamp),
        place_index=recognition.place,
        place_stamp=time_message(place.stamp),
        distance=recognition.nearest.distance,
        threshold=recognition.threshold,
        inliers=outcome.inliers,
        pairs=pairs,
    )
    if query.pose is not None and place.pose is not None:
        message.has_poses = True
        message.query_pose, message.place_pose = pose_message(query.pose), pose_message(place.pose)
    return message


def matched_pose_message(header: Header, outcome: Outcome, frame: str) -> PoseWithCovarianceStamped | None:
    """
    Return the pose of the place that the newest image was taken at; None without a match or a known pose.

    The covariance is diagonal: the variance of each coordinate over the poses of the two places before and
    after it, since a match may be a place off, and at least (0.1 m)^2 and (0.1 rad)^2; the camera may besides
    stand beside the way that the map was made on, which no place recognition tells.

    :param frame: of the map's poses.
    """
    places, recognition = outcome.places, outcome.recognition
    if outcome.answer is not Answer.MATCH or places is None or recognition is None:
        return None
    newest = recognition.newest
    facts = place_facts(places, newest)
    if facts.pose is None:
        return None
    first = places.first if isinstance(places, GrowingMap) else 0
    around = range(max(first, newest - 2), min(first + len(places), newest + 3))
    near = [pose for pose in (place_facts(places, i).pose for i in around) if pose is not None]
    message = PoseWithCovarianceStamped()
    message.header.stamp, message.header.frame_id = header.stamp, frame
    message.pose.pose = pose_message(facts.pose)
    spread = np.var([pose[:3] for pose in near], axis=0)
    turns = np.var([_rotation_between(facts.pose, pose) for pose in near], axis=0)
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
    describer: Describer | None,
    stamp: Time,
) -> MapInfo:
    """
    Describe the map that is in use.

    :param state: see the message.
    """
    message = MapInfo(
        header=Header(stamp=stamp), operation=operation, state=state, path=path, format_version=VERSION
    )
    if describer is not None:
        settings = describer.settings
        message.features, message.settings = settings.kind, settings.to_json()
        message.strips = settings.strips
        message.projected = settings.projection is not None
    if places is not None:
        message.places = len(places)
        if len(places):
            message.dimension = places.features.strips.shape[2]
        message.has_stamps, message.has_ids = places.has_stamps, places.has_ids
        message.has_poses = places.has_poses
        message.has_thumbnails = any(places.thumbnails)
    return message
