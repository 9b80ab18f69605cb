# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Videos: images, stamps and rotation; damaged and hostile files give errors of our own only."""

from contextlib import suppress
import time

import cv2
import numpy as np
import pytest
from stavpr_ros.errors import ImageError, SettingsError, SourceError, StavprError
from stavpr_ros.sources import open_source, video
from stavpr_ros.sources.video import VideoSource
from stavpr_ros.units import SECOND

RATE, FRAMES, HEIGHT, WIDTH = 30, 60, 48, 64


def write_video(path, frames=FRAMES, codec='mp4v'):
    """Write a video whose left half is red and whose right half becomes brighter."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), RATE, (WIDTH, HEIGHT))
    for i in range(frames):
        image = np.full((HEIGHT, WIDTH, 3), 4 * i, np.uint8)
        image[:, : WIDTH // 2] = 0, 0, 255
        writer.write(image)
    writer.release()
    return path


def seconds(frames):
    return [(frame.stamp - SECOND) / SECOND for frame in frames]


@pytest.mark.parametrize(('suffix', 'codec'), [('mp4', 'mp4v'), ('AVI', 'MJPG'), ('mkv', 'MJPG')])
def test_video_yields_images_at_the_rate(tmp_path, suffix, codec):
    source = open_source(write_video(tmp_path / f'phone.{suffix}', codec=codec), fps=10)
    frames = list(source)
    assert isinstance(source, VideoSource)
    assert len(frames) == len(source) == 20
    np.testing.assert_allclose(seconds(frames), np.arange(20) / 10, atol=0.001)
    assert [frame.identifier for frame in frames[:2]] == [f'phone.{suffix}#0', f'phone.{suffix}#1']
    for i, frame in enumerate(frames):
        left, right = (np.median(half, (0, 1)) for half in np.split(frame.image, 2, 1))
        np.testing.assert_allclose(left, (255, 0, 0), atol=12)
        np.testing.assert_allclose(right, [12 * i] * 3, atol=12)


@pytest.mark.parametrize(('fps', 'count'), [(1000, 60), (30, 60), (20, 40), (7, 14), (0.1, 1)])
def test_rate_chooses_frames(tmp_path, fps, count):
    source = open_source(write_video(tmp_path / 'phone.mkv', codec='MJPG'), fps=fps)
    assert len(list(source)) == len(source) == count


def test_records_are_cut_by_time(tmp_path):
    source = open_source(write_video(tmp_path / 'phone.mp4'))
    assert len(source) == 10
    stamps = [record.stamp_ns for record in source.records(0.5, 0.9)]
    np.testing.assert_allclose(stamps, [1.6e9, 1.8e9, 2.0e9, 2.2e9], atol=1e6)


def test_video_is_turned_upright(tmp_path):
    path = write_video(tmp_path / 'phone.mp4', 3)
    content, matrix = path.read_bytes(), path.read_bytes().index(b'tkhd') + 44
    turned = np.array([0, 1 << 16, 0, -1 << 16, 0, 0, 0, 0, 1 << 30], '>i4').tobytes()
    path.write_bytes(content[:matrix] + turned + content[matrix + 36 :])
    image = next(iter(open_source(path))).image
    assert image.shape == (WIDTH, HEIGHT, 3)
    np.testing.assert_allclose(np.median(image[: WIDTH // 2], (0, 1)), (255, 0, 0), atol=12)


def test_video_that_ends_early_is_reported_once(tmp_path):
    path = write_video(tmp_path / 'phone.avi', codec='MJPG')
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(ImageError, match=r'phone\.avi ends early, after \d+ of about 60 frames'):
        list(open_source(path))
    errors = []
    assert 2 <= len(list(open_source(path, on_error=errors.append))) < 10
    assert len(errors) == 1


def test_stamps_that_do_not_increase_are_an_error(tmp_path):
    path = write_video(tmp_path / 'phone.mkv', 3, 'MJPG')
    # SimpleBlock, track 1: the time of the third becomes that of the first
    content = path.read_bytes()
    third = content.index(b'\x81\x00\x43')
    path.write_bytes(content[:third] + b'\x81\x00\x00' + content[third + 3 :])
    with pytest.raises(SourceError, match=r'frame 2 has the stamp 0\.000 s after 0\.033 s'):
        list(open_source(path))


def test_size_in_the_header_is_limited(tmp_path):
    path = write_video(tmp_path / 'phone.avi', 3, 'FFV1')
    size, huge = (np.array(sides, '<u4').tobytes() for sides in ((WIDTH, HEIGHT), (9_000, 8_000)))
    path.write_bytes(path.read_bytes().replace(size, huge))
    with pytest.raises(SourceError, match='frames of more than 64000000 pixels'):
        open_source(path)


def test_playlist_with_the_name_of_a_video_is_not_followed(tmp_path):
    write_video(tmp_path / 'other.mp4', 3)
    path = tmp_path / 'phone.mp4'
    path.write_text('ffconcat version 1.0\nfile other.mp4\n')
    assert cv2.VideoCapture(str(path), cv2.CAP_FFMPEG).isOpened()
    with pytest.raises(SourceError, match='no video that OpenCV decodes'):
        open_source(path)


@pytest.mark.parametrize(('suffix', 'codec'), [('mp4', 'mp4v'), ('avi', 'MJPG'), ('mkv', 'VP90')])
def test_mutated_videos_give_images_or_errors_of_our_own(tmp_path, suffix, codec):
    path, random = tmp_path / f'phone.{suffix}', np.random.default_rng(5)
    content = np.frombuffer(write_video(path, codec=codec).read_bytes(), np.uint8)
    for share in (0.0005, 0.005, 0.05):
        mutated = content.copy()
        at = random.integers(0, len(content), max(1, int(share * len(content))))
        mutated[at] = random.integers(0, 256, len(at))
        path.write_bytes(mutated.tobytes())
        with suppress(StavprError):
            assert all(frame.image.ndim == 3 for frame in open_source(path))


@pytest.mark.parametrize('content', [b'', b'no video' * 99])
def test_other_content_is_an_error(tmp_path, content):
    path = tmp_path / 'phone.mov'
    path.write_bytes(content)
    with pytest.raises(SourceError, match=r'phone\.mov is damaged, cut off or no video'):
        open_source(path)


@pytest.mark.parametrize(
    ('program', 'timeout', 'reason'),
    [
        ('import time; time.sleep(60)', 1, r'no frame was decoded in 1 s'),
        ('import os; os.kill(os.getpid(), 11)', 60, r'crashed the decoder with signal 11'),
    ],
)
def test_decoder_that_fails_is_an_error(tmp_path, monkeypatch, program, timeout, reason):
    (tmp_path / 'broken_decoder.py').write_text(program)
    monkeypatch.setenv('PYTHONPATH', str(tmp_path), prepend=':')
    monkeypatch.setattr(video, 'MODULE', 'broken_decoder')
    monkeypatch.setattr(video, 'TIMEOUT', timeout)
    began = time.monotonic()
    with pytest.raises(SourceError, match=reason):
        open_source(write_video(tmp_path / 'phone.mp4', 1))
    assert time.monotonic() - began < 30


def test_options_that_do_not_fit_are_errors(tmp_path):
    path = write_video(tmp_path / 'phone.mp4', 1)
    with pytest.raises(SettingsError, match=r'fps = 0\.0 must be above 0'):
        open_source(path, fps=0.0)
    with pytest.raises(SourceError, match='is no bag: leave the topic out'):
        open_source(path, topic='/camera')
