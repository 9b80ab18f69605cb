"""The reference map: build, save, load."""

from stavpr_ros.mapping.build import build_map, describe_frames
from stavpr_ros.mapping.place_map import PlaceMap, encode_thumbnail
from stavpr_ros.mapping.storage import load_map, save_map

__all__ = ['PlaceMap', 'build_map', 'describe_frames', 'encode_thumbnail', 'load_map', 'save_map']
