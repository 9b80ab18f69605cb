# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Write requirements/locked/NAME.txt: every package with its version and the hashes of its files.

Usage: ``python3 tools/lock_requirements.py python3.11 python3.12 python3.13``

Each Python resolves requirements/NAME.txt for the first release of its version (3.11.0, ...), so
that all of its releases can install them. torch is not locked: its builds depend on the package
index. ``base.txt`` is always installed; the files of the extras list the additional packages.
"""

import json
from pathlib import Path
import subprocess
import sys
from typing import Any

from pip._vendor.packaging.requirements import Requirement
from pip._vendor.packaging.utils import canonicalize_name
from setup_venv import BASE, LOCKED_EXTRAS

FOLDER = Path(__file__).resolve().parent.parent / 'requirements'
HEAD = '# Written by tools/lock_requirements.py.\n'
# pip with the Python X.Y.0. Its --python-version excludes packages that have no wheel.
PIP_OF_FIRST_RELEASE = """
import collections, platform, runpy, sys
version = collections.namedtuple('version_info', 'major minor micro releaselevel serial')
sys.version_info = version(*sys.version_info[:2], 0, 'final', 0)
platform.python_version = lambda: '{}.{}.0'.format(*sys.version_info)
runpy.run_module('pip', run_name='__main__')
"""


def resolve(python: str) -> dict[str, Any]:
    """Return pip's report of a dry run of all requirements."""
    command = [python, '-c', PIP_OF_FIRST_RELEASE, 'install', '--dry-run', '--quiet']
    command += ['--ignore-installed', '--report', '-', '-c', str(FOLDER / 'constraints.txt')]
    for name in (*BASE, *LOCKED_EXTRAS):
        command += ['-r', str(FOLDER / f'{name}.txt')]
    report: dict[str, Any] = json.loads(subprocess.check_output(command))
    return report


def requirements(*names: str) -> list[Requirement]:
    """Return the requirements in requirements/NAME.txt."""
    lines = [
        line.partition(' #')[0].strip()
        for name in names
        for line in (FOLDER / f'{name}.txt').read_text(encoding='utf-8').splitlines()
    ]
    return [Requirement(line) for line in lines if line and not line.startswith('#')]


def closure(roots: list[Requirement], report: dict[str, Any]) -> set[str]:
    """Return the names of the packages that requirements need, of a report."""
    packages = {canonicalize_name(row['metadata']['name']): row for row in report['install']}
    visited: set[tuple[str, str]] = set()
    todo = [(canonicalize_name(one.name), extra) for one in roots for extra in ('', *one.extras)]
    while todo:
        name, extra = todo.pop()
        if (name, extra) in visited:
            continue
        visited.add((name, extra))
        for text in packages[name]['metadata'].get('requires_dist', ()):
            one = Requirement(text)
            environment = report['environment'] | {'extra': extra}
            if one.marker is None or one.marker.evaluate(environment):
                key = canonicalize_name(one.name)
                todo += [(key, more) for more in ('', *one.extras)]
    return {name for name, _ in visited}


def lock_text(reports: dict[str, dict[str, Any]], names: dict[str, set[str]]) -> str:
    """Return the lines of a lock file: packages by name, of each Python version (3.11, ...)."""
    hashes_of: dict[tuple[str, str], dict[str, str]] = {}  # hash by Python version
    for version, report in reports.items():
        for row in report['install']:
            name = canonicalize_name(row['metadata']['name'])
            if name in names[version]:
                hashes = row['download_info']['archive_info']['hashes']
                key = name, row['metadata']['version']
                hashes_of.setdefault(key, {})[version] = hashes['sha256']
    lines = []
    for (name, release), hashes in sorted(hashes_of.items()):
        versions = [f"python_version == '{version}'" for version in hashes]
        marker = '' if len(hashes) == len(reports) else f' ; {" or ".join(versions)}'
        options = ''.join(
            f' \\\n    --hash=sha256:{value}' for value in sorted({*hashes.values()})
        )
        lines.append(f'{name}=={release}{marker}{options}\n')
    return HEAD + ''.join(lines)


def main(pythons: list[str]) -> None:
    """Write all lock files."""
    reports_of_pythons = map(resolve, pythons)
    reports = {report['environment']['python_version']: report for report in reports_of_pythons}
    base = {version: closure(requirements(*BASE), report) for version, report in reports.items()}
    folder = FOLDER / 'locked'
    folder.mkdir(exist_ok=True)
    (folder / 'base.txt').write_text(lock_text(reports, base), encoding='utf-8')
    for extra in LOCKED_EXTRAS:
        added = {
            version: closure(requirements(extra), report) - base[version]
            for version, report in reports.items()
        }
        (folder / f'{extra}.txt').write_text(lock_text(reports, added), encoding='utf-8')


if __name__ == '__main__':
    main(sys.argv[1:])
