# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The program that decodes videos for :class:`stavpr_ros.sources.video.VideoSource`, with PyAV.

``python3 -m stavpr_ros.sources.video_decoder FPS FILE...`` writes messages to its standard output,
a connection: what each file states (``FACTS``); then a header (``FRAME``) for every decoded frame,
which the pixels of an image follow: RGB, uint8. Frames between the images have height and width 0.
A file that is shorter than it states ends with a header of the seconds that it has, ``CUT_OFF``;
a header ``JUMP`` precedes the first frame where the clock of a file jumps.
"""

from collections.abc import Iterator
from contextlib import suppress
from datetime import datetime, UTC
import math
from multiprocessing.connection import Connection
import resource
import struct
import sys
from typing import Any

import numpy as np
from stavpr_ros.sources.frame import MAX_PIXELS

FACTS = struct.Struct('<dddII')  # duration, s; rate, Hz; creation, s since 1970; height, width
FRAME = struct.Struct('<dIII')  # seconds after the start of the first file, file, height, width
CUT_OFF, JUMP = 1, 2  # width of a header without height
MEMORY = 4 << 30  # bytes of address space
MIN_COMPLETE = 0.9  # share of the stated duration, which may be an estimate
EARLY = 0.002  # seconds that an image may be early by: containers round to milliseconds
RESTART = 1.0  # seconds back: another recording in the same file, no frames out of order
AHEAD = 10.0  # seconds, or periods, ahead in a stream: another clock, as ffmpeg takes it, no pause
TICK = 1e-4  # seconds: nearer times are equal
RATE = 25  # Hz, of a file that states none
NO_TIMES = 0x80  # AVFMT_NOTIMESTAMPS: bare streams, whose duration and rate are guesses
DISCONTINUOUS = 0x200  # AVFMT_TS_DISCONT: streams, whose clocks may jump
HDR = {16, 18}  # transfer functions PQ and HLG, shown as BT.709, 1

REFERENCES = 'concat dash hls image2 imf lavfi rtsp sap sdp vapoursynth avisynth vobsub'
"""Containers of names of other files and addresses, or programs: not read."""

REMEDY = 'play it to the end to check it, or convert it: ffmpeg -i FILE converted.mp4'
NOT_OPENED, TOO_LARGE, NO_PYAV = 3, 4, 5  # exit codes; 0 = end of the last file
REASONS = {
    NOT_OPENED: f'is damaged, cut off, no video that FFmpeg decodes, or too large; {REMEDY}',
    TOO_LARGE: f'has frames of more than {MAX_PIXELS} pixels; {REMEDY}',
    NO_PYAV: 'needs PyAV, which is not installed: pip install av',
}


def main(fps: float, paths: list[str], output: Connection) -> int:
    """Decode videos as one; return the exit code."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        import av
    except ImportError:
        return NO_PYAV
    try:
        for path in paths:
            with _open(path) as container:
                output.send_bytes(FACTS.pack(*_facts(container)))
        decode(fps, paths, output)
    except (av.FFmpegError, MemoryError):
        return NOT_OPENED
    return 0


def _open(path: str) -> Any:
    import av

    formats = ','.join(av.formats_available.difference(REFERENCES.split()))
    options = {'protocol_whitelist': 'file', 'format_whitelist': formats}
    return av.open(path, options=options, metadata_errors='replace')


def _video(container: Any) -> Any:
    """Return the first track of video that is no cover or thumbnail, if there is one."""
    from av.stream import Disposition

    stills = Disposition.attached_pic | Disposition.timed_thumbnails
    tracks = [track for track in container.streams.video if track.codec_context is not None]
    tracks.sort(key=lambda track: bool(track.disposition & stills) or track.frames == 1)
    if not tracks:
        sys.exit(NOT_OPENED)
    if tracks[0].width * tracks[0].height > MAX_PIXELS:
        sys.exit(TOO_LARGE)
    return tracks[0]


def _facts(container: Any) -> tuple[float, float, float, int, int]:
    stream, duration, created = _video(container), (container.duration or 0) / 1e6, 0.0
    bare = container.format.flags & NO_TIMES
    rate = (not bare and stream.average_rate) or stream.guessed_rate or RATE
    with suppress(ValueError):
        creation = datetime.fromisoformat(container.metadata.get('creation_time', ''))
        created = creation.replace(tzinfo=creation.tzinfo or UTC).timestamp()
        created *= 0 < created < 2**31  # the range of stamps in ROS
    if container.format.name == 'avi':  # FFmpeg shortens the duration of a file that is cut off
        duration = float(stream.frames / rate)
    elif stream.duration:
        duration = float(stream.duration * stream.time_base)
    elif container.format.name.startswith('matroska'):  # it states the last time
        duration -= max(container.start_time or 0, 0) / 1e6
    return (0.0 if bare else duration), float(rate), created, stream.height, stream.width


def _packets(container: Any, span: list[float]) -> Iterator[Any]:
    """Yield the packets of the video; widen a span, s, by all tracks, as sound may be longer."""
    index = _video(container).index
    for packet in container.demux():
        if packet.pts is not None and packet.time_base:
            end = packet.pts + (packet.duration or 0)
            span[0] = min(span[0], float(packet.pts * packet.time_base))
            span[1] = max(span[1], float(end * packet.time_base))
        if packet.stream_index == index:
            yield packet


def decode(fps: float, paths: list[str], output: Connection) -> None:
    """Send the frames of videos, and ``fps`` of them each second with pixels."""
    from av.video.reformatter import VideoReformatter

    reformatter, end, due = VideoReformatter(), 0.0, -math.inf  # due: number of the next image
    for file, path in enumerate(paths):
        with _open(path) as container:
            start, (duration, rate, *_) = end, _facts(container)
            span = [math.inf, -math.inf]
            for seconds, frame, jump in _frames(container, span, start, 1 / rate):
                if jump:
                    output.send_bytes(FRAME.pack(jump, file, 0, JUMP))
                number = (seconds + EARLY) * fps
                if number < due:
                    output.send_bytes(FRAME.pack(seconds, file, 0, 0))
                else:
                    image = rgb_of(frame, reformatter)
                    output.send_bytes(FRAME.pack(seconds, file, *image.shape[:2]))
                    output.send_bytes(image.reshape(-1).data)
                    due = math.floor(number) + 1
                end = seconds + 1 / rate
            if max(end - start, span[1] - span[0]) < MIN_COMPLETE * duration:
                output.send_bytes(FRAME.pack(end - start, file, 0, CUT_OFF))


def _frames(
    container: Any, span: list[float], start: float, period: float
) -> Iterator[tuple[float, Any, float]]:
    """
    Yield the frames with increasing times, the first one at ``start``, and jumps of the clock, s.

    A time that is missing, falls, or jumps in a stream is continued by the frame rate. AVI has no
    times of presentation: there the times of decoding count, which FFmpeg gives in the order of
    frames.
    """
    from av import FFmpegError, InvalidDataError

    stream, seconds, origin = _video(container), start - period, math.nan
    stream.thread_type, stream.codec_context.thread_count = 'AUTO', 2
    stream.codec_context.options = {'max_pixels': str(MAX_PIXELS)}
    bare, avi = container.format.flags & NO_TIMES, container.format.name == 'avi'
    ahead = AHEAD * max(1, period)
    ahead = ahead if container.format.flags & DISCONTINUOUS else math.inf
    with suppress(FFmpegError):  # cut off
        for packet in _packets(container, span):
            with suppress(InvalidDataError):  # damaged: players skip it, too
                for frame in packet.decode():
                    ticks = frame.dts if avi or frame.pts is None else frame.pts
                    time = math.nan if bare or ticks is None else float(ticks * frame.time_base)
                    following, jump = seconds + period, 0.0
                    if math.isnan(origin):
                        origin = time - following
                    elif (step := time - origin - seconds) < -RESTART or step > ahead:
                        origin, jump = time - following, step
                    seconds = time - origin if time - origin > seconds + TICK else following
                    yield seconds, frame, jump


def rgb_of(frame: Any, reformatter: Any) -> np.ndarray:
    """Return a frame as RGB, uint8, upright; of an interlaced one, one field with double lines."""
    to = {'dst_color_trc': 1, 'dst_color_primaries': 1} if frame.color_trc in HDR else {}
    image = reformatter.reformat(frame, format='rgb24', **to).to_ndarray()
    if frame.interlaced_frame:
        image[1::2] = image[: len(image) // 2 * 2 : 2]
    for data in frame.side_data:
        if data.type.name == 'DISPLAYMATRIX':  # x and y become a x + c y and b x + d y
            a, b, _, c, d = np.frombuffer(data, np.int32)[:5].tolist()
            if abs(b) > abs(a):
                image, a, d = image.swapaxes(0, 1), c, b
            image = image[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1]
    return np.ascontiguousarray(image)


if __name__ == '__main__':
    rate, *files = sys.argv[1:]
    sys.exit(main(float(rate), files, Connection(sys.stdout.fileno(), readable=False)))
