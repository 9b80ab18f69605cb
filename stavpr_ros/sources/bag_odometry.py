"""Where the robot was, from the odometry of a ROS 1 or ROS 2 bag."""

from pathlib import Path
from typing import Any

import numpy as np

from stavpr_ros.errors import SourceError
from stavpr_ros.sources.bag_file import OpenBag, message_type, open_bag, reading

ODOMETRY = 'nav_msgs/msg/Odometry'
SECOND = 1_000_000_000
LATE = SECOND // 2  # messages may come in the wrong order by so much; more is a clock that jumped


def read_odometry(path: str | Path, topic: str) -> tuple[np.ndarray, np.ndarray]:
    """
    Read the poses of one topic of ``nav_msgs/Odometry``.

    :param path: a ROS 1 .bag file; a ROS 2 bag: its folder, or its .db3 or .mcap file.
    :param topic: with or without the leading slash.
    :returns: stamps of the headers (times of recording where they are 0), ns, shape (m,), int64, in order;
        x y z (meters) and quaternion x y z w, shape (m, 7), float64, as they were recorded.
    :raises SourceError: the bag cannot be read, there is no such topic, or time goes back in it.
    """
    path = Path(path)
    if not path.exists():
        raise SourceError(f'{path} does not exist: expected a bag')
    stamps, poses = [], []
    with open_bag(path) as bag:
        wanted = _connections(bag, path, topic)
        with reading(path):
            for connection, time_ns, raw in bag.reader.messages(wanted):
                message = bag.deserialize(raw, message_type(connection))
                stamp = message.header.stamp
                stamps.append(stamp.sec * SECOND + stamp.nanosec or time_ns)
                poses.append(_pose(message.pose.pose))
    if not stamps:
        raise SourceError(f'odometry {topic!r} of {path} has no messages: expected at least one')
    when, where = np.array(stamps, np.int64), np.array(poses, np.float64)
    _require_one_run(when, f'odometry {topic!r} of {path}')
    order = np.argsort(when, kind='stable')
    return when[order], where[order]


def _connections(bag: OpenBag, path: Path, topic: str) -> list[Any]:
    found = [connection for connection in bag.connections if connection.topic.strip('/') == topic.strip('/')]
    kinds = {message_type(connection) for connection in found}
    if kinds == {ODOMETRY}:
        return found
    what = f'is of type {" and ".join(sorted(kinds))}, not {ODOMETRY}, in' if kinds else 'is not in'
    others = {connection.topic for connection in bag.connections if message_type(connection) == ODOMETRY}
    listed = ', '.join(sorted(others)) or 'none'
    raise SourceError(f'odometry topic {topic!r} {what} {path}: topics of that type are {listed}')


def _pose(pose: Any) -> tuple[float, ...]:
    p, q = pose.position, pose.orientation
    return p.x, p.y, p.z, q.x, q.y, q.z, q.w


def _require_one_run(stamps: np.ndarray, name: str) -> None:
    back = np.maximum.accumulate(stamps) - stamps
    if back.max() > LATE:
        i = int(np.argmax(back > LATE))
        raise SourceError(
            f'{name} goes back by {back[i] / SECOND:.1f} s at message {i}: expected one run, cut the bag'
        )
