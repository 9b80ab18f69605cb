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
from typing import Any
import warnings

from stavpr_ros.sources.notes import note_once

NaturalKey = tuple[list[str | int], list[str | int], str]
Texts = Sequence[str]

REAL = re.compile(r'(.*?)(?<![\d.])(-?)(\d+)(?:\.(\d+))?(\D*)')  # the last number
SPANS = 2**8, 2**16, 2**31, 2**32  # ranges of counters, beside powers of ten
DIGITS = 7  # decimals of seconds since 1970 as a float; more are nanoseconds
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

    Names are in natural order, or by decimal or negative numbers, and counters that began again.
    Times in EXIF count more, unless a clock was set.
    """
    levels = {file: [*reversed((path := file.relative_to(top)).parents), path] for file in files}
    names: dict[Path, set[str]] = {}
    for folder, below in (pair for level in levels.values() for pair in pairwise(level)):
        names.setdefault(folder, set()).add(below.name)
    keys: dict[Path, Any] = {}
    notes = [_add_keys(keys, folder, sorted(entries)) for folder, entries in names.items()]
    result = sorted(files, key=lambda file: [keys[path] for path in levels[file][1:]])
    result, note = _by_times(result, '; '.join(filter(None, dict.fromkeys(notes))))
    if note:
        note_once(f'{top}: {note}')
    return result


def _add_keys(keys: dict[Path, Any], folder: Path, names: list[str]) -> str:
    """Add what the names of one folder are sorted by; return what was guessed."""
    natural = [natural_key(name) for name in names]
    stems = [re.sub(r'\.[a-z]\w*$', '', name.casefold()) for name in names]
    parts = [part.groups('') for part in map(REAL.fullmatch, stems) if part]
    values, guess = natural, ''
    if len(parts) == len(stems) and len({(part[0], part[4]) for part in parts}) == 1:
        _, signs, wholes, fractions, _ = zip(*parts, strict=True)
        values, guess = (
            _read_decimals(signs, wholes, fractions)
            or _read_restarted_counter(wholes)
            or (natural, '')
        )
    pairs = [*zip(values, natural, strict=True)]
    keys.update(zip((folder / name for name in names), pairs, strict=True))
    return guess if [key for _, key in sorted(pairs)] != sorted(natural) else ''


def _read_decimals(signs: Texts, wholes: Texts, fractions: Texts) -> tuple[list[Any], str] | None:
    """Read decimal numbers of unequal length, and numbers of both signs."""
    is_sure = is_signed = len({*signs}) > 1
    if not is_signed:
        # 1.10 behind 1.9: a second counter, or nanoseconds without zeros before them
        is_long = len(wholes[0]) > 8 and max(map(len, fractions)) > DIGITS
        is_sure = any(len(f) > 1 and f[0] == '0' for f in fractions)
        is_other = is_long or any(len(f) > 1 and f[-1] == '0' for f in fractions)
        if len({*map(len, fractions)}) == 1 or (is_other and not is_sure):
            return None
    rows = zip(signs if is_signed else [''] * len(signs), wholes, fractions, strict=True)
    values = [Decimal(f'{sign}{whole}.{fraction or 0}') for sign, whole, fraction in rows]
    guess = 'the numbers in the names are taken for decimal ones, 1.25 before 1.5'
    return values, '' if is_sure else guess


def _read_restarted_counter(texts: Texts) -> tuple[list[Any], str] | None:
    """Read a counter that began again at its end: 9998, 9999, 0001."""
    tens = []
    if len(texts) > 1 and len({*map(len, texts)}) == 1:  # behind digits that all have
        columns = enumerate(zip(*texts, strict=True))
        begin = next((i for i, column in columns if len({*column}) > 1), 0)
        texts = [text[begin:] for text in texts]
        tens = [10 ** len(texts[0])]
    values = sorted(map(int, texts))
    steps = [b - a for a, b in pairwise(values)]
    last = steps.index(max(steps)) if steps else 0  # the last value of the counter
    usual = max([*steps[:last], *steps[last + 1 :], 1])
    for span in (*tens, *SPANS) if steps and steps[last] > 10 * usual else ():
        if 0 < values[0] + span - values[-1] <= 2 * usual:
            guess = f'the counter in the names ends with {values[-1]} and goes on from {values[0]}'
            return [(int(text) - values[last + 1]) % span for text in texts], guess
    return None


def _by_times(files: list[Path], guess: str) -> tuple[list[Path], str]:
    """Compare an order with the times in EXIF, if the files have them."""
    times = [*map(_exposure_time, files)] if files and _exposure_time(files[0]) else ['']
    if not all(times):
        return files, guess
    falls = [i for i in range(1, len(files)) if times[i] < times[i - 1]]
    if not falls:
        return files, ''
    if all(_follows(files[i - 1], files[i]) for i in falls):
        note = f'the times in EXIF go back at {files[falls[0]].name}: the names count'
        return files, f'{guess}; {note}'.removeprefix('; ')
    order = sorted(range(len(files)), key=lambda i: (times[i], i))
    return [files[i] for i in order], 'the names contradict the times in EXIF, which count'


def _follows(file: Path, after: Path) -> bool:
    """Return whether two names differ by the next number only."""
    a, b = ([int(number) for number in re.findall(r'\d+', str(path))] for path in (file, after))
    return a[:-1] == b[:-1] and 0 < b[-1] - a[-1] <= 2


def _exposure_time(file: Path) -> str:
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
