"""
The node's parameters: one table, from which declaration, checks, documentation and configuration follow.

``python3 -m stavpr_ros.ros.parameters``, in a checkout, writes the configuration file and the README's table.
"""

from pathlib import Path

from stavpr_ros.alignment.settings import STRATEGIES
from stavpr_ros.devices import BACKENDS
from stavpr_ros.features.registry import KINDS
from stavpr_ros.pipeline.settings import OPERATIONS
from stavpr_ros.recognition.matcher import PRECISIONS
from stavpr_ros.recognition.robust.options import MODES
from stavpr_ros.ros.parameter_table import (
    TABLE_HEAD,
    NodeParameter,
    configuration_yaml,
    documentation_markdown,
)

TRANSPORTS = ('raw', 'compressed')
CHECKS = ('none', 'orb', 'sift')
VERBOSITIES = ('default', 'debug', 'info', 'warn', 'error')

_WHAT = (
    NodeParameter(
        'operation',
        'localization',
        '',
        'What is done with images: localization on a fixed map, mapping (a map grows), or loop_closure '
        '(places that the same route has passed before).',
        'live',
        choices=OPERATIONS,
    ),
    NodeParameter(
        'map_path',
        '',
        '',
        'Map file made by build_map or save_map; without one, localization waits, mapping begins a new map.',
        'live',
    ),
    NodeParameter(
        'threshold',
        -1.0,
        'distance',
        'A window is matched when its distance is below this; negative = 1 in mode robust (0.8 for '
        'loop_closure), where 1 is as near as unknown places come; in mode paper the node waits until it '
        'is set.',
        'live',
        bounds=(-1.0, 1e6),
    ),
    NodeParameter(
        'mode',
        'robust',
        '',
        'How places are recognized: paper is STA-VPR as published; robust goes beyond it.',
        choices=MODES,
    ),
    NodeParameter(
        'autostart', True, '', 'Configure and activate the node by itself; else a manager does it.', 'start'
    ),
)

_INPUT = (
    NodeParameter(
        'image_transport',
        'raw',
        '',
        'raw: sensor_msgs/Image on the topic image; compressed: sensor_msgs/CompressedImage on /compressed '
        'below what image is remapped to.',
        choices=TRANSPORTS,
    ),
    NodeParameter(
        'queue_size',
        4,
        'images',
        'Images that may wait; when one more comes, the oldest is dropped.',
        bounds=(1, 1000),
    ),
    NodeParameter(
        'max_rate',
        0.0,
        'Hz',
        'Images that come faster than this are skipped; 0 = none are.',
        'live',
        (0.0, 1e4),
    ),
    NodeParameter(
        'keyframe_interval',
        0.0,
        's',
        'An image counts only so long after the last that counted; 0 = at once.',
        'live',
        bounds=(0.0, 1e4),
    ),
    NodeParameter(
        'keyframe_distance',
        0.0,
        'm',
        'An image counts only when the camera has moved this far (or turned by keyframe_angle) since the '
        'last that counted, by nav_msgs/Odometry on the topic odom; 0 = not asked.',
        'live',
        bounds=(0.0, 1e4),
    ),
    NodeParameter(
        'keyframe_angle',
        0.0,
        'degrees',
        'See keyframe_distance; 0 = turning does not count.',
        'live',
        bounds=(0.0, 180.0),
    ),
    NodeParameter(
        'keyframe_change',
        0.004,
        '',
        'An image counts only when it differs by this from the last that counted (1 - correlation of small '
        'gray pictures), so that a robot that stands still does not fill the window; 0 = not asked.',
        'live',
        bounds=(0.0, 2.0),
    ),
    NodeParameter(
        'max_stamp_gap',
        2.0,
        's',
        'A longer time between the stamps of two images is counted as a gap in the diagnostics.',
        'live',
        bounds=(0.01, 1e6),
    ),
    NodeParameter(
        'odometry_timeout',
        0.5,
        's',
        'The newest odometry is taken for an image that is this much newer.',
        bounds=(0.0, 60.0),
    ),
)

_METHOD = (
    NodeParameter(
        'strategy',
        'adaptive',
        '',
        'How the strips of two images are aligned.',
        choices=STRATEGIES,
    ),
    NodeParameter(
        'sigma', 1.0, '', 'How strongly a viewpoint change penalizes diagonal steps.', bounds=(0.0, 100.0)
    ),
    NodeParameter(
        'xi',
        0,
        'strips',
        'Restricted alignment: strips this far apart are never aligned; 0 = no restriction.',
        bounds=(0, 1000),
    ),
    NodeParameter(
        'vertical',
        False,
        '',
        'Align the cells of two strips from top to bottom first, for cameras that rise and sink; slow.',
    ),
    NodeParameter('sequence_length', 20, 'images', 'Images in the query window, l.', bounds=(2, 1000)),
    NodeParameter(
        'beta',
        2.0,
        '',
        'Map images considered per query image, above 1 (mode paper).',
        bounds=(1.01, 20.0),
    ),
    NodeParameter(
        'nms_radius',
        20,
        'places',
        'The second best, and every candidate, is more than so many places from those that are nearer.',
        bounds=(0, 1000000),
    ),
    NodeParameter('candidates', 10, 'places', 'Nearest places in ~/candidates.', 'live', (0, 1000)),
    NodeParameter(
        'geometric_check',
        'none',
        '',
        'Check matches by keypoints and epipolar geometry, the newest image against its place.',
        'live',
        choices=CHECKS,
    ),
    NodeParameter(
        'min_inliers',
        30,
        'keypoints',
        'A match with fewer inliers is rejected by the geometric check; 20 will do for sift.',
        'live',
        bounds=(8, 100000),
    ),
)

_GROWING = (
    NodeParameter(
        'features', 'gradient', '', 'Features of a map that is begun without map_path.', choices=tuple(KINDS)
    ),
    NodeParameter(
        'feature_settings', '', '', 'Their settings as a JSON object; what it does not name is the default.'
    ),
    NodeParameter(
        'model_path',
        '',
        '',
        "File of the network, for maps made with one, if it is not where the map's maker had it.",
    ),
    NodeParameter(
        'exclude_places',
        50,
        'places',
        'loop_closure: the latest places of the route, which are not compared.',
        bounds=(1, 1000000),
    ),
    NodeParameter(
        'exclude_seconds',
        0.0,
        's',
        'loop_closure: nor are places younger than this.',
        bounds=(0.0, 1e6),
    ),
    NodeParameter(
        'max_places',
        20000,
        'places',
        'Most places of a growing map: when it is full, mapping stops, and loop_closure forgets the oldest '
        'eighth of its route.',
        bounds=(100, 10000000),
    ),
    NodeParameter(
        'thumbnail_width',
        192,
        'pixels',
        'Width of the pictures of a growing map; 0 = none.',
        bounds=(0, 4096),
    ),
)

_OUTPUT = (
    NodeParameter(
        'save_path',
        '',
        '',
        'File that what has grown is written to when the node is deactivated or ends; a file of another map '
        'that is there stays, and a name beside it is taken.',
        'live',
    ),
    NodeParameter('map_frame', 'map', '', "Frame of the map's poses, for ~/pose."),
    NodeParameter('diagnostics_period', 1.0, 's', 'Time between two diagnostics.', 'start', (0.1, 60.0)),
    NodeParameter(
        'verbosity',
        'default',
        '',
        'What the node logs; default: as --log-level has it.',
        'live',
        choices=VERBOSITIES,
    ),
)

_MACHINE = (
    NodeParameter(
        'backend',
        'auto',
        '',
        'Where images are matched; auto takes cuda if it is there and says what it took.',
        choices=BACKENDS,
    ),
    NodeParameter(
        'precision',
        'float32',
        '',
        "How the map's features are kept; float16 takes half the memory and, on large maps, half the time.",
        choices=PRECISIONS,
    ),
    NodeParameter('threads', 0, 'threads', 'Processor threads for the numerics; 0 = all.', bounds=(0, 1024)),
)

PARAMETERS = _WHAT + _INPUT + _METHOD + _GROWING + _OUTPUT + _MACHINE
BY_NAME = {row.name: row for row in PARAMETERS}


def _write_documentation() -> None:
    """Write the table into the configuration file and the README of the checkout in the current folder."""
    Path('config/stavpr.yaml').write_text(configuration_yaml(PARAMETERS))
    readme = Path('README.md')
    before, _, rest = readme.read_text().partition(TABLE_HEAD)
    after = rest.partition('\n\n')[2]
    readme.write_text(f'{before}{documentation_markdown(PARAMETERS)}\n{after}')


if __name__ == '__main__':
    _write_documentation()
