# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The license header of every Python file."""

from collections.abc import Iterator
import os
from pathlib import Path
import subprocess
import sys

import pytest

ROOT = Path(__file__).resolve().parents[2]
HEADER = '# Copyright 2026 The stavpr_ros authors\n# SPDX-License-Identifier: Apache-2.0\n'
# The rules that ament_pep257 ignores in ROS 2 Jazzy; it checks all others of pydocstyle.
PEP257_IGNORES = {
    *('D100', 'D101', 'D102', 'D103', 'D104', 'D105', 'D106', 'D107'),
    *('D203', 'D212', 'D404'),
}
NOT_OURS = {'build', 'install', 'log'}
PLUGINS = ('flake8_builtins', 'flake8_comprehensions', 'flake8_import_order', 'flake8_quotes')


def repository_files(suffix: str) -> Iterator[Path]:
    for folder, subfolders, files in os.walk(ROOT):
        subfolders[:] = sorted(
            name for name in subfolders if not name.startswith('.') and name not in NOT_OURS
        )
        yield from (Path(folder, name) for name in sorted(files) if name.endswith(suffix))


def test_python_files_have_license_header():
    """Behind a shebang or without."""
    for path in [*sorted((ROOT / 'scripts').iterdir()), *repository_files('.py')]:
        text = path.read_text(encoding='utf-8').removeprefix('#!/usr/bin/env python3\n')
        assert text.startswith(HEADER), path


@pytest.mark.long  # ruff checks nearly the same rules in `make lint`
@pytest.mark.parametrize('name', ['flake8', 'pydocstyle'])
def test_linter_of_ament_finds_nothing(name):
    for module in (name, *PLUGINS) if name == 'flake8' else (name,):
        pytest.importorskip(module, reason=f'{module} is not installed (extra dev)')
    # pydocstyle without the decorators of properties, as ament_pep257 calls it: their summaries
    # are checked
    pydocstyle = (
        'import pydocstyle, sys; '
        f'rules = set(pydocstyle.violations.ErrorRegistry.get_error_codes()) - {PEP257_IGNORES}; '
        'found = pydocstyle.check(sys.argv[1:], select=rules); '
        'sys.exit("\\n".join(map(str, found)) or 0)'
    )
    command = {
        'flake8': ['-m', 'flake8', '--config', 'setup.cfg', '.'],
        'pydocstyle': ['-c', pydocstyle, *map(str, repository_files('.py'))],
    }[name]
    done = subprocess.run(
        [sys.executable, *command], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
