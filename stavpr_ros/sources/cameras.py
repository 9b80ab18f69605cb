# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The cameras of the image files of a folder, by their names."""

from collections.abc import Callable, Sequence
from itertools import combinations
import os
from pathlib import Path
import re

from stavpr_ros.errors import SourceError
from stavpr_ros.sources.notes import note_once

WORDS = re.compile(
    'left|right|cent(er|re)|middle|front|rear|back(ward)?|forward|top|bottom|side|[lr]|[fbr][lr]|'
    'rgb|colou?r|gr[ae]y|mono|depth|disparity|confidence|infra(red)?|n?ir|thermal|fisheye|wide|'
    'tele|masks?|seg(mentation)?|semantics?|labels?|instance|annotations?|normals?|flow|lidar|'
    'velodyne|radar|raw|rect(ified)?|undistorted|resized|small|previews?',
    re.IGNORECASE,
)
"""Parts of the names of cameras, and of images that are made of theirs."""
NUMBERED = re.compile(
    r'(cam|camera|image|img|infra|ir|fisheye|lens|sensor|view|stereo|eye|port)[ _-]?\d\d?(?!\d)',
    re.IGNORECASE,
)
SINGLE = re.compile(r'(?<![^\W_])[a-fA-F](?![^\W_])')  # else they are hexadecimal digits
TOKEN = re.compile(r'[A-Z]?[a-z]+|[A-Z]+')
WORD = re.compile(r'[^\W\d_]*[^\W\d_a-f][^\W\d_]*')  # no hexadecimal digits
MIN_SHARE = 0.05  # images of a camera over all images
MIN_ROLE_SHARE = 0.75  # of images with cameras in their names; else parts: hall_left, stairs
MIN_COMMON = 0.95  # common counters of two cameras that take images together
STAMPS = 10**7  # stamps and dates are not below

Groups = dict[str, dict[Path, tuple[int, ...]]]
"""The files of each camera with the numbers in their names."""


def of_one_camera(files: Sequence[Path], top: Path, camera: str | None = None) -> list[Path]:
    """
    Return the files of one camera.

    :param files: files of the folder ``top`` and its sub-folders.
    :param camera: its name as the error lists it; None = there is one.
    :raises SourceError: several cameras passed the same places, or none has the name.
    """
    roles, streams = (_groups(files, top, split) for split in (_role, _stream))
    groups = roles if len(roles) > 1 else streams
    if camera is not None:
        by_name = {name.casefold(): group for name, group in groups.items()}
        if group := by_name.get(camera.strip('/').casefold()):
            return list(group)
        choice = f'expected one of {_describe(groups)}' if len(groups) > 1 else 'leave it out'
        raise SourceError(f'{top} has no camera {camera!r}: {choice}')
    alike: dict[str, list[Path]] = {}  # by names without camera and numbers
    for file in files:
        rest = Path(_role(file.relative_to(top))[1]).name.casefold()
        alike.setdefault(re.sub(r'[\W\d_]', '', rest), []).append(file)
    largest = max(alike.values(), key=len, default=[])
    of_roles = _groups(largest if len(largest) >= MIN_ROLE_SHARE * len(files) else [], top, _role)
    several, is_sure = _parallel(of_roles, len(files), MIN_COMMON), True
    if not several:
        several = _parallel(streams, len(files), 0.5)
        is_sure = bool(several) and all(map(_is_stamped, several.values()))
    if several and is_sure:
        raise SourceError(
            f'{top} has images of {len(several)} cameras, {_describe(several)}: expected one; '
            'choose it, --camera NAME; parts of one drive need other names'
        )
    if several:
        note_once(
            f'{top} has images of the same numbers, {_describe(several)}: they are taken for '
            'parts of one drive; if they are of several cameras or drives, choose one, --camera '
            'NAME'
        )
    return list(files)


def _groups(files: Sequence[Path], top: Path, split: Callable[[Path], tuple[str, str]]) -> Groups:
    groups: Groups = {}
    for file in files:
        name, rest = split(file.relative_to(top))
        groups.setdefault(name, {})[file] = tuple(map(int, re.findall(r'\d+', rest)))
    if len(groups) > 1 and '' in groups:  # images without a name are of their folder
        loose = groups.pop('')
        groups[os.path.relpath(os.path.commonpath([file.parent for file in loose]), top)] = loose
    return groups


def _role(path: Path) -> tuple[str, str]:
    """Return the camera that a path names, and the path without it."""
    folders = [part for part in path.parts[:-1] if _words(part, 0)]
    others = [part for part in path.parts[:-1] if part not in folders]
    rest, words = path.stem, {word for part in folders for word in _words(part, 0)}
    own_words = [word for word in _words(rest, 1) if word not in words]
    for word in [*own_words, *words]:
        rest = rest.replace(word, ' ')
    return '/'.join(filter(None, [*folders, '_'.join(own_words)])), '/'.join([*others, rest])


def _words(name: str, counters: int) -> list[str]:
    """Return the words for cameras in a name; so many of its numbers are counters."""
    words = [word for word in TOKEN.findall(name) if WORDS.fullmatch(word)]
    numbers, numbered = len(re.findall(r'\d+', name)), NUMBERED.search(name)
    words += SINGLE.findall(name) if counters and numbers else []
    return words + ([numbered[0]] if numbered and numbers > counters else [])


def _stream(path: Path) -> tuple[str, str]:
    """Return the folder and the words of a name, and its numbers."""
    name, number = '_'.join(WORD.findall(path.stem.casefold())), re.search(r'\d+', path.stem)
    is_stamp = number and int(number[0]) >= STAMPS
    return '/'.join([*path.parts[:-1], name]).strip('/'), path.stem if is_stamp else str(path)


def _is_stamped(group: dict[Path, tuple[int, ...]]) -> bool:
    return all(numbers >= (STAMPS,) for numbers in group.values())


def _parallel(groups: Groups, count: int, common: float) -> Groups:
    """Return the groups whose times, or a common share of their counters, are another group's."""
    min_images = max(2, MIN_SHARE * count)
    large = {name: group for name, group in groups.items() if len(group) >= min_images}
    several: Groups = {}
    for a, b in combinations(large, 2):
        small, other = sorted((large[a], large[b]), key=len)
        first, last = min(other.values()), max(other.values())
        min_count = len(small) / 2
        if not (_is_stamped(small) and _is_stamped(other)):
            min_count = max(min_count, common * len(other))
        if sum(first <= numbers <= last for numbers in small.values()) >= min_count:
            several |= {a: large[a], b: large[b]}
    return several


def _describe(groups: Groups) -> str:
    return ', '.join(f'{name} ({len(group)})' for name, group in sorted(groups.items()))
