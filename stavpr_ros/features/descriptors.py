# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Features that another program computed: NumPy, CSV and MATLAB arrays of descriptors.

An array has the shape (n, D), one vector an image, or (n, W, D), W local features from left to
right. Nothing in a file is executed: no pickles, no MATLAB objects.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
import re

import numpy as np
from stavpr_ros.errors import SourceError, UnavailableError
from stavpr_ros.features.extractor import FeatureSettings, LocalFeatures, normalize
from stavpr_ros.features.registry import DescriptorSettings
from stavpr_ros.output_file import atomic_output, Force, NPY
from stavpr_ros.regular_file import require_regular
import torch

_PATH = re.compile(r'(?P<file>.*\.(npy|npz|csv|mat))(:(?P<name>\w+))?', re.IGNORECASE)
_NUMERIC = ('double', 'single', *(f'{u}int{bits}' for u in ('', 'u') for bits in (8, 16, 32, 64)))
MOST_STRIPS = 1024


class Descriptors:
    """The kind of features of such arrays: no images can be extracted."""

    def __init__(self, settings: DescriptorSettings, device: str = 'cpu') -> None:
        raise UnavailableError(
            "features 'descriptors' come from arrays that another program computed, not from "
            'images: give the descriptors of the query as well (evaluate --query FILE), or make '
            'the map with the network itself'
        )

    def feature_maps(self, images: Sequence[np.ndarray]) -> torch.Tensor:
        """See :class:`stavpr_ros.features.registry.Backbone`."""
        raise NotImplementedError


def is_descriptors(path: str | None) -> bool:
    """Return whether a path names an array by its suffix: FILE or FILE:NAME."""
    return path is not None and _PATH.fullmatch(path) is not None


def read_descriptors(path: str, source: str = '') -> LocalFeatures:
    """
    Read the descriptors of a traverse.

    :param path: ``FILE`` (.npy, .npz, .csv, .mat), or ``FILE:NAME`` for one of several arrays.
    :param source: what computed them; those of map and query must be equal.
    :returns: unit-norm features (W, n, d); W = 1 for an array (n, D).
    :raises SourceError: the file cannot be read, has no such array, or other numbers or another
        shape than expected.
    """
    found = _PATH.fullmatch(path)
    if found is None:
        raise SourceError(f'descriptors {path}: expected a file .npy, .npz, .csv or .mat')
    file, name = Path(found['file']), found['name'] or ''
    read = _READERS[file.suffix.lower()]
    try:
        require_regular(file)
        array = read(file, name)
    except SourceError:
        raise
    except Exception as error:  # damaged files raise errors of any type
        raise SourceError(f'descriptors {file} cannot be read: {error}') from error
    if array.dtype.kind not in 'fiu' or array.ndim not in (2, 3) or 0 in array.shape:
        raise SourceError(
            f'descriptors {path}: {array.dtype} {array.shape}: expected real numbers (n, D) or '
            '(n, W, D), one row an image'
        )
    numbers = array.astype(np.float32)
    if not np.isfinite(numbers).all():
        row = int(np.flatnonzero(~np.isfinite(numbers).reshape(len(numbers), -1).all(axis=1))[0])
        raise SourceError(f'descriptors {path}: row {row} holds NaN or infinite numbers')
    strips = numbers[None] if numbers.ndim == 2 else numbers.transpose(1, 0, 2)
    if len(strips) > MOST_STRIPS:
        raise SourceError(f'descriptors {path}: W = {len(strips)} strips, at most {MOST_STRIPS}')
    settings = FeatureSettings('descriptors', DescriptorSettings(source=source), len(strips))
    features = torch.from_numpy(np.ascontiguousarray(strips))
    return LocalFeatures(*normalize(features), settings)


def write_descriptors(features: LocalFeatures, path: Path, force: Force = False) -> None:
    """
    Write features as a .npy array that :func:`read_descriptors` reads.

    :param features: strips (W, n, d); written as (n, d) if W = 1, else (n, W, d), float32, each
        strip with its share of the norm of its image.
    """
    strips = (features.strips * features.weights[:, :, None]).permute(1, 0, 2).cpu().numpy()
    array = np.ascontiguousarray(strips[:, 0] if strips.shape[1] == 1 else strips)
    with atomic_output(path, NPY, force) as file:
        np.save(file, array)


def require_comparable(features: LocalFeatures, settings: FeatureSettings, dimension: int) -> None:
    """
    Reject descriptors that are not comparable with those of a map.

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
    return np.load(file, allow_pickle=False)


def _from_npz(file: Path, name: str) -> np.ndarray:
    with np.load(file, allow_pickle=False) as arrays:
        return arrays[_chosen(file, name, arrays.files)]


def _from_mat(file: Path, name: str) -> np.ndarray:
    from scipy.io import loadmat, whosmat

    try:
        arrays = [row for row, _, kind in whosmat(file) if kind in _NUMERIC]
    except NotImplementedError as error:
        raise SourceError(
            f'descriptors {file} is a MATLAB file of version 7.3 (HDF5): save it with -v7'
        ) from error
    return loadmat(file, variable_names=[_chosen(file, name, arrays)])[name or arrays[0]]


def _chosen(file: Path, name: str, arrays: list[str]) -> str:
    """Return the name of the array to read."""
    if not arrays or (name and name not in arrays) or (not name and len(arrays) > 1):
        some = ', '.join(arrays[:20]) or 'none'
        raise SourceError(
            f'descriptors {file}: {name or "which array"}? Its arrays of numbers are {some}: '
            f'give {file}:NAME'
        )
    return name or arrays[0]


def _from_csv(file: Path, name: str) -> np.ndarray:
    if name:
        raise SourceError(f'descriptors {file} is one table: leave :{name} out')
    with file.open(encoding='utf-8-sig') as text:
        first = next((line for line in text if line.strip() and line[0] != '#'), '')
    separator = next((mark for mark in ',;\t' if mark in first), None)
    try:
        np.array(first.split(separator), np.float64)
        header = 0
    except ValueError:
        header = 1
    with file.open(encoding='utf-8-sig') as text:
        return np.loadtxt(text, np.float32, delimiter=separator, skiprows=header, ndmin=2)


_READERS: dict[str, Callable[[Path, str], np.ndarray]] = {
    '.npy': _from_npy,
    '.npz': _from_npz,
    '.mat': _from_mat,
    '.csv': _from_csv,
}
