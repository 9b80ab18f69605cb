# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A video, in one file or several, as a sequence of images."""

from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing, suppress
from itertools import islice
import math
from multiprocessing import Pipe
import os
from pathlib import Path
import subprocess
import sys

import numpy as np
from stavpr_ros.checks import require_above
from stavpr_ros.errors import ImageError, SettingsError, SourceError
from stavpr_ros.regular_file import require_regular
from stavpr_ros.sources.bag_path import reading
from stavpr_ros.sources.files import reduce
from stavpr_ros.sources.folder import PROXIES, VIDEOS
from stavpr_ros.sources.frame import Frame, ImageRecord
from stavpr_ros.sources.notes import note_once
from stavpr_ros.sources.order import natural_key
from stavpr_ros.sources.suffixes import SUFFIXES as IMAGES
from stavpr_ros.sources.video_decoder import CUT_OFF, EARLY, FACTS, FRAME, JUMP, REASONS, REMEDY
from stavpr_ros.units import SECOND

FPS = 5.0
"""Images taken per second: 20 of them, the length of a window, show 4 s of the route."""
TIMEOUT = 30.0  # seconds for the start of the decoder, and for each frame
SAME_RATE = 0.05  # relative difference of the frame rates of one camera
MODULE = 'stavpr_ros.sources.video_decoder'


def video_files(path: str | Path) -> list[Path]:
    """
    Return a video's file, or the videos of a folder in natural order, by names only.

    Among more images than videos, videos are not the drive: a telephone adds one to each photo.
    """
    path = Path(path)
    with reading(path):
        files = list(path.glob('[!.]*')) if path.is_dir() else [path]
        videos = [file for file in files if file.suffix.lower() in VIDEOS and not file.is_dir()]
    videos = [file for file in videos if file.suffix.lower() not in PROXIES] or videos
    if sum(file.suffix.lower() in IMAGES for file in files) >= max(len(videos), 2):
        return []
    return sorted(videos, key=lambda file: natural_key(file.name))


def is_video(path: str | Path) -> bool:
    """Return whether a path is a video, or a folder with videos, by names only."""
    return bool(video_files(path))


def require_video(fps: float | None, paths: Iterable[str | None]) -> None:
    """Raise SettingsError if the option ``--fps`` is given, and no input is a video."""
    if fps is not None and not any(path is not None and is_video(path) for path in paths):
        raise SettingsError(f'--fps {fps:g}: no input is a video (.mp4, .mov ...); leave it out')


class VideoSource:
    """
    Images of a video, at a fixed rate, upright by the rotation that the file states.

    Iterating yields :class:`Frame` with ``name#i`` as identifier, i counting the images from 0. A
    stamp is the time since the first frame, counted from the creation time that the file states,
    else from 1 s, since 0 is unknown. Of an interlaced frame, one field is taken.
    ``min_size`` is as of a :class:`stavpr_ros.sources.folder.FolderSource`.

    Each iteration decodes in a process of its own, with limited memory and time: a damaged
    file cannot crash this one.

    :param path: a file that FFmpeg decodes; or a folder with the files of one drive, of one size
        and frame rate, in natural order of their names: stamps go on from file to file.
    :param on_error: called with an :class:`ImageError` if a file ends early; without it the error
        is raised.
    :param fps: images per second of video; all frames if it has fewer.
    :raises SettingsError: the rate is not above 0.
    :raises SourceError: a file cannot be decoded, or they are not one drive.
    """

    def __init__(
        self,
        path: str | Path,
        on_error: Callable[[ImageError], None] | None = None,
        fps: float = FPS,
    ) -> None:
        require_above('fps', fps, 0)
        self.path, self.on_error, self.fps = Path(path), on_error, fps
        self.min_size: tuple[int, int] | None = None
        self._files = video_files(path) if self.path.is_dir() else [self.path]
        if any(file.suffix.lower() in IMAGES for file in self.path.glob('[!.]*')):
            raise SourceError(f'{path} has videos and images: expected one kind; name a video')
        for file in self._files:
            with reading(file):
                require_regular(file)  # a pipe would never end
        facts = []
        with closing(_messages(self._files, fps)) as messages:
            for file in self._files:
                try:
                    facts.append(FACTS.unpack(next(messages)))
                except _DecoderError as error:
                    raise SourceError(f'{file} {error}') from error
        self._durations, rates, created, *sizes = np.array(facts).T
        self._rate = rates[0]
        disorder = created.all() and (np.diff(created) < 0).any()
        if disorder or np.ptp(sizes, 1).any() or np.ptp(rates) > SAME_RATE * self._rate:
            rows = zip(self._files, facts, strict=True)
            videos = ', '.join(
                f'{file.name} ({w}x{h}, {r:.4g} Hz)' for file, (_, r, _, h, w) in rows
            )
            raise SourceError(
                f'{path} has videos of several sizes or rates, or not in the order of creation: '
                f'expected the files of one drive; name one of {videos}'
            )
        self._start = round(created[0] * SECOND) or SECOND

    def __len__(self) -> int:
        """Return the number of images by the stated durations: an estimate."""
        duration, frames = self._durations.sum(), self._durations.sum() * self._rate
        # no frame is smaller than a byte
        if not 0 < frames < sum(file.stat().st_size for file in self._files):
            return 0
        return int(min(frames, (duration - 1 / self._rate + EARLY) * self.fps // 1 + 1))

    def __iter__(self) -> Iterator[Frame]:
        """Decode one image after the other."""
        i, file, seconds = 0, 0, 0.0
        with closing(_messages(self._files, self.fps)) as messages:
            try:
                for header in islice(messages, len(self._files), None):
                    seconds, file, height, width = FRAME.unpack(header)
                    if height:
                        image = np.frombuffer(next(messages), np.uint8)
                        stamp = self._start + round(seconds * SECOND)
                        name = f'{self._files[file].name}#{i}'
                        image = reduce(image.reshape(height, width, 3), self.min_size)
                        yield Frame(image, stamp, name)
                        i += 1
                    elif width == CUT_OFF:
                        self._cut_off(file, seconds)
                    elif width == JUMP:
                        note_once(
                            f'the clock of {self._files[file]} jumps by {seconds:.0f} s: the '
                            'images behind it follow at the frame rate; it may be several drives'
                        )
            except _DecoderError as error:
                self._cut_off(file, seconds, f': {error}')
        if not i:
            raise SourceError(f'{self.path} has no frame that can be decoded; {REMEDY}')

    def _cut_off(self, file: int, seconds: float, reason: str = '') -> None:
        early = ImageError(
            f'{self._files[file]} ends early, after {seconds:.1f} s of about '
            f'{self._durations[file]:.1f} s{reason}',
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
            seconds = (frame.stamp - self._start) / SECOND
            if seconds >= start + duration:
                return
            if seconds >= start:
                yield ImageRecord.of_image(frame.image, frame.stamp)


class _DecoderError(Exception):
    """The decoder has ended or stalled; the text is the reason."""


def _messages(files: list[Path], fps: float) -> Generator[bytearray]:
    """Yield what a decoder sends; end it at the end; raise _DecoderError if it is not in time."""
    messages, end = Pipe(duplex=False)
    threads = dict.fromkeys(('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS'), '1')
    with messages:
        with end:
            process = subprocess.Popen(
                [sys.executable, '-m', MODULE, str(fps), *(file.absolute() for file in files)],
                stdin=subprocess.DEVNULL,
                stdout=end.fileno(),
                stderr=subprocess.DEVNULL,
                process_group=0,  # an interrupt from the terminal is for this process
                env=os.environ | threads,
            )
        try:
            with suppress(EOFError, OSError):  # ended, perhaps within a message
                while messages.poll(TIMEOUT):
                    yield bytearray(messages.recv_bytes())
                raise _DecoderError(f'no frame was decoded in {TIMEOUT:g} s')
            with suppress(subprocess.TimeoutExpired):
                process.wait(TIMEOUT)
        finally:
            process.kill()
            process.wait()
    if (code := process.returncode) < 0:
        raise _DecoderError(f'crashed the decoder with signal {-code}')
    if code:
        raise _DecoderError(REASONS.get(code, f'ended the decoder with status {code}'))
