# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Paths of bags and their files, without rosbags, which loads slowly."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stavpr_ros.errors import SourceError, StavprError
from stavpr_ros.regular_file import open_regular
from stavpr_ros.sources.suffixes import SUFFIXES

METADATA = 'metadata.yaml'
IN_METADATA = b'rosbag2_bagfile_information'  # not in files of other programs
STORAGE_SUFFIXES = frozenset({'.db3', '.mcap', '.bag'})
ZSTD = '.zstd'  # behind the suffix of a file that is compressed as a whole
MAGIC = {
    b'SQLite format 3\0': '.db3',
    b'\x89MCAP0\r\n': '.mcap',
    b'#ROSBAG V2.0': '.bag',
    b'\x28\xb5\x2f\xfd': ZSTD,
}
"""The first bytes of the files of bags, and the suffixes that they should have."""


def is_bag(path: Path) -> bool:
    """
    Return whether a path is a bag and no folder of images: by names, of one file by its content.

    :raises SourceError: the folder cannot be listed.
    """
    with reading(path):
        if not path.is_dir():
            return _is_storage(path) or (path.is_file() and storage_kind(path) in STORAGE_SUFFIXES)
        metadata = path / METADATA
        if metadata.is_file() and IN_METADATA in metadata.read_bytes():
            return True
        bags = sum(not file.is_dir() for file in storage_files(path))
        images = sum(file.suffix.lower() in SUFFIXES for file in path.glob('[!.]*'))
        return bags > 0 and images < max(bags, 2)


def storage_kind(file: Path) -> str:
    """Return the suffix that fits the content of a file; else its own one."""
    with open_regular(file) as opened:  # a pipe would never end
        start = opened.read(max(map(len, MAGIC)))
    kinds = (kind for magic, kind in MAGIC.items() if start.startswith(magic))
    return next(kinds, file.suffix.lower())


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn errors of rosbags on a damaged file, of any type, into one that names the file."""
    try:
        yield
    except StavprError:
        raise
    except OSError as error:
        raise SourceError(
            f'{path} cannot be read: {error}; check its name and permissions'
        ) from error
    except Exception as error:
        raise SourceError(
            f'{path} is damaged, cut off or no bag: expected a ROS 2 bag (folder, .db3, .mcap) or '
            f'a ROS 1 .bag ({type(error).__name__}: {error}); try `ros2 bag reindex`, `rosbag '
            'reindex` or `mcap recover`'
        ) from error


def storage_files(folder: Path) -> list[Path]:
    """Return the files of a folder that bags store messages in, by their names."""
    return sorted(filter(_is_storage, folder.iterdir()))


def _is_storage(file: Path) -> bool:
    return Path(file.name.lower().removesuffix(ZSTD)).suffix in STORAGE_SUFFIXES
