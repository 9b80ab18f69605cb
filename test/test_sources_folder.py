# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A folder of images: order, files that count as images, errors."""

import os
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
import pytest
from stavpr_ros.errors import ImageError, InputError, SourceError
from stavpr_ros.sources import open_source
from stavpr_ros.sources.folder import FolderSource
from stavpr_ros.sources.order import natural_key


def fill(folder, names):
    for i, name in enumerate(names):
        cv2.imwrite(str(folder / name), np.full((4, 6, 3), 10 * i, np.uint8))


def test_natural_key_sorts_numbers():
    names = ['10.jpg', 'a2b10.png', '2.jpg', '1.jpg', 'a2b9.png', 'A1.png', '01.jpg', 'a.png']
    expected = ['01.jpg', '1.jpg', '2.jpg', '10.jpg', 'a.png', 'A1.png', 'a2b9.png', 'a2b10.png']
    assert sorted(names, key=natural_key) == expected


@pytest.mark.parametrize('mark', [' (1)', '(0)', '-1', '_2', ' copy'])
def test_natural_key_sorts_numbered_copies_behind_their_name(mark):
    expected = ['IMG_9.jpg', f'IMG_9{mark}.jpg', 'IMG_10.jpg', f'IMG_10{mark}.JPG']
    assert sorted({*expected}, key=natural_key) == expected


FOREIGN = ('@eaDir', '#recycle', '$RECYCLE.BIN', '__MACOSX', 'lost+found', 'Thumbnails')
OTHER = ('a.gif', 'b.ico', 'c.avifs', '._1.png')
DRIVES = {  # files; images that are read; counts of those that are left out
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
    'no images': ([*OTHER, '1.png', '2.png'], ['1.png', '2.png'], {'format': 3}),
    # a bag that is cut off, and metadata of another program, are no bag of images
    'a bag': (['drive_0.mcap', '1.png', '2.png'], ['1.png', '2.png'], {'bag': 1}),
    'metadata': (['metadata.yaml', '1.png', '2.png'], ['1.png', '2.png'], {}),
}


@pytest.mark.parametrize('name', DRIVES)
@pytest.mark.parametrize('folder', ['drive', 'drive.bag', 'drive.mp4'])
def test_images_of_a_drive_are_read_in_order_and_others_counted(tmp_path, name, folder):
    files, images, counts = DRIVES[name]
    (tmp_path / folder / 'folder.png').mkdir(parents=True)
    for i, file in enumerate(files):
        path = tmp_path / folder / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text('camera: front\nfps: 10\n')
        if path.suffix.lower() in {'.png', '.jpg', '.bmp'} and path.name != '._1.png':
            cv2.imwrite(str(path), np.full((4, 6, 3), i, np.uint8))
    source = open_source(tmp_path / folder)
    frames = list(source)
    assert isinstance(source, FolderSource)
    assert [frame.identifier for frame in frames] == images
    assert [frame.image[0, 0, 0] for frame in frames] == [files.index(name) for name in images]
    assert (len(source), {frame.stamp for frame in frames}) == (len(images), {0})
    assert source.left_out == counts


def test_folder_of_other_formats_alone_is_refused(tmp_path):
    for name in ('1.ARW', '3.avif', '4.dng'):
        (tmp_path / name).write_bytes(b'content')
    with pytest.raises(SourceError, match='left out: 3 images of a format that is'):
        FolderSource(tmp_path)


def test_folder_records_have_stamps_by_rate(tmp_path):
    fill(tmp_path, ['1.png', '2.png', '3.png'])
    (tmp_path / '2.png').write_bytes(b'damaged')
    records = list(FolderSource(tmp_path, on_error=lambda _: None).records(4))
    assert [record.stamp_ns for record in records] == [250_000_000, 750_000_000]
    assert [record.time_ns for record in records] == [250_000_000, 750_000_000]
    records = FolderSource(tmp_path, on_error=lambda _: None).records(4, start=0.3, duration=4)
    assert [record.stamp_ns for record in records] == [750_000_000]
    assert not list(FolderSource(tmp_path, on_error=lambda _: None).records(4, start=7.0))
    with pytest.raises(InputError, match='0 frames per second'):
        next(FolderSource(tmp_path).records(0))


def test_folder_with_damaged_file_fails_or_skips(tmp_path):
    fill(tmp_path, ['1.png', '3.png'])
    (tmp_path / '2.png').write_bytes(b'\x89PNG damaged')
    with pytest.raises(ImageError, match=r'2\.png: 12 bytes are no image'):
        list(FolderSource(tmp_path))
    errors = []
    assert [frame.identifier for frame in FolderSource(tmp_path, errors.append)] == [
        '1.png',
        '3.png',
    ]
    assert ['2.png' in str(error) for error in errors] == [True]


def test_open_source_of_no_source_fails(tmp_path):
    with pytest.raises(SourceError, match='has no images: expected files ending in'):
        open_source(tmp_path)
    with pytest.raises(SourceError, match='does not exist'):
        open_source(tmp_path / 'missing')
    with pytest.raises(SourceError, match='No such file or directory; check its name'):
        FolderSource(tmp_path / 'missing')
    fill(tmp_path, ['1.png'])
    with pytest.raises(SourceError, match='is no folder, video or bag'):
        open_source(tmp_path / '1.png')
    with pytest.raises(SourceError, match='leave the topic out'):
        open_source(tmp_path, '/image')


@pytest.mark.parametrize('method', ['exists', 'is_dir', 'is_file'])
def test_folder_without_permission_fails(tmp_path, monkeypatch, method):
    """As user root, permissions forbid nothing."""

    def refuse(*_):
        raise PermissionError(13, 'Permission denied')

    fill(tmp_path, ['1.png'])
    with monkeypatch.context() as patch:
        patch.setattr(Path, method, refuse)
        with pytest.raises(SourceError, match='Permission denied; check its name and permissions'):
            open_source(tmp_path)


def test_folder_with_names_not_utf8_is_read(tmp_path):
    fill(tmp_path, ['1.png', '2.png'])
    for number, name in (('1', b'caf\xe9.png'), ('2', 'caff\u00e8.png'.encode())):
        (tmp_path / f'{number}.png').rename(tmp_path / os.fsdecode(name))
    identifiers = [frame.identifier for frame in open_source(tmp_path)]
    assert sorted(identifiers) == ['caff\u00e8.png', 'caf\ufffd.png']
    (tmp_path / os.fsdecode(b'caf\xe9.png')).write_bytes(b'')
    with pytest.raises(ImageError, match=r'caf\ufffd\.png: 0 bytes'):
        list(open_source(tmp_path))


LFS = b'version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 48213\n'


@pytest.mark.parametrize(('content', 'reason'), [
    (LFS, 'a pointer of Git LFS instead of the content: run `git lfs pull`'),
    (b'/annex/objects/SHA256E-s48213--00.jpg\n', 'run `git annex get`'),
    ('../.git/annex/objects/Xj/q5/00.jpg', 'a link into nothing, .*: run `git annex get`'),
    ('/mnt/disk/2.png', 'a link into nothing, /mnt/disk/2.png: copy the file'),
    (b'', '0 bytes: a placeholder of a cloud'),
])  # fmt: skip
def test_images_whose_content_is_elsewhere_are_named(tmp_path, content, reason):
    """Not called damaged, nor left out in silence."""
    fill(tmp_path, ['1.png', '3.png'])
    if isinstance(content, bytes):
        (tmp_path / '2.png').write_bytes(content)
    else:
        (tmp_path / '2.png').symlink_to(content)
    with pytest.raises(ImageError, match=rf'2\.png: .*{reason}') as caught:
        list(open_source(tmp_path))
    assert caught.value.kind == 'elsewhere'
    assert len(list(open_source(tmp_path, on_error=lambda _: None))) == 2


@pytest.mark.parametrize('name', ['drive.mp4', 'drive.mcap', 'drive.bag', 'drive'])
def test_sources_whose_content_is_elsewhere_are_named(tmp_path, name):
    (tmp_path / name).write_bytes(LFS)
    with pytest.raises(SourceError, match=r'is a pointer of Git LFS .*: run `git lfs pull`'):
        open_source(tmp_path / name)


def test_images_beside_the_metadata_of_a_bag_do_not_hide_it(tmp_path):
    fill(tmp_path, ['1.png', '2.png'])
    (tmp_path / 'drive_0.mcap').write_bytes(b'cut off')
    (tmp_path / 'metadata.yaml').write_text('rosbag2_bagfile_information:\n  version: 5\n')
    with pytest.raises(SourceError, match=f'{tmp_path}.* is damaged, cut off or no bag'):
        open_source(tmp_path)


@pytest.mark.parametrize(
    ('kind', 'name'),
    [('TIFF', '1.tif'), ('PNG', '1.png'), ('WEBP', '1.webp'), ('MPO', '1.jpg'), ('MPO', '1.mpo')],
)
def test_pages_behind_the_first_one_are_counted_once(tmp_path, kind, name):
    pages = [Image.new('RGB', (8, 8), (80 * i, 0, 0)) for i in range(3)]
    pages[0].save(tmp_path / name, kind, save_all=True, append_images=pages[1:])
    fill(tmp_path, ['2.png', '3.jpg', '4.tiff', '5.webp'])
    source = open_source(tmp_path)
    assert [len(list(source)) for _ in range(2)] == [5, 5]
    assert next(iter(source)).image.max() < 8
    assert source.left_out == {'pages': 2}
