"""Files of weights: where they lie, how published ones get here, and that they are what they should be."""

import hashlib
import http.client
import os
import sys
import tempfile
import urllib.request
from dataclasses import dataclass
from pathlib import Path
from typing import IO, BinaryIO

from tqdm import tqdm

from stavpr_ros.errors import FeatureMismatchError, UnavailableError

CACHED, DOWNLOAD = 'cached', 'download'  # words that stand for a published file instead of a path
TIMEOUT = 30  # seconds without a byte
PIECE = 1 << 20  # bytes


@dataclass(frozen=True)
class PublishedFile:
    """
    A file of weights on the server of its authors.

    :param address: its URL.
    :param sha256: what its authors say of its hash: the first digits, or '' where they say nothing.
    """

    address: str
    sha256: str = ''

    @property
    def name(self) -> str:
        """The name of the file."""
        return self.address.rsplit('/', 1)[-1]


def cache_folder() -> Path:
    """Return the folder of downloaded weights, ``$XDG_CACHE_HOME/stavpr_ros`` or ``~/.cache/stavpr_ros``."""
    return Path(os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache') / 'stavpr_ros'


def find_weights(model: str, published: PublishedFile, sha256: str = '') -> Path:
    """
    Turn a setting into the path of a file.

    :param model: a path; or ``cached``, the published file as an earlier download left it; or
        ``download``, the same, downloaded now if it is not there.
    :param sha256: the hash that a download must have, '' if it is not known.
    :raises UnavailableError: the published file is not there, or cannot be downloaded.
    """
    if model not in (CACHED, DOWNLOAD):
        return Path(model)
    path = cache_folder() / published.name
    if path.exists():
        return path
    if model == CACHED:
        raise UnavailableError(
            f"there is no {path}: give 'download' to get it from {published.address}, or the file's path"
        )
    download(published.address, path, sha256 or promised_hash(path, published))
    return path


def promised_hash(path: Path, published: PublishedFile | None = None) -> str:
    """
    Return what is known of the hash that a file ought to have, its first digits or all, '' if nothing.

    That is what the authors of a published file say; else what stands in ``NAME.sha256`` beside the file,
    in the format of sha256sum: a download leaves it there, so that later changes are noticed.
    """
    if published is not None and published.sha256 and path.name == published.name:
        return published.sha256
    try:
        words = _note(path).read_text().split()
    except FileNotFoundError:
        return ''
    except (OSError, ValueError) as error:
        raise UnavailableError(f'{_note(path)} cannot be read: {error}') from error
    return words[0].lower() if words else ''


def _note(path: Path) -> Path:
    return path.with_name(path.name + '.sha256')


def open_weights(path: Path, promised: str = '', wanted: str = '') -> tuple[BinaryIO, str]:
    """
    Open a file of weights once its content is known to be the right one.

    :param promised: the first digits of the hash that the file ought to have, see :func:`promised_hash`.
    :param wanted: the hash of the file that a map was made with, '' for any.
    :returns: the open file, at its beginning, and its sha256.
    :raises UnavailableError: it cannot be read, or is damaged.
    :raises FeatureMismatchError: it is another file than the one wanted.
    """
    try:
        file = path.open('rb')
    except OSError as error:
        raise UnavailableError(f'weights {str(path)!r} cannot be read: {error}') from error
    try:
        digest = hashlib.file_digest(file, 'sha256').hexdigest()
        if not digest.startswith(promised):
            raise UnavailableError(
                f'{path} has sha256 {digest[:16]}, it ought to begin with {promised[:16]}: it is damaged or '
                'another file; delete it and get it again'
            )
        if wanted and digest != wanted:
            raise FeatureMismatchError(
                f'weights {path} have sha256 {digest[:16]}, the settings ask for {wanted[:16]}: '
                'give the file that the map was built with'
            )
        file.seek(0)
    except OSError as error:
        file.close()
        raise UnavailableError(f'weights {str(path)!r} cannot be read: {error}') from error
    except BaseException:
        file.close()
        raise
    return file, digest


def download(address: str, path: Path, expected: str = '') -> None:
    """
    Download a file; it appears under its name complete and checked, or not at all.

    Its hash is noted beside it: where nothing is known of the hash, the first download is trusted, and
    whatever comes later is held against it.

    :param expected: the first digits of the hash that it must have, '' for any.
    :raises UnavailableError: it cannot be had, is cut short or has another hash.
    """
    advice = f'download it by other means and give its path, or copy it to {path}'
    partial = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f'{path.name}.', delete=False) as file:
            partial = Path(file.name)
            digest = _fetch(address, file, path.name)
        if not digest.startswith(expected):
            raise UnavailableError(
                f'what {address} sent has sha256 {digest[:16]}, expected {expected[:16]}: it was changed or '
                f'damaged on its way; try again, or {advice}'
            )
        _note(path).write_text(f'{digest}  {path.name}\n')
        partial.replace(path)
    except (OSError, http.client.HTTPException) as error:
        raise UnavailableError(f'{address} cannot be downloaded ({error}): {advice}') from error
    finally:
        if partial is not None:
            partial.unlink(missing_ok=True)
    known = 'as published' if expected else 'not published: trusted now, and noted to notice later changes'
    tqdm.write(f'{path}: sha256 {digest} ({known})', file=sys.stderr)


def _fetch(address: str, file: IO[bytes], name: str) -> str:
    """Copy what the address sends into a file and return its sha256."""
    digest = hashlib.sha256()
    with urllib.request.urlopen(address, timeout=TIMEOUT) as answer:
        length = answer.headers.get('Content-Length')
        total = int(length) if length and length.isdigit() else None
        with tqdm(total=total, unit='B', unit_scale=True, desc=name, disable=None) as bar:
            while piece := answer.read(PIECE):
                file.write(piece)
                digest.update(piece)
                bar.update(len(piece))
            got = file.tell()
    if total is not None and got != total:
        raise OSError(f'only {got} of {total} bytes came')
    return digest.hexdigest()
