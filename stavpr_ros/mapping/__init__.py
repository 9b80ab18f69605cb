"""The reference map: build, grow, save, load; and which images become its places."""

from stavpr_ros.mapping.builder import build_map, extract_features
from stavpr_ros.mapping.growing_map import GrowingMap
from stavpr_ros.mapping.keyframes import KeyframeSelector, KeyframeSettings, image_change, small_gray
from stavpr_ros.mapping.map_file import load_map, open_map, save_map
from stavpr_ros.mapping.place import Place, place_at, place_thumbnail
from stavpr_ros.mapping.place_map import PlaceMap, encode_thumbnail
from stavpr_ros.mapping.trajectory import Trajectory, distance, rotation

__all__ = [
    'GrowingMap',
    'KeyframeSelector',
    'KeyframeSettings',
    'Place',
    'PlaceMap',
    'Trajectory',
    'build_map',
    'extract_features',
    'distance',
    'encode_thumbnail',
    'image_change',
    'load_map',
    'open_map',
    'place_at',
    'place_thumbnail',
    'rotation',
    'save_map',
    'small_gray',
]
