# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tables of numbers that other programs wrote as text: poses, ground truth, descriptors."""

from collections.abc import Iterator, Sequence
from itertools import islice
from operator import attrgetter
from pathlib import Path, PureWindowsPath
import re

import numpy as np
from stavpr_ros.errors import SourceError
from stavpr_ros.regular_file import require_regular

SEPARATORS = ';\t,'  # else blanks
COMMENTS = ('#', '%', 'sep=')  # a spreadsheet writes the last one
MIN_STAMP = 1e8  # seconds of 1973; no meters on Earth, and no number of an image
MAX_REASON = 120  # characters
FILE = re.compile(r'.*\.[a-z]\w{2,4}', re.IGNORECASE)  # the name of one


class Table:
    """
    The lines of a text file, each with the same columns.

    Encoding, separator, decimal comma, a line and a column of names, comments, blank lines
    and separators at the ends of lines are recognized by the first lines of the file. A comment
    above the numbers may name their columns.

    :param path: the file, UTF-8 or UTF-16 with a byte order mark.
    :param what: what the file is, as ``poses``, for errors.
    :param expected: what a line must have, for errors.
    :param counted: a first line 0, 1, 2 ... is names of columns; else behind a blank cell only.
    :raises SourceError: the file cannot be read, or has no line of numbers.

    ``names`` are empty where the file names no columns, ``width`` is the number of columns; a
    column of names, such as of image files, does not count.
    """

    def __init__(self, path: Path, what: str, expected: str, counted: bool = False) -> None:
        self.path, self._what, self._expected = path, f'{what} {path}', expected
        self.lines: list[int] = []  # number of each line that :meth:`numbers` has read
        self.labels: list[str] = []  # the names in these lines, if there are
        self._comment = ''
        try:
            require_regular(path)
            first, second = [*(line for _, line in islice(self._lines(), 2)), '', ''][:2]
        except OSError as error:
            raise SourceError(f'{self._what} cannot be read: {error}') from error
        if not first:
            raise self.error('it is empty')
        self._separator = next((mark for mark in SEPARATORS if mark in first), None)
        in_spreadsheet = self._separator in (';', '\t') and '.' not in (second or first)
        self._point = ',' if in_spreadsheet else '.'  # as German programs write numbers
        names, cells = self._cells(first), self._cells(second or first)
        self._ends_with_separator = len(cells) > 1 and not cells[-1]  # a separator ends each line
        width = len(cells) - self._ends_with_separator
        names = [''] * (width - len(names)) + names
        unnamed = not names[0]
        is_labeled = is_name(cells[0]) or (unnamed and _is_header(names[1:], width - 1, True))
        files = [i for i, cell in enumerate(cells) if FILE.fullmatch(cell)]
        self._label = 0 if is_labeled else files[0] if files else None
        self.width = width - (self._label is not None)
        self._header = _is_header(self._without_label(names), self.width, counted or unnamed)
        if self._header and not second:
            raise self.error('it has names, but no line of numbers')
        comment = self._cells(self._comment)
        if not self._header:
            names = comment if len(comment) == width else []
        self.names = self._without_label(names)[: self.width]

    def error(self, reason: str, row: int | None = None) -> SourceError:
        """Return the error of the table, or of a row of :meth:`numbers`, and what it expected."""
        where = '' if row is None else f', line {self.lines[row]}'
        return SourceError(f'{self._what}{where}: {reason}: expected {self._expected}')

    def numbers(self, columns: Sequence[int] | None = None) -> np.ndarray:
        """
        Read the numbers, all or of chosen columns, shape (rows, columns), float64.

        :raises SourceError: a cell is no number, or a line has other columns.
        """
        try:
            return np.loadtxt(
                self._rows(), delimiter=self._separator, ndmin=2, quotechar='"',
                comments=None, usecols=columns,
            )  # fmt: skip
        except (OSError, ValueError) as error:
            reason = str(error).partition(' at row ')[0][:MAX_REASON]
            raise self.error(reason, -1 if self.lines else None) from error

    def cells(self) -> list[list[str]]:
        """Return the text of all lines, a first one of names included."""
        return [self._cells(line) for _, line in self._lines()]

    def _rows(self) -> Iterator[str]:
        """Yield the lines of numbers, without labels, as NumPy reads them."""
        self.lines, self.labels = [], []
        for number, line in islice(self._lines(), int(self._header), None):
            self.lines.append(number)
            row = line.replace(self._point, '.')
            row = row.removesuffix(self._separator or '') if self._ends_with_separator else row
            if self._label is not None:
                cells = row.split(self._separator)
                self.labels += [cell.strip(' "') for cell in cells[self._label :][:1]]
                row = (self._separator or ' ').join(self._without_label(cells))
            yield row

    def _without_label(self, cells: list[str]) -> list[str]:
        return [cell for i, cell in enumerate(cells) if i != self._label]

    def _lines(self) -> Iterator[tuple[int, str]]:
        """Yield the lines that are neither empty nor comments, and their numbers from 1."""
        with self.path.open('rb') as file:
            encoding = 'utf-16' if file.read(2) in (b'\xff\xfe', b'\xfe\xff') else 'utf-8-sig'
        with self.path.open(encoding=encoding, errors='replace') as text:
            for number, line in enumerate(text, 1):
                row = line.strip(' \r\n')
                if row.startswith(COMMENTS):
                    self._comment = row.strip('#% ')
                elif row.replace(';', '').replace(',', '').strip():
                    yield number, row

    def _cells(self, line: str) -> list[str]:
        return [cell.strip(' "').replace(self._point, '.') for cell in line.split(self._separator)]


def by_name(names: Sequence[str], keys: Sequence[str]) -> np.ndarray:
    """
    Find names of files among others: by path, else by file name, else without suffix.

    :returns: the last key that names the same file as each name, shape (names,); -1 = none.
    """
    best = np.full(len(names), -1)
    for form in (PureWindowsPath.as_posix, attrgetter('name'), attrgetter('stem')):
        texts, others = ([form(PureWindowsPath(text)) for text in row] for row in (names, keys))
        if len({*texts}) < len({*names}) or len({*others}) < len({*keys}):
            break  # several files of this name
        row_of = {key: row for row, key in enumerate(others)}
        rows = np.array([row_of.get(name, -1) for name in texts])
        best = max(best, rows, key=lambda candidate: np.count_nonzero(candidate >= 0))
    return best


def is_stamps(column: np.ndarray) -> bool:
    """Return whether numbers are stamps: of seconds or less, since 1970, that do not fall."""
    values = np.asarray(column, np.float64)
    return bool(len(values) and values.min() >= MIN_STAMP and (np.diff(values) >= 0).all())


def is_counted(column: np.ndarray) -> bool:
    """Return whether numbers count the lines, from any number on."""
    return len(column) > 2 and bool((np.diff(np.asarray(column, np.float64)) == 1).all())


def _is_header(cells: list[str], width: int, counted: bool) -> bool:
    """Return whether cells are names, or the numbers of more than two columns."""
    numbers = counted and width > 2 and cells == [str(i) for i in range(width)]
    return numbers or any(map(is_name, cells[:width]))


def is_name(cell: str) -> bool:
    """Return whether a cell is neither empty nor a number."""
    try:
        float(cell.strip() or 0)
    except ValueError:
        return True
    return False
