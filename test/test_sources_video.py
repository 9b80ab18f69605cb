# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Videos: images, stamps and rotation; damaged and hostile files give errors of our own only."""

from contextlib import suppress
import time

import cv2
import numpy as np
import pytest
from stavpr_ros.errors import ImageError, SettingsError, SourceError, StavprError
from stavpr_ros.sources import open_source, video, video_decoder
from stavpr_ros.sources.video import is_video, VideoSource
from stavpr_ros.units import SECOND
from videos import colored_images, copy_video, FRAMES, HEIGHT, RATE, WIDTH, write_video

QUARTERS = np.zeros((2, HEIGHT, WIDTH, 3), np.uint8)
QUARTERS[:, : HEIGHT // 2, : WIDTH // 2] = 255, 0, 0
QUARTERS[:, : HEIGHT // 2, WIDTH // 2 :] = 0, 255, 0
QUARTERS[:, HEIGHT // 2 :, WIDTH // 2 :] = 0, 0, 255


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

    def check(self, times, images=None):
        """Compare with what was written; codecs lose a little."""
        np.testing.assert_allclose(self.times, times, atol=0.0015)
        assert not self.cut_off
        if images is not None:
            for image, expected in zip(self.images, images, strict=True):
                assert np.median(np.abs(image.astype(int) - expected)) < 4


def seconds(frames):
    return [(frame.stamp - SECOND) / SECOND for frame in frames]


@pytest.mark.parametrize(('suffix', 'codec'), [('mp4', 'libx264'), ('AVI', 'mjpeg')])
def test_video_yields_images_at_the_rate(tmp_path, suffix, codec):
    pixels = 'yuvj420p' if codec == 'mjpeg' else 'yuv420p'
    path = write_video(tmp_path / f'phone.{suffix}', codec=codec, pixels=pixels)
    source = open_source(path, fps=10)
    frames = list(source)
    assert isinstance(source, VideoSource)
    assert len(frames) == len(source) == 20
    np.testing.assert_allclose(seconds(frames), np.arange(20) / 10, atol=0.001)
    assert [frame.identifier for frame in frames[:2]] == [f'phone.{suffix}#0', f'phone.{suffix}#1']
    for i, frame in enumerate(frames):
        left, right = (np.median(half, (0, 1)) for half in np.split(frame.image, 2, 1))
        np.testing.assert_allclose(left, (255, 0, 0), atol=12)
        np.testing.assert_allclose(right, [12 * i] * 3, atol=12)
    stamps = [record.stamp_ns for record in source.records(0.5, 0.4)]
    np.testing.assert_allclose(stamps, [1.5e9, 1.6e9, 1.7e9, 1.8e9], atol=1e6)


@pytest.mark.parametrize(('fps', 'count'), [(1000, 60), (30, 60), (20, 40), (7, 14), (0.1, 1)])
def test_rate_chooses_frames(tmp_path, fps, count):
    output = Output(write_video(tmp_path / 'phone.mkv'), fps=fps)
    assert (len(output.images), len(output.times)) == (count, FRAMES)


@pytest.mark.parametrize(
    ('name', 'codec', 'options'),
    [
        ('dash.TS', 'libx264', {}),
        ('camcorder.MTS', 'libx264', {}),
        ('h265.mp4', 'libx265', {'x265-params': 'log-level=none'}),
        ('b_frames.avi', 'libx264', {'bf': '2'}),
        ('xvid.avi', 'mpeg4', {'bf': '2'}),
        ('disc.mpg', 'mpeg2video', {'bf': '2'}),
        ('old.wmv', 'wmv2', {}),
        ('web.flv', 'flv', {}),
        ('vp9.webm', 'libvpx-vp9', {'deadline': 'realtime'}),
        ('bare.h264', 'libx264', {}),
    ],
)
def test_codecs_and_containers(tmp_path, name, codec, options):
    path = write_video(tmp_path / name, colored_images(30), codec, options=options)
    assert is_video(path)
    Output(path).check(np.arange(30) / RATE, colored_images(30))


@pytest.mark.parametrize('codec', ['mpeg2video', 'libx264'])
def test_interlaced_frame_is_one_of_its_fields(tmp_path, codec):
    images = np.full((6, HEIGHT, WIDTH, 3), 40, np.uint8)
    images[:, 1::2] = 200  # the other field, as after a fast motion
    options = {'flags': '+ildct+ilme', 'x264-params': 'tff=1', 'qmin': '1', 'qmax': '1'}
    for image in Output(write_video(tmp_path / 'a.mkv', images, codec, options=options)).images:
        np.testing.assert_allclose(image, 40, atol=20)


@pytest.mark.parametrize(
    ('matrix', 'turned'),
    [
        ((0, 1, -1, 0), lambda image: np.rot90(image, -1)),
        ((0, -1, 1, 0), np.rot90),
        ((-1, 0, 0, -1), lambda image: image[::-1, ::-1]),
        ((-1, 0, 0, 1), lambda image: image[:, ::-1]),
        ((0, 1, 1, 0), lambda image: image.swapaxes(0, 1)),
    ],
    ids=['right', 'left', 'upside down', 'mirrored', 'mirrored and turned'],
)
def test_display_matrix_is_applied(tmp_path, matrix, turned):
    path = write_video(tmp_path / 'phone.mp4', QUARTERS)
    content, at = path.read_bytes(), path.read_bytes().index(b'tkhd') + 44
    a, b, c, d = (value << 16 for value in matrix)
    entry = np.array([a, b, 0, c, d, 0, 0, 0, 1 << 30], '>i4').tobytes()
    path.write_bytes(content[:at] + entry + content[at + 36 :])
    for image in Output(path).images:
        np.testing.assert_allclose(image, turned(QUARTERS[0]), atol=60)


@pytest.mark.parametrize(
    ('name', 'later', 'options', 'first'),
    [('cut.mp4', -1, {'avoid_negative_ts': 'disabled'}, 30), ('later.mkv', 7.5, {}, 0)],
    ids=['those that the edit list hides are not shown', 'they count from the first one'],
)
def test_times_of_frames_of_a_copy(tmp_path, name, later, options, first):
    whole = write_video(tmp_path / 'whole.mp4', codec='libx264', options={'g': '60'})
    path = copy_video(whole, tmp_path / name, later, **options)
    Output(path).check(np.arange(FRAMES - first) / RATE, colored_images()[first:])


def test_times_of_a_variable_rate_are_kept(tmp_path):
    times = np.delete(np.arange(40), [3, 4, 10, 22])
    path = write_video(tmp_path / 'phone.mp4', colored_images(36), times=times)
    Output(path).check(times / RATE)


def test_time_that_falls_is_continued_by_the_rate(tmp_path):
    path = write_video(tmp_path / 'phone.mkv', colored_images(3), 'mjpeg', pixels='yuvj420p')
    # SimpleBlock, track 1: the time of the third becomes that of the first
    content = path.read_bytes()
    third = content.index(b'\x81\x00\x43')
    path.write_bytes(content[:third] + b'\x81\x00\x00' + content[third + 3 :])
    Output(path).check(np.arange(3) / RATE)


def test_clock_that_starts_again_is_continued(tmp_path):
    path = write_video(tmp_path / 'dash.ts')
    path.write_bytes(path.read_bytes() * 2)
    output = Output(path)
    np.testing.assert_allclose(np.diff(output.times), 1 / RATE, atol=0.001)
    assert len(output.times) == 2 * FRAMES


@pytest.mark.parametrize('later', [1000, -4, 95443.7])  # the last: over the end of 33 bits
def test_clock_of_a_stream_that_jumps_is_continued_and_named(tmp_path, caplog, later):
    first = write_video(tmp_path / 'first.ts', colored_images(30), 'libx264')
    second = copy_video(first, tmp_path / 'second.ts', max(later, 0))
    if later < 0:
        first = copy_video(first, tmp_path / 'later.ts', -later)
    path = tmp_path / 'dash.ts'
    path.write_bytes(first.read_bytes() + second.read_bytes())
    frames = list(open_source(path, fps=RATE))
    np.testing.assert_allclose(seconds(frames), np.arange(60) / RATE, atol=0.002)
    assert caplog.text.count('dash.ts jumps by') == (later < 95000)


def test_small_copies_of_a_camera_are_no_part_of_the_drive(tmp_path):
    small = write_video(tmp_path / 'small.mp4', colored_images(30)[:, ::2, ::2])
    small.rename(tmp_path / 'DJI_0001.LRF')
    assert len(open_source(tmp_path, fps=RATE)) == 30
    write_video(tmp_path / 'DJI_0001.MP4', colored_images(60))
    assert len(open_source(tmp_path, fps=RATE)) == 60


def test_ten_bits_become_eight(tmp_path):
    images = np.repeat(np.arange(0, 240, 8, dtype=np.uint8), 3).reshape(-1, 1, 1, 3)
    images = np.broadcast_to(images, (30, HEIGHT, WIDTH, 3))
    path = write_video(tmp_path / 'a.mkv', images, 'ffv1', pixels='yuv420p10le')
    np.testing.assert_allclose(Output(path).images, images, atol=2)


def test_high_dynamic_range_becomes_ordinary(tmp_path):
    images = np.zeros((1, HEIGHT, WIDTH, 3), np.uint8)
    shown = np.arange(WIDTH) / WIDTH
    light = (203 * shown**2.4 / 10_000) ** (2610 / 16384)  # of SMPTE ST 2084
    code = ((3424 / 4096 + 2413 / 128 * light) / (1 + 2392 / 128 * light)) ** (2523 / 32)
    images[:] = np.round(255 * code)[:, None]
    path = tmp_path / 'a.mkv'
    write_video(path, images, 'ffv1', pixels='yuv420p10le', high_dynamic_range=True)
    image = Output(path).images[0]
    np.testing.assert_allclose(image[0, :, 1], 255 * shown, atol=4)


def test_drive_in_several_files_is_one(tmp_path):
    for name in ('GX010123.MP4', 'GX020123.MP4', 'GX100123.MP4'):
        write_video(tmp_path / name, colored_images(30))
    (tmp_path / '._GX010123.MP4').write_bytes(b'of a file manager')
    (tmp_path / 'GX010123.THM').write_bytes(b'a thumbnail')
    assert is_video(tmp_path)
    source = open_source(tmp_path, fps=10)
    frames = list(source)
    assert len(frames) == len(source) == 30
    np.testing.assert_allclose(seconds(frames), np.arange(30) / 10, atol=0.001)
    names = [frame.identifier for frame in frames[::10]]
    assert names == ['GX010123.MP4#0', 'GX020123.MP4#10', 'GX100123.MP4#20']


@pytest.mark.parametrize('other', ['size', 'rate', 'creation', 'image', 'damaged'])
def test_files_that_are_not_one_drive_are_refused_with_the_list(tmp_path, other):
    created = {'creation_time': '2026-05-01T10:00:00Z'}
    write_video(tmp_path / '1.mp4', colored_images(2), metadata=created)
    rate = 25 if other == 'rate' else RATE
    images = colored_images(2)[:, :, :32] if other == 'size' else colored_images(2)
    if other == 'creation':
        created = {'creation_time': '2026-05-01T09:59:00Z'}
    write_video(tmp_path / '2.mp4', images, rate=rate, metadata=created)
    match = rf'not in the order .* 1\.mp4 \(64x48, 30 Hz\), 2\.mp4 \(\d\dx48, {rate} Hz\)'
    if other == 'image':
        cv2.imwrite(str(tmp_path / '1.jpg'), QUARTERS[0])
        match = 'has videos and images: expected one kind'
    if other == 'damaged':
        (tmp_path / '2.mp4').write_bytes(b'damaged')
        match = r'2\.mp4 is damaged'
    with pytest.raises(SourceError, match=match):
        open_source(tmp_path)


@pytest.mark.parametrize(
    ('text', 'start'),
    [('2026-05-01T10:00:00.5+02:00', 1_777_622_400.5), ('1804-01-01', 1)],
)
def test_stamps_count_from_the_stated_creation(tmp_path, text, start):
    path = write_video(tmp_path / 'a.mkv', colored_images(2), metadata={'creation_time': text})
    stamps = [frame.stamp / SECOND for frame in open_source(path, fps=RATE)]
    np.testing.assert_allclose(stamps, [start, start + 1 / RATE], atol=0.002)


def test_video_that_ends_early_is_reported_once(tmp_path):
    path = write_video(tmp_path / 'phone.avi', codec='mjpeg', pixels='yuvj420p')
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(ImageError, match=r'phone\.avi ends early, after \d\.\d s of about 2\.0 s'):
        list(open_source(path))
    errors = []
    assert 2 <= len(list(open_source(path, on_error=errors.append))) < 10
    assert len(errors) == 1


@pytest.mark.parametrize('sounds', [[(0, 8)], [(5, 9)], [(0, 1), (3, 6)]])
@pytest.mark.parametrize(('name', 'codec', 'voice'), [
    ('recorder.mkv', 'libx264', 'aac'),
    ('browser.webm', 'libvpx', 'libopus'),
    ('stream.flv', 'libx264', 'aac'),
    ('old.wmv', 'wmv2', 'mp2'),
    ('dash.ts', 'libx264', 'aac'),
])  # fmt: skip
def test_sound_may_have_another_length(tmp_path, name, codec, voice, sounds):
    sounds = sounds[:1] if name.endswith('flv') else sounds  # it has one track
    path = write_video(tmp_path / name, colored_images(30), codec, sounds=sounds, voice=voice)
    Output(path).check(np.arange(30) / RATE)


@pytest.mark.parametrize('suffix', ['mkv', 'flv', 'mov'])
def test_video_with_sound_that_is_cut_is_reported(tmp_path, suffix):
    path = write_video(tmp_path / f'cut.{suffix}', codec='libx264', sounds=[(0, 2)])
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    with pytest.raises(ImageError, match='ends early'):
        list(open_source(path))


def test_size_in_the_header_is_limited(tmp_path):
    path = write_video(tmp_path / 'phone.avi', colored_images(3), 'ffv1')
    size, huge = (np.array(sides, '<u4').tobytes() for sides in ((WIDTH, HEIGHT), (9_000, 8_000)))
    path.write_bytes(path.read_bytes().replace(size, huge))
    with pytest.raises(SourceError, match='frames of more than 64000000 pixels'):
        open_source(path)


@pytest.mark.parametrize(
    ('content', 'sentence'),
    [
        (b'', 'is damaged, cut off, no video'),
        (b'no video' * 99, 'is damaged, cut off, no video'),
        (b'ffconcat version 1.0\nfile other.mp4\n', 'no video that FFmpeg decodes'),
        (b'#EXTM3U\nother.mp4\n', 'no video that FFmpeg decodes'),
    ],
)
def test_other_content_with_the_name_of_a_video_is_an_error(tmp_path, content, sentence):
    """A playlist is not followed."""
    write_video(tmp_path / 'other.mp4', colored_images(3))
    path = tmp_path / 'phone.mov'
    path.write_bytes(content)
    with pytest.raises(SourceError, match=rf'phone\.mov .*{sentence}'):
        open_source(path)


@pytest.mark.parametrize(
    ('suffix', 'codec', 'share'),
    [('mp4', 'mpeg4', 0.0005), ('ts', 'libx264', 0.005), ('mkv', 'libvpx-vp9', 0.05)],
)
def test_mutated_videos_give_images_or_errors_of_our_own(tmp_path, suffix, codec, share):
    path, random = tmp_path / f'phone.{suffix}', np.random.default_rng(5)
    content = np.frombuffer(write_video(path, codec=codec).read_bytes(), np.uint8).copy()
    at = random.integers(0, len(content), max(1, int(share * len(content))))
    content[at] = random.integers(0, 256, len(at))
    path.write_bytes(content.tobytes())
    with suppress(StavprError):
        assert all(frame.image.ndim == 3 for frame in open_source(path))


@pytest.mark.parametrize(
    ('program', 'timeout', 'reason'),
    [
        ('import time; time.sleep(600)', 1, r'no frame was decoded in 1 s'),
        ('import os; os.kill(os.getpid(), 11)', 600, r'crashed the decoder with signal 11'),
    ],
)
def test_decoder_that_fails_is_an_error(tmp_path, monkeypatch, program, timeout, reason):
    (tmp_path / 'broken_decoder.py').write_text(program)
    monkeypatch.setenv('PYTHONPATH', str(tmp_path), prepend=':')
    monkeypatch.setattr(video, 'MODULE', 'broken_decoder')
    monkeypatch.setattr(video, 'TIMEOUT', timeout)
    began = time.monotonic()
    with pytest.raises(SourceError, match=reason):
        open_source(write_video(tmp_path / 'phone.mp4', colored_images(1)))
    assert time.monotonic() - began < 300


def test_without_pyav_the_remedy_is_named(tmp_path, monkeypatch):
    (tmp_path / 'av.py').write_text('raise ImportError')
    monkeypatch.setenv('PYTHONPATH', str(tmp_path), prepend=':')
    with pytest.raises(SourceError, match='needs PyAV, which is not installed: pip install av'):
        open_source(write_video(tmp_path / 'phone.mp4', colored_images(1)))


def test_options_that_do_not_fit_are_errors(tmp_path):
    path = write_video(tmp_path / 'phone.mp4', colored_images(1))
    with pytest.raises(SettingsError, match=r'fps = 0\.0 must be above 0'):
        open_source(path, fps=0.0)
    with pytest.raises(SourceError, match='is no bag: leave the topic out'):
        open_source(path, topic='/camera')
