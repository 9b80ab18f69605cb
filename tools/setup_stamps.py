"""
Stamps: small files that say what a finished step was made from.

A step is taken for done only while its stamp says what would be written now. The stamp goes away before the
step begins and comes back after its end, so that a half-finished step is done again.
"""

import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

IGNORED_FOLDERS = ('__pycache__',)


def digest_of(paths: Iterable[Path], root: Path) -> str:
    """
    One number for the names and contents of files, and of all files in folders.

    :param paths: files and folders under ``root``; one that does not exist counts as empty.
    :param root: the folder that names are relative to, so that a moved checkout has the same number.
    :returns: a SHA-256 in hexadecimal digits.
    """
    files: set[Path] = set()
    for path in paths:
        if path.is_dir():
            files.update(file for file in path.rglob('*') if file.is_file())
        elif path.is_file():
            files.add(path)
    digest = hashlib.sha256()
    for file in sorted(files):
        name = file.relative_to(root)
        if not set(name.parts).intersection(IGNORED_FOLDERS):
            content = hashlib.sha256(file.read_bytes()).hexdigest()
            digest.update(f'{name.as_posix()}\0{content}\n'.encode())
    return digest.hexdigest()


def read_stamp(stamp: Path) -> dict[str, str]:
    """What the finished step was made from; empty if it was never finished."""
    try:
        content = json.loads(stamp.read_text(encoding='utf-8'))
    except (FileNotFoundError, NotADirectoryError, json.JSONDecodeError):
        # A stamp cut short by a full disk says as little as none: the step is done again.
        return {}
    return content if isinstance(content, dict) else {}


def is_current(stamp: Path, wanted: Mapping[str, str]) -> bool:
    """Whether the step was finished with all of ``wanted``; it may have been made with more."""
    found = read_stamp(stamp)
    return all(found.get(key) == value for key, value in wanted.items())


def write_stamp(stamp: Path, made_from: Mapping[str, str]) -> None:
    """Say that the step is finished, in one move: an interrupted write leaves no stamp."""
    stamp.parent.mkdir(parents=True, exist_ok=True)
    draft = stamp.with_name(stamp.name + '.draft')
    draft.write_text(json.dumps(dict(made_from), indent=1, sort_keys=True) + '\n', encoding='utf-8')
    os.replace(draft, stamp)


def remove_stamp(stamp: Path) -> None:
    """Say that the step is not finished."""
    stamp.unlink(missing_ok=True)
