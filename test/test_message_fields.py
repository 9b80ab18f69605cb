# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Every field of every message, end to end: its sentence in the .msg beside what a node publishes.

A node receives images and odometry of a synthetic route, in each operation and mode. Each row of
the tables holds for all messages of all drives.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
import json
import math
from pathlib import Path
import re
import threading
import time
from typing import Any

from builtin_interfaces.msg import Time
from fixtures import route_images
import numpy as np
import pytest
from rclpy.qos import QoSProfile
from robot import image_message, LENGTH, NodeThread, PARAMETERS, Robot, SECOND
from sensor_msgs.msg import CameraInfo
from stavpr_msgs.msg import LoopClosure, MapInfo, PlaceCandidates, PlaceMatch, RelativePose
from stavpr_ros.mapping import load_map, Map, save_map, Session
from stavpr_ros.ros.messages import nanoseconds, time_message
from std_srvs.srv import Trigger

INTERFACES = Path(__file__).parents[1] / 'stavpr_msgs' / 'msg'
# the node repeat of stavpr_nav publishes Offset, and its tests check it
OF_THIS_NODE = sorted({*INTERFACES.glob('*.msg')} - {INTERFACES / 'Offset.msg'})
STEP, DEPTH, LAP = 24, 5.0, 30  # pixels between two places, meters to the scene, places
AHEAD = 0.125  # of the query to its place, meters; there is a place each meter
LEFT = '0 0 0 -1.5708 0 0'  # camera_transform of a camera that looks to the left
ELSEWHERE = math.nan  # where the map has no place
PROBABILITY = 0.3  # min_probability
Status = PlaceMatch
ROUTE, OFF_MAP = route_images(60), route_images(8, seed=9)


@dataclass
class Drive:
    """
    What a node has published, and what is true of it.

    :param places: the map, None = the route.
    :param x: of each image by its stamp, ns, in the order of the window; place i is at x = i.
    :param around: the message that a nested one is a field of.
    """

    robot_id: str = ''
    mode: str = 'robust'
    operation: str = 'localization'
    path: str = ''
    places: Map | None = None
    has_camera: bool = False
    began: int = 0
    reset: int = 0
    x: dict[int, float] = field(default_factory=dict)
    odometry: dict[int, float] = field(default_factory=dict)
    at_rest: set[int] = field(default_factory=set)
    matches: list[PlaceMatch] = field(default_factory=list)
    closures: list[LoopClosure] = field(default_factory=list)
    candidates: list[PlaceCandidates] = field(default_factory=list)
    infos: list[MapInfo] = field(default_factory=list)
    around: Any = None
    is_back: bool = False
    length: int = LENGTH  # images of a window

    @property
    def map_id(self) -> str:
        return '' if self.places is None else self.places.map_id

    def x_of(self, place: int) -> float:
        return float(place) if self.places is not None else list(self.x.values())[place]

    def shows(self, stamp: Time, place: int) -> bool:
        """
        Whether the image of a stamp is of a place, or of one beside it.

        The camera looks to the left: from place to place its view shifts by about a strip.
        """
        return abs(self.x[nanoseconds(stamp)] - self.x_of(place)) <= 1

    def odometry_at(self, stamp: Time) -> float:
        """Return x by the odometry, 0 = unknown."""
        return self.odometry.get(nanoseconds(stamp), 0.0)

    def stamp(self, place: int) -> Time:
        """Return the stamp of a place."""
        stamps = list(self.x) if self.places is None else self.places.stamps
        return time_message(int(stamps[place]))

    def identifier(self, place: int) -> str:
        return '' if self.places is None else self.places.ids[place]

    def session(self, place: int) -> str:
        if self.places is None or not self.places.sessions:
            return ''
        return ('day', 'night')[place >= LAP]

    def window(self, match: PlaceMatch) -> list[Time]:
        """Return the stamps of the images in the window."""
        own = nanoseconds(match.header.stamp)
        if own not in self.x or match.status > Status.MATCH:
            return [match.header.stamp]
        stamps = [stamp for stamp in self.x if (stamp > self.reset) == (own > self.reset)]
        end = stamps.index(own) + 1
        images = match.path[-1].query_index + 1 if match.path else self.length
        return [time_message(stamp) for stamp in stamps[max(end - images, 0) : end]]

    def limit(self, match: PlaceMatch) -> float:
        """Return the threshold that applies, of a camera at rest or less."""
        if self.mode == 'paper':
            return 0.2
        if 'not confirmed' in match.reason:
            return 0.0
        return 0.1 if len(match.path) in range(1, self.length) else 1 - PROBABILITY


def is_close(a: float, b: float, error: float = 1e-6) -> bool:
    """Whether two numbers are equal, or NaN both."""
    return (math.isnan(a) and math.isnan(b)) or abs(a - b) <= error


def is_route(d: Drive) -> bool:
    return d.operation == 'loop_closure'


def has_poses(m: LoopClosure, d: Drive) -> bool:
    """Whether the odometry of the query is known; each place has a pose."""
    return nanoseconds(m.query_stamp) in d.odometry


def is_match(m: PlaceMatch) -> bool:
    return m.status == Status.MATCH


# Of each field: its sentence in the .msg, and what is true of it on a drive.
Checks = dict[str, tuple[str, Callable[[Any, Drive], bool]]]

CAMERAS = {'': ('', 0.0), 'day': ('front', 0.1), 'night': ('rear', math.pi)}  # name, yaw

# fmt: off
PLACE_MATCH: Checks = {
    'header': ("header of the image, copied: frame_id is the camera's",
        lambda m, d: m.header.frame_id == 'camera' and m.header.stamp.sec > 0),
    'robot_id': ('parameter robot_id; empty = not set', lambda m, d: m.robot_id == d.robot_id),
    'map_id': ('map of the indices: first 16 hexadecimal digits of the hash of its content; '
        'empty = it is in no file (recorded maps)',
        lambda m, d: m.map_id == d.map_id),
    'session': ('session of the map that the place is of; empty = unknown',
        lambda m, d: m.session == (d.session(m.place_index) if is_match(m) else '')),
    'camera': ('camera of that session; empty = unknown',
        lambda m, d: m.camera == (CAMERAS[d.session(m.place_index)][0] if is_match(m) else '')),
    'status': ('',
        lambda m, d: is_match(m) <= (m.newest_index >= 0) and (m.status == 7) ==
        bool(d.operation == 'mapping' and nanoseconds(m.header.stamp) in d.x)),
    'reason': ('why there is no match; empty for MATCH and MAPPED',
        lambda m, d: bool(m.reason) == (m.status not in (Status.MATCH, Status.MAPPED))),
    'place_index': ('the place of the image at window_middle; mode paper: midpoint of the '
        'matched sequence',
        lambda m, d: m.place_index == (m.sequence_middle if is_match(m) else -1) and (not
        is_match(m) or d.shows(m.window_middle, m.place_index))),
    'place_stamp': ('stamp of that place in the map; 0 = unknown',
        lambda m, d: m.place_stamp == (d.stamp(m.place_index) if is_match(m) else Time())),
    'place_id': ('external identifier of that place; empty = none',
        lambda m, d: m.place_id == (d.identifier(m.place_index) if is_match(m) else '')),
    'newest_index': ('the place aligned with the newest image',
        lambda m, d: d.shows(m.header.stamp, m.newest_index) if m.status in (Status.MATCH,
        Status.MAPPED) else m.newest_index == -1),
    'newest_stamp': ('',
        lambda m, d: m.newest_stamp == (d.stamp(m.newest_index) if is_match(m) else Time())),
    'newest_id': ('',
        lambda m, d: m.newest_id == (d.identifier(m.newest_index) if is_match(m) else '')),
    'distance': ('mode paper: of the window to that sequence, 0 = identical; mode robust: 1 - '
        'probability',
        lambda m, d: is_close(m.distance, 1 - m.probability) if d.mode == 'robust' else
        math.isnan(m.distance) == (m.sequence_first < 0) and (not is_match(m) or
        is_close(m.distance, 0, 0.001))),
    'threshold': ('as applied: MATCH means distance < threshold; mode robust: 1 - the '
        'probability that applies: of min_probability or max_error; at least 0.9 of fewer images '
        'than a full window, 1 of a path that is not confirmed yet (operation loop_closure)',
        lambda m, d: (is_close(m.threshold, d.limit(m)) or m.status == Status.INVALID_IMAGE or
        (nanoseconds(m.header.stamp) in d.at_rest and 0.0999 < m.threshold < d.limit(m))) and
        (not is_match(m) or m.distance < m.threshold)),
    'probability': ('that sequence_middle is the right place, 0 to 1; NaN in mode paper and '
        'without a sequence',
        lambda m, d: math.isnan(m.probability) if d.mode == 'paper' or m.sequence_first < 0
        else 0 <= m.probability <= 1 and (m.probability < PROBABILITY or
        d.shows(m.window_middle, m.sequence_middle))),
    'sequence_first': ('first map index of the sequence',
        lambda m, d: m.sequence_first == (m.path[0].place_index if m.path else -1)),
    'sequence_last': ('its last one',
        lambda m, d: m.sequence_last == (m.path[-1].place_index if m.path else -1)),
    'sequence_middle': ('its place of the image at window_middle; mode paper: midpoint, '
        'floor((sequence_first + sequence_last) / 2)',
        lambda m, d: m.sequence_middle == (-1 if not m.path else (m.sequence_first +
        m.sequence_last) // 2 if d.mode == 'paper' else m.path[(len(m.path) - 1) //
        2].place_index)),
    'direction': ('1 = the camera moves along the map, -1 = against it (parameter direction: '
        'both), 0 = no sequence',
        lambda m, d: m.direction in ((0,) if not m.path else (1,) if not d.is_back else
        (-1,) if is_match(m) else (1, -1))),
    'relative_yaw': ("of the robot in its pose at place_index, rad to the left: yaw of the map's "
        "camera less the own one's; 0 = not stated by the map",
        lambda m, d: is_close(m.relative_yaw, CAMERAS[d.session(m.place_index)][1] if is_match(m)
        else 0)),
    'path': ('its warping path, from the oldest image to the newest',
        lambda m, d: not m.path or (sorted({pair.query_index for pair in m.path}) ==
        list(range(len(d.window(m)))) and (np.diff([(p.query_index, m.direction * p.place_index)
        for p in m.path], axis=0) >= 0).all())),
    'path_probabilities': ('that each place of path is right, the last one thus that '
        'newest_index is; empty in mode paper and off the map',
        lambda m, d: len(m.path_probabilities) == (len(m.path) if m.probability > 0 else 0) and
        all(0 <= p <= 1 for p in m.path_probabilities) and (not len(m.path_probabilities) or
        is_close(m.path_probabilities[(len(m.path) - 1) // 2], m.probability))),
    'window_first': ('', lambda m, d: m.window_first == d.window(m)[0]),
    'window_middle': ('',
        lambda m, d: m.window_middle == d.window(m)[(len(d.window(m)) - 1) // 2]),
    'window_last': ('', lambda m, d: m.window_last == m.header.stamp),
    'second_best_index': ('as sequence_middle',
        lambda m, d: m.second_best_index == -1 or abs(m.second_best_index - m.sequence_middle)
        > PARAMETERS['nms_radius']),
    'second_best_distance': ('mode robust: 1 - its probability',
        lambda m, d: math.isnan(m.second_best_distance) == (m.second_best_index == -1) and (not
        m.second_best_distance > 1 + (d.mode == 'paper')) and (not (d.mode == 'paper' and
        m.second_best_distance < m.distance))),
    'inliers': ('keypoint matches of one geometry; -1 = not checked',
        lambda m, d: m.inliers >= 30 if d.mode == 'paper' and is_match(m) else m.inliers >= -1),
    'has_relative_pose': ('relative_pose.source is ALIGNED or PNP',
        lambda m, d: m.has_relative_pose == (m.relative_pose.source in (RelativePose.ALIGNED,
        RelativePose.PNP))),
    'relative_pose': ('',
        lambda m, d: m.relative_pose.source == RelativePose.NONE if not is_match(m) or
        d.has_camera else m.relative_pose.source in (RelativePose.ALIGNED, RelativePose.NONE)),
}

ALIGNED_PAIR: Checks = {
    'query_index': ('0-based position in the query window, 0 = its oldest image',
        lambda m, d: 0 <= m.query_index < len(d.window(d.around))),
    'place_index': ('0-based place of the map',
        lambda m, d: not is_match(d.around) or d.shows(d.window(d.around)[m.query_index],
        m.place_index)),
}

PLACE_CANDIDATES: Checks = {
    'header': ('header of the newest image of the window, copied',
        lambda m, d: m.header.frame_id == 'camera' and nanoseconds(m.header.stamp) in d.x),
    'robot_id': ('parameter robot_id; empty = not set', lambda m, d: m.robot_id == d.robot_id),
    'map_id': ('map of the indices, see PlaceMatch; empty = it is in no file',
        lambda m, d: m.map_id == d.map_id),
    'threshold': ('a smaller distance is near enough for a match',
        lambda m, d: m.threshold == d.around.threshold),
    'candidates': ('',
        lambda m, d: m.candidates[0].distance == d.around.distance and
        m.candidates[0].place_index == d.around.sequence_middle and ([c.place_index for c in
        m.candidates[1:2]] in ([], [d.around.second_best_index])) and (np.diff([c.distance for
        c in m.candidates[1:]]) >= 0).all()),
    'session_probabilities': ('of each of MapInfo.sessions, that the newest image is on it; '
        'empty in mode paper, and of a map without sessions',
        lambda m, d: len(m.session_probabilities) == (len(d.infos[-1].sessions) if d.mode ==
        'robust' else 0) and sum(m.session_probabilities) < 1.001),
}

PLACE_CANDIDATE: Checks = {
    'place_index': ('0-based, as PlaceMatch.sequence_middle',
        lambda m, d: abs(m.place_index - d.around.sequence_middle) not in range(1, 6)),
    'distance': ('on the scale of PlaceMatch.distance',
        lambda m, d: m.distance > -1e-06 and (m.distance <= 1 or d.mode == 'paper')),
    'probability': ('that the place is right, 0 to 1; NaN in mode paper',
        lambda m, d: is_close(1 - m.probability, m.distance) if d.mode == 'robust' else
        math.isnan(m.probability)),
    'place_stamp': ('stamp of the place; 0 = unknown',
        lambda m, d: m.place_stamp == d.stamp(m.place_index)),
    'place_id': ('external identifier of the place; empty = none',
        lambda m, d: m.place_id == d.identifier(m.place_index)),
    'session': ('session of the map that the place is of; empty = unknown',
        lambda m, d: m.session == d.session(m.place_index)),
}

LOOP_CLOSURE: Checks = {
    'header': ("header of the newest image of the window: frame_id is the camera's",
        lambda m, d: m.header.frame_id == 'camera' and (m.is_late or m.header.stamp ==
        d.around.header.stamp) and (m.pairs[-1].query_stamp == m.header.stamp)),
    'robot_id': ('parameter robot_id; empty = not set', lambda m, d: m.robot_id == d.robot_id),
    'map_id': ('map of the indices, see PlaceMatch; empty = it is in no file',
        lambda m, d: m.map_id == d.map_id),
    'query_session': ('session of the query, the present drive: robot_id; empty = not set',
        lambda m, d: m.query_session == d.robot_id),
    'place_session': ('session of the place: of the map, operation loop_closure: query_session; '
        'empty = unknown',
        lambda m, d: m.place_session == (m.query_session if is_route(d) else
        d.session(m.place_index))),
    'query_index': ('place of the route, 0-based, counted from its start; -1 = the query is no '
        'place (localization)',
        lambda m, d: d.stamp(m.query_index) == m.query_stamp if is_route(d) else m.query_index
        == -1),
    'query_stamp': ('',
        lambda m, d: m.query_stamp in [pair.query_stamp for pair in m.pairs] and (m.is_late or
        m.query_stamp == d.around.window_middle)),
    'is_late': ('the query is the middle or the oldest image of the window',
        lambda m, d: not m.is_late or m.query_stamp in (m.pairs[0].query_stamp, m.pairs[(LENGTH
        - 1) // 2].query_stamp)),
    'place_index': ('',
        lambda m, d: d.shows(m.query_stamp, m.place_index) and (m.is_late or m.place_index ==
        d.around.place_index)),
    'place_stamp': ('', lambda m, d: m.place_stamp == d.stamp(m.place_index)),
    'has_poses': ('both poses are known', lambda m, d: m.has_poses == has_poses(m, d)),
    'pose_frame': ('frame of place_pose: frame_id of the odometry, localization: parameter '
        'map_frame; empty without poses',
        lambda m, d: m.pose_frame == (('map', 'wheels')[is_route(d)] if has_poses(m, d) else
        '')),
    'query_pose_frame': ('frame of query_pose: frame_id of the odometry',
        lambda m, d: m.query_pose_frame == ('wheels' if has_poses(m, d) else '')),
    'pose_child_frame': ('frame whose poses they are: child_frame_id of the odometry, as a rule '
        'the base of the robot, not the camera',
        lambda m, d: m.pose_child_frame == ('base' if has_poses(m, d) else '')),
    'query_pose': ('odometry at query_stamp',
        lambda m, d: is_close(m.query_pose.position.x, d.odometry_at(m.query_stamp))),
    'place_pose': ('odometry at place_stamp, localization: pose in the map',
        lambda m, d: is_close(m.place_pose.position.x, d.odometry_at(m.place_stamp) if
        is_route(d) else m.place_index * has_poses(m, d))),
    'distance': ('mode paper: of the window to the matched sequence, 0 = identical; mode robust: '
        '1 - probability',
        lambda m, d: is_close(m.distance, 1 - m.probability) if d.mode == 'robust' else
        m.distance == d.around.distance),
    'threshold': ('as applied, see PlaceMatch: distance < threshold',
        lambda m, d: m.distance < m.threshold and (m.is_late or m.threshold ==
        d.around.threshold)),
    'probability': ('that the place is right, 0 to 1; NaN in mode paper',
        lambda m, d: math.isnan(m.probability) if d.mode == 'paper' else 0 <= m.probability <=
        1),
    'inliers': ('of the geometric check of this pair, -1 = none',
        lambda m, d: m.inliers >= 30 if d.mode == 'paper' else m.inliers == -1),
    'has_relative_pose': ('relative_pose.source is ALIGNED or PNP',
        lambda m, d: m.has_relative_pose == (m.relative_pose.source in (RelativePose.ALIGNED,
        RelativePose.PNP))),
    'relative_pose': ('of query_index and place_index',
        lambda m, d: (m.relative_pose.query_index, m.relative_pose.place_index) ==
        (m.query_index, m.place_index)),
    'pairs': ('the whole window, from its oldest image to its newest',
        lambda m, d: len({pair.query_stamp.sec for pair in m.pairs}) in (range(2, d.length + 1)
        if d.operation == 'localization' else [LENGTH]) and
        (np.diff([nanoseconds(pair.query_stamp) for pair in m.pairs]) >= 0).all()),
}

ALIGNED_PLACES: Checks = {
    'query_index': ('place of the route: the later image',
        lambda m, d: d.stamp(m.query_index) == m.query_stamp if is_route(d) else m.query_index
        == -1),
    'query_stamp': ('', lambda m, d: nanoseconds(m.query_stamp) in d.x),
    'place_index': ('place of the route: the earlier image',
        lambda m, d: d.shows(m.query_stamp, m.place_index)),
    'place_stamp': ('', lambda m, d: m.place_stamp == d.stamp(m.place_index)),
    'query_change': ('how much the query image differs from the image before it, 0 = equal; '
        'large where the robot was carried; NaN = unknown',
        lambda m, d: math.isnan(m.query_change) if d.mode == 'paper' else m.query_change < 0.01
        if nanoseconds(m.query_stamp) in d.at_rest else m.query_change > 0.1),
}

RELATIVE_POSE: Checks = {
    'source': ('',
        lambda m, d: isinstance(d.around, PlaceMatch) or m.source == (RelativePose.PNP if
        d.has_camera else RelativePose.ALIGNED if d.around.has_poses else RelativePose.NONE)),
    'reason': ('why source is not PNP; empty = it is PNP',
        lambda m, d: bool(m.reason) == (m.source != RelativePose.PNP)),
    'query_index': ('place of the route, operation loop_closure; -1 otherwise',
        lambda m, d: d.stamp(m.query_index) == m.query_stamp if is_route(d) else m.query_index
        == -1),
    'query_stamp': ('',
        lambda m, d: m.query_stamp == (d.around.window_middle if isinstance(d.around,
        PlaceMatch) else d.around.query_stamp)),
    'place_index': ('', lambda m, d: m.place_index == d.around.place_index),
    'place_stamp': ('', lambda m, d: m.place_stamp == d.around.place_stamp),
    'frame': ('the base of the robot: child_frame_id of the odometry',
        lambda m, d: m.frame in ('base', '' if m.source == RelativePose.NONE else 'base')),
    'pose': ('of the base at the query in the base at the place, m; covariance as in ROS: x y z, '
        'rotations about the fixed axes of the place',
        lambda m, d: m.source == RelativePose.NONE or (is_close(m.pose.pose.position.x,
        d.x[nanoseconds(m.query_stamp)] - d.x_of(m.place_index), 0.1 if m.source ==
        RelativePose.PNP else 1) and (np.linalg.eigvalsh(m.pose.covariance.reshape(6, 6)) >
        0).all())),
    'is_independent': ('far enough from the previous edge to add it as well: errors of '
        'neighboring edges are correlated',
        lambda m, d: not m.is_independent or m.source != RelativePose.NONE),
    'inliers': ('of PnP; -1 = not tried',
        lambda m, d: m.inliers >= 14 if m.source == RelativePose.PNP else m.inliers == -1),
    'reprojection_error': ('rms of the inliers, pixels of the thumbnail; NaN = none',
        lambda m, d: 0 <= m.reprojection_error < 2 if m.source == RelativePose.PNP else
        math.isnan(m.reprojection_error)),
}

MAP_INFO: Checks = {
    'header': ('stamp: time of the change',
        lambda m, d: d.began <= nanoseconds(m.header.stamp) <= time.time_ns()),
    'robot_id': ('parameter robot_id; empty = not set', lambda m, d: m.robot_id == d.robot_id),
    'map_id': ('first 16 hexadecimal digits of the hash of the content of the map; empty = it is '
        'in no file (recorded maps)',
        lambda m, d: m.map_id == (d.map_id if m.state == 'loaded' else '')),
    'sessions': ('of the map; empty = unknown',
        lambda m, d: list(m.sessions) == ([session.id for session in d.places.sessions] if m.state
        == 'loaded' else [])),
    'operation': ('localization, mapping or loop_closure',
        lambda m, d: m.operation == d.operation),
    'state': ('none, loading (old map in use), loaded, growing, full',
        lambda m, d: m.state in (('none', 'loading', 'loaded') if d.places else ('growing',
        'full', 'none'))),
    'path': ('file it was loaded from or last saved to, a first map: is being loaded from; empty '
        '= none',
        lambda m, d: m.path == (d.path if m.state in ('loading', 'loaded') else '')),
    'format_version': ('of the map file; 0 = no map was loaded yet',
        lambda m, d: m.format_version == (0 if m.state == 'loading' else 2)),
    'feature_version': ('of the computation of the features; 0 = unknown',
        lambda m, d: m.feature_version == (m.state not in ('none', 'loading'))),
    'places': ('number of places n at the time of publication',
        lambda m, d: m.places == len(d.places) if m.state == 'loaded' else m.places <= len(d.x)
        and (m.state != 'full' or m.places == len(d.x))),
    'features': ('kind of the local features: gradient, onnx, ...',
        lambda m, d: m.features == ('gradient' if m.feature_version else '')),
    'settings': ('all settings of the features, as JSON',
        lambda m, d: not m.feature_version or json.loads(m.settings)['kind'] == 'gradient'),
    'strips': ('local features per image W',
        lambda m, d: m.strips == (7 if m.feature_version else 0)),
    'dimension': ('length of a local feature, after the projection if any',
        lambda m, d: m.dimension == (64 if m.state == 'loaded' else 224 if m.places else 0)),
    'projected': ('Gaussian random projection was applied',
        lambda m, d: m.projected == (m.dimension == 64)),
    'has_stamps': ('', lambda m, d: m.has_stamps == (m.places > 0)),
    'has_ids': ('', lambda m, d: m.has_ids == (m.state == 'loaded')),
    'has_poses': ('', lambda m, d: m.has_poses == (m.places > 0)),
    'has_thumbnails': ('', lambda m, d: m.has_thumbnails == (m.places > 0)),
}
# fmt: on
TABLES = {
    'PlaceMatch': PLACE_MATCH,
    'AlignedPair': ALIGNED_PAIR,
    'PlaceCandidates': PLACE_CANDIDATES,
    'PlaceCandidate': PLACE_CANDIDATE,
    'LoopClosure': LOOP_CLOSURE,
    'AlignedPlaces': ALIGNED_PLACES,
    'RelativePose': RELATIVE_POSE,
    'MapInfo': MAP_INFO,
}


def view(x: float) -> np.ndarray:
    """Return what the camera sees at x, off the map where x is NaN."""
    if math.isnan(x):
        return OFF_MAP[0]
    place, shift = int(x), round(STEP * (x % 1))
    rows = ROUTE[place][:, shift:], ROUTE[place + 1][:, -STEP : shift - STEP or None]
    return np.ascontiguousarray(np.hstack(rows) if shift else ROUTE[place])


@contextmanager
def running(robot: Robot, drive: Drive, **parameters: Any) -> Iterator[Any]:
    """Yield a node; the drive receives what it publishes."""
    drive.began = time.time_ns()
    robot.forget()
    closures = robot.listen(LoopClosure, '/stavpr/loop_closure', 1000)
    candidates = robot.listen(PlaceCandidates, '/stavpr/candidates', 1000)
    thread = NodeThread(robot.context, [], {
        'robot_id': drive.robot_id,
        'mode': drive.mode,
        'operation': drive.operation,
        'map_path': drive.path,
        'min_probability': PROBABILITY,
        'sequence_length': drive.length,
        'keyframe_distance': 0.001,  # an image without odometry is not taken
    } | parameters)  # fmt: skip
    try:
        robot.wait_for_node()
        first = len(robot.answers)
        yield thread.node
        # the last one of each image: it is shown again while the node has no odometry of its time
        drive.matches = list(
            {nanoseconds(match.header.stamp): match for match in robot.answers[first:]}.values()
        )
        count = sum(map(is_match, drive.matches))
        robot.until(lambda: len(candidates) >= count, 'candidates of each match')
        if drive.operation != 'mapping' and drive.x:
            robot.until(
                lambda: sum(not closure.is_late for closure in closures) >= count,
                'a closure of each match',
            )
        drive.closures, drive.candidates = list(closures), list(candidates)
        drive.infos = [
            info for info in robot.infos if nanoseconds(info.header.stamp) > drive.began
        ]
    finally:
        thread.end()
        robot.wait_for_nobody()


def show(robot: Robot, drive: Drive, xs: Sequence[float]) -> None:
    """Show the views at positions, with odometry in a frame of its own."""
    for x in xs:
        odometry = 100.0 + len(drive.x)
        match = robot.show_at(odometry, view(x))
        if match.status not in (Status.NOT_READY, Status.SKIPPED):
            drive.x[robot.stamp], drive.odometry[robot.stamp] = x, odometry


@pytest.fixture(scope='module')
def drives(robot, small_map, tmp_path_factory):
    """Return a drive of each operation and mode, and one of images that are not matched."""
    path = str(tmp_path_factory.mktemp('map') / 'route.stavpr')
    index = np.repeat(np.array([0, 1], np.int32), LAP)
    sessions = tuple(
        Session(session, camera=name, yaw=yaw)
        for session, (name, yaw) in CAMERAS.items()
        if session
    )
    save_map(replace(small_map, sessions=sessions, session_index=index), path)
    on_map = {'path': path, 'places': load_map(path)}

    robust = Drive('r2', **on_map)
    with running(robot, robust, candidates=3) as node:
        robot.until(lambda: robot.odometry.get_subscription_count() > 0, 'odometry')
        show(robot, robust, np.arange(40, 50) + AHEAD)
        rest(robot, robust, 49 + AHEAD)
        reset(robot, robust)
        show(robot, robust, [ELSEWHERE])
        rest(robot, robust, ELSEWHERE)
        show(robot, robust, np.arange(10, 20) + AHEAD)

    paper = Drive('r2', 'paper', **on_map)
    checked = {'threshold': 0.2, 'geometric_check': 'orb'}
    with running(robot, paper, **checked):
        show(robot, paper, range(10, 20))
        reset(robot, paper)
        show(robot, paper, [ELSEWHERE] * LENGTH)

    mapping = Drive(operation='mapping')
    with running(robot, mapping, max_places=100):
        show(robot, mapping, [*range(51), *range(51)])
        robot.until_map(state='full')

    loop = Drive('r2', operation='loop_closure', has_camera=True)
    with running(robot, loop, exclude_places=10, camera_transform=LEFT):
        publisher = robot.node.create_publisher(CameraInfo, '/camera_info', QoSProfile(depth=1))
        robot.until(lambda: publisher.get_subscription_count() > 0, 'camera_info')
        focal, (height, width, _) = DEPTH * STEP, ROUTE[0].shape
        k = [focal, 0.0, width / 2 - 0.5, 0.0, focal, height / 2 - 0.5, 0.0, 0.0, 1.0]
        publisher.publish(CameraInfo(width=width, height=height, k=k))
        show(robot, loop, [*range(LAP), *(np.arange(20) + AHEAD)])
        robot.node.destroy_publisher(publisher)

    others = Drive(**on_map)
    with running(robot, others, queue_size=1, keyframe_distance=0.0) as node:
        robot.set(max_rate=5.0)  # probes would be skipped, and overtake others
        invalid = image_message(ROUTE[0])
        invalid.encoding = 'teleport8'
        robot.show(invalid)
        robot.show(ROUTE[0], SECOND // 100)  # above max_rate
        end = threading.Event()
        node.runtime.worker.call(end.wait)
        before = len(robot.answers)
        for number in range(3):
            robot.stamp += SECOND
            robot.publisher.publish(image_message(ROUTE[number], robot.stamp))
            others.x[robot.stamp] = number
        robot.until(lambda: len(robot.answers) > before, 'a dropped image')
        end.set()
        robot.until(lambda: len(robot.answers) == before + 3, 'a match for each image')
        for match in robot.answers[before:]:
            if match.status == Status.DROPPED:
                del others.x[nanoseconds(match.header.stamp)]

    without_map = Drive()
    with running(robot, without_map):
        show(robot, without_map, range(2))

    path = str(tmp_path_factory.mktemp('map') / 'route.stavpr')
    save_map(small_map, path)
    early = Drive(path=path, places=load_map(path), length=8)
    with running(robot, early):
        show(robot, early, range(40, 50))

    back = Drive(**on_map, is_back=True)
    with running(robot, back, direction='both'):
        show(robot, back, np.arange(49, 35, -1) + AHEAD)
    return [robust, paper, mapping, loop, others, without_map, early, back]


def reset(robot: Robot, drive: Drive) -> None:
    """Empty the window."""
    robot.does(Trigger, 'reset')
    drive.reset = robot.stamp


def rest(robot: Robot, drive: Drive, x: float) -> None:
    """Stand at x for longer than a window, without odometry."""
    robot.set(keyframe_distance=0.0)
    for _ in range(2 * LENGTH):
        robot.show(view(x))
        drive.x[robot.stamp] = x
        drive.at_rest.add(robot.stamp)
    robot.set(keyframe_distance=0.001)


def messages_of(drives: Sequence[Drive], kind: str) -> Iterator[tuple[Any, Drive]]:
    """Yield the messages of a kind; the drive holds the message around each."""
    for d in drives:
        by_stamp = {nanoseconds(match.header.stamp): match for match in d.matches}

        def inside(message: Any, drive: Drive = d) -> Drive:
            return replace(drive, around=message)

        def own(message: Any, drive: Drive = d, matches: Any = by_stamp) -> Drive:
            return replace(drive, around=matches[nanoseconds(message.header.stamp)])

        messages: dict[str, list[tuple[Any, Drive]]] = {
            'PlaceMatch': [(m, d) for m in d.matches],
            'AlignedPair': [(pair, inside(m)) for m in d.matches for pair in m.path],
            'PlaceCandidates': [(c, own(c)) for c in d.candidates],
            'PlaceCandidate': [(x, own(c)) for c in d.candidates for x in c.candidates],
            'LoopClosure': [(c, own(c)) for c in d.closures],
            'AlignedPlaces': [(pair, inside(c)) for c in d.closures for pair in c.pairs],
            'RelativePose': [
                (m.relative_pose, inside(m)) for m in [*filter(is_match, d.matches), *d.closures]
            ],
            'MapInfo': [(info, d) for info in d.infos],
        }
        yield from messages[kind]


@pytest.mark.parametrize(
    ('kind', 'name'), [(kind, name) for kind, table in TABLES.items() for name in table]
)
def test_field_is_as_documented(drives, kind, name):
    sentence, check = TABLES[kind][name]
    wrong = [m for m, drive in messages_of(drives, kind) if not check(m, drive)]
    assert not wrong, f'{len(wrong)} messages have another {name}: {sentence!r}: {wrong[0]}'


@pytest.mark.parametrize('file', OF_THIS_NODE, ids=lambda file: file.stem)
def test_every_field_has_a_check_beside_its_sentence(file):
    text = re.sub(r'\n +#', '', file.read_text())  # continued comments
    fields = re.findall(r'^[\w/\[\]]+ (\w+) *(?:# *(.*))?$', text, re.MULTILINE)
    assert dict(fields) == {name: sentence for name, (sentence, _) in TABLES[file.stem].items()}


def test_drives_show_what_the_fields_distinguish(drives):
    """Or a check would hold for want of messages."""
    robust, paper, mapping, loop, _, _, early, back = drives
    assert {match.status for drive in drives for match in drive.matches} == set(range(8))
    assert {1 - PROBABILITY, 0.1} == {round(match.threshold, 6) for match in early.matches}
    assert 0.0 in {match.threshold for match in loop.matches}
    assert any(is_match(match) for match in back.matches)
    for drive in (robust, paper):
        assert {is_match(match) for match in drive.matches} == {True, False}
        assert drive.candidates
        assert drive.closures
    sessions = {match.session for match in robust.matches + paper.matches}
    assert sessions == {'', 'day', 'night'}
    assert any(closure.is_late for closure in loop.closures)
    assert len([closure for closure in loop.closures if closure.relative_pose.is_independent]) > 1
    assert {info.state for info in mapping.infos} >= {'growing', 'full'}
    sources = {m.relative_pose.source for m, _ in messages_of(drives, 'LoopClosure')}
    assert sources >= {RelativePose.ALIGNED, RelativePose.PNP}
