# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of ground truth: text, arrays, black and white images."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from stavpr_ros.errors import ImageError, InputError, SourceError
from stavpr_ros.regular_file import require_regular
from stavpr_ros.sources.files import check_file_header, MAX_PIXELS
from stavpr_ros.sources.suffixes import SUFFIXES
from stavpr_ros.sources.table import by_name, is_name, is_stamps, Table

TEXT, ARRAYS = ('.csv', '.tsv', '.txt'), ('.npy', '.npz')
NAME = 'truth'  # name of the array to read from an .npz with several
TRANSPOSED = 'GTsoft'  # in the files of VPR_Tutorial: shape (n, N), the tolerance included
QUERY_WORDS = ('query', 'live', 'current')
PLACE_WORDS = ('place', 'ref', 'map', 'database', 'historical')
BLACK, WHITE = 32, 223  # gray levels; between them an image is not black and white

Pairs = tuple[np.ndarray, np.ndarray]
Names = tuple[Sequence[str], Sequence[str]]
"""Identifiers of the queries and of the places."""
MAX_WHOLE = 2**53  # whole numbers below it are exact as floating-point numbers


def read_pairs(path: Path, N: int, n: int, names: Names = ((), ())) -> Pairs:
    """
    Read accepted pairs; see :meth:`stavpr_lab.evaluation.ground_truth.GroundTruth.from_file`.

    :returns: queries and places, shape (M,), int64; -1 = the query is not in the map. From text
        and pairs, they may exceed N and n, and queries may be missing.
    :raises SourceError: the file cannot be read.
    :raises InputError: its size does not fit N queries and n places, or it accepts nothing.
    """
    suffix = path.suffix.lower()
    if suffix in TEXT:
        queries, places = _from_text(path, N, names)
    elif suffix in ARRAYS:
        queries, places = _from_array(_load(path), path, N, n)
    elif suffix in SUFFIXES:
        queries, places = _from_image(path, N, n)
    else:
        raise SourceError(
            f'ground truth {path}: expected text ({" ".join(TEXT)}), an array '
            f'({" ".join(ARRAYS)}) or a black and white image (.png .bmp ...)'
        )
    if not (places != -1).any():
        raise InputError(f'ground truth {path} accepts no pair: is it the right file?')
    return queries, places


# ------------------------------------------------------------------------------------------ text


def _columns(table: Table, names: list[str], width: int) -> list[int]:
    """Return the columns of query and place, or of the place of each line."""
    if names:
        positions = []
        for words in (QUERY_WORDS, PLACE_WORDS):
            columns = [
                i for i, name in enumerate(names) if any(word in name.casefold() for word in words)
            ]
            positions.append(columns[0] if len(columns) == 1 else None)
        query, place = positions
        if place is not None and query != place:
            return [place] if query is None else [query, place]
    if width in (1, 2):
        return [0, 1][:width]
    raise table.error(f'it has {width} columns, without a header of these names')


def _of_names(table: Table, names: Names) -> np.ndarray | None:
    """Return the places, or queries and places, of a table of names; None = it has numbers."""
    rows, ids, header = table.cells(), [*names[0], *names[1]], []
    if len(rows) > 1 and all(by_name([cell], ids)[0] < 0 for cell in rows[0]):
        header = rows.pop(0) if any(map(is_name, rows[0])) else []
    if not any(map(is_name, rows[0])):
        return None
    columns = _columns(table, header, len(rows[0]))
    if min(map(len, rows)) <= max(columns):
        raise table.error('its lines have different numbers of columns')
    if not any(is_name(rows[0][column]) for column in columns):
        return None
    pairs = []
    for column, own in zip(columns, names[-len(columns) :], strict=True):
        cells = [row[column] for row in rows]
        pairs.append(by_name(cells, own))
        for row, cell in enumerate(cells):
            if pairs[-1][row] < 0:
                value = np.nan if is_name(cell) else float(cell or 'nan')
                if not (abs(value) < MAX_WHOLE and value.is_integer()):
                    raise table.error(f'{cell!r} is the name of no image, and no whole number')
                pairs[-1][row] = value
    return np.transpose(pairs)


def _from_text(path: Path, N: int, names: Names) -> Pairs:
    table = Table(path, 'ground truth', 'two columns, query and place, whole numbers from 0')
    rows = _of_names(table, names)
    if rows is None:
        columns = _columns(table, table.names, table.width)
        rows = table.numbers(columns)
        for column, values in zip(columns, rows.T, strict=True):
            whole = (abs(values) < MAX_WHOLE) & (values == np.floor(values))
            where = f'column {column + 1} has'
            if not whole.all():
                row = int(np.argmin(whole))
                raise table.error(f'{where} no whole number, {values[row]:g}', row)
            if is_stamps(values):
                raise table.error(f'{where} stamps instead of the numbers of images')
    if rows.shape[1] == 1:
        if len(rows) != N:
            raise InputError(
                f'ground truth {path} has a place for {len(rows)} queries, but there are {N}'
            )
        rows = np.column_stack([np.arange(N), rows])
    pairs = rows.astype(np.int64)
    return pairs[:, 0], pairs[:, 1]


# ------------------------------------------------------------------------------------------ arrays


def _load(path: Path) -> np.ndarray:
    try:
        require_regular(path)
        content = np.load(path, allow_pickle=False)
        if isinstance(content, np.ndarray):
            return content
        with content:
            names = content.files
            if TRANSPOSED in names:
                return content[TRANSPOSED].T
            if len(names) == 1 or NAME in names:
                array = content[names[0] if len(names) == 1 else NAME]
                if isinstance(array, np.ndarray):  # other files are returned as bytes
                    return array
    except Exception as error:  # damage raises errors of any type, of NumPy, zipfile and tokenize
        if 'pickle' in str(error):
            raise SourceError(
                f'ground truth {path} contains Python objects, which are stored as a pickle, and '
                'reading a pickle runs whatever program is in it: save it as an array of numbers, '
                'or as text, query,place a line'
            ) from error
        raise SourceError(f'ground truth {path} cannot be read: {error}') from error
    raise SourceError(
        f'ground truth {path} has {", ".join(names)}: expected one array, or one called {NAME}'
    )


def _from_array(array: np.ndarray, path: Path, N: int, n: int) -> Pairs:
    if array.dtype.kind not in 'buif' or not np.isfinite(array).all():
        raise InputError(f'ground truth {path} is {array.dtype}: expected finite numbers')
    if array.shape == (N, n):
        if not np.isin(array, (0, 1, array.max(initial=1))).all():
            raise InputError(
                f'ground truth {path} has other values than 0 and one more: expected 1 where a '
                'place is correct; is it a matrix of distances?'
            )
        return _of_matrix(array)
    whole = array.astype(np.int64)
    if array.dtype.kind == 'b' or not (whole == array).all():
        raise InputError(_wrong_shape(array.shape, path, N, n))
    if array.ndim == 2 and array.shape[1] == 2:
        return whole[:, 0], whole[:, 1]
    if array.shape == (N,):
        return np.arange(N), whole
    raise InputError(_wrong_shape(array.shape, path, N, n))


def _of_matrix(accepted: np.ndarray) -> Pairs:
    """Return the pairs of a matrix, which is on all queries: others are not in the map."""
    queries, places = np.nonzero(accepted)
    none = np.flatnonzero(~accepted.any(axis=1))
    return np.append(queries, none), np.append(places, np.full(len(none), -1))


def _wrong_shape(shape: tuple[int, ...], path: Path, N: int, n: int) -> str:
    hint = '; it seems to be transposed: rows are queries' if shape == (n, N) and n != N else ''
    return (
        f'ground truth {path} has shape {shape}: expected ({N}, {n}) for {N} queries and {n} '
        f'places, pairs (M, 2), or a place a query ({N},){hint}'
    )


# ------------------------------------------------------------------------------------------ images


def _from_image(path: Path, N: int, n: int) -> Pairs:
    try:
        content = np.frombuffer(path.read_bytes(), np.uint8)
        check_file_header(content, max(MAX_PIXELS, N * n))
        image = cv2.imdecode(content, cv2.IMREAD_GRAYSCALE)
    except (OSError, ImageError) as error:
        raise SourceError(f'ground truth {path} cannot be read: {error}') from error
    if image is None:
        raise SourceError(f'ground truth {path} is no image that can be decoded')
    if image.shape != (N, n):
        raise InputError(
            f'ground truth {path} is {image.shape[0]} high and {image.shape[1]} wide: expected '
            f'{N} rows, one a query, and {n} columns, one a place'
        )
    if image.max() == 1:  # a mask
        image = image * np.uint8(255)
    gray = np.count_nonzero((image > BLACK) & (image < WHITE))
    if gray:
        raise InputError(
            f'ground truth {path} has {gray} gray pixels: expected white where a place is '
            'correct, black elsewhere'
        )
    return _of_matrix(image >= WHITE)
