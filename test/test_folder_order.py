# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The order of image files: kinds of numbers in names, counters that begin again, EXIF."""

import random

import numpy as np
from PIL import Image
import pytest
from stavpr_ros.sources.order import in_order


def counter(first, span, count=24, width=0, zero=0):
    return [f'{(first + i - zero) % (span - zero) + zero:0{width}d}' for i in range(count)]


SURE = {
    'decimal': ['1.05', '1.5', '1.75'],
    'two counters': ['1.1', '1.2', '1.9', '1.10', '1.11', '2.1'],
    'nanoseconds behind a dot': ['1700000000.5000000', '1700000000.55000000', '1700000001.0'],
    'longer than a float': ['1700000000.63555584', '1700000000.113555584'],
    'one more digit': ['999999999', '1000000000', '1000000001'],
    'negative': ['x-10', 'x-2', 'x-1.5', 'x0', 'x3', 'x12'],
    'dash': ['IMG-1', 'IMG-2', 'IMG-10'],
    'hexadecimal': [f'frame_{i:x}' for i in range(40)],
    'hexadecimal, padded': [f'{i:04X}' for i in range(300)],
    'letters': ['1a', '1b', '2a', '9b', '10a'],
    'days first': ['31-12-2029', '01-01-2030', '02-01-2030', '15-02-2030'],
    'months first': ['12-31-2029', '01-01-2030', '01-20-2030'],
    'days, joined': ['31122029_120000', '01012030_000000', '02012030_000000'],
    'copies': ['IMG_9', 'IMG_9 (2)', 'IMG_10'],
    'bytes': [f'{i}' for i in range(256)],
}
GUESSED = {
    'decimal': ['1.25', '1.5'],
    'stamps': ['1700000000.25', '1700000000.5', '1700000001.0'],
    'days or months': ['05-01-2030', '03-02-2030'],
    'hashes': ['1d41d8cd98f00b20', 'd41d8cd98f00b204'],
    'camera': [f'DSC_{i}' for i in counter(9989, 10000, width=4, zero=1)],
    'gopro': [f'G001{i}' for i in counter(9989, 10000, width=4, zero=1)],
    'three digits': counter(990, 1000, width=3),
    'steps': counter(9900, 10000, 240, width=4)[::10],
    '16 bits': counter(65530, 2**16),
}


@pytest.mark.parametrize(
    ('names', 'guesses'), [*((n, 0) for n in SURE.values()), *((n, 1) for n in GUESSED.values())]
)
@pytest.mark.parametrize('folder', [False, True])
def test_names_are_in_the_order_of_their_kind_of_number(tmp_path, names, guesses, folder, caplog):
    form = '{}/1.jpg' if folder else '{}.jpg'
    expected = [tmp_path / form.format(name) for name in names]
    assert in_order(random.Random(0).sample(expected, len(expected)), tmp_path) == expected
    assert len(caplog.records) == guesses


def write(folder, names, seconds, subseconds=False):
    for name, second in zip(names, seconds, strict=True):
        exif = Image.Exif()
        ifd = exif.get_ifd(0x8769)
        ifd[0x9003] = f'2030:05:06 10:{int(second) // 60:02d}:{int(second) % 60:02d}'
        if subseconds:
            ifd[0x9291] = f'{second % 1:.3f}'[2:]
        file = folder / name
        file.parent.mkdir(exist_ok=True, parents=True)
        Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(file, exif=exif)
    return [folder / name for name in names]


@pytest.mark.parametrize(
    ('names', 'guesses'),
    [
        ([f'DSC_{i}.JPG' for i in counter(9989, 10000, width=4, zero=1)], 0),
        ([f'{100 + i // 11}MEDIA/{n}.jpg' for i, n in enumerate(counter(9989, 10000))], 0),
        ([f'{(999, 100)[i // 12]}MEDIA/DJI_{i:04d}.jpg' for i in range(24)], 1),
        ([f'{i * 7919 % 997:03d} x.jpg' for i in range(24)], 1),
        ([f'{("phone", "camera")[i % 2]}_{i}.jpg' for i in range(24)], 1),
    ],
)
@pytest.mark.parametrize('step', [7, 0.25])
def test_times_in_exif_decide(tmp_path, names, guesses, step, caplog):
    """Also within a second, where the file has its fractions."""
    expected = write(tmp_path, names, np.arange(len(names)) * step, step < 1)
    assert in_order(sorted(expected), tmp_path) == expected
    assert len(caplog.records) == guesses


def test_clock_that_is_set_back_does_not_shuffle_a_counter(tmp_path, caplog):
    seconds = np.arange(24) * 5 + 1000
    seconds[10:] -= 600
    expected = write(tmp_path, [f'{i:04d}.jpg' for i in range(24)], seconds)
    assert in_order(sorted(expected), tmp_path) == expected
    assert 'the times in EXIF go back at 0010.jpg: the names count' in caplog.text
