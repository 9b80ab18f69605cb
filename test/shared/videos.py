# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Small videos, by the encoders of PyAV."""

from fractions import Fraction
from pathlib import Path

import av
import numpy as np

RATE, FRAMES, HEIGHT, WIDTH = 30, 60, 48, 64


def colored_images(count=FRAMES):
    """Return images whose left half is red and whose right half becomes brighter."""
    images = np.empty((count, HEIGHT, WIDTH, 3), np.uint8)
    images[:] = 4 * np.arange(count)[:, None, None, None]
    images[:, :, : WIDTH // 2] = 255, 0, 0
    return images


def write_video(
    path: Path,
    images=None,
    codec: str = 'mpeg4',
    rate: int = RATE,
    pixels: str = 'yuv420p',
    options: dict[str, str] | None = None,
    metadata: dict[str, str] | None = None,
    times=None,
    high_dynamic_range: bool = False,
    sounds=(),
    voice: str = 'aac',
) -> Path:
    """
    Write a video.

    :param images: RGB, uint8; of ``colored_images`` if not given.
    :param times: of the frames, in frames; 0, 1, 2, ... if not given.
    :param sounds: begin and end of each track of sound, seconds, encoded by ``voice``.
    :param high_dynamic_range: state BT.2020 and SMPTE ST 2084; the images are not changed.
    """
    images = colored_images() if images is None else images
    with av.open(str(path), 'w', options={'movflags': 'faststart'}) as container:
        container.metadata.update(metadata or {})
        stream = container.add_stream(codec, rate=rate, options=options or {})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt, stream.bit_rate = pixels, 1_000_000
        if high_dynamic_range:
            stream.color_primaries, stream.color_trc, stream.colorspace = 9, 16, 9  # ITU-T H.273
        voices = [container.add_stream(voice, rate=48000, layout='mono') for _ in sounds]
        for i, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format='rgb24')
            frame.pts = int(i if times is None else times[i])
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
        for stream, (begin, end) in zip(voices, sounds, strict=True):
            for at in range(int(begin * 48000), int(end * 48000), 960):
                frame = av.AudioFrame.from_ndarray(np.zeros((1, 960), np.float32), 'fltp', 'mono')
                frame.sample_rate, frame.pts = 48000, at
                container.mux(stream.encode(frame))
            container.mux(stream.encode(None))
    return path


def copy_video(path: Path, target: Path, later: float = 0.0, **options: str) -> Path:
    """Copy the packets of a video, with times that are later by seconds, without encoding."""
    with av.open(str(path)) as source, av.open(str(target), 'w', options=options) as container:
        stream = container.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(source.streams.video[0]):
            if packet.dts is not None:
                packet.pts += round(later / packet.time_base)
                packet.dts += round(later / packet.time_base)
                packet.stream = stream
                container.mux(packet)
    return target


def packets(images, codec: str = 'libx264', gop: int = 5, b_frames: int = 0) -> list[av.Packet]:
    """Encode RGB images as a camera's encoder does: parameters in each key frame, no file."""
    encoder = av.CodecContext.create(codec, 'w')
    encoder.height, encoder.width = images[0].shape[:2]
    encoder.pix_fmt, encoder.time_base, encoder.bit_rate = 'yuv420p', Fraction(1, RATE), 1_000_000
    encoder.gop_size, encoder.max_b_frames = gop, b_frames
    options = f'keyint={gop}:min-keyint={gop}:scenecut=0:bframes={b_frames}'
    encoder.options = {f'{codec[3:]}-params': options + ':log-level=none' * (codec == 'libx265')}
    result = []
    for i, image in enumerate(images):
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format='rgb24')
        frame.pts = i
        result += encoder.encode(frame)
    return result + encoder.encode(None)
