# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The license header of every Python file."""

from collections.abc import Iterator
import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
NOT_OURS = {'build', 'install', 'log'}
HEADER = ['# Copyright 2026 The stavpr_ros authors', '# SPDX-License-Identifier: Apache-2.0']


def python_files() -> Iterator[Path]:
    """Yield the Python files of the repository, the executables without a suffix as well."""
    yield from sorted((ROOT / 'scripts').iterdir())
    for folder, subfolders, files in os.walk(ROOT):
        subfolders[:] = sorted(
            name for name in subfolders if not name.startswith('.') and name not in NOT_OURS
        )
        yield from (Path(folder, name) for name in sorted(files) if name.endswith('.py'))


def test_python_files_have_license_header():
    for path in python_files():
        lines = path.read_text(encoding='utf-8').split('\n')
        start = 1 if lines[0].startswith('#!') else 0
        assert lines[start : start + 2] == HEADER, path
