# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The program that decodes a video for :class:`stavpr_ros.sources.video.VideoSource`.

``python3 -m stavpr_ros.sources.video_decoder FILE FPS`` writes to its standard output the number
of frames and their rate as the container states them (``FACTS``), then a header (``FRAME``) for
every decoded frame, with height and width 0 for those between the images that are taken. The
pixels of an image follow its header: RGB, uint8.
"""

import math
import os
import resource
import struct
import sys
from typing import BinaryIO

FACTS = struct.Struct('<dd')
FRAME = struct.Struct('<dII')  # seconds after the start, height, width
MEMORY = 4 << 30  # bytes of address space
NOT_OPENED, TOO_LARGE, NO_BACKEND, NO_MEMORY = 3, 4, 5, 6  # exit codes; 0 = end of the video
EARLY = 0.002  # seconds that an image may be early by: containers round to milliseconds

CONTAINERS = 'mov,mp4,m4a,3gp,3g2,mj2,avi,matroska,webm'
OPTIONS = f'protocol_whitelist;file|format_whitelist;{CONTAINERS}|threads;2'
"""Of FFmpeg: without playlists, which name other files and addresses."""


def main(path: str, fps: float, output: BinaryIO) -> int:
    """Decode a video; return the exit code."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    os.environ['OPENCV_FFMPEG_CAPTURE_OPTIONS'] = OPTIONS
    import cv2

    if cv2.CAP_FFMPEG not in cv2.videoio_registry.getStreamBackends():
        return NO_BACKEND
    try:
        return _decode(path, fps, output)
    except (MemoryError, cv2.error):
        return NO_MEMORY


def _decode(path: str, fps: float, output: BinaryIO) -> int:
    import cv2
    from stavpr_ros.sources.files import MAX_PIXELS

    capture = cv2.VideoCapture(path, cv2.CAP_FFMPEG)
    if not capture.isOpened():
        return NOT_OPENED
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
    get = capture.get
    if get(cv2.CAP_PROP_FRAME_WIDTH) * get(cv2.CAP_PROP_FRAME_HEIGHT) > MAX_PIXELS:
        return TOO_LARGE
    output.write(FACTS.pack(get(cv2.CAP_PROP_FRAME_COUNT), get(cv2.CAP_PROP_FPS)))
    output.flush()
    due = -math.inf  # number of the next image, by its time
    while capture.grab():
        seconds = get(cv2.CAP_PROP_POS_MSEC) / 1000
        number = (seconds + EARLY) * fps
        image = capture.retrieve()[1] if number >= due else None
        if image is None:
            output.write(FRAME.pack(seconds, 0, 0))
        else:
            output.write(FRAME.pack(seconds, *image.shape[:2]))
            output.write(cv2.cvtColor(image, cv2.COLOR_BGR2RGB).data)
            due = math.floor(number) + 1
        output.flush()
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1], float(sys.argv[2]), sys.stdout.buffer))
