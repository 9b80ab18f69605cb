# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The parameters of the node: one table for validation, launch arguments and documentation.

``python3 tools/parameter_files.py``, in a checkout, writes ``config/stavpr.yaml`` and
``docs/parameters.md``. Launch files read this table, so it imports nothing but the standard
library.
"""

from dataclasses import dataclass
from typing import Any, Literal

EXPECTED: dict[type, str] = {bool: 'true or false', int: 'an integer', float: 'a number'}
WHEN = {
    'live': 'at any time',
    'unconfigured': 'while the node is unconfigured',
    'start': 'at the start of the node only',
}


@dataclass(frozen=True)
class NodeParameter:
    """
    One row of the table.

    :param default: its type is the type of the parameter.
    :param when: it can be set, see ``WHEN``.
    :param bounds: smallest and largest value.
    :param choices: the allowed values of a string, empty = any.
    """

    name: str
    default: Any
    sentence: str
    unit: str = ''
    when: Literal['live', 'unconfigured', 'start'] = 'unconfigured'
    bounds: tuple[float, float] | None = None
    choices: tuple[str, ...] = ()

    @property
    def constraints(self) -> str:
        """Return the choices, and when the parameter can be set."""
        rules = ['one of: ' + ', '.join(self.choices)] if self.choices else []
        return '; '.join([*rules, f'can be set {WHEN[self.when]}'])

    @property
    def text(self) -> str:
        """Return the sentence with unit, range and choices."""
        limits = ', '.join(filter(None, [self.unit, self.range, ' | '.join(self.choices)]))
        return self.sentence + f' [{limits}]' * bool(limits)

    @property
    def range(self) -> str:
        """Return the bounds, empty = none."""
        return f'{self.bounds[0]:g} ... {self.bounds[1]:g}' if self.bounds else ''


BASIC = 'Basic parameters'
GROUPS: dict[str, tuple[NodeParameter, ...]] = {
    BASIC: (
        NodeParameter(
            'operation',
            'localization',
            'Chooses what images are used for: localization recognizes places of a fixed map, '
            'mapping records a map, loop_closure recognizes places that the same route has '
            'passed before. The service ~/set_operation changes it while the node is configured.',
            choices=('localization', 'mapping', 'loop_closure'),
        ),
        NodeParameter(
            'map_path',
            '',
            'Names the map file, made by build_map or save_map; or a folder, whose maps become '
            'sessions with the names of their files; or the address of the map of a fleet, such '
            'as qdrant://HOST:6333/NAME (docs/fleet.md). ~ is the home folder, a relative path '
            'is in the working directory. Empty: localization waits for the service ~/load_map, '
            'and mapping starts a new map.',
        ),
        NodeParameter(
            'save_path',
            '',
            'Names the file that a recorded map is saved to on deactivation or shutdown. Beside '
            'a file of another map, a numbered name is used.',
            when='live',
        ),
        NodeParameter(
            'mode',
            'robust',
            'Chooses the method: robust, a filter over places and speeds that computes '
            'probabilities, or paper, STA-VPR as published, for comparisons.',
            choices=('paper', 'robust'),
        ),
        NodeParameter(
            'min_probability',
            0.5,
            'Accepts a match when the probability that its place is right is above this; greater '
            'is stricter. Mode paper has threshold instead.',
            when='live',
            bounds=(0.0, 1.0),
        ),
        NodeParameter(
            'max_error',
            0.0,
            'Orders a rate of wrong matches, 0.005 or more, which chooses min_probability by the '
            'calibration of the map (evaluate --calibrate), or else by drives on other maps; 0 = '
            'off. With both set, the stricter applies.',
            when='live',
            bounds=(0.0, 1.0),
        ),
        NodeParameter(
            'sequence_length',
            20,
            'Sets how many images are matched together: the length of the window.',
            'images',
            bounds=(2, 1000),
        ),
        NodeParameter(
            'features',
            'auto',
            'Chooses the features of a map that is recorded without map_path. auto: hybrid where '
            'onnxruntime and the network are installed, else gradient, which suits small boards. '
            'Others: efficientnet_lite1, onnx, or a kind of another package, such as '
            'densenet161_places365 of stavpr_lab.',
        ),
        NodeParameter(
            'exclude_places',
            50,
            'loop_closure: leaves the latest places of the route, as many as this, out of the '
            'comparison.',
            'places',
            bounds=(1, 1000000),
        ),
        NodeParameter(
            'geometric_check',
            'none',
            'Verifies matches by keypoints and epipolar geometry, on the thumbnails of the '
            'middle image of the window and of its place.',
            when='live',
            choices=('none', 'orb', 'sift'),
        ),
        NodeParameter(
            'keyframe_distance',
            0.0,
            'Skips images until the robot has moved this far (or turned by keyframe_angle_deg) '
            'since the last keyframe, by nav_msgs/Odometry on the topic odom; 0 = off.',
            'm',
            'live',
            (0.0, 1e4),
        ),
        NodeParameter(
            'keyframe_angle_deg',
            0.0,
            'Skips images until the robot has turned this far (or moved by keyframe_distance) '
            'since the last keyframe; 0 = off.',
            'degrees',
            'live',
            (0.0, 180.0),
        ),
        NodeParameter(
            'keyframe_change',
            0.004,
            'Skips images that differ less than this from the last keyframe (1 - correlation of '
            'small gray images), so that a robot at rest does not fill the window; 0 = off.',
            when='live',
            bounds=(0.0, 2.0),
        ),
        NodeParameter(
            'image_transport',
            'raw',
            'Chooses the topic of the images: raw, sensor_msgs/Image on image; compressed, '
            'sensor_msgs/CompressedImage on image/compressed (follows a remapping of image); '
            'ffmpeg or foxglove, video on image/ffmpeg or image/foxglove, decoded by PyAV '
            '(docs/integration.md).',
            choices=('raw', 'compressed', 'ffmpeg', 'foxglove'),
        ),
        NodeParameter(
            'backend',
            'auto',
            'Chooses the device of networks and of the image distances of localization; auto: '
            'CUDA if it is available. Features gradient and loop closure are computed on the '
            'CPU.',
            choices=('auto', 'cpu', 'cuda'),
        ),
    ),
    'Input': (
        NodeParameter(
            'queue_size',
            4,
            'Limits the number of waiting images; a new one drops the oldest.',
            'images',
            bounds=(1, 1000),
        ),
        NodeParameter(
            'max_rate',
            0.0,
            'Skips images that come faster than this; 0 = unlimited.',
            'Hz',
            'live',
            (0.0, 1e4),
        ),
        NodeParameter(
            'keyframe_interval',
            0.0,
            'Skips images until this time has passed since the last keyframe; 0 = off.',
            's',
            'live',
            (0.0, 1e4),
        ),
        NodeParameter(
            'max_stamp_gap',
            2.0,
            'Counts a longer time between the stamps of successive images as a gap in the '
            'diagnostics.',
            's',
            'live',
            (0.01, 1e6),
        ),
        NodeParameter(
            'odometry_timeout',
            0.5,
            'Limits the age of the newest odometry message, relative to the stamp of the image.',
            's',
            bounds=(0.0, 60.0),
        ),
    ),
    'Recognition': (
        NodeParameter(
            'threshold',
            -1.0,
            'Mode paper: accepts a match when its distance is below this; negative = the '
            'threshold that build_map stored in the map. Mode robust rejects it, see '
            'min_probability.',
            'distance',
            'live',
            bounds=(-1.0, 1e6),
        ),
        NodeParameter(
            'nms_radius',
            20,
            'Keeps the second best place and the candidates at least this far from each other '
            'along the map.',
            'places',
            bounds=(0, 1000000),
        ),
        NodeParameter(
            'candidates',
            10,
            'Sets the number of places in ~/candidates.',
            'places',
            'live',
            (0, 1000),
        ),
        NodeParameter(
            'min_inliers',
            30,
            'Sets how many keypoints must agree for the geometric check to pass; 20 is '
            'sufficient for sift.',
            'keypoints',
            'live',
            (8, 100000),
        ),
        NodeParameter(
            'odometry_error',
            0.1,
            'States the error of a distance by odometry, as a share of it. Matches whose path '
            'disagrees with the odometry become less probable, where the places have poses in '
            'meters with z up; 0 = never.',
            bounds=(0.0, 1.0),
        ),
        NodeParameter(
            'exclude_seconds',
            0.0,
            'loop_closure: compares only places that are older than this, in addition to '
            'exclude_places.',
            's',
            bounds=(0.0, 1e6),
        ),
        NodeParameter(
            'direction',
            'forward',
            'Chooses the directions of localization: forward, the camera moves along the map; '
            'both, it may also move against it, as a robot that reverses, or one that comes back '
            'and has a map of its rear camera. ~/match names the direction. Mode robust only.',
            choices=('forward', 'both'),
        ),
    ),
    'Recorded maps': (
        NodeParameter(
            'update_map',
            False,
            'localization: adds drives whose places are certain to the map as sessions, as '
            '`stavpr map update` does: in its file, by ~/save_map without a path, and on '
            'deactivation or shutdown. The latest three are kept, each of max_places images at '
            'most.',
        ),
        NodeParameter(
            'maps_folder',
            '',
            'Names the folder of the maps that services name; map_path, save_path and model_path '
            'must be in it too when they are set after the start. Empty: stavpr/maps in '
            '$XDG_DATA_HOME, that is ~/.local/share.',
            when='start',
        ),
        NodeParameter(
            'feature_settings',
            '',
            'Sets the features by a JSON object; missing keys take their defaults.',
        ),
        NodeParameter(
            'model_path',
            '',
            'Names the file of the network, for features of a network, or for a map also a '
            'folder with it. Empty: the folder $STAVPR_MODELS, by default '
            '~/.local/share/stavpr_ros/models.',
        ),
        NodeParameter(
            'max_places',
            20000,
            'Limits the number of places of a recorded map: mapping stops there, loop_closure '
            'removes the oldest eighth of its route.',
            'places',
            bounds=(100, 10000000),
        ),
        NodeParameter(
            'thumbnail_width',
            192,
            'Sets the width of the thumbnails in a recorded map; 0 = none.',
            'pixels',
            bounds=(0, 4096),
        ),
    ),
    'Output': (
        NodeParameter(
            'robot_id',
            '',
            'Names the robot in messages and diagnostics, for systems of several robots.',
        ),
        NodeParameter('map_frame', 'map', 'Names the frame of the poses of the map, for ~/pose.'),
        NodeParameter(
            'relative_pose',
            'auto',
            'Chooses how ~/loop_closure relates the poses of query and place: pnp, by keypoints '
            '(requires camera_info, thumbnails and poses of the places); aligned, by odometry '
            'alone; auto, pnp where it is possible, else aligned; none.',
            choices=('auto', 'none', 'aligned', 'pnp'),
        ),
        NodeParameter(
            'camera_transform',
            '',
            "States the pose of the camera's optical frame (z ahead, x right) in the base of the "
            'robot: x y z roll pitch yaw, or x y z and a quaternion x y z w, in m and rad. '
            'Empty: from tf, where tf2_ros is installed, else a camera at the base that looks '
            'ahead.',
        ),
        NodeParameter(
            'publish_tf',
            False,
            'localization: publishes the transform from map_frame to the frame of the odometry '
            'on /tf every 0.05 s, from the first match on. Requires a map with poses, tf2_msgs, '
            'and odometry on the topic odom; no other node may publish it.',
        ),
        NodeParameter(
            'transform_tolerance',
            0.2,
            'Dates the transform of publish_tf this much ahead, so that it is available at the '
            'present time. Corrections take effect so much later.',
            's',
            bounds=(0.0, 60.0),
        ),
        NodeParameter(
            'publish_initialpose',
            False,
            'localization: publishes initialpose (x, y, yaw) for Nav2 at the first match after '
            'the start, a reset or sequence_length images without a match, when it has a '
            'subscriber. Requires a map with poses.',
        ),
        NodeParameter(
            'localized_probability',
            0.9,
            'localization: sets ~/localized to true after a match of at least this probability '
            'that 3 of the next 5 images confirm.',
            bounds=(0.0, 1.0),
        ),
        NodeParameter(
            'lost_images',
            20,
            'Sets ~/localized to false after this many images without a match.',
            'images',
            bounds=(1, 1000000),
        ),
        NodeParameter(
            'lost_distance',
            5.0,
            'Sets ~/localized to false this far from the last match, by odometry where the node '
            'has it; 0 = by images only.',
            'm',
            bounds=(0.0, 1e6),
        ),
        NodeParameter(
            'subgoal_distance',
            2.0,
            'localization: sets how far ahead of the matched place, along the route of the map, '
            'the place of ~/subgoal is; in places on a map without poses.',
            'm',
            bounds=(0.0, 1e4),
        ),
        NodeParameter(
            'subgoal_width',
            0,
            'Sets the width of the image on ~/subgoal; 0 = as the thumbnails of the map.',
            'pixels',
            bounds=(0, 4096),
        ),
        NodeParameter(
            'diagnostics_period',
            1.0,
            'Sets the time between two messages of the diagnostics.',
            's',
            'start',
            (0.1, 60.0),
        ),
        NodeParameter(
            'verbosity',
            'default',
            'Sets the log level of the node; default: as set by --log-level.',
            when='live',
            choices=('default', 'debug', 'info', 'warn', 'error'),
        ),
    ),
    'Computation and life cycle': (
        NodeParameter(
            'precision',
            'auto',
            "Chooses the precision of the map's features; int8 quarters their memory and, on "
            'large maps on a CPU, takes less than half the time. auto: int8 in localization in '
            'mode robust on the CPU for 2,000 places and more, else float32. In loop closure, '
            'int8 applies to a route of 2,000 places and more.',
            choices=('auto', 'float32', 'int8'),
        ),
        NodeParameter(
            'threads',
            0,
            'Limits the CPU threads of the computation; 0 = all.',
            'threads',
            bounds=(0, 1024),
        ),
        NodeParameter(
            'autostart',
            True,
            'Lets the node configure and activate itself; false: a lifecycle manager does.',
            when='start',
        ),
        NodeParameter(
            'bond_heartbeat_period',
            0.25,
            'Sets the time between heartbeats of the bond to a lifecycle manager of Nav2, where '
            'the package bond is installed; 0 = no bond.',
            's',
            bounds=(0.0, 4.0),
        ),
    ),
}

PARAMETERS = tuple(row for rows in GROUPS.values() for row in rows)
BY_NAME = {row.name: row for row in PARAMETERS}
# earlier names, accepted with a warning until version 1.1
RENAMED = {'keyframe_angle': 'keyframe_angle_deg'}
# parameters without effect, named in a warning until version 1.1: what to do instead
REMOVED = {
    'verifier': 'verify closures in a node of your own, which subscribes to ~/loop_closure',
    'time_budget_ms': 'reduce the map by `stavpr map compact MAP OUTPUT --pca 64`, and take '
    'precision int8',
}


def default(name: str) -> Any:
    """Return the default of a parameter."""
    return BY_NAME[name].default
