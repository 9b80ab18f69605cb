# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The order of image files: kinds of numbers in names, counters that begin again, EXIF."""

import random

import numpy as np
from PIL import Image
import pytest
from stavpr_ros.sources.order import in_order, natural_key


def counter(first, span, count=24, width=0, zero=0):
    return [f'{(first + i - zero) % (span - zero) + zero:0{width}d}' for i in range(count)]


SURE = {
    'decimal': ['1.05', '1.5', '1.75'],
    'two counters': ['1.1', '1.2', '1.9', '1.10', '1.11', '2.1'],
    'nanoseconds behind a dot': ['1700000000.5000000', '1700000000.55000000', '1700000001.0'],
    'longer than a float': ['1700000000.63555584', '1700000000.113555584'],
    'negative': ['x-10', 'x-2', 'x-1.5', 'x0', 'x3', 'x12'],
    'dash': ['IMG-1', 'IMG-2', 'IMG-10'],
    'dates': ['2030.1.5', '2030.1.10', '2030.2.1'],
    'copies': ['IMG_9', 'IMG_9 (2)', 'IMG_10'],
}
GUESSED = {
    'decimal': ['1.25', '1.5'],
    'gopro': [f'G001{i}' for i in counter(9989, 10000, width=4, zero=1)],
    'steps': counter(9900, 10000, 240, width=4)[::10],
    '16 bits': counter(65530, 2**16),
}


def test_natural_key_sorts_numbers():
    names = ['10.jpg', 'a2b10.png', '2.jpg', '1.jpg', 'a2b9.png', 'A1.png', '01.jpg', 'a.png']
    expected = ['01.jpg', '1.jpg', '2.jpg', '10.jpg', 'a.png', 'A1.png', 'a2b9.png', 'a2b10.png']
    assert sorted(names, key=natural_key) == expected


@pytest.mark.parametrize('mark', [' (1)', '(0)', '-1', '_2', ' copy'])
def test_natural_key_sorts_numbered_copies_behind_their_name(mark):
    expected = ['IMG_9.jpg', f'IMG_9{mark}.jpg', 'IMG_10.jpg', f'IMG_10{mark}.JPG']
    assert sorted({*expected}, key=natural_key) == expected


@pytest.mark.parametrize(
    ('names', 'guesses'), [*((n, 0) for n in SURE.values()), *((n, 1) for n in GUESSED.values())]
)
@pytest.mark.parametrize('folder', [False, True])
def test_names_are_in_the_order_of_their_kind_of_number(tmp_path, names, guesses, folder, caplog):
    form = '{}/1.jpg' if folder else '{}.jpg'
    expected = [tmp_path / form.format(name) for name in names]
    assert in_order(random.Random(0).sample(expected, len(expected)), tmp_path) == expected
    assert len(caplog.records) == guesses


@pytest.mark.parametrize(('names', 'step', 'note'), [
    ([f'DSC_{i}.JPG' for i in counter(9989, 10000, width=4, zero=1)], 7, None),
    ([f'{100 + i // 11}MEDIA/{n}.jpg' for i, n in enumerate(counter(9989, 10000))], 7, None),
    ([f'{(999, 100)[i // 12]}MEDIA/DJI_{i:04d}.jpg' for i in range(24)], 7, 'contradict'),
    ([f'{i * 7919 % 997:03d} x.jpg' for i in range(24)], 0.25, 'contradict'),
    ([f'{("phone", "camera")[i % 2]}_{i}.jpg' for i in range(24)], 7, 'contradict'),
    ([f'{i:04d}.jpg' for i in range(24)], 7, 'go back at 0010.jpg: the names count'),
])  # fmt: skip
def test_times_in_exif_decide_unless_a_clock_was_set(tmp_path, names, step, note, caplog):
    """Also within a second, where the file has its fractions."""
    expected = [tmp_path / name for name in names]
    seconds = 600 + step * np.arange(24)
    seconds[10:] -= 600 if note and 'go back' in note else 0
    for file, second in zip(expected, seconds, strict=True):
        exif = Image.Exif()
        tags = exif.get_ifd(0x8769)
        tags[0x9003] = f'2030:05:06 10:{int(second) // 60:02d}:{int(second) % 60:02d}'
        tags[0x9291] = f'{second % 1:.3f}'[2:]
        file.parent.mkdir(exist_ok=True)
        Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(file, exif=exif)
    assert in_order(sorted(expected), tmp_path) == expected
    assert len(caplog.records) == bool(note)
    assert (note or '') in caplog.text
