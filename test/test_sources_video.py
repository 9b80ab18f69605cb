# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Videos: images, stamps and rotation; damaged and hostile files give errors of our own only."""

import time

import numpy as np
import pytest
from stavpr_ros.errors import ImageError, SourceError
from stavpr_ros.sources import open_source, video, video_decoder
from stavpr_ros.sources.video import is_video
from videos import colored_images, copy_video, FRAMES, HEIGHT, RATE, WIDTH, write_video


class Output:
    """The messages of a decoder in this process: times of all frames, and the images."""

    def __init__(self, *paths, fps=1000):
        self.times, self.images, self.cut_off, self._shape = [], [], [], (0, 0)
        video_decoder.decode(fps, list(map(str, paths)), self)

    def send_bytes(self, message):
        if self._shape[0]:
            self.images.append(np.frombuffer(message, np.uint8).reshape(*self._shape, 3))
            self._shape = 0, 0
            return
        seconds, _, *self._shape = video_decoder.FRAME.unpack(message)
        if self._shape == [0, video_decoder.CUT_OFF]:
            self.cut_off.append(seconds)
        elif self._shape != [0, video_decoder.JUMP]:
            self.times.append(seconds)


def even(images):
    """Return the times and images of a video of the usual rate."""
    return np.arange(len(images)) / RATE, images


@pytest.mark.parametrize(('fps', 'count'), [(1000, 60), (30, 60), (20, 40), (7, 14), (0.1, 1)])
def test_rate_chooses_frames(tmp_path, fps, count):
    output = Output(write_video(tmp_path / 'phone.mkv'), fps=fps)
    assert (len(output.images), len(output.times)) == (count, FRAMES)


def encode(path, name, codec, **options):
    return write_video(path / name, colored_images(30), codec, options=options), *even(
        colored_images(30)
    )


def interlace(path, codec):
    """Write a video of two fields; the second one looks as after a fast motion."""
    images = np.full((6, HEIGHT, WIDTH, 3), 40, np.uint8)
    images[:, 1::2] = 200
    options = {'flags': '+ildct+ilme', 'x264-params': 'tff=1', 'qmin': '1', 'qmax': '1'}
    file = write_video(path / 'a.mkv', images, codec, options=options)
    return file, *even(np.full((6, HEIGHT, WIDTH, 3), 40))


QUARTERS = np.zeros((2, HEIGHT, WIDTH, 3), np.uint8)
QUARTERS[:, : HEIGHT // 2, : WIDTH // 2] = 255, 0, 0
QUARTERS[:, : HEIGHT // 2, WIDTH // 2 :] = 0, 255, 0
QUARTERS[:, HEIGHT // 2 :, WIDTH // 2 :] = 0, 0, 255


def turn(path, *matrix):
    """Write a display matrix into a file; return images that are turned or mirrored by it."""
    file = write_video(path / 'phone.mp4', QUARTERS)
    content, at = file.read_bytes(), file.read_bytes().index(b'tkhd') + 44
    a, b, c, d = (value << 16 for value in matrix)
    entry = np.array([a, b, 0, c, d, 0, 0, 0, 1 << 30], '>i4').tobytes()
    file.write_bytes(content[:at] + entry + content[at + 36 :])
    images = QUARTERS.swapaxes(1, 2) if matrix[1] else QUARTERS
    horizontal, vertical = sum(matrix[::2]), sum(matrix[1::2])
    return file, *even(images[:, ::vertical, ::horizontal])


def copy(path, name, later, first=0, **options):
    """Copy a file; frames that an edit list hides are not shown, and times begin at 0."""
    whole = write_video(path / 'whole.mp4', codec='libx264', options={'g': '60'})
    return copy_video(whole, path / name, later, **options), *even(colored_images()[first:])


def variable_rate(path):
    times = np.delete(np.arange(40), [3, 4, 10, 22])
    file = write_video(path / 'phone.mp4', colored_images(36), times=times)
    return file, times / RATE, colored_images(36)


def time_that_falls(path):
    """Write one that is continued by the rate."""
    file = write_video(path / 'phone.mkv', colored_images(3), 'mjpeg', pixels='yuvj420p')
    # SimpleBlock, track 1: the third gets the time of the first
    content = file.read_bytes()
    third = content.index(b'\x81\x00\x43')
    file.write_bytes(content[:third] + b'\x81\x00\x00' + content[third + 3 :])
    return file, *even(colored_images(3))


def clock_that_starts_again(path):
    file = write_video(path / 'dash.ts')
    file.write_bytes(file.read_bytes() * 2)
    return file, *even(np.concatenate([colored_images()] * 2))


def ten_bits(path):
    images = np.repeat(np.arange(0, 240, 8, dtype=np.uint8), 3).reshape(-1, 1, 1, 3)
    images = np.broadcast_to(images, (30, HEIGHT, WIDTH, 3))
    return write_video(path / 'a.mkv', images, 'ffv1', pixels='yuv420p10le'), *even(images)


def high_dynamic_range(path):
    images = np.zeros((1, HEIGHT, WIDTH, 3), np.uint8)
    shown = np.arange(WIDTH) / WIDTH
    light = (203 * shown**2.4 / 10_000) ** (2610 / 16384)  # of SMPTE ST 2084
    code = ((3424 / 4096 + 2413 / 128 * light) / (1 + 2392 / 128 * light)) ** (2523 / 32)
    images[:] = np.round(255 * code)[:, None]
    options = {'pixels': 'yuv420p10le', 'high_dynamic_range': True}
    file = write_video(path / 'a.mkv', images, 'ffv1', **options)
    return file, *even(np.broadcast_to(255 * shown[:, None], images.shape))


def with_sound(path, name, codec, voice, *sounds):
    """Sound may have another length."""
    images = colored_images(30)
    file = write_video(path / name, images, codec, sounds=sounds, voice=voice)
    return file, *even(images)


SOUNDS = [[(0, 8)], [(5, 9)], [(0, 1), (3, 6)]]
VIDEOS = [  # a function that writes a file, and its arguments
    (encode, 'dash.TS', 'libx264'),
    (encode, 'camcorder.MTS', 'libx264'),
    (encode, 'h265.mp4', 'libx265', {'x265-params': 'log-level=none'}),
    (encode, 'b_frames.avi', 'libx264', {'bf': '2'}),
    (encode, 'xvid.avi', 'mpeg4', {'bf': '2'}),
    (encode, 'disc.mpg', 'mpeg2video', {'bf': '2'}),
    (encode, 'old.wmv', 'wmv2'),
    (encode, 'web.flv', 'flv'),
    (encode, 'vp9.webm', 'libvpx-vp9', {'deadline': 'realtime'}),
    (encode, 'bare.h264', 'libx264'),
    (interlace, 'mpeg2video'),
    (interlace, 'libx264'),
    *((turn, *matrix) for matrix in ((0, 1, -1, 0), (0, -1, 1, 0), (-1, 0, 0, -1))),
    *((turn, *matrix) for matrix in ((-1, 0, 0, 1), (0, 1, 1, 0))),
    (copy, 'cut.mp4', -1, 30, {'avoid_negative_ts': 'disabled'}),
    (copy, 'later.mkv', 7.5),
    (variable_rate,),
    (time_that_falls,),
    (clock_that_starts_again,),
    (ten_bits,),
    (high_dynamic_range,),
    *((with_sound, 'recorder.mkv', 'libx264', 'aac', *sounds) for sounds in SOUNDS),
    *((with_sound, 'browser.webm', 'libvpx', 'libopus', *sounds) for sounds in SOUNDS),
    *((with_sound, 'stream.flv', 'libx264', 'aac', *sounds) for sounds in SOUNDS[:2]),
    *((with_sound, 'old.wmv', 'wmv2', 'mp2', *sounds) for sounds in SOUNDS),
    *((with_sound, 'dash.ts', 'libx264', 'aac', *sounds) for sounds in SOUNDS),
]


@pytest.mark.parametrize('case', VIDEOS, ids=lambda case: case[0].__name__)
def test_video_is_decoded(tmp_path, case):
    """Codecs lose a little."""
    write, *arguments = case
    options = arguments.pop() if arguments and isinstance(arguments[-1], dict) else {}
    path, times, images = write(tmp_path, *arguments, **options)
    output = Output(path)
    assert is_video(path)
    assert not output.cut_off
    np.testing.assert_allclose(output.times, times, atol=0.0015)
    for image, expected in zip(output.images, images, strict=True):
        assert image.shape == expected.shape
        assert np.abs(image - expected.astype(float)).mean() < 6


def test_video_that_ends_early_is_reported_once(tmp_path):
    path = write_video(tmp_path / 'phone.avi', codec='mjpeg', pixels='yuvj420p')
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(ImageError, match=r'phone\.avi ends early, after \d\.\d s of about 2\.0 s'):
        list(open_source(path))
    errors = []
    assert 2 <= len(list(open_source(path, on_error=errors.append))) < 10
    assert len(errors) == 1


@pytest.mark.parametrize(
    ('program', 'timeout', 'reason'),
    [
        ('import time; time.sleep(600)', 1, r'no frame was decoded in 1 s'),
        ('import os; os.kill(os.getpid(), 11)', 600, r'crashed the decoder with signal 11'),
        ('raise ImportError', 600, 'needs PyAV, which is not installed: pip install av'),
    ],
)
def test_decoder_that_fails_is_an_error(
    tmp_path, environ, set_constants, program, timeout, reason
):
    (tmp_path / 'av.py').write_text(program)
    environ['PYTHONPATH'] = f'{tmp_path}:{environ["PYTHONPATH"]}'
    set_constants(video, TIMEOUT=timeout)
    began = time.monotonic()
    with pytest.raises(SourceError, match=reason):
        open_source(write_video(tmp_path / 'phone.mp4', colored_images(1)))
    assert time.monotonic() - began < 300
