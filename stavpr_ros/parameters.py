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
    def range(self) -> str:
        """Return the bounds, empty = none."""
        return f'{self.bounds[0]:g} ... {self.bounds[1]:g}' if self.bounds else ''


BASIC = 'Basic parameters'
GROUPS: dict[str, tuple[NodeParameter, ...]] = {
    BASIC: (
        NodeParameter(
            'operation',
            'localization',
            'Processing of the images: localization on a fixed map, mapping (records a map), or '
            'loop_closure (places that the same route has passed before). The service '
            '~/set_operation changes it while the node is configured.',
            choices=('localization', 'mapping', 'loop_closure'),
        ),
        NodeParameter(
            'map_path',
            '',
            'Map file made by build_map or save_map; ~ is the home folder, a relative path is in '
            'the working directory. Of a folder, all maps are used, each as a session with the '
            'name of its file. Without one, localization waits for the service '
            '~/load_map, and mapping starts a new map. Or the address of the map of a fleet, such '
            'as qdrant://HOST:6333/NAME (docs/fleet.md).',
        ),
        NodeParameter(
            'save_path',
            '',
            'Where a recorded map is saved on deactivation or shutdown; an existing file of '
            'another map is never overwritten, a numbered name is used.',
            when='live',
        ),
        NodeParameter(
            'mode',
            'robust',
            'Recognition method: paper is STA-VPR as published, robust adds mitigations of its '
            'failure modes.',
            choices=('paper', 'robust'),
        ),
        NodeParameter(
            'min_probability',
            0.5,
            'Mode robust: a window is matched when the probability that its place is right is '
            'above this, between 0 and 1; greater is stricter. No effect in mode paper.',
            when='live',
            bounds=(0.0, 1.0),
        ),
        NodeParameter(
            'max_error',
            0.0,
            'Mode robust: rate of wrong matches, at least 0.005, that chooses min_probability, by '
            'the calibration of the map (evaluate --calibrate) or as measured on drives; 0 = off. '
            'With both set, the stricter applies.',
            when='live',
            bounds=(0.0, 1.0),
        ),
        NodeParameter(
            'sequence_length', 20, 'Length l of the query window.', 'images', bounds=(2, 1000)
        ),
        NodeParameter(
            'features',
            'auto',
            'Kind of the features of a map that is recorded without map_path: hybrid; gradient, '
            'for a small board; auto, the former where onnxruntime and its network are, else the '
            'latter; efficientnet_lite1, onnx, or one that another package adds, such as '
            'densenet161_places365 of stavpr_lab.',
        ),
        NodeParameter(
            'exclude_places',
            50,
            'loop_closure: number of the latest places of the route that are not compared.',
            'places',
            bounds=(1, 1000000),
        ),
        NodeParameter(
            'geometric_check',
            'none',
            'Verification of matches by keypoints and epipolar geometry: the thumbnail of the '
            'middle image of the window against that of its place.',
            when='live',
            choices=('none', 'orb', 'sift'),
        ),
        NodeParameter(
            'keyframe_distance',
            0.0,
            'Minimum distance between keyframes (or minimum rotation, keyframe_angle_deg), from '
            'nav_msgs/Odometry on the topic odom; 0 = off.',
            'm',
            'live',
            (0.0, 1e4),
        ),
        NodeParameter(
            'keyframe_angle_deg',
            0.0,
            'Minimum rotation between keyframes, see keyframe_distance; 0 = off.',
            'degrees',
            'live',
            (0.0, 180.0),
        ),
        NodeParameter(
            'keyframe_change',
            0.004,
            'Minimum change of the image between keyframes (1 - correlation of small gray '
            'images), so that a robot at rest does not fill the window; 0 = off.',
            when='live',
            bounds=(0.0, 2.0),
        ),
        NodeParameter(
            'image_transport',
            'raw',
            'raw: sensor_msgs/Image on the topic image; compressed: sensor_msgs/CompressedImage '
            'on the topic image/compressed (follows a remapping of image); ffmpeg, foxglove: '
            'video on image/ffmpeg, image/foxglove, decoded by PyAV (docs/integration.md).',
            choices=('raw', 'compressed', 'ffmpeg', 'foxglove'),
        ),
        NodeParameter(
            'backend',
            'auto',
            'Device of networks and of the image distances of localization; auto: CUDA if it is '
            'available. Features gradient and loop closure are computed on the CPU.',
            choices=('auto', 'cpu', 'cuda'),
        ),
    ),
    'Input': (
        NodeParameter(
            'queue_size',
            4,
            'Maximum number of waiting images; a new one drops the oldest.',
            'images',
            bounds=(1, 1000),
        ),
        NodeParameter(
            'max_rate', 0.0, 'Maximum image rate; 0 = unlimited.', 'Hz', 'live', (0.0, 1e4)
        ),
        NodeParameter(
            'keyframe_interval',
            0.0,
            'Minimum time between keyframes; 0 = off.',
            's',
            'live',
            (0.0, 1e4),
        ),
        NodeParameter(
            'max_stamp_gap',
            2.0,
            'A longer time between the stamps of successive images is counted as a gap in the '
            'diagnostics.',
            's',
            'live',
            (0.01, 1e6),
        ),
        NodeParameter(
            'odometry_timeout',
            0.5,
            'Maximum age of the newest odometry message, relative to the stamp of the image.',
            's',
            bounds=(0.0, 60.0),
        ),
    ),
    'Recognition': (
        NodeParameter(
            'threshold',
            -1.0,
            'Mode paper: a window is matched when its distance is below this; negative = the '
            "map's, as suggested by build_map. Mode robust rejects it, see min_probability.",
            'distance',
            'live',
            bounds=(-1.0, 1e6),
        ),
        NodeParameter(
            'nms_radius',
            20,
            'Radius of the non-maximum suppression of the second best and of the candidates.',
            'places',
            bounds=(0, 1000000),
        ),
        NodeParameter(
            'candidates', 10, 'Number of places in ~/candidates.', 'places', 'live', (0, 1000)
        ),
        NodeParameter(
            'min_inliers',
            30,
            'Minimum number of inliers of the geometric check; 20 is sufficient for sift.',
            'keypoints',
            'live',
            (8, 100000),
        ),
        NodeParameter(
            'odometry_error',
            0.1,
            'Mode robust: error of a distance by odometry, as a share of it. Matches whose path '
            'disagrees with the odometry become less probable, where the places have poses in '
            'meters, z up; 0 = never.',
            bounds=(0.0, 1.0),
        ),
        NodeParameter(
            'exclude_seconds',
            0.0,
            'loop_closure: minimum age of the places that are compared, in addition to '
            'exclude_places.',
            's',
            bounds=(0.0, 1e6),
        ),
        NodeParameter(
            'direction',
            'forward',
            'Localization in mode robust: forward, the camera moves along the map, or both, it '
            'may move against it as well: a robot that reverses, or one that comes back and has a '
            'map of its rear camera. ~/match names the direction.',
            choices=('forward', 'both'),
        ),
    ),
    'Recorded maps': (
        NodeParameter(
            'update_map',
            False,
            'Localization: drives that are certain where they are become sessions of the map, as '
            'by `stavpr map update`: in its file, by ~/save_map without a path, and on '
            'deactivation or shutdown. Of max_places images at most. The latest three are kept.',
        ),
        NodeParameter(
            'maps_folder',
            '',
            'Folder of the maps that services name; map_path, save_path and model_path must also '
            'be in it when they are set after the start. Empty: stavpr/maps in $XDG_DATA_HOME, '
            'that is ~/.local/share.',
            when='start',
        ),
        NodeParameter(
            'feature_settings',
            '',
            'Settings of the features as a JSON object; missing keys take their defaults.',
        ),
        NodeParameter(
            'model_path',
            '',
            'File of the network, for features of a network. For a map also a folder with it; '
            'empty: the folder $STAVPR_MODELS, by default ~/.local/share/stavpr_ros/models.',
        ),
        NodeParameter(
            'max_places',
            20000,
            'Maximum number of places of a recorded map: mapping stops there, loop_closure '
            'evicts the oldest eighth of its route.',
            'places',
            bounds=(100, 10000000),
        ),
        NodeParameter(
            'thumbnail_width',
            192,
            'Width of the thumbnails of a recorded map; 0 = none.',
            'pixels',
            bounds=(0, 4096),
        ),
    ),
    'Output': (
        NodeParameter(
            'robot_id',
            '',
            'Name of the robot, copied into the messages and the diagnostics, for systems of '
            'several robots.',
        ),
        NodeParameter('map_frame', 'map', 'Frame of the poses of the map, for ~/pose.'),
        NodeParameter(
            'relative_pose',
            'auto',
            'Relative poses of query and place in ~/loop_closure: pnp (keypoints; requires '
            'camera_info, thumbnails and poses of the places), aligned (by odometry alone), auto '
            '(pnp where it is possible, else aligned), none.',
            choices=('auto', 'none', 'aligned', 'pnp'),
        ),
        NodeParameter(
            'camera_transform',
            '',
            'Pose of the optical frame of the camera (z ahead, x right) in the base of the robot, '
            'whose poses the odometry has: x y z roll pitch yaw, or x y z and a quaternion x y z '
            'w, m and rad. Empty: from tf, where tf2_ros is installed, else a camera at the base '
            'that looks ahead.',
        ),
        NodeParameter(
            'publish_tf',
            False,
            'localization: publish the transform from map_frame to the frame of the odometry on '
            '/tf, from the first match on, every 0.05 s; for maps with poses; requires tf2_msgs, '
            'and odometry on the topic odom. No other node may publish it.',
        ),
        NodeParameter(
            'transform_tolerance',
            0.2,
            'Time by which the transform of publish_tf is post-dated, so that it is known at the '
            'present time. A correction has its effect so much later.',
            's',
            bounds=(0.0, 60.0),
        ),
        NodeParameter(
            'publish_initialpose',
            False,
            'localization: publish initialpose (x, y, yaw), for Nav2, at the first match after '
            'the start, a reset or sequence_length images without a match; for maps with poses.',
        ),
        NodeParameter(
            'localized_probability',
            0.9,
            'localization: ~/localized becomes true after a match of at least this probability '
            'that 3 of the next 5 images confirm.',
            bounds=(0.0, 1.0),
        ),
        NodeParameter(
            'lost_images',
            20,
            '~/localized becomes false after this many images without a match.',
            'images',
            bounds=(1, 1000000),
        ),
        NodeParameter(
            'lost_distance',
            5.0,
            '~/localized becomes false this far, by the odometry where there is one, from the '
            'last match; 0 = by images only.',
            'm',
            bounds=(0.0, 1e6),
        ),
        NodeParameter(
            'subgoal_distance',
            2.0,
            'localization: how far ahead of the matched place, along the route of the map, the '
            'place of ~/subgoal is; number of places on a map without poses.',
            'm',
            bounds=(0.0, 1e4),
        ),
        NodeParameter(
            'subgoal_width',
            0,
            'Width of the image on ~/subgoal; 0 = of the thumbnails of the map.',
            'pixels',
            bounds=(0, 4096),
        ),
        NodeParameter(
            'diagnostics_period', 1.0, 'Period of the diagnostics.', 's', 'start', (0.1, 60.0)
        ),
        NodeParameter(
            'verbosity',
            'default',
            'Log level of the node; default: as set by --log-level.',
            when='live',
            choices=('default', 'debug', 'info', 'warn', 'error'),
        ),
    ),
    'Computation and life cycle': (
        NodeParameter(
            'precision',
            'auto',
            'Precision of the features of the map; int8 quarters their memory and, on large maps '
            'on a CPU, takes less than half the time. auto: int8 in mode robust on the CPU for '
            '2,000 places and more, else float32. In loop closure, auto is float32, and int8 '
            'applies to a route of 2,000 places and more.',
            choices=('auto', 'float32', 'int8'),
        ),
        NodeParameter(
            'threads', 0, 'CPU threads of the numerics; 0 = all.', 'threads', bounds=(0, 1024)
        ),
        NodeParameter(
            'autostart',
            True,
            'The node configures and activates itself; false: a lifecycle manager does.',
            when='start',
        ),
        NodeParameter(
            'bond_heartbeat_period',
            0.25,
            'Period of the heartbeats of the bond to a lifecycle manager of Nav2, where the '
            'package bond is installed; 0 = no bond.',
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
