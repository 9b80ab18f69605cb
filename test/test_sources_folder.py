# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A folder of images: order, files that count as images, errors."""

import os
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
import pytest
from stavpr_ros.errors import ImageError, InputError, left_out, SourceError
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


def test_folder_yields_frames_in_order(tmp_path):
    fill(tmp_path, ['10.png', '9.PNG', '11.bmp', '.hidden.png'])
    (tmp_path / 'notes.txt').write_text('no image')
    (tmp_path / 'folder.png').mkdir()
    source = open_source(tmp_path)
    frames = list(source)
    assert isinstance(source, FolderSource)
    assert len(source) == 3
    assert [frame.identifier for frame in frames] == ['9.PNG', '10.png', '11.bmp']
    assert [frame.image[0, 0].tolist() for frame in frames] == [[10] * 3, [0] * 3, [20] * 3]
    assert {frame.stamp for frame in frames} == {0}
    assert len(list(source)) == 3


def test_folder_records_have_stamps_by_rate(tmp_path):
    fill(tmp_path, ['1.png', '2.png', '3.png'])
    (tmp_path / '2.png').write_bytes(b'damaged')
    records = list(FolderSource(tmp_path, on_error=lambda _: None).records(4))
    assert [record.stamp_ns for record in records] == [250_000_000, 750_000_000]
    assert [record.time_ns for record in records] == [250_000_000, 750_000_000]
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


def test_folder_without_images_yields_those_of_sub_folders(tmp_path):
    for name in ('10', '9/b', '.hidden', '9'):
        (tmp_path / name).mkdir(parents=True, exist_ok=True)
    fill(tmp_path, ['10/1.png', '9/b/1.png', '.hidden/1.png', '9/2.png', '9/a.png'])
    expected = ['9/2.png', '9/a.png', '9/b/1.png', '10/1.png']
    assert [frame.identifier for frame in FolderSource(tmp_path)] == expected


def test_folder_with_more_images_in_sub_folders_yields_the_drive(tmp_path):
    """Stray images beside the drive, or sub-folders beside it: the others are counted."""
    (tmp_path / 'drive').mkdir()
    fill(tmp_path, ['overview.png', *(f'drive/{i}.png' for i in range(5))])
    source = FolderSource(tmp_path)
    assert [frame.identifier for frame in source] == [f'drive/{i}.png' for i in range(5)]
    assert source.left_out == {'beside': 1}
    fill(tmp_path, ['1.png'])
    source = FolderSource(tmp_path)
    assert [frame.identifier for frame in source] == ['1.png', 'overview.png']
    assert left_out(source.left_out) == 'left out: 5 images in sub-folders of the drive'


def test_folder_ignores_folders_that_other_programs_add(tmp_path):
    foreign = ('@eaDir', '#recycle', '$RECYCLE.BIN', '__MACOSX', 'lost+found', 'Thumbnails')
    for name in (*foreign, '.@__thumb', 'a/@eaDir'):
        (tmp_path / name).mkdir(parents=True)
        fill(tmp_path, [f'{name}/{i}.png' for i in range(9)])
    fill(tmp_path, ['a/1.png', 'a/2.png'])
    source = FolderSource(tmp_path)
    assert [frame.identifier for frame in source] == ['a/1.png', 'a/2.png']
    assert source.left_out == {'foreign': 7}


def test_folder_counts_images_of_other_formats_once(tmp_path):
    """A raw image beside its JPEG is not missing, and of HEIC and JPEG the JPEG is read."""
    fill(tmp_path, ['1.jpg', '2.jpg'])
    for name in ('1.ARW', '2.heic', '3.avif', '4.dng', 'notes.txt'):
        (tmp_path / name).write_bytes(b'content')
    source = FolderSource(tmp_path)
    assert [frame.identifier for frame in source] == ['1.jpg', '2.jpg']
    assert left_out(source.left_out, {'damaged': 1}).startswith('left out: 2 images of a format')
    for image in ('1.jpg', '2.jpg', '2.heic'):
        (tmp_path / image).unlink()
    with pytest.raises(SourceError, match='left out: 3 images of a format that is'):
        FolderSource(tmp_path)


def test_photos_of_a_telephone_with_a_video_each_are_the_drive(tmp_path):
    for number in range(3):
        cv2.imwrite(str(tmp_path / f'{number}.jpg'), np.full((8, 8), number, np.uint8))
        (tmp_path / f'{number}.MOV').write_bytes(b'of the same moment')
    source = open_source(tmp_path)
    assert len(source) == 3
    assert left_out(source.left_out) == 'left out: 3 videos among images (to read one, name it)'


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


@pytest.mark.parametrize(('names', 'counts'), [
    (['a.gif', 'b.ico', 'c.avifs', '._1.png'], {'format': 3}),
    (['drive_0.mcap'], {'bag': 1}),
    (['metadata.yaml'], {}),
])  # fmt: skip
@pytest.mark.parametrize('folder', ['drive', 'drive.bag', 'drive.mp4'])
def test_files_of_other_kinds_beside_images_are_counted(tmp_path, names, counts, folder):
    """Bags that are cut off, and metadata of another program, are no bag of images."""
    (tmp_path / folder).mkdir()
    for name in names:
        (tmp_path / folder / name).write_text('camera: front\nfps: 10\n')
    fill(tmp_path / folder, ['1.png', '2.png'])
    source = open_source(tmp_path / folder)
    assert [frame.identifier for frame in source] == ['1.png', '2.png']
    assert source.left_out == counts


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
