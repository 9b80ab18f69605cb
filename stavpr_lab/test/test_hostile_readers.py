# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Damaged files for all readers, and the memory and time that they take."""

import os
from pathlib import Path
import struct
import subprocess
import sys
import zlib

from evaluation_commands import write_images
from processes import executable
import pytest

ROOM = 64 * 2**20  # bytes
# of a small process: a child counts its parent's memory before it runs the command
PEAK = """
import resource, subprocess, sys
code = subprocess.call(sys.argv[1:], stdout=subprocess.DEVNULL)
print(code, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
"""
FUZZ = Path(__file__).with_name('reader_fuzz.py')


@pytest.mark.parametrize(
    'files', [100, pytest.param(20_000, marks=pytest.mark.long)], ids=['quick', 'long']
)
def test_damaged_files_are_rejected_by_our_own_error(files, tmp_path):
    """See reader_fuzz.py; other seeds by hand."""
    pytest.importorskip('onnx')
    pytest.importorskip('onnxruntime')
    command = [sys.executable, FUZZ, str(files), '0']
    done = subprocess.run(command, check=False, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.count('refused, slowest') == 9


def peak(name: str, *arguments: object) -> tuple[int, int]:
    """Run a command; return its exit code and its largest resident memory, bytes."""
    command = [sys.executable, '-S', '-c', PEAK, executable(name), *map(str, arguments)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert 'Traceback' not in done.stderr
    code, kilobytes = done.stdout.split()
    return int(code), int(kilobytes) * 1024


def png(width: int, height: int, length: int = 0) -> bytes:
    """Return a black image of one bit a pixel; ``length``, if any, is claimed for its pixels."""
    compress, row = zlib.compressobj(9), bytes((width + 7) // 8 + 1)
    content = b''.join(compress.compress(row) for _ in range(height)) + compress.flush()
    head = struct.pack('>IIBBBBB', width, height, 1, 0, 0, 0, 0)
    made = b'\x89PNG\r\n\x1a\n'
    for chunk, claimed in ((b'IHDR' + head, 0), (b'IDAT' + content, length), (b'IEND', 0)):
        size, checksum = claimed or len(chunk) - 4, zlib.crc32(chunk)
        made += struct.pack('>I', size) + chunk + struct.pack('>I', checksum)
    return made


@pytest.mark.long
def test_commands_take_no_more_memory_for_hostile_files(route, map_file, tmp_path):
    """Beside that for a valid file: 64 MB, and three times the size of the decoded image."""
    images, hostile = tmp_path / 'images', tmp_path / 'hostile.stavpr'
    write_images(images, route)
    output = tmp_path / 'made.stavpr'
    code, valid = peak('build_map', '--input', images, '--output', output)
    assert code == 0
    for content, decoded in (
        (png(60_000, 60_000), 0),
        (png(64, 64, 0x7FFFFFFF), 0),
        (png(3000, 3000), 3000 * 3000 * 3),
    ):
        (images / '030.png').write_bytes(content)
        options = '--input', images, '--output', output, '--force', '--skip-bad-images'
        code, used = peak('build_map', *options)
        assert code == 0
        assert used < valid + ROOM + 3 * decoded, f'{used - valid} bytes for {len(content)}'
    (images / '030.png').unlink()
    content = Path(map_file).read_bytes()
    arguments = 'evaluate', '--map', map_file, '--query', images, '--output', tmp_path / 'report'
    code, evaluated = peak(*arguments)
    assert code == 0
    _, shown = peak('map', 'info', map_file)
    with hostile.open('wb') as file:
        file.write(content[:8000])
        file.truncate(8 * 2**30)
    for size in (8 * 2**30, len(content) // 2):
        os.truncate(hostile, size)
        for used, usual in (
            (peak('map', 'info', hostile), shown),
            (peak('evaluate', '--map', hostile, '--query', images), evaluated),
        ):
            assert used[0] == 1
            assert used[1] < usual + ROOM
