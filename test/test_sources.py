# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bags, folders and videos: a table of files and their frames, one of errors, and their order."""

from dataclasses import dataclass, field
import hashlib
import os
from pathlib import Path
import random
import re
import shutil
import sqlite3

from bags import (
    Bag,
    file_of,
    pixels,
    records,
    SECOND,
    T0,
    TEXT,
    write_images,
    write_mixed,
    write_split,
    writing,
)
import cv2
import numpy as np
from PIL import Image
import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from stavpr_ros.errors import ImageError, InputError, OutputError, SettingsError, SourceError
from stavpr_ros.sources import open_source
from stavpr_ros.sources.bag import BagSource, RAW
from stavpr_ros.sources.bag_messages import read_messages
from stavpr_ros.sources.bag_writer import write_bag
from stavpr_ros.sources.encodings import decode_message
from stavpr_ros.sources.folder import FolderSource
from stavpr_ros.sources.frame import ImageRecord
from stavpr_ros.sources.order import in_order, natural_key
from videos import colored_images, copy_video, HEIGHT, RATE, WIDTH, write_video


@dataclass
class Drive:
    """
    Files, and what must come out of them: identifier, stamp [ns] and image of each frame.

    :param note: pattern of what is logged; empty = nothing.
    :param errors: patterns of kind and text of the errors of images, which are skipped.
    :param lossy: of a codec, whose stamps are rounded.
    :param counted: whether the length is not estimated.
    """

    path: Path
    frames: list[tuple[str, int, np.ndarray]]
    options: dict = field(default_factory=dict)
    note: str = ''
    errors: tuple[str, ...] = ()
    left_out: dict[str, int] = field(default_factory=dict)
    lossy: bool = False
    counted: bool = True


def frames_of(images, topic='/raw', stamped=True):
    """Return the frames that records of a bag become."""
    return [
        (f'{topic}#{i}', record.stamp_ns if stamped else record.time_ns, pixels(record))
        for i, record in enumerate(images)
    ]


# ------------------------------------------------------------------------------------------ bags


def written_bag(path, storage='sqlite3', as_file=False, stamped=True):
    write_bag(path / 'bag', '/raw', records(stamped=stamped), storage)
    frames = frames_of(records(stamped=stamped), stamped=stamped)
    return Drive(file_of(path / 'bag') if as_file else path / 'bag', frames)


def mixed_bag(path, ros1, topic, bad=()):
    frames = frames_of(records(), topic)
    for i in sorted(bad, reverse=True):
        del frames[i]
    file = write_mixed(path / 'MIXED.BAG', ros1, bad)
    errors = tuple(rf'{topic}#{i}: .*damaged' for i in bad)
    return Drive(file, frames, {'topic': topic}, errors=errors)


def parts_of_a_ros1_bag(path):
    for first in (6, 0, 3):
        with writing(path / f'drive_{first}.bag', ros1=True) as bag:
            write_images(bag, list(records(9))[first : first + 3])
    return Drive(path, frames_of(records(9)))


def bag_after_2038(path, seconds):
    """Write a header of the same 32 bits: no time before 1970."""
    with writing(path / 'drive') as bag:
        header = bag.header((seconds - 2**32) * SECOND + 7)
        bag.write('/raw', RAW, T0, header, 1, 2, 'rgb8', 0, 6, np.zeros(6, np.uint8))
    return Drive(path / 'drive', [('/raw#0', seconds * SECOND + 7, np.zeros((1, 2, 3)))])


def bag_beside_images(path):
    drive = written_bag(path)
    for name in ('a.png', 'b.png'):
        cv2.imwrite(str(drive.path / name), np.zeros((4, 4), np.uint8))
    drive.note = 'is a bag beside 2 images: the bag is read; to read the images, move'
    return drive


def bag_that_states_too_many_messages(path):
    """No memory is reserved for them."""
    drive = written_bag(path)
    metadata = drive.path / 'metadata.yaml'
    text = metadata.read_text().replace('message_count: 5', f'message_count: {2**60}')
    metadata.write_text(text)
    drive.note = f'states: /raw has 5 of {2**60} messages'
    return drive


def mcap_without_an_end(path, share, images, zeros):
    """As after a power loss: of whole chunks, of one megabyte; zeros may follow."""
    image = np.zeros((64, 64, 3), np.uint8)
    times = [2, 1, *range(3, 201)]  # recorded by two threads
    write_bag(path / 'bag', '/raw', (ImageRecord.of_image(image, t) for t in times), 'mcap')
    data, file = file_of(path / 'bag').read_bytes(), path / 'lost.MCAP'
    file.write_bytes(data[: int(len(data) * share)] + bytes(zeros))
    frames = [(f'/raw#{i}', time, image) for i, time in enumerate(times[:images])]
    return Drive(file, frames, note='lost.MCAP has no end, as after a power loss')


def mcap_without_its_index(path):
    drive = written_bag(path, 'mcap', as_file=True)
    content = drive.path.read_bytes()
    drive.path.write_bytes(content[: content.rindex(b'/raw') - 40])
    drive.note = 'has no end'
    return drive


ALL = range(9)


def split_bag(path, suffix, change, numbers, note):
    folder = write_split(path / 'drive', suffix)
    change(*sorted(folder.glob('drive_*')), at=folder / 'metadata.yaml')
    whole = list(records(9))
    return Drive(folder, frames_of([whole[i] for i in numbers]), note=note)


NO_METADATA = r'metadata\.yaml is damaged or of another program .*: read without it'
MISSING = r'2\.\w+ is missing, /raw has 6 of 9 messages'
DAMAGED = r'left out: .*_1\.\w+ is damaged'
SPLIT = [  # what is done to the files; numbers of the images that are read; what is logged
    (lambda *files, at: at.unlink(), ALL, ''),
    (lambda *files, at: at.write_text(at.read_text()[:150]), ALL, NO_METADATA),
    (lambda *files, at: at.write_text('rosbag2_bagfile_information: {}'), ALL, NO_METADATA),
    (lambda *files, at: files[2].unlink(), ALL[:6], MISSING),
    (lambda *files, at: files[1].write_bytes(b'?' * 300), [*ALL[:3], *ALL[6:]], DAMAGED),
    (lambda *files, at: files[0].rename(files[0].with_stem('a')), ALL, r'_0\.\w+ is missing'),
    (lambda *files, at: [f.rename(f.with_name(f.name.upper())) for f in files], ALL, ''),
]


def compressed_bag(path, mode, has_metadata):
    plugin = StoragePlugin.MCAP if mode == 'STORAGE' else StoragePlugin.SQLITE3
    writer = Ros2Writer(path / 'bag', version=9, storage_plugin=plugin)
    writer.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
    with writer:
        write_images(Bag(writer, ros1=False), records())
    folder = (path / 'bag').rename(path / 'odd #%41?')
    if not has_metadata:
        (folder / 'metadata.yaml').unlink()
    return Drive(folder, frames_of(records()))


# --------------------------------------------------------------------------------------- folders


def fill(folder, names):
    """Write images, the i-th of gray value i; other files have a text."""
    (folder / 'folder.png').mkdir(parents=True)  # no image
    for i, name in enumerate(names):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text('camera: front\nfps: 10\n')
        if path.suffix.lower() in {'.png', '.jpg', '.bmp'} and path.name != '._1.png':
            cv2.imwrite(str(path), gray(i))
    return folder


def gray(i):
    return np.full((4, 6, 3), i, np.uint8)


def folder(path, name, kind):
    names, images, left_out = FOLDERS[kind]
    frames = [(image, 0, gray(names.index(image))) for image in images]
    return Drive(fill(path / name, names), frames, left_out=left_out)


FOREIGN = ('@eaDir', '#recycle', '$RECYCLE.BIN', '__MACOSX', 'lost+found', 'Thumbnails')
FOLDERS = {  # files; images that are read; counts of those that are left out
    'numbers': (['10.png', '9.PNG', '11.bmp', '.no.png'], ['9.PNG', '10.png', '11.bmp'], {}),
    'sub-folders': (
        ['10/1.png', '9/b/1.png', '.hidden/1.png', '9/2.png', '9/a.png'],
        ['9/2.png', '9/a.png', '9/b/1.png', '10/1.png'],
        {},
    ),
    'a stray image': (
        ['overview.png', *(f'drive/{i}.png' for i in range(5))],
        [f'drive/{i}.png' for i in range(5)],
        {'beside': 1},
    ),
    'stray sub-folders': (['1.png', '2.png', 'x/3.png'], ['1.png', '2.png'], {'below': 1}),
    'of other programs': (
        [f'{name}/{i}.png' for name in (*FOREIGN, 'a/@eaDir') for i in range(9)]
        + ['a/1.png', 'a/2.png'],
        ['a/1.png', 'a/2.png'],
        {'foreign': 7},
    ),
    # a raw image beside its JPEG is not missing, and of HEIC and JPEG the JPEG is read
    'of other formats': (
        ['1.jpg', '2.jpg', '1.ARW', '2.heic', '3.avif', '4.dng', 'notes.txt'],
        ['1.jpg', '2.jpg'],
        {'format': 2},
    ),
    'of a telephone': (['0.jpg', '0.MOV', '1.jpg', '1.MOV'], ['0.jpg', '1.jpg'], {'video': 2}),
    'no images': (
        ['a.gif', 'b.ico', 'c.avifs', '._1.png', '1.png', '2.png'],
        ['1.png', '2.png'],
        {'format': 3},
    ),
    # a bag that is cut off, and metadata of another program, are no bag of images
    'a bag': (['drive_0.mcap', '1.png', '2.png'], ['1.png', '2.png'], {'bag': 1}),
    'metadata': (['metadata.yaml', '1.png', '2.png'], ['1.png', '2.png'], {}),
}


PAGES = ('TIFF 1.tif', 'PNG 1.png', 'WEBP 1.webp', 'MPO 1.jpg', 'MPO 1.mpo')


def folder_with_pages(path, kind, name):
    pages = [Image.new('RGB', (6, 4), (80 * i, 0, 0)) for i in range(3)]
    pages[0].save(path / name, kind, save_all=True, append_images=pages[1:])
    others = ['2.png', '3.jpg', '4.tiff', '5.webp']
    for other in others:
        cv2.imwrite(str(path / other), gray(0))
    frames = [(file, 0, gray(0)) for file in (name, *others)]
    return Drive(path, frames, left_out={'pages': 2})


def folder_of_names_that_are_no_utf8(path):
    for i, name in enumerate((b'caf\xe9.png', 'caff\u00e8.png'.encode())):
        cv2.imwrite(str(path / '1.png'), gray(i))
        (path / '1.png').rename(path / os.fsdecode(name))
    (path / os.fsdecode(b'empty\xe9.png')).write_bytes(b'')
    frames = [('caff\u00e8.png', 0, gray(1)), ('caf\ufffd.png', 0, gray(0))]
    return Drive(path, frames, errors=('empty\ufffd\\.png: 0 bytes',))


LFS = b'version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 48213\n'
BAD_FILES = {
    b'\x89PNG damaged': r'damaged: .*2\.png: 12 bytes are no image',
    LFS: r'elsewhere: .*2\.png: .*a pointer of Git LFS instead of the content: run `git lfs pull`',
    b'/annex/objects/SHA256E-s48213--00.jpg\n': 'elsewhere: .*run `git annex get`',
    '../.git/annex/objects/Xj/q5/00.jpg': 'elsewhere: .*link into nothing.*: run `git annex get`',
    '/mnt/disk/2.png': 'elsewhere: .*link into nothing, /mnt/disk/2.png: copy the file',
    b'': 'elsewhere: .*0 bytes: a placeholder of a cloud',
}


def folder_with_a_bad_file(path, content):
    """Write one whose content is damaged or elsewhere: not left out in silence."""
    fill(path, ['1.png', '3.png'])
    if isinstance(content, bytes):
        (path / '2.png').write_bytes(content)
    else:
        (path / '2.png').symlink_to(content)
    frames = [('1.png', 0, gray(0)), ('3.png', 0, gray(1))]
    return Drive(path, frames, errors=(BAD_FILES[content],))


# ---------------------------------------------------------------------------------------- videos


def video_drive(path, files, fps=10, start=SECOND, **more):
    """Return the frames of files by their images at their times, all of them of ``RATE``."""
    step, frames = RATE // fps, []
    for name, images in files:
        for image in images[::step]:
            i = len(frames)
            frames.append((f'{name}#{i}', start + i * SECOND // fps, image))
    return Drive(path, frames, {'fps': fps}, lossy=True, **more)


def video(path, name, codec, pixels):
    file = write_video(path / name, codec=codec, pixels=pixels)
    return video_drive(file, [(name, colored_images())])


OVER_33_BITS = 95443.7  # seconds of a clock of 90 kHz


def stream_whose_clock_jumps(path, later):
    first = write_video(path / 'first.ts', colored_images(30), 'libx264')
    second = copy_video(first, path / 'second.ts', max(later, 0))
    if later < 0:
        first = copy_video(first, path / 'later.ts', -later)
    (path / 'dash.ts').write_bytes(first.read_bytes() + second.read_bytes())
    images = np.concatenate([colored_images(30)] * 2)
    note = r'dash\.ts jumps by' * (later != OVER_33_BITS)
    return video_drive(path / 'dash.ts', [('dash.ts', images)], RATE, note=note, counted=False)


def small_copies_of_a_camera(path, beside):
    small = write_video(path / 'small.mp4', colored_images(30)[:, ::2, ::2])
    small.rename(path / 'DJI_0001.LRF')
    if not beside:
        return video_drive(path, [('DJI_0001.LRF', colored_images(30)[:, ::2, ::2])], RATE)
    write_video(path / 'DJI_0001.MP4')
    return video_drive(path, [('DJI_0001.MP4', colored_images())], RATE)


def videos_of_one_drive(path):
    names = ['GX010123.MP4', 'GX020123.MP4', 'GX100123.MP4']
    for name in names:
        write_video(path / name, colored_images(30))
    (path / '._GX010123.MP4').write_bytes(b'of a file manager')
    (path / 'GX010123.THM').write_bytes(b'a thumbnail')
    return video_drive(path, [(name, colored_images(30)) for name in names])


def video_of_a_stated_time(path, text, start):
    file = write_video(path / 'a.mkv', colored_images(2), metadata={'creation_time': text})
    files = [('a.mkv', colored_images(2))]
    return video_drive(file, files, RATE, round(start * SECOND), counted=False)


DRIVES: list[tuple] = [  # a function that writes files, and its arguments
    *((written_bag, storage, one) for storage in ('sqlite3', 'mcap') for one in (False, True)),
    (written_bag, 'sqlite3', False, False),
    *((mixed_bag, ros1, '/raw') for ros1 in (False, True)),
    *((mixed_bag, ros1, '/small', bad) for ros1 in (False, True) for bad in ((), (1, 3))),
    (parts_of_a_ros1_bag,),
    (bag_after_2038, 2**31),
    (bag_after_2038, 2**32 - 1),
    (bag_beside_images,),
    (bag_that_states_too_many_messages,),
    *((mcap_without_an_end, 0.6, 85, zeros) for zeros in (0, 2_000_000)),
    *((mcap_without_an_end, 0.95, 170, zeros) for zeros in (0, 2_000_000)),
    (mcap_without_its_index,),
    *((split_bag, suffix, *row) for suffix in ('db3', 'mcap') for row in SPLIT),
    *((compressed_bag, mode, has) for mode in ('FILE', 'MESSAGE', 'STORAGE') for has in (0, 1)),
    *((folder, name, kind) for name in ('drive', 'drive.bag', 'drive.mp4') for kind in FOLDERS),
    *((folder_with_pages, *one.split()) for one in PAGES),
    (folder_of_names_that_are_no_utf8,),
    *((folder_with_a_bad_file, content) for content in BAD_FILES),
    (video, 'phone.mp4', 'libx264', 'yuv420p'),
    (video, 'phone.AVI', 'mjpeg', 'yuvj420p'),
    *((stream_whose_clock_jumps, later) for later in (1000, -4, OVER_33_BITS)),
    (small_copies_of_a_camera, False),
    (small_copies_of_a_camera, True),
    (videos_of_one_drive,),
    (video_of_a_stated_time, '2026-05-01T10:00:00.5+02:00', 1_777_622_400.5),
    (video_of_a_stated_time, '1804-01-01', 1),
]


def name_of(case):
    """Return the name of a row of a table."""
    return ' '.join(getattr(part, '__name__', str(part))[:40] for part in case[:3])


@pytest.mark.parametrize('case', DRIVES, ids=name_of)
def test_files_become_frames(tmp_path, caplog, case):
    """Also if they are read again; what is logged is logged once."""
    write, *arguments = case
    drive, errors = write(tmp_path, *arguments), []
    source = open_source(drive.path, on_error=errors.append, **drive.options)
    for _ in range(2):
        frames = list(source)
        assert [frame.identifier for frame in frames] == [frame[0] for frame in drive.frames]
        stamps = [stamp for _, stamp, _ in drive.frames]
        off = np.subtract([frame.stamp for frame in frames], stamps)
        assert np.abs(off).max() <= (2e6 if drive.lossy else 0)
        for frame, (_, _, image) in zip(frames, drive.frames, strict=True):
            assert frame.image.shape == image.shape
            assert np.abs(frame.image - image.astype(float)).mean() <= (6 if drive.lossy else 0)
        for error, text in zip(errors, drive.errors, strict=True):
            assert re.search(text, f'{error.kind}: {error}')
        errors.clear()
    if drive.counted:
        assert len(source) == len(drive.frames) + len(drive.errors)
    assert getattr(source, 'left_out', {}) == drive.left_out
    notes = [record.getMessage() for record in caplog.records if record.name.startswith('stavpr')]
    assert (len(notes), bool(notes)) == (len({*notes}), bool(drive.note))
    assert re.search(drive.note, '\n'.join(notes))
    if isinstance(source, BagSource):
        for frame, record in zip(frames, source.records(), strict=True):
            assert record.stamp_ns in (0, frame.stamp)
            np.testing.assert_array_equal(decode_message(record), frame.image)
    if drive.errors:
        with pytest.raises(ImageError) as caught:
            list(open_source(drive.path, **drive.options))
        assert re.search(drive.errors[0], f'{caught.value.kind}: {caught.value}')


# ---------------------------------------------------------------------------------------- errors


def bag_of_texts(path):
    with writing(path / 'none') as bag:
        bag.topic('/text', TEXT)
    return path / 'none'


def bags_of_two_topics(path):
    parts_of_a_ros1_bag(path)
    with writing(path / 'rear.bag', ros1=True) as bag:
        bag.write('/rear', RAW, T0, bag.header(5), 1, 2, 'rgb8', 0, 6, np.zeros(6, np.uint8))
    return path


def bag_with_another_file(path, storage):
    folder = written_bag(path, storage).path
    (folder / 'metadata.yaml').unlink()
    shutil.copy(file_of(folder), file_of(folder).with_stem('second'))
    return folder


SECOND_FILE = r'exactly one .db3 or .mcap file then, .* found .*second'


def file_of_kind(path, kind):
    """Write a bag or a video."""
    if kind == 'ros1':
        return write_mixed(path / 'drive.bag', ros1=True)
    if kind in ('sqlite3', 'mcap'):
        write_bag(path / 'bag', '/raw', records(200), kind)
        return file_of(path / 'bag')
    codec, sounds = {'avi': ('ffv1', ())}.get(kind, ('libx264', [(0, 2)]))
    return write_video(path / f'drive.{kind}', codec=codec, sounds=sounds)


def cut_off(path, kind, share):
    file = file_of_kind(path, kind)
    file.write_bytes(file.read_bytes()[: int(file.stat().st_size * share)])
    return file


def replace_bytes(path, kind, old, new):
    file = file_of_kind(path, kind)
    file.write_bytes(file.read_bytes().replace(old, new, 1 if kind == 'mcap' else -1))
    return file


def pipe(path, name):
    """Make one instead of a bag: reading it would not end."""
    file = path / name
    file.parent.mkdir(exist_ok=True)
    os.mkfifo(file)
    return file.parent if name.startswith('folder/') else file


def images(path, *names):
    return fill(path / 'images', names or ['1.png'])


def other_content(path, name, content):
    (path / name).write_bytes(content)
    return path / name


def bag_that_images_do_not_hide(path):
    folder = images(path, '1.png', '2.png')
    (folder / 'drive_0.mcap').write_bytes(b'cut off')
    (folder / 'metadata.yaml').write_text('rosbag2_bagfile_information:\n  version: 5\n')
    return folder


def videos_of_two_drives(path, second=None, rate=RATE, created='2026-05-01T10:00:00Z'):
    first = {'creation_time': '2026-05-01T10:00:00Z'}
    write_video(path / '1.mp4', colored_images(2), metadata=first)
    second = colored_images(2) if second is None else second
    write_video(path / '2.mp4', second, rate=rate, metadata={'creation_time': created})
    return path


def video_beside(path, name, content):
    write_video(path / '1.mp4', colored_images(2))
    (path / name).write_bytes(content)
    return path


def playlist(path, content):
    """Write a file that names another one: it is not followed."""
    write_video(path / 'other.mp4', colored_images(3))
    return other_content(path, 'phone.mov', content)


def bag_with(path, topic):
    return write_mixed(path / 'bag'), {'topic': topic}


SIZE, HUGE = (np.array(sides, '<u4').tobytes() for sides in ((WIDTH, HEIGHT), (9000, 8000)))
CREATED = '2026-05-01T09:59:00Z'
LISTED = r'not in the order .* 1\.mp4 \(64x48, 30 Hz\), 2\.mp4 \(\d\dx48, {} Hz\)'
TOPICS = r'2 image topics.*/raw \(sensor_msgs/msg/Image, 5 messages\), /small'
POINTER = r'is a pointer of Git LFS .*: run `git lfs pull`'
NO_VIDEO = r'phone\.mov .*is damaged, cut off, no video'
NOT_DECODED = r'phone\.mov .*no video that FFmpeg decodes'
REFUSED: list[tuple] = [  # pattern of the error, a function that writes files, its arguments
    (TOPICS, bag_with, None),
    (r"'/other' is not in .*expected one of /raw", bag_with, '/other'),
    ('is of type std_msgs/msg/String in ', bag_with, '/text'),
    ("'/silent' has no messages in", bag_with, '/silent'),
    (r'no images.*/text .std_msgs/msg/String, 0 messages', bag_of_texts),
    (r'2 image topics, choose one .* /raw .*, /rear ', bags_of_two_topics),
    *((SECOND_FILE, bag_with_another_file, storage) for storage in ('sqlite3', 'mcap')),
    ("is an MCAP of profile 'ros1': expected ros2", replace_bytes, 'mcap', b'ros2', b'ros1'),
    *((r'\.(db3|bag)', cut_off, kind, s) for kind in ('sqlite3', 'ros1') for s in (0, 0.3, 0.99)),
    *((r'\.mcap', cut_off, 'mcap', share) for share in (0, 0.3)),
    ('has no images', cut_off, 'mcap', 0.01),
    *((r'pipe|director', pipe, name) for name in ('bag.bag', 'bag.db3', 'folder/bag.db3')),
    (r'left out: images in a format that is .*: 3', images, '1.ARW', '3.avif', '4.dng'),
    ('has no images: expected files ending in', images, 'notes.txt'),
    ('does not exist', lambda path: path / 'missing'),
    ('is no folder, video or bag', lambda path: images(path) / '1.png'),
    ('leave the topic out', lambda path: (images(path), {'topic': '/image'})),
    *((POINTER, other_content, f'drive{suffix}', LFS) for suffix in ('.mp4', '.mcap', '.bag', '')),
    ('is damaged, cut off or no bag', bag_that_images_do_not_hide),
    (LISTED.format(30), videos_of_two_drives, colored_images(2)[:, :, :32]),
    (LISTED.format(25), videos_of_two_drives, None, 25),
    (LISTED.format(30), videos_of_two_drives, None, RATE, CREATED),
    ('has videos and images: expected one kind', video_beside, '1.jpg', b'an image'),
    (r'2\.mp4 is damaged', video_beside, '2.mp4', b'damaged'),
    ('frames of more than 64000000 pixels', replace_bytes, 'avi', SIZE, HUGE),
    *((NO_VIDEO, playlist, content) for content in (b'', b'no video' * 99)),
    (NOT_DECODED, playlist, b'ffconcat version 1.0\nfile other.mp4\n'),
    (NOT_DECODED, playlist, b'#EXTM3U\nother.mp4\n'),
    *(('ends early', cut_off, suffix, 0.6) for suffix in ('mkv', 'flv', 'mov')),
    (r'fps = 0\.0 must be above 0', lambda path: (file_of_kind(path, 'mkv'), {'fps': 0.0})),
    ('is no bag: leave', lambda path: (file_of_kind(path, 'mkv'), {'topic': '/camera'})),
]
OTHERS = {'ends early': ImageError, r'fps = 0\.0 must be above 0': SettingsError}


@pytest.mark.parametrize('case', REFUSED, ids=name_of)
def test_files_are_refused_with_the_remedy(tmp_path, case):
    text, write, *arguments = case
    made = write(tmp_path, *arguments)
    path, options = made if isinstance(made, tuple) else (made, {})
    with pytest.raises(OTHERS.get(text, SourceError), match=text):
        list(open_source(path, **options))


@pytest.mark.parametrize('changes', [20, 200])
@pytest.mark.parametrize('kind', ['sqlite3', 'mcap', 'ros1', 'mp4', 'ts', 'mkv'])
def test_damaged_files_give_images_or_errors_of_our_own(tmp_path, kind, changes):
    """Bags often, since they are read in this process; :mod:`reader_fuzz` tries more."""
    file = file_of_kind(tmp_path, kind)
    data, rng, outcomes = file.read_bytes(), np.random.default_rng(0), set()
    topic = '/raw' if kind in ('sqlite3', 'mcap', 'ros1') else None
    for _ in range(30 if topic else 1):
        damaged = np.frombuffer(data, np.uint8).copy()
        at = rng.integers(0, len(damaged), changes)
        damaged[at] = rng.integers(0, 256, changes)
        file.write_bytes(damaged.tobytes())
        try:
            outcomes.add(len(list(open_source(file, topic))))
        except (SourceError, ImageError) as error:
            outcomes.add(type(error))
    assert SourceError in outcomes or not topic


def test_folder_records_have_stamps_by_rate(tmp_path):
    folder = images(tmp_path, '1.png', '2.png', '3.png')
    (folder / '2.png').write_bytes(b'damaged')
    source = open_source(folder, on_error=lambda _: None)
    for options, stamps in (
        ({}, [250_000_000, 750_000_000]),
        ({'start': 0.3, 'duration': 4}, [750_000_000]),
        ({'start': 7.0}, []),
    ):
        records = list(source.records(4, **options))
        assert [record.stamp_ns for record in records] == stamps
        assert [record.time_ns for record in records] == stamps
    with pytest.raises(InputError, match='0 frames per second'):
        next(source.records(0))


def test_video_records_begin_and_end_when_asked(tmp_path):
    source = open_source(file_of_kind(tmp_path, 'mp4'), fps=10)
    stamps = [record.stamp_ns for record in source.records(0.5, 0.4)]
    np.testing.assert_allclose(stamps, [1.5e9, 1.6e9, 1.7e9, 1.8e9], atol=1e6)


def test_image_that_is_gone_when_it_is_read_is_an_error(tmp_path):
    source = open_source(images(tmp_path))
    (tmp_path / 'images' / '1.png').unlink()
    with pytest.raises(ImageError, match='cannot be read') as caught:
        list(source)
    assert caught.value.kind == 'unreadable'
    with pytest.raises(SourceError, match='No such file or directory; check its name'):
        FolderSource(tmp_path / 'missing')


@pytest.mark.parametrize('method', ['exists', 'is_dir', 'is_file'])
def test_folder_without_permission_fails(tmp_path, monkeypatch, method):
    """As user root, permissions forbid nothing."""

    def refuse(*_):
        raise PermissionError(13, 'Permission denied')

    folder = images(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(Path, method, refuse)
        with pytest.raises(SourceError, match='Permission denied; check its name and permissions'):
            open_source(folder)


# Bags that are written, recorded by others or damaged


def test_parts_of_a_split_ros1_bag_are_read_by_time(tmp_path):
    parts_of_a_ros1_bag(tmp_path)
    times = [record.time_ns for record in records(9)]
    assert [record.time_ns for record in open_source(tmp_path).records(0.4, 0.3)] == times[4:7]
    assert [record.time_ns for record in read_messages(tmp_path, ['/text'])] == times


def test_bag_is_written_by_one_writer_and_over_what_a_killed_one_left(tmp_path):
    path = tmp_path / 'drive'

    def others():
        with pytest.raises(OutputError, match='is being written'):
            write_bag(path, '/image', records())
        yield from records()
        assert not path.exists()

    stale = tmp_path / '.stavpr-0123456789ab'
    (stale / 'drive').mkdir(parents=True)  # a killed writer left it
    (stale / 'drive' / 'drive.db3').write_bytes(b'old')
    assert write_bag(path, '/image', others()) == 5
    assert [file.name for file in tmp_path.iterdir()] == ['drive']
    assert sorted(file.name for file in path.iterdir()) == ['drive.db3', 'metadata.yaml']


@pytest.mark.parametrize('storage', ['sqlite3', 'mcap'])
def test_records_of_a_bag_are_those_that_were_written(tmp_path, storage):
    assert write_bag(tmp_path / 'bag', '/camera/image', records(), storage) == 5
    source = open_source(tmp_path / 'bag')
    assert source.topic == '/camera/image'
    for original, read in zip(records(), source.records(), strict=True):
        assert vars(read) | {'data': 0} == vars(original) | {'data': 0}
        np.testing.assert_array_equal(read.data, original.data)


def listing(folder):
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in folder.iterdir()}


def test_bag_with_write_ahead_log_is_read_and_unchanged(tmp_path):
    write_bag(tmp_path / 'made', '/image', records())
    folder = tmp_path / 'odd #name%41?'
    folder.mkdir()
    file = folder / 'made#%.db3'
    shutil.copy(tmp_path / 'made' / 'made.db3', file)
    database = sqlite3.connect(file)
    database.execute('PRAGMA journal_mode=WAL')
    database.execute('PRAGMA wal_autocheckpoint=0')
    database.execute(
        'INSERT INTO messages SELECT 99, topic_id, timestamp + 1000000000, data FROM messages '
        'WHERE id=1'
    )
    database.commit()
    before = listing(folder)
    assert f'{file.name}-wal' in before
    assert len(list(open_source(file))) == 6
    assert listing(folder) == before
    database.close()


def test_write_bag_never_overwrites_nor_leaves_parts(tmp_path):
    def broken():
        yield from records(2)
        raise ImageError('the third one')

    with pytest.raises(ImageError, match='the third one'):
        write_bag(tmp_path / 'bag', '/image', broken())
    assert not list(tmp_path.iterdir())
    write_bag(tmp_path / 'bag', '/image', records())
    with pytest.raises(OutputError, match='exists already'):
        write_bag(tmp_path / 'bag', '/image', records())
    with pytest.raises(SettingsError, match="'zip' is unknown: take one of sqlite3, mcap"):
        write_bag(tmp_path / 'other', '/image', records(), 'zip')


def test_bag_of_2019_is_read(data_folder):
    path = data_folder / 'bags' / 'klintan_rosbag2js_sample.db3'
    before = sorted(path.parent.iterdir())
    for topic in ('/image', '/image/compressed'):
        (record,), (frame,) = open_source(path, topic).records(), open_source(path, topic)
        assert frame.image.shape == (480, 640, 3)
        assert (record.stamp_ns, frame.stamp) == (0, record.time_ns)
    assert sorted(path.parent.iterdir()) == before


def test_bag_of_ros1_is_read(data_folder):
    path = data_folder / 'bags' / 'kapture_t265_trimmed_locoffice.bag'
    for camera in (1, 2):
        topic = f'/camera/fisheye{camera}/image_raw'
        frames = list(open_source(path, topic))
        assert [frame.image.shape for frame in frames] == [(800, 848, 3)] * 3
        assert [round(gap / 1e6) for gap in np.diff([frame.stamp for frame in frames])] == [33, 33]
        assert all(np.ptp(frame.image) > 100 for frame in frames)


# The order of image files: kinds of numbers in names, counters that begin again, EXIF


def counter(first, span, count=24, width=0, zero=0):
    return [f'{(first + i - zero) % (span - zero) + zero:0{width}d}' for i in range(count)]


SURE = {
    'decimal': ['1.05', '1.5', '1.75'],
    'two counters': ['1.1', '1.2', '1.9', '1.10', '1.11', '2.1'],
    'nanoseconds behind a dot': ['1700000000.5000000', '1700000000.55000000', '1700000001.0'],
    'longer than a float': ['1700000000.63555584', '1700000000.113555584'],
    'negative': ['x-10', 'x-2', 'x-1.5', 'x0', 'x3', 'x12'],
    'dash': ['IMG-1', 'IMG-2', 'IMG-10'],
    'dates': ['2030.1.5', '2030.1.10', '2030.2.1'],
    'copies': ['IMG_9', 'IMG_9 (2)', 'IMG_10'],
}
GUESSED = {
    'decimal': ['1.25', '1.5'],
    'gopro': [f'G001{i}' for i in counter(9989, 10000, width=4, zero=1)],
    'steps': counter(9900, 10000, 240, width=4)[::10],
    '16 bits': counter(65530, 2**16),
}


def test_natural_key_sorts_numbers():
    names = ['10.jpg', 'a2b10.png', '2.jpg', '1.jpg', 'a2b9.png', 'A1.png', '01.jpg', 'a.png']
    expected = ['01.jpg', '1.jpg', '2.jpg', '10.jpg', 'a.png', 'A1.png', 'a2b9.png', 'a2b10.png']
    assert sorted(names, key=natural_key) == expected


@pytest.mark.parametrize('mark', [' (1)', '(0)', '-1', '_2', ' copy'])
def test_natural_key_sorts_numbered_copies_behind_their_name(mark):
    expected = ['IMG_9.jpg', f'IMG_9{mark}.jpg', 'IMG_10.jpg', f'IMG_10{mark}.JPG']
    assert sorted({*expected}, key=natural_key) == expected


@pytest.mark.parametrize(
    ('names', 'guesses'), [*((n, 0) for n in SURE.values()), *((n, 1) for n in GUESSED.values())]
)
@pytest.mark.parametrize('folder', [False, True])
def test_names_are_in_the_order_of_their_kind_of_number(tmp_path, names, guesses, folder, caplog):
    form = '{}/1.jpg' if folder else '{}.jpg'
    expected = [tmp_path / form.format(name) for name in names]
    assert in_order(random.Random(0).sample(expected, len(expected)), tmp_path) == expected
    assert len(caplog.records) == guesses


@pytest.mark.parametrize(('names', 'step', 'note'), [
    ([f'DSC_{i}.JPG' for i in counter(9989, 10000, width=4, zero=1)], 7, None),
    ([f'{100 + i // 11}MEDIA/{n}.jpg' for i, n in enumerate(counter(9989, 10000))], 7, None),
    ([f'{(999, 100)[i // 12]}MEDIA/DJI_{i:04d}.jpg' for i in range(24)], 7, 'contradict'),
    ([f'{i * 7919 % 997:03d} x.jpg' for i in range(24)], 0.25, 'contradict'),
    ([f'{("phone", "camera")[i % 2]}_{i}.jpg' for i in range(24)], 7, 'contradict'),
    ([f'{i:04d}.jpg' for i in range(24)], 7, 'go back at 0010.jpg: the names count'),
])  # fmt: skip
def test_times_in_exif_decide_unless_a_clock_was_set(tmp_path, names, step, note, caplog):
    """Also within a second, where the file has its fractions."""
    expected = [tmp_path / name for name in names]
    seconds = 600 + step * np.arange(24)
    seconds[10:] -= 600 if note and 'go back' in note else 0
    for file, second in zip(expected, seconds, strict=True):
        exif = Image.Exif()
        tags = exif.get_ifd(0x8769)
        tags[0x9003] = f'2030:05:06 10:{int(second) // 60:02d}:{int(second) % 60:02d}'
        tags[0x9291] = f'{second % 1:.3f}'[2:]
        file.parent.mkdir(exist_ok=True)
        Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(file, exif=exif)
    assert in_order(sorted(expected), tmp_path) == expected
    assert len(caplog.records) == bool(note)
    assert (note or '') in caplog.text
