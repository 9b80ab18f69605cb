# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Every Python file: license header, line length, rules of ament_flake8 and ament_pep257."""

from collections.abc import Iterator
import importlib.util
import os
from pathlib import Path
import subprocess
import sys

import pytest

ROOT = Path(__file__).resolve().parents[1]
NOT_OURS = {'build', 'install', 'log'}
HEADER = ['# Copyright 2026 The stavpr_ros authors', '# SPDX-License-Identifier: Apache-2.0']
COLUMNS = 99
# The rules that ament_pep257 ignores in ROS 2 Jazzy; it checks all others of pydocstyle.
PEP257_IGNORES = {
    *('D100', 'D101', 'D102', 'D103', 'D104', 'D105', 'D106', 'D107'),
    *('D203', 'D212', 'D404'),
}
PLUGINS = (
    'flake8_builtins',
    'flake8_comprehensions',
    'flake8_import_order',
    'flake8_quotes',
)


def python_files() -> Iterator[Path]:
    """Yield the Python files of the repository, the executables without a suffix as well."""
    yield from sorted((ROOT / 'scripts').iterdir())
    for folder, subfolders, files in os.walk(ROOT):
        subfolders[:] = sorted(
            name for name in subfolders if not name.startswith('.') and name not in NOT_OURS
        )
        yield from (Path(folder, name) for name in sorted(files) if name.endswith('.py'))


def lines_of(path: Path) -> list[str]:
    return path.read_text(encoding='utf-8').split('\n')


def without_header(paths: list[Path]) -> list[Path]:
    """Return the files that do not begin with the license header, behind a shebang or without."""
    missing = []
    for path in paths:
        lines = lines_of(path)
        start = 1 if lines[0].startswith('#!') else 0
        if lines[start : start + 2] != HEADER:
            missing.append(path)
    return missing


def long_lines(paths: list[Path]) -> list[str]:
    """Return FILE:LINE of every line that is too long."""
    return [
        f'{path}:{number}: {len(line)} columns'
        for path in paths
        for number, line in enumerate(lines_of(path), start=1)
        if len(line) > COLUMNS
    ]


def test_python_files_finds_package_tests_and_executables():
    found = {path.relative_to(ROOT).as_posix() for path in python_files()}
    assert {'setup.py', 'scripts/node', 'stavpr_ros/__init__.py', 'test/test_linters.py'} <= found
    assert not {name for name in found if name.split('/')[0] in NOT_OURS | {'.venv'}}


def test_every_file_has_the_license_header():
    assert [str(path.relative_to(ROOT)) for path in without_header(list(python_files()))] == []


def test_no_line_is_too_long():
    assert long_lines(list(python_files())) == []


def test_violations_are_reported(tmp_path):
    good, bad = tmp_path / 'good.py', tmp_path / 'bad.py'
    good.write_text('#!/usr/bin/env python3\n' + '\n'.join(HEADER) + '\n' + 'x' * COLUMNS)
    bad.write_text('# Copyright 2026\n' + 'x' * (COLUMNS + 1))
    assert without_header([good, bad]) == [bad]
    assert long_lines([good, bad]) == [f'{bad}:2: {COLUMNS + 1} columns']


@pytest.fixture(scope='module')
def linters() -> dict[str, subprocess.Popen[str]]:
    """Start flake8 and pydocstyle beside each other: each takes seconds."""
    # pydocstyle without the decorators of properties, as ament_pep257 calls it: their summaries
    # are checked
    pydocstyle = (
        'import pydocstyle, sys; '
        f'rules = set(pydocstyle.violations.ErrorRegistry.get_error_codes()) - {PEP257_IGNORES}; '
        'found = pydocstyle.check(sys.argv[1:], select=rules); '
        'sys.exit("\\n".join(map(str, found)) or 0)'
    )
    commands = {
        'flake8': ['-m', 'flake8', '--jobs', '1', '--config', 'setup.cfg', '.'],
        'pydocstyle': ['-c', pydocstyle, *map(str, python_files())],
    }
    return {
        name: subprocess.Popen(
            [sys.executable, *command],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for name, command in commands.items()
        if importlib.util.find_spec(name)
    }


@pytest.mark.parametrize('name', ['flake8', 'pydocstyle'])
def test_linter_of_ament_finds_nothing(name, linters):
    for module in (name, *PLUGINS) if name == 'flake8' else (name,):
        pytest.importorskip(module, reason=f'{module} is not installed (extra dev)')
    output, _ = linters[name].communicate()
    assert linters[name].returncode == 0, output
