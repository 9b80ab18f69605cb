"""The reference map: build, grow, save, load; and which images become its places."""

from stavpr_ros.mapping.build import build_map, describe_frames
from stavpr_ros.mapping.growing import GrowingMap
from stavpr_ros.mapping.keyframes import KeyframeSelector, KeyframeSettings, image_change, small_grey
from stavpr_ros.mapping.place_map import PlaceMap, encode_thumbnail
from stavpr_ros.mapping.storage import load_map, save_map
from stavpr_ros.mapping.trajectory import Trajectory, distance, rotation

__all__ = [
    'GrowingMap',
    'KeyframeSelector',
    'KeyframeSettings',
    'PlaceMap',
    'Trajectory',
    'build_map',
    'describe_frames',
    'distance',
    'encode_thumbnail',
    'image_change',
    'load_map',
    'rotation',
    'save_map',
    'small_grey',
]
