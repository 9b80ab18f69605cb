"""Between messages and the library's own types; no node in here."""

import math

from builtin_interfaces.msg import Time
from std_msgs.msg import Header

from stavpr_msgs.msg import AlignedPair, MapInfo, PlaceMatch
from stavpr_ros.mapping import PlaceMap
from stavpr_ros.mapping.storage import VERSION
from stavpr_ros.recognition import Recognition, Verdict

_VERDICTS = {
    Verdict.WARMING_UP: PlaceMatch.WARMING_UP,
    Verdict.NO_MATCH: PlaceMatch.NO_MATCH,
    Verdict.MATCH: PlaceMatch.MATCH,
}


def time_message(nanoseconds: int) -> Time:
    """Return a time; 0 is 'unknown' wherever this package uses it."""
    return Time(sec=int(nanoseconds) // 10**9, nanosec=int(nanoseconds) % 10**9)


def blank_match(header: Header, verdict: int, reason: str, threshold: float | None) -> PlaceMatch:
    """Return an answer that names no place."""
    return PlaceMatch(
        header=header,
        verdict=verdict,
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
    )


def match_message(recognition: Recognition, headers: list[Header], place_map: PlaceMap) -> PlaceMatch:
    """
    Return the answer to the newest image.

    :param headers: of the images in the window, oldest first.
    """
    message = blank_match(
        headers[-1], _VERDICTS[recognition.verdict], recognition.reason, recognition.threshold
    )
    message.window_first = headers[0].stamp
    message.window_middle = headers[(len(headers) - 1) // 2].stamp
    nearest = recognition.nearest
    if nearest is None:
        return message
    message.distance = nearest.distance
    message.sequence_first, message.sequence_last = nearest.first, nearest.last
    message.sequence_middle = nearest.middle
    message.path = [AlignedPair(query_index=q, map_index=m) for q, m in recognition.path.tolist()]
    message.runner_up_index, message.runner_up_distance = nearest.runner_up_index, nearest.runner_up_distance
    if recognition.verdict is Verdict.MATCH:
        place, newest = recognition.place, recognition.newest
        message.place_index, message.newest_index = place, newest
        message.place_stamp, message.place_id = time_message(place_map.stamps[place]), place_map.ids[place]
        message.newest_stamp, message.newest_id = (
            time_message(place_map.stamps[newest]),
            place_map.ids[newest],
        )
    return message


def map_info_message(place_map: PlaceMap, path: str, stamp: Time) -> MapInfo:
    """Describe a loaded map."""
    settings = place_map.settings
    return MapInfo(
        header=Header(stamp=stamp),
        path=path,
        format_version=VERSION,
        places=len(place_map),
        features=settings.kind,
        settings=settings.to_json(),
        strips=settings.strips,
        dimension=place_map.features.strips.shape[2],
        projected=place_map.projection is not None,
        has_stamps=place_map.has_stamps,
        has_ids=place_map.has_ids,
        has_poses=place_map.poses is not None,
        has_thumbnails=bool(place_map.thumbnails),
    )
