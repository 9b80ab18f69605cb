# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The order of image files: by the kind of number in their names, checked with times in EXIF."""

from collections.abc import Sequence
from contextlib import suppress
from decimal import Decimal
from itertools import pairwise
import os
from pathlib import Path
import re
from string import digits
from typing import Any
import warnings

from stavpr_ros.sources.notes import note_once

NaturalKey = tuple[list[str | int], list[str | int], str]
Sorted = tuple[list[Any], str] | None
"""What names are sorted by, and what was guessed; None = names of another kind."""

REAL = re.compile(r'(-?)(\d+)(?:\.(\d+))?')
DATE = re.compile(r'(?<!\d)(\d\d?)([-_. ]?)(\d\d?)\2((?:19|20)\d\d)(?!\d)')
SPANS = 2**8, 2**16, 2**31, 2**32  # of counters, beside powers of ten
DIGITS = 7  # of a fraction of seconds since 1970, as a float; more are nanoseconds
EXIF, TAKEN, FRACTION, CHANGED = 0x8769, 0x9003, 0x9291, 0x0132  # tags
TIME = re.compile(r'\d{4}:\d\d:\d\d \d\d:\d\d:\d\d')


def natural_key(name: str) -> NaturalKey:
    """Return a sort key: ``01.jpg``, ``1.jpg``, ``2.jpg``, ``2 (1).jpg``, ``10.jpg``."""
    # the parts alternate between text and number: equal positions have equal types
    stem, suffix = (re.split(r'(\d+)', part.casefold()) for part in os.path.splitext(name))
    stem[1::2], suffix[1::2] = map(int, stem[1::2]), map(int, suffix[1::2])
    return stem, suffix, name


def in_order(files: Sequence[Path], top: Path) -> list[Path]:
    """
    Sort the images of a folder and its sub-folders; print a line where the order is a guess.

    Names are in natural order, or by decimal, negative or hexadecimal numbers, dates, and counters
    that began again. Times in EXIF count more, unless a clock was set.
    """
    parts = {file: file.relative_to(top).parts for file in files}
    names: dict[tuple[str, ...], set[str]] = {}
    for own in parts.values():
        for depth, name in enumerate(own):
            names.setdefault(own[:depth], set()).add(name)
    keys, guesses = {}, []
    for folder, siblings in names.items():
        keys[folder], guess = _keys(sorted(siblings))
        guesses += [guess] if guess else []
    result = sorted(
        files,
        key=lambda file: [keys[parts[file][:i]][name] for i, name in enumerate(parts[file])],
    )
    result, guesses = _by_times(result, guesses)
    if guesses:
        note_once(f'{top}: {"; ".join(dict.fromkeys(guesses))}')
    return result


def _keys(names: list[str]) -> tuple[dict[str, Any], str]:
    """Return what the names of one folder are sorted by, and what was guessed."""
    natural = {name: natural_key(name) for name in names}
    stems = [re.sub(r'\.[a-z]\w*$', '', name.casefold()) for name in names]
    for read in (_real, _hexadecimal, _dated, _continued) if len(names) > 1 else ():
        if values := read(stems):
            keys = {n: (value, natural[n]) for n, value in zip(names, values[0], strict=True)}
            differ = sorted(names, key=keys.__getitem__) != sorted(names, key=natural.__getitem__)
            return keys, values[1] if differ or read is _hexadecimal else ''
    return natural, ''


def _tails(stems: list[str], kept: str = '') -> list[str]:
    """Return what differs: behind a common begin, which lacks its last ``kept``."""
    begin = _begin(stems).rstrip(kept)
    tails = [stem[len(begin) :] for stem in stems]
    end = re.sub(r'\d.*', '', _begin([tail[::-1] for tail in tails]))
    return [tail[: len(tail) - len(end)] for tail in tails]


def _begin(texts: list[str]) -> str:
    first, last = min(texts), max(texts)
    return first[: next((i for i, c in enumerate(first) if c != last[i]), len(first))]


def _real(stems: list[str]) -> Sorted:
    """Read decimal numbers of unequal length, and numbers of both signs."""
    rows = [part.groups('') for part in map(REAL.fullmatch, _tails(stems, f'{digits}.-')) if part]
    fractions, is_signed = [row[2] for row in rows], len({row[0] for row in rows}) > 1
    if len(rows) < len(stems) or not (is_signed or len({*map(len, fractions)}) > 1):
        return None
    guess = ''
    if not (is_signed or any(len(f) > 1 and f[0] == '0' for f in fractions)):
        # 1.10 behind 1.9: a second counter, or nanoseconds without zeros before them
        is_long = len(rows[0][1]) > 8 and max(map(len, fractions)) > DIGITS
        if is_long or any(len(f) > 1 and f[-1] == '0' for f in fractions):
            return None
        guess = 'the numbers in the names are taken for decimal ones, 1.25 before 1.5'
    return [
        Decimal(f'{sign if is_signed else ""}{whole}.{fraction or 0}')
        for sign, whole, fraction in rows
    ], guess


def _hexadecimal(stems: list[str]) -> Sorted:
    tails = [tail.replace('-', '') for tail in _tails(stems, digits)]
    if not all(re.fullmatch('[0-9a-f]+', tail) for tail in tails) or ''.join(tails).isdigit():
        return None
    values = [int(tail, 16) for tail in tails]
    if max(values) - min(values) < 2 * len(values):
        return values, ''
    guess = 'the names are no counter, and are taken for hexadecimal numbers'
    return (values, guess) if min(map(len, tails)) >= 8 else None


def _dated(stems: list[str]) -> Sorted:
    """Read days and months before years."""
    dates = [match for match in map(DATE.search, stems) if match]
    if len(dates) < len(stems):
        return None
    first, second = (max(int(date[i]) for date in dates) for i in (1, 3))
    day, month = (1, 3) if second <= 12 else (3, 1)
    guess = 'days and months in the names are ambiguous, and are taken for day-month-year'
    return [
        natural_key(f'{date[4]} {date[month]} {date[day]} {DATE.sub(" ", date.string, 1)}.')
        for date in dates
    ], guess if max(first, second) <= 12 else ''


def _continued(stems: list[str]) -> Sorted:
    """Read a counter that began again at its end: 9998, 9999, 0001."""
    tails = _tails(stems)
    if not all(tail.isdecimal() for tail in tails):
        return None
    values = sorted(map(int, tails))
    steps = [b - a for a, b in pairwise(values)]
    gap = steps.index(max(steps))
    usual = max([*steps[:gap], *steps[gap + 1 :], 1])
    spans = [10 ** max(map(len, tails))] if len({*map(len, tails)}) == 1 else []
    for span in (*spans, *SPANS):
        if steps[gap] > 10 * usual and 0 < values[0] + span - values[-1] <= 2 * usual:
            first = values[gap + 1]
            guess = f'the counter in the names ends with {values[-1]} and goes on from {values[0]}'
            return [(int(tail) - first) % span for tail in tails], guess
    return None


def _by_times(files: list[Path], guesses: list[str]) -> tuple[list[Path], list[str]]:
    """Compare an order with the times in EXIF, if the files have them."""
    times = [*map(_taken, files)] if files and _taken(files[0]) else ['']
    if not all(times):
        return files, guesses
    falls = [i for i in range(1, len(files)) if times[i] < times[i - 1]]
    if not falls:
        return files, []
    if all(_follows(files[i - 1], files[i]) for i in falls):
        where = files[falls[0]].name
        return files, [*guesses, f'the times in EXIF go back at {where}: the names count']
    order = sorted(range(len(files)), key=lambda i: (times[i], i))
    return [files[i] for i in order], ['the names contradict the times in EXIF, which count']


def _follows(file: Path, after: Path) -> bool:
    """Return whether two names differ by the next number only."""
    numbers = [[int(number) for number in re.findall(r'\d+', str(each))] for each in (file, after)]
    return numbers[0][:-1] == numbers[1][:-1] and 0 < numbers[1][-1] - numbers[0][-1] <= 2


def _taken(file: Path) -> str:
    """Return the time of the exposure by EXIF, which sorts as text; '' = unknown."""
    from PIL import Image

    with suppress(Exception), warnings.catch_warnings():  # damage raises errors of any type
        warnings.simplefilter('ignore')
        with Image.open(file) as image:
            exif = image.getexif()
        tags = exif.get_ifd(EXIF)
        text = f'{tags.get(TAKEN) or exif.get(CHANGED)}.{tags.get(FRACTION, "")}'
        return text if TIME.match(text) else ''
    return ''
