# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``stavpr warm`` compiles what the documented commands use, and fails where it cannot."""

import subprocess
import sys

import cv2
from evaluation_commands import write_images
import numpy as np
from processes import environment, TIMEOUT
import pytest
from stavpr_ros import kernel_cache
from stavpr_ros.commands import warm
from stavpr_ros.compilation import KERNELS

PROGRAM = """
import sys
from numba.core import event
compiled = event.RecordingListener()
event.register('numba:compile', compiled)
from stavpr_ros.commands.stavpr import main
for line in sys.argv[1].strip().splitlines():
    assert main(line.split()) == 0, line
if 'evaluate' in line:
    from stavpr_lab.demonstration.street.traverses import first_traverse, second_traverse, World
    first_traverse(World(3))[10], second_traverse(World(3))[70]
print([each.data['dispatcher'] for _, each in compiled.buffer if each.is_start])
"""
COMMANDS = """
build_map --input monday --output monday.stavpr
build_map --input tuesday --output tuesday.stavpr
map merge both.stavpr monday.stavpr tuesday.stavpr
map close monday.stavpr closed.stavpr
map compact both.stavpr small.stavpr --pca 16 --storage float16
map update monday.stavpr tuesday
optimize_graph graph.g2o --output solved.tum
evaluate --map both.stavpr --query tuesday --output report_both
evaluate --map small.stavpr --query tuesday --output report_small --precision int8
evaluate --map closed.stavpr --query tuesday --output report_closed --direction both
evaluate --map monday.stavpr --query tuesday --json paper.json --mode paper --truth identity
"""


def test_nothing_is_compiled_after_warm(tmp_path, route):
    """In an empty cache folder, by operations on maps of one and several sessions, and graphs."""
    dice = np.random.default_rng(0)
    for day in ('monday', 'tuesday'):
        noise = dice.integers(0, 20, (len(route), *route[0].shape)).astype(np.uint8)
        write_images(tmp_path / day, map(cv2.add, route, noise))
    edges = [(i, i + 1) for i in range(39)] + [(i, i + 20) for i in range(20)]
    lines = [f'EDGE_SE2 {i} {j} {i % 2} 0 0 9 0 0 9 0 9' for i, j in edges]
    (tmp_path / 'graph.g2o').write_text('\n'.join(lines))
    variables = environment() | {'NUMBA_CACHE_DIR': str(tmp_path / 'kernels')}
    options = {'cwd': tmp_path, 'env': variables, 'text': True, 'timeout': 5 * TIMEOUT}
    compiled = []
    for commands in ('warm', COMMANDS):
        done = subprocess.check_output([sys.executable, '-c', PROGRAM, commands], **options)
        compiled.append(done.splitlines()[-1])
    assert compiled[0].count('CPUDispatcher') == pytest.approx(KERNELS, rel=0.05)
    assert compiled[1] == '[]'


def test_warm_fails_where_the_cache_cannot_be_written(monkeypatch, capsys):
    failures = {kernel_cache.WRITE_FAILED: '[Errno 28] No space left on device'}
    monkeypatch.setattr(kernel_cache, 'failures', failures)
    assert warm.main([]) == 1
    assert 'cannot be written: [Errno 28] No space left' in capsys.readouterr().err
