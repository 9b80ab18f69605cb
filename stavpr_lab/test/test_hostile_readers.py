# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Damaged files for all readers, and the memory and time that they take."""

from pathlib import Path
import subprocess
import sys

import pytest

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
    assert done.stdout.count('refused, slowest') == 7
