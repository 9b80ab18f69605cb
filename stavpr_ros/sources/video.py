# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A video file as a sequence of images."""

from collections.abc import Callable, Iterable, Iterator
import math
import os
from pathlib import Path
import select
import subprocess
import sys
from typing import Self

import numpy as np
from stavpr_ros.checks import require_above
from stavpr_ros.errors import ImageError, SettingsError, SourceError
from stavpr_ros.regular_file import require_regular
from stavpr_ros.sources.files import MAX_PIXELS
from stavpr_ros.sources.frame import Frame, ImageRecord
from stavpr_ros.sources.video_decoder import (
    EARLY,
    FACTS,
    FRAME,
    MEMORY,
    NO_BACKEND,
    NO_MEMORY,
    NOT_OPENED,
    TOO_LARGE,
)
from stavpr_ros.units import SECOND

SUFFIXES = frozenset({'.mp4', '.m4v', '.mov', '.avi', '.mkv', '.webm', '.3gp'})
FPS = 5.0
"""Images taken per second: 20 of them, the length of a window, show 4 s of the route."""
TIMEOUT = 30.0  # seconds for the start of the decoder, and for each frame
COMPLETE = 0.9  # share of the stated frames, whose number may be an estimate
MODULE = 'stavpr_ros.sources.video_decoder'
REMEDY = 'play it to the end to check it, or convert it: ffmpeg -i FILE converted.mp4'
REASONS = {
    NOT_OPENED: 'is damaged, cut off or no video that OpenCV decodes',
    TOO_LARGE: f'has frames of more than {MAX_PIXELS} pixels',
    NO_BACKEND: 'cannot be decoded: this OpenCV is built without FFmpeg',
    NO_MEMORY: f'needs more than the {MEMORY >> 30} GiB of memory of the decoder',
}


def is_video(path: str | Path) -> bool:
    """Return whether a path is a video, by its name only."""
    return Path(path).suffix.lower() in SUFFIXES and not Path(path).is_dir()


def require_video(fps: float | None, paths: Iterable[str | None]) -> None:
    """
    Reject the option ``--fps`` where no input is a video.

    :raises SettingsError: it is given, and none is.
    """
    if fps is not None and not any(path is not None and is_video(path) for path in paths):
        raise SettingsError(f'--fps {fps:g}: no input is a video (.mp4, .mov ...); leave it out')


class VideoSource:
    """
    Images of a video, at a fixed rate, upright by the rotation that the file states.

    Iterating yields :class:`Frame` with ``name#i`` as identifier, i counting the images from 0. A
    stamp is the time of the frame in the container, counted from 1 s, since 0 is unknown.

    Each iteration decodes in a process of its own, with limited memory and time: a damaged
    file cannot crash this one.

    :param path: .mp4, .m4v, .mov, .avi, .mkv, .webm or .3gp, of a codec that OpenCV decodes.
    :param on_error: called with an :class:`ImageError` if the video ends early; without it the
        error is raised.
    :param fps: images per second of video; all frames if it has fewer.
    :raises SettingsError: the rate is not above 0.
    :raises SourceError: it cannot be decoded, or its stamps do not increase.
    """

    def __init__(
        self,
        path: str | Path,
        on_error: Callable[[ImageError], None] | None = None,
        fps: float = FPS,
    ) -> None:
        require_above('fps', fps, 0)
        self.path, self.on_error, self.fps = Path(path), on_error, fps
        try:
            require_regular(self.path)  # a pipe would never end
        except OSError as error:
            raise SourceError(
                f'{path} cannot be read: {error.strerror}; check its name and permissions'
            ) from error
        with _Decoder(self.path, fps) as decoder:
            frame_count, rate = decoder.facts()
        most = self.path.stat().st_size  # no frame is smaller than a byte
        self._stated = min(frame_count, most) if frame_count > 0 else 0
        self._rate = rate if 0 < rate < math.inf else fps

    def __len__(self) -> int:
        """Return the number of images by the container's number of frames: an estimate."""
        if self._stated < 1:
            return 0
        last = (self._stated - 1) / self._rate
        return int(min(self._stated, (last + EARLY) * self.fps // 1 + 1))

    def __iter__(self) -> Iterator[Frame]:
        """Decode one image after the other."""
        frames, last, i = 0, -math.inf, 0
        with _Decoder(self.path, self.fps) as decoder:
            decoder.facts()
            try:
                while header := decoder.read(FRAME.size):
                    seconds, height, width = FRAME.unpack(header)
                    if not last < seconds < math.inf:
                        raise SourceError(
                            f'{self.path}: frame {frames} has the stamp {seconds:.3f} s after '
                            f'{last:.3f} s: expected increasing stamps; {REMEDY}'
                        )
                    frames, last = frames + 1, seconds
                    if height * width > MAX_PIXELS:
                        raise SourceError(f'{self.path} {REASONS[TOO_LARGE]}; {REMEDY}')
                    if height * width:
                        pixels = decoder.read(height * width * 3)
                        image = np.frombuffer(pixels, np.uint8).reshape(height, width, 3)
                        stamp = SECOND + round(seconds * SECOND)
                        yield Frame(image, stamp, f'{self.path.name}#{i}')
                        i += 1
                reason = decoder.reason()
            except _DecoderError as error:
                reason = str(error)
        if not frames:
            raise SourceError(f'{self.path} has no frame that can be decoded; {REMEDY}')
        if reason or frames < COMPLETE * self._stated:
            early = ImageError(
                f'{self.path} ends early, after {frames} of about {self._stated:.0f} frames'
                f'{reason and ": "}{reason}',
                kind='cut off',
            )
            if self.on_error is None:
                raise early
            self.on_error(early)

    def records(self, start: float = 0.0, duration: float = math.inf) -> Iterator[ImageRecord]:
        """
        Yield the images as messages.

        :param start: seconds after the start of the video.
        :param duration: seconds from there on.
        """
        for frame in self:
            seconds = (frame.stamp - SECOND) / SECOND
            if seconds >= start + duration:
                return
            if seconds >= start:
                yield ImageRecord.of_image(frame.image, frame.stamp)


class _DecoderError(Exception):
    """The decoder has ended or stalled; the text is the reason."""


class _Decoder:
    """A running decoder; killed at the end of the block."""

    def __init__(self, path: Path, fps: float) -> None:
        self._path = path
        one = dict.fromkeys(('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS'), '1')
        self._process = subprocess.Popen(
            [sys.executable, '-m', MODULE, str(path.absolute()), str(fps)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            process_group=0,  # an interrupt from the terminal is for this process
            env=os.environ | one,
        )
        assert self._process.stdout is not None
        self._output = self._process.stdout

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        self._output.close()

    def facts(self) -> tuple[float, float]:
        """Return the stated number of frames and frames per second, both perhaps wrong."""
        try:
            content = self.read(FACTS.size)
            reason = '' if content else self.reason()
        except _DecoderError as error:
            content, reason = bytearray(), str(error)
        if not content:
            raise SourceError(f'{self._path} {reason}; {REMEDY}')
        frame_count, rate = FACTS.unpack(content)
        return frame_count, rate

    def read(self, size: int) -> bytearray:
        """Return the next bytes, or none at the end; raise _DecoderError if it is not in time."""
        content = bytearray(size)
        rest = memoryview(content)
        poll = select.poll()
        poll.register(self._output, select.POLLIN)
        while rest:
            if not poll.poll(TIMEOUT * 1000):
                raise _DecoderError(f'no frame was decoded in {TIMEOUT:g} s')
            count = os.readv(self._output.fileno(), [rest])
            if not count:
                if len(rest) == size:
                    return bytearray()
                raise _DecoderError(self.reason() or 'the decoder ended within a frame')
            rest = rest[count:]
        return content

    def reason(self) -> str:
        """Return why the decoder ended, '' for the end of the video."""
        try:
            code = self._process.wait(TIMEOUT)
        except subprocess.TimeoutExpired:
            return f'the decoder did not end in {TIMEOUT:g} s'
        if code < 0:
            return f'crashed the decoder with signal {-code}'
        return REASONS.get(code, f'ended the decoder with status {code}') if code else ''
