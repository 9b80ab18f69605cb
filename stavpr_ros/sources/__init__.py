# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Folders, videos, bags and messages to images."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from stavpr_ros.checks import require_type
from stavpr_ros.errors import ImageError, SourceError
from stavpr_ros.regular_file import elsewhere

if TYPE_CHECKING:
    from stavpr_ros.sources.bag import BagSource
    from stavpr_ros.sources.folder import FolderSource
    from stavpr_ros.sources.video import VideoSource

Source: TypeAlias = 'FolderSource | VideoSource | BagSource'


def open_source(
    path: str | Path,
    topic: str | None = None,
    on_error: Callable[[ImageError], None] | None = None,
    fps: float | None = None,
    camera: str | None = None,
) -> Source:
    """
    Open a folder of images, a video or a bag, whichever it is.

    :param path: a folder of images; a video (.mp4, .mov ...); a ROS 2 bag (its folder, or its .db3
        or .mcap file); a ROS 1 .bag file; a folder of the videos or .bag files of one drive.
    :param topic: the bag's image topic; may be left out if there is only one. Of bags only.
    :param on_error: called with the error of an image that cannot be decoded, which is then
        skipped; without it the error is raised.
    :param fps: images per second that are taken of a video, 5 if not given; all images of the
        others are.
    :param camera: the camera to read of a folder with the images of several. Of folders only.
    :raises SettingsError: ``fps`` is not above 0.
    :raises SourceError: it cannot be read, or the topic or the camera is ambiguous.
    """
    # imported on use: rosbags and OpenCV load slowly
    from stavpr_ros.sources.bag_path import is_bag, reading
    from stavpr_ros.sources.folder import FolderSource
    from stavpr_ros.sources.notes import note_once
    from stavpr_ros.sources.suffixes import SUFFIXES
    from stavpr_ros.sources.video import FPS, is_video, VideoSource

    require_type('path', path, (str, Path), 'the path of a folder of images, a video or a bag')
    path = Path(path)
    with reading(path):
        exists, reason = path.exists(), elsewhere(path)
    if reason:
        raise SourceError(f'{path} is {reason}')
    if not exists:
        raise SourceError(f'{path} does not exist: expected a folder of images, a video or a bag')
    if camera is not None and not is_folder(path):
        raise SourceError(f'camera {camera!r} was given, but {path} is no folder of images')
    if is_bag(path):
        from stavpr_ros.sources.bag import BagSource

        images = path.is_dir() and sum(file.suffix.lower() in SUFFIXES for file in path.iterdir())
        if images > 1:
            note_once(
                f'{path} is a bag beside {images} images: the bag is read; to read the images, '
                'move them to a folder of their own'
            )
        return BagSource(path, topic, on_error)
    if topic is not None:
        raise SourceError(f'topic {topic!r} was given, but {path} is no bag: leave the topic out')
    if is_video(path):
        return VideoSource(path, on_error, FPS if fps is None else fps)
    if not path.is_dir():
        raise SourceError(
            f'{path} is no folder, video or bag: expected images, a video (.mp4, .mov ...), a '
            'ROS 2 bag (folder, .db3, .mcap) or a ROS 1 .bag'
        )
    return FolderSource(path, on_error, camera)


def is_folder(path: str | Path) -> bool:
    """Return whether a path is a folder of images, by names only."""
    from stavpr_ros.sources.bag_path import is_bag
    from stavpr_ros.sources.video import is_video

    return Path(path).is_dir() and not is_bag(Path(path)) and not is_video(path)
