"""The virtual environment: made, filled with pinned packages, its ROS wheels fitted to this machine."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from setup_report import StepFailedError, run_logged
from setup_stamps import digest_of, is_current, read_stamp, remove_stamp, write_stamp

GROUPS = ('runtime', 'ros', 'build', 'onnx', 'cuda', 'evaluation', 'dev')  # requirements/NAME.txt
ALWAYS = ('runtime', 'ros', 'build')

# Variables of another ROS, another Python or the make that called us; none of them may leak into ours.
FOREIGN = (
    'PYTHONPATH',
    'PYTHONHOME',
    'CONDA_PREFIX',
    'PIP_TARGET',
    'PIP_PREFIX',
    'DESTDIR',
    'AMENT_PREFIX_PATH',
    'AMENT_CURRENT_PREFIX',
    'CMAKE_PREFIX_PATH',
    'RMW_IMPLEMENTATION',
    'ROS_DISTRO',
    'ROS_VERSION',
    'ROS_PYTHON_VERSION',
    'ROS_PACKAGE_PATH',
    'ROS_ROOT',
    'ROS_ETC_DIR',
    '_ROS_WHEELS_BOOTSTRAP_COMPLETE',
    'MAKEFLAGS',
    'MFLAGS',
    'MAKEOVERRIDES',
    'MAKELEVEL',
    'MAKEFILES',
)
SEARCH_PATHS = ('PATH', 'LD_LIBRARY_PATH', 'PKG_CONFIG_PATH')

# Folders of the machine that the wheels were built on, as they stand in the wheels' CMake files.
WHEEL_PYTHON = r'/opt/python/cp3\d+-cp3\d+'
WHEEL_INCLUDE = re.compile(WHEEL_PYTHON + r'/include/python3\.\d+')
WHEEL_NUMPY = re.compile(WHEEL_PYTHON + r'/lib/python3\.\d+/site-packages/numpy/_?core/include')


def clean_environment(variables: Mapping[str, str], venv: Path) -> dict[str, str]:
    """
    Environment variables in which only the virtual environment's ROS is found.

    :param variables: those of the caller, who may have sourced another ROS or activated another Python.
    :param venv: the virtual environment.
    """
    others = [
        entry
        for name in ('AMENT_PREFIX_PATH', 'COLCON_PREFIX_PATH')
        for entry in variables.get(name, '').split(os.pathsep)
        if entry
    ]
    roots = [Path(entry) for entry in ['/opt/ros', *others]]

    def is_foreign(entry: str) -> bool:
        # The wheels put their own libraries on the path of every Python that they start in.
        return '/site-packages/ros_' in entry or any(Path(entry).is_relative_to(root) for root in roots)

    clean = {
        name: value
        for name, value in variables.items()
        if name not in FOREIGN and not name.startswith('COLCON_')
    }
    for name in SEARCH_PATHS:
        found = clean.pop(name, '').split(os.pathsep)
        entries = [entry for entry in found if entry and not is_foreign(entry)]
        if name == 'PATH':
            entries = [str(venv / 'bin'), *(entry for entry in entries if entry != str(venv / 'bin'))]
        if entries:
            clean[name] = os.pathsep.join(entries)
    clean.update(
        {
            'VIRTUAL_ENV': str(venv),
            'AMENT_PREFIX_PATH': str(venv),
            'CMAKE_PREFIX_PATH': str(venv),
            'PIP_USER': '0',  # a user's pip.conf may say otherwise, and pip refuses that in an environment
        }
    )
    return clean


def relocate(share: Path, include: str, numpy_include: str) -> int:
    """
    Point the wheels' CMake files to this machine's headers.

    :param share: the folder ``share`` of the virtual environment.
    :param include: the folder with ``Python.h``.
    :param numpy_include: the folder with NumPy's headers.
    :returns: how many files were changed; none, where it was done before.
    """
    changed = 0
    for file in sorted(share.rglob('*.cmake')):
        before = file.read_text(encoding='utf-8')
        after = WHEEL_NUMPY.sub(lambda _: numpy_include, WHEEL_INCLUDE.sub(lambda _: include, before))
        if after != before:
            # A new file in place of the old one: installers may share one file among environments.
            draft = file.with_name(file.name + '.draft')
            draft.write_text(after, encoding='utf-8')
            os.replace(draft, file)
            changed += 1
    return changed


def forget_torn(packages: Path) -> list[str]:
    """
    Make pip install again what an interrupted pip left in pieces, which it would take for installed.

    :param packages: the folder ``site-packages``.
    :returns: the names of what was torn.
    """
    # pip writes INSTALLER after a package's own files.
    torn = [folder for folder in sorted(packages.glob('*.dist-info')) if not (folder / 'INSTALLER').exists()]
    for folder in torn:
        shutil.rmtree(folder)
    return [folder.name for folder in torn]


def torch_requirement(requirements: str) -> str:
    """The line of a requirements file that pins torch."""
    for line in requirements.splitlines():
        if re.match(r'torch\s*==', line):
            return line.split('#')[0].strip()
    raise StepFailedError('requirements/runtime.txt has no line torch==VERSION: put it back.')


class Environment:
    """
    The virtual environment of a checkout.

    :param root: the checkout.
    :param groups: names of :data:`GROUPS` that must be installed.
    :param torch_index: a package index to take torch from; empty for pip's usual one.
    """

    def __init__(self, root: Path, groups: tuple[str, ...] = ALWAYS, torch_index: str = '') -> None:
        self.root = root
        self.venv = root / '.venv'
        self.python = self.venv / 'bin' / 'python3'
        self.groups = groups
        self.torch_index = torch_index
        self.log_folder = root / 'log' / 'setup'
        self._stamps = self.venv / 'stavpr_setup'

    def variables(self) -> dict[str, str]:
        """Environment variables for everything that runs in it."""
        return clean_environment(os.environ, self.venv)

    def identity(self) -> dict[str, str]:
        """What the environment depends on: it cannot be moved, and belongs to one Python."""
        return {
            'python': f'{sys.version_info.major}.{sys.version_info.minor}',
            'base': sys.base_prefix,
            'folder': str(self.venv),
        }

    def ros_digest(self) -> str:
        """One number for everything that the built packages depend on in it."""
        files = [self._requirements(name) for name in ('ros', 'build', 'constraints')]
        return digest_of(files, self.root) + ' ' + ' '.join(self.identity().values())

    # Step: the environment itself

    def is_made(self) -> bool:
        """Whether it was made by this Python, at this place."""
        return self.python.exists() and is_current(self._stamp('venv'), self.identity())

    def make(self) -> None:
        """Make it, anew where another Python or a checkout elsewhere has made it."""
        command = [getattr(sys, '_base_executable', '') or sys.executable, '-m', 'venv']
        if read_stamp(self._stamp('venv')) or not self._resembles():
            command.append('--clear')
        self._run(
            'venv',
            [*command, str(self.venv)],
            f'Look at the log; if nothing helps, delete {self.venv} and run the same command again.',
        )
        write_stamp(self._stamp('venv'), self.identity())

    def _resembles(self) -> bool:
        """Whether an interrupted run of the same Python left it: what is installed in it can stay."""
        try:
            text = (self.venv / 'pyvenv.cfg').read_text(encoding='utf-8')
        except FileNotFoundError:
            return False
        version = re.escape(self.identity()['python'])
        return re.search(rf'^version = {version}\.', text, re.MULTILINE) is not None

    # Step: torch, apart from the rest, since it may come from an index of its own

    def has_torch(self) -> bool:
        """Whether torch is there, and from the index that is asked for, if one is."""
        wanted = {'torch': self._torch()}
        if self.torch_index:
            wanted['index'] = self.torch_index
        return is_current(self._stamp('torch'), wanted)

    def install_torch(self) -> None:
        """Install torch."""
        advice = (
            'If it cannot be reached or is too large (torch may bring CUDA, several GB), name an index '
            'of CPU wheels: make demo TORCH_INDEX=URL'
        )
        made_before = read_stamp(self._stamp('torch'))
        remove_stamp(self._stamp('torch'))
        if made_before and self.torch_index:
            # pip would take the same version from the other index for the one that is asked for.
            self._run('torch', [str(self.python), '-m', 'pip', 'uninstall', '--yes', 'torch'], advice)
        index = ['--index-url', self.torch_index] if self.torch_index else []
        self._pip('torch', [*index, self._torch()], advice)
        write_stamp(self._stamp('torch'), {'torch': self._torch(), 'index': self.torch_index})

    def _torch(self) -> str:
        return torch_requirement(self._requirements('runtime').read_text(encoding='utf-8'))

    # Step: all other packages

    def has_packages(self) -> bool:
        """Whether all groups are installed as their files say now."""
        return is_current(self._stamp('packages'), self._package_digests(self.groups))

    def install_packages(self) -> None:
        """Install the groups, together with those that are there, so that pip keeps them consistent."""
        before = read_stamp(self._stamp('packages'))
        groups = [name for name in GROUPS if name in self.groups or name in before]
        remove_stamp(self._stamp('packages'))
        if not is_current(self._stamp('relocated'), {'ros': self.ros_digest()}):
            remove_stamp(self._stamp('relocated'))
        files = [part for name in groups for part in ('-r', str(self._requirements(name)))]
        self._pip(
            'packages',
            [*files, '-c', str(self._requirements('constraints'))],
            'If the package index cannot be reached: once it can, run the same command again.',
        )
        write_stamp(self._stamp('packages'), self._package_digests(tuple(groups)))

    def _package_digests(self, groups: tuple[str, ...]) -> dict[str, str]:
        return {name: digest_of([self._requirements(name)], self.root) for name in (*groups, 'constraints')}

    # Step: the wheels' CMake files

    def is_relocated(self) -> bool:
        """Whether the wheels that are installed now were fitted to this machine."""
        return is_current(self._stamp('relocated'), {'ros': self.ros_digest()})

    def relocate_wheels(self) -> None:
        """Fit the wheels' CMake files to this machine."""
        question = (
            'import numpy, sysconfig\nprint(sysconfig.get_paths()["include"], numpy.get_include(), sep="\\n")'
        )
        answer = subprocess.run(
            [str(self.python), '-c', question],
            env=self.variables(),
            capture_output=True,
            text=True,
            check=False,
        )
        if answer.returncode != 0:
            raise StepFailedError(
                f'{self.python} cannot import numpy:\n{answer.stderr}\n'
                f'Delete {self.venv} and run the same command again.'
            )
        include, numpy_include = answer.stdout.splitlines()
        relocate(self.venv / 'share', include, numpy_include)
        write_stamp(self._stamp('relocated'), {'ros': self.ros_digest()})

    # Parts of the steps

    def _requirements(self, name: str) -> Path:
        return self.root / 'requirements' / f'{name}.txt'

    def _stamp(self, name: str) -> Path:
        return self._stamps / f'{name}.json'

    def _pip(self, name: str, arguments: list[str], advice: str) -> None:
        version = self.identity()['python']
        forget_torn(self.venv / 'lib' / f'python{version}' / 'site-packages')
        options = ['--no-input', '--disable-pip-version-check', '--progress-bar', 'off']
        self._run(name, [str(self.python), '-m', 'pip', 'install', *options, *arguments], advice)

    def _run(self, name: str, command: list[str], advice: str) -> None:
        run_logged(command, self.log_folder / f'{name}.log', self.variables(), self.root, advice)
