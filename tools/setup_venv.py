# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Set up stavpr_ros without a ROS installation; the Makefile calls this program.

It installs ROS 2 Jazzy and the Python packages from wheels into ``.venv``, and builds the packages
of this repository with colcon. The syntax is limited to Python 3.6, so that an unsupported Python
reports the supported versions instead of a SyntaxError.
"""

import argparse
import hashlib
import importlib.util
import json
import os
from pathlib import Path
import platform
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import time

ROOT = Path(__file__).resolve().parent.parent
SUPPORTED = ('3.11', '3.12', '3.13')
PYTHON_VERSION = '{}.{}'.format(*sys.version_info)
LAST_LINES = 25  # of the log of a failed command

# Names of files requirements/NAME.txt. tools/lock_requirements.py makes requirements/locked of
# them: base.txt, and a file for each extra. Those are installed, and their hashes compared.
# torch is not locked: its builds depend on the index; NO_TORCH in its place = without torch.
NO_TORCH = 'none'
BASE = ('runtime', 'ros', 'build')
LOCKED_EXTRAS = (
    'onnx', 'learned', 'hdf5', 'heif', 'faiss', 'fleet', 'ray', 'slam', 'evaluation', 'bench',
    'dev', 'docs',
)  # fmt: skip

# The files that a package is built from, in build order: each depends on earlier ones.
SOURCES = {
    'stavpr_msgs': ('stavpr_msgs',),
    'stavpr_ros': (
        'package.xml', 'setup.py', 'setup.cfg', 'pyproject.toml',
        'resource', 'config', 'launch', 'scripts', 'stavpr_ros',
    ),
    'stavpr_fleet': ('stavpr_fleet',),
    'stavpr_slam': ('stavpr_slam',),
    'stavpr_nav': ('stavpr_nav',),
    'stavpr_lab': ('stavpr_lab',),
}  # fmt: skip

# Variables of another ROS, of another Python, or of the make that runs this program.
FOREIGN = (
    'PYTHONPATH', 'PYTHONHOME', 'CONDA_PREFIX', 'PIP_TARGET', 'PIP_PREFIX', 'DESTDIR',
    'AMENT_CURRENT_PREFIX', 'RMW_IMPLEMENTATION', '_ROS_WHEELS_BOOTSTRAP_COMPLETE',
    'ROS_DISTRO', 'ROS_VERSION', 'ROS_PYTHON_VERSION',
    'MAKEFLAGS', 'MFLAGS', 'MAKEOVERRIDES', 'MAKELEVEL',
)  # fmt: skip

# Roots of the build machine in the CMake files of the wheels.
WHEEL_INCLUDE = re.compile(r'/opt/python/cp3\d+-cp3\d+/include/python3\.\d+')
WHEEL_PACKAGES = re.compile(r'/opt/python/cp3\d+-cp3\d+/lib/python3\.\d+/site-packages')


class SetupError(Exception):
    """The set-up cannot go on; the text gives the reason and the remedy."""


def python_problem(version: str, implementation: str) -> str:
    """Explain why an interpreter, such as CPython 3.12, is not supported; empty if it is."""
    if version in SUPPORTED and implementation == 'CPython':
        return ''
    return (
        f'{implementation} {version} ({sys.executable}) is not supported: the pinned wheels are '
        f'for CPython {", ".join(SUPPORTED)}. Select one of these: make demo PYTHON=python3.12'
    )


def machine_problems() -> list:
    """List everything that this machine lacks for the set-up, one sentence each."""
    problems = []
    kind = (platform.system(), platform.machine(), platform.libc_ver()[0])
    if kind != ('Linux', 'x86_64', 'glibc'):
        problems.append(
            f'The ROS 2 wheels are for Linux on x86_64 with glibc, not for {" ".join(kind)}: '
            'install ROS 2 Jazzy with apt on Ubuntu 24.04 and build with colcon, see README.md.'
        )
    for variable, default in (('CC', 'cc'), ('CXX', 'c++'), ('', 'cmake')):
        program = shlex.split(os.environ.get(variable) or default)[0]
        if not shutil.which(program):
            problems.append(f'{program} is not on the PATH: install build-essential and cmake.')
    header = Path(sysconfig.get_paths()['include'], 'Python.h')
    if not header.is_file() or not importlib.util.find_spec('ensurepip'):
        problems.append(
            f'{header} or the module ensurepip is missing: install python{PYTHON_VERSION}-dev and '
            f'python{PYTHON_VERSION}-venv.'
        )
    return problems


def clean_environment() -> dict:
    """Copy the environment variables, with the ROS of ``.venv`` as the only one in them."""
    venv = (ROOT / '.venv').resolve()
    overlays = [os.environ.get(name, '') for name in ('AMENT_PREFIX_PATH', 'COLCON_PREFIX_PATH')]
    prefixes = [entry for entry in ':'.join(['/opt/ros', *overlays]).split(':') if entry]
    # The wheels add their own libraries to LD_LIBRARY_PATH of every Python that they start in.
    patterns = ['.*/site-packages/ros_', *(f'{re.escape(prefix)}(/|$)' for prefix in prefixes)]
    foreign = re.compile('|'.join(patterns))
    clean = {
        name: value
        for name, value in os.environ.items()
        if name not in FOREIGN and not name.startswith('COLCON_')
    }
    for name in ('PATH', 'LD_LIBRARY_PATH', 'PKG_CONFIG_PATH'):
        entries = clean.pop(name, '').split(':')
        own = [entry for entry in entries if entry and not foreign.match(entry)]
        if name == 'PATH':
            own.insert(0, str(venv / 'bin'))
        if own:
            clean[name] = ':'.join(own)
    clean.update(
        VIRTUAL_ENV=str(venv),
        AMENT_PREFIX_PATH=str(venv),
        CMAKE_PREFIX_PATH=str(venv),
        COLCON_HOME=str(venv / 'colcon'),  # without the defaults of the user's own workspaces
        PIP_USER='0',  # a user's pip.conf may set it, and pip rejects it in an environment
    )
    return clean


def run_logged(name: str, title: str, command: list) -> None:
    """Run a command with its output in ``log/setup/NAME.log``; the title is for the terminal."""
    log = ROOT / 'log' / 'setup' / f'{name}.log'
    log.parent.mkdir(parents=True, exist_ok=True)
    print(f'{title} (log: {log.relative_to(ROOT)}) ...', end='', flush=True)
    start = time.monotonic()
    with log.open('w') as stream:
        status = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=subprocess.STDOUT,
            env=clean_environment(),
            cwd=ROOT,
            check=False,
        ).returncode
    print(f' {time.monotonic() - start:.0f} s' if status == 0 else ' failed', flush=True)
    if status != 0:
        lines = log.read_text(errors='replace').splitlines()[-LAST_LINES:]
        raise SetupError(
            '\n  | '.join([f'{name} failed with status {status}. The end of {log}:', *lines])
            + '\nRemove the cause, then run the same command again.'
        )


def digest(paths: list) -> str:
    """Hash the names and contents of files and folders; missing ones are skipped."""
    total = hashlib.sha256()
    for file in sorted(file for path in paths for file in (path, *path.rglob('*'))):
        if file.is_file() and '__pycache__' not in file.parts:
            content = hashlib.sha256(file.read_bytes()).hexdigest()
            total.update(f'{file.relative_to(ROOT)} {content}\n'.encode())
    return total.hexdigest()


def relocate_wheels() -> None:
    """Replace the header folders of the build machine in the wheels' CMake files by local ones."""
    include = sysconfig.get_paths()['include']
    packages = str(ROOT / '.venv' / 'lib' / f'python{PYTHON_VERSION}' / 'site-packages')
    for file in (ROOT / '.venv' / 'share').rglob('*.cmake'):
        text = file.read_text()
        local = WHEEL_INCLUDE.sub(lambda _: include, text)
        local = WHEEL_PACKAGES.sub(lambda _: packages, local)
        if local != text:
            file.write_text(local)


def install(extras: list, torch_index: str) -> None:
    """
    Install the requirements into ``.venv``, unless this was finished with the same inputs.

    Extras and a package index of torch that were requested before are kept.
    """
    venv = (ROOT / '.venv').resolve()
    stamp = venv / 'setup.json'
    try:
        before = json.loads(stamp.read_text())
    except (FileNotFoundError, ValueError):
        before = {}  # no installation was finished
    place = {
        'python': PYTHON_VERSION,
        'prefix': sys.base_prefix,
        'folder': str(venv),
        'torch_index': torch_index or before.get('torch_index', ''),
    }
    extras = [name for name in LOCKED_EXTRAS if name in extras or name in before.get('extras', [])]
    requirements = ROOT / 'requirements'
    locked = ['base', *extras]
    files = [requirements / 'locked' / f'{name}.txt' for name in locked]
    torch = requirements / 'torch.txt'
    state = {**place, 'extras': extras, 'files': digest([*files, torch])}
    if before == state:
        return
    problems = machine_problems()
    if problems:
        raise SetupError('\n  * '.join(['This machine lacks:', *problems]))

    # Without the stamp, an interrupted installation is made anew from nothing.
    stamp.unlink(missing_ok=True)
    is_new = any(before.get(key) != value for key, value in place.items())
    pip = [venv / 'bin' / 'python3', '-m', 'pip', 'install', '--no-input', '--progress-bar', 'off']
    try:
        if is_new:
            # The base executable, since `make shell` runs this program by .venv's own Python.
            command = [sys._base_executable, '-m', 'venv', '--clear', venv]
            run_logged('venv', 'Creating .venv', command)
        index = ['--index-url', place['torch_index']] if place['torch_index'] else []
        title = ' '.join(['Installing torch', *(['from', place['torch_index']] if index else [])])
        if place['torch_index'] != NO_TORCH:
            run_logged('torch', title, [*pip, *index, '-r', torch])
        options = [part for file in files for part in ('-r', file)]
        title = f'Installing {", ".join(locked)}: a few minutes the first time'
        # The files name every package; pip before 24 takes NAME[EXTRA] from outside them.
        run_logged('pip', title, [*pip, '--require-hashes', '--no-deps', *options])
    except SetupError:
        if not is_new:
            # pip rolls a failed installation back.
            stamp.write_text(json.dumps(before))
        raise
    relocate_wheels()
    stamp.write_text(json.dumps(state))


def build() -> None:
    """Build each package from nothing, unless it was built from the same sources."""
    python = ROOT / '.venv' / 'bin' / 'python3'
    requirements = ['requirements/locked/base.txt']
    for package, sources in SOURCES.items():
        stamp = ROOT / 'install' / package / '.setup.sha256'
        # pyvenv.cfg names the Python and the folder of .venv; extras have no effect on a build.
        inputs = digest([ROOT / name for name in (*sources, *requirements, '.venv/pyvenv.cfg')])
        if stamp.is_file() and stamp.read_text() == inputs:
            continue
        for folder in (ROOT / 'build' / package, ROOT / 'install' / package):
            if folder.exists():
                shutil.rmtree(folder)
        # colcon's own flags for make include -l, which stalls a build on a loaded machine.
        command = ['env', f'MAKEFLAGS=-j{os.cpu_count()}']
        command += [python, '-m', 'colcon', '--log-base', 'log', 'build']
        # colcon does not look for packages inside a package, so all folders are named.
        command += ['--base-paths', '.', *(name for name in SOURCES if name != 'stavpr_ros')]
        command += ['--packages-select', package]
        command += ['--cmake-args', '-DCMAKE_BUILD_TYPE=Release', '-DBUILD_TESTING=OFF']
        command += [f'-DPython3_EXECUTABLE={python}']
        run_logged(package, f'Building {package}', command)
        stamp.write_text(inputs)


def run(command: list) -> None:
    """Replace this process by a command that finds the built packages."""
    setup_file = str(ROOT / 'install' / 'local_setup.bash')
    shell = ['bash', '--norc', '-c', 'source "$0" && exec "$@"', setup_file]
    os.execvpe('bash', [*shell, *command], clean_environment())


def main(arguments: list) -> int:
    """Run one command; return 0, 1 after a failure, or 130 after an interruption."""
    try:
        problem = python_problem(PYTHON_VERSION, platform.python_implementation())
        if problem:
            raise SetupError(problem)
        parser = argparse.ArgumentParser(description='Set up stavpr_ros without ROS.')
        commands = parser.add_subparsers(dest='command', required=True)
        for name, text in (('setup', 'make .venv'), ('build', 'the same, and build the packages')):
            command = commands.add_parser(name, help=text)
            command.add_argument(
                '--with', dest='extras', nargs='*', default=[], choices=LOCKED_EXTRAS
            )
            command.add_argument('--torch-index', default='', metavar='URL')
        command = commands.add_parser('run', help='run a command with the built packages')
        command.add_argument('argv', nargs=argparse.REMAINDER, metavar='COMMAND')
        options = parser.parse_args(arguments)

        if options.command == 'run':
            run(options.argv)
        install(options.extras, options.torch_index)
        if options.command == 'build':
            build()
    except SetupError as error:
        print(f'\n{error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print('\nInterrupted: run the same command again.', file=sys.stderr)
        return 130
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
