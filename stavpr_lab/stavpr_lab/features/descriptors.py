# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Features that another program computed: NumPy, CSV and MATLAB arrays of descriptors.

An array has the shape (n, D), one vector an image, or (n, W, D), W local features from left to
right. Arrays of uint8 are binary descriptors, D bytes of 8 bits, and never read as numbers.
Nothing in a file is executed: no pickles, no MATLAB objects.
"""

from collections.abc import Callable
from pathlib import Path
import re
import zipfile

import numpy as np
from stavpr_ros.errors import SourceError
from stavpr_ros.features.extractor import FeatureSettings, LocalFeatures, normalize
from stavpr_ros.features.registry import DescriptorSettings
from stavpr_ros.regular_file import require_regular
from stavpr_ros.sources.table import is_counted, is_stamps, Table

_PATH = re.compile(r'(?P<file>.*\.(npy|npz|csv|mat))(:(?P<name>.+))?', re.IGNORECASE)
_NUMERIC = ('double', 'single', *(f'{u}int{bits}' for u in ('', 'u') for bits in (8, 16, 32, 64)))
MAX_STRIPS = 1024
EXPECTED = 'real numbers (n, D) or (n, W, D), one row an image'
AT_ONCE = 1024  # images converted together
MAPPED = 2**26  # bytes of a .npy file from which on it is not read as a whole


def is_descriptors(path: str | None) -> bool:
    """Return whether a path names an array by its suffix: FILE or FILE:NAME."""
    return path is not None and _PATH.fullmatch(path) is not None


def read_descriptors(path: str, source: str = '', bits: bool = False) -> LocalFeatures:
    """
    Read the descriptors of a traverse.

    :param path: ``FILE`` (.npy, .npz, .csv, .mat), or ``FILE:NAME`` for one of several arrays.
    :param source: what computed them; map and query must have the same.
    :param bits: the array is uint8, and each bit a dimension, -1 or 1: the cosine distance is
        2 / d times the Hamming distance. The most significant bit is the first.
    :returns: unit-norm features (W, n, d); W = 1 for an array (n, D); d = D, or 8 D of bits.
    :raises SourceError: the file cannot be read, has no such array, or other numbers or another
        shape than expected; it is uint8 without ``bits``, or not with them.
    """
    match = _PATH.fullmatch(path)
    if match is None:
        raise SourceError(f'descriptors {path}: expected a file .npy, .npz, .csv or .mat')
    file, name = Path(match['file']), match['name'] or ''
    read = _READERS[file.suffix.lower()]
    try:
        require_regular(file)
        array = read(file, name)
    except SourceError:
        raise
    except Exception as error:  # damaged files raise errors of any type
        reason = str(error)
        if 'allow_pickle' in reason or 'Python objects' in reason:
            reason = 'it has Python objects, or is of another format; save an array of numbers'
        raise SourceError(f'descriptors {file} cannot be read: {reason}') from error
    if array.dtype.kind not in 'fiu' or array.ndim not in (2, 3) or 0 in array.shape:
        raise SourceError(f'descriptors {path}: {array.dtype} {array.shape}: expected {EXPECTED}')
    if (array.dtype == np.uint8) != bits:
        raise SourceError(
            f'descriptors {path}: {array.dtype} {array.shape}: expected uint8 for bits, 8 a '
            'number, with --descriptors-bits true, and another type, such as float32, for numbers'
        )
    if array.ndim == 2 and (is_stamps(array[:, 0]) or is_counted(array[:, 0])):
        raise SourceError(
            f'descriptors {path}: its first column is stamps or numbers of images: leave it out; '
            f'expected {EXPECTED}'
        )
    n, W = len(array), 1 if array.ndim == 2 else array.shape[1]
    if W > MAX_STRIPS:
        raise SourceError(f'descriptors {path}: W = {W} strips, at most {MAX_STRIPS}')
    dimension = array.shape[-1] * (8 if bits else 1)
    strips, weights = np.empty((W, n, dimension), np.float32), np.empty((W, n), np.float32)
    for low in range(0, n, AT_ONCE):  # it may be in its file
        part = slice(low, low + AT_ONCE)
        rows = array[part].reshape(-1, W, array.shape[-1])
        if bits:
            rows = np.unpackbits(rows, axis=-1).astype(np.int8) * 2 - 1
        rows = _float32(rows, path, low)
        strips[:, part], weights[:, part] = normalize(rows.transpose(1, 0, 2))
    settings = FeatureSettings('descriptors', DescriptorSettings(source=source, bits=bits), W)
    return LocalFeatures(strips, weights, settings)


def _float32(rows: np.ndarray, path: str, first: int) -> np.ndarray:
    """
    Return rows (n, W, D) as float32, each over a power of two, so that squares are in range.

    :param first: number of the first row, for the error.
    """
    rows = rows.astype(np.promote_types(rows.dtype, np.float32))
    finite = np.isfinite(rows).all(axis=(1, 2))
    if not finite.all():
        row = first + int(np.flatnonzero(~finite)[0])
        raise SourceError(f'descriptors {path}: row {row} has NaN or infinite numbers')
    _, exponents = np.frexp(abs(rows).max(axis=(1, 2), keepdims=True))
    return np.ldexp(rows, -exponents).astype(np.float32)


def require_comparable(features: LocalFeatures, settings: FeatureSettings, dimension: int) -> None:
    """
    Reject descriptors that are not comparable with a map's.

    :raises FeatureMismatchError: another source or W.
    :raises SourceError: another dimension.
    """
    features.require_same_settings(settings, 'the map')
    if features.dimension != dimension:
        raise SourceError(
            f'descriptors of {features.dimension} dimensions, those of the map have {dimension}: '
            'were both computed by the same program?'
        )


def _from_npy(file: Path, name: str) -> np.ndarray:
    if name:
        raise SourceError(f'descriptors {file} is one array without a name: leave :{name} out')
    return np.load(file, mmap_mode='r' if file.stat().st_size > MAPPED else None)


def _from_npz(file: Path, name: str) -> np.ndarray:
    with zipfile.ZipFile(file) as archive:
        shapes = {}
        for member in filter(lambda name: name.endswith('.npy'), archive.namelist()):
            with archive.open(member) as content:
                version = np.lib.format.read_magic(content)
                read = np.lib.format.read_array_header_1_0
                if version != (1, 0):
                    read = np.lib.format.read_array_header_2_0
                shape, _, dtype = read(content)
            if dtype.kind in 'fiu':
                shapes[member.removesuffix('.npy')] = shape
    with np.load(file) as arrays:
        return arrays[_chosen(file, name, shapes)]


def _from_mat(file: Path, name: str) -> np.ndarray:
    from scipy.io import loadmat, whosmat

    try:
        shapes = {row: shape for row, shape, kind in whosmat(file) if kind in _NUMERIC}
    except NotImplementedError:
        return _from_hdf5(file, name)
    name = _chosen(file, name, shapes)
    return loadmat(file, variable_names=[name])[name]


def _from_hdf5(file: Path, name: str) -> np.ndarray:
    """Read a MATLAB file of version 7.3; its arrays have their axes in reverse order."""
    try:
        import h5py  # type: ignore[import-untyped]
    except ImportError as error:
        raise SourceError(
            f'descriptors {file} is a MATLAB file of version 7.3 (HDF5): save it with -v7, or pip '
            'install h5py'
        ) from error
    with h5py.File(file, 'r') as content:
        shapes = {
            key: item.shape[::-1]
            for key, item in content.items()
            if isinstance(item, h5py.Dataset)
            and item.attrs.get('MATLAB_class', b'').decode() in _NUMERIC
            and 'MATLAB_sparse' not in item.attrs
        }
        return content[_chosen(file, name, shapes)][:].T


def _chosen(file: Path, name: str, shapes: dict[str, tuple[int, ...]]) -> str:
    """Return the name of the array to read: the requested or the only possible one."""
    able = [key for key, shape in shapes.items() if len(shape) in (2, 3) and min(shape) > 1]
    if not name and len(able if len(shapes) > 1 else shapes) == 1:
        return (able or list(shapes))[0]
    if name not in shapes:
        names = ', '.join(list(shapes)[:20]) or 'none'
        raise SourceError(
            f'descriptors {file}: {name or "which array"}? Its arrays of numbers are {names}: '
            f'give {file}:NAME'
        )
    return name


def _from_csv(file: Path, name: str) -> np.ndarray:
    if name:
        raise SourceError(f'descriptors {file} is one table: leave :{name} out')
    return Table(file, 'descriptors', EXPECTED, counted=True).numbers()


_READERS: dict[str, Callable[[Path, str], np.ndarray]] = {
    '.npy': _from_npy,
    '.npz': _from_npz,
    '.mat': _from_mat,
    '.csv': _from_csv,
}
