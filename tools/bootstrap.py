"""
Set up, build and run stavpr_ros on a machine that has Python and a compiler; the Makefile calls it.

This file only checks what the machine has, and then hands over to ``setup_main``. It keeps to syntax that
Python 3.6 reads, so that a Python that does not do is refused by a sentence and not by a SyntaxError.
"""

import importlib.util
import os
import platform
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile

SUPPORTED = ((3, 11), (3, 12), (3, 13))
OLDEST_CMAKE = (3, 20)
COMPILERS = (
    # what, environment variable, names in CMake's order, language, a program that needs the standard library
    ('C compiler', 'CC', ('cc', 'gcc', 'clang'), 'c', '#include <stdio.h>\nint main(void) { return 0; }\n'),
    (
        'C++ compiler',
        'CXX',
        ('c++', 'g++', 'clang++'),
        'c++',
        '#include <string>\nint main() { return std::string().size(); }\n',
    ),
)


def python_problem(version: tuple, implementation: str, free_threaded: bool, executable: str) -> str:
    """Why this Python does not do, in words; empty if it does."""
    names = [f'{major}.{minor}' for major, minor in SUPPORTED]
    wanted = ', '.join(names[:-1]) + ' or ' + names[-1]
    came = '.'.join(str(part) for part in version[:3])
    if implementation != 'cpython':
        reason = f'it is {implementation}, and the ROS 2 wheels are for CPython'
    elif tuple(version[:2]) not in SUPPORTED:
        reason = 'the packages that stavpr_ros needs have no wheels for it that fit together'
    elif free_threaded:
        reason = 'it is a free-threaded build, for which the ROS 2 wheels are not made'
    else:
        return ''
    return (
        f'Python {came} ({executable}) is not supported: {reason}. Python {wanted} is needed; '
        'name one of these, for example: make demo PYTHON=python3.12'
    )


def platform_problem(system: str, machine: str, libc: str) -> str:
    """Why the ROS wheels do not run on this kind of machine, in words; empty if they do."""
    if system == 'Linux' and machine in ('x86_64', 'AMD64') and libc == 'glibc':
        return ''
    came = f'{system} on {machine}' + ('' if libc or system != 'Linux' else ', without the GNU C library')
    return (
        f'This machine is {came}: the ROS 2 Jazzy wheels are for Linux on x86-64 with the GNU C library. '
        'On Ubuntu 24.04 install ROS 2 Jazzy with apt and build with colcon, as the README says.'
    )


def compiler_problem(kind: str, variable: str, names: tuple, language: str, program: str) -> str:
    """Why no program of this language can be built here, in words; empty if one can."""
    chosen = os.environ.get(variable, '')
    command = shlex.split(chosen) if chosen else [name for name in names if shutil.which(name)][:1]
    if not command:
        return f'No {kind} ({", ".join(names)}) is on the PATH: install build-essential.'
    if not shutil.which(command[0]):
        return f'{variable}={chosen} names no program on the PATH: install it, or unset {variable}.'
    with tempfile.TemporaryDirectory() as folder:
        built = subprocess.run(
            [*command, '-x', language, '-', '-o', os.path.join(folder, 'program')],
            input=program.encode(),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            check=False,
        )
    if built.returncode != 0:
        return (
            f'The {kind} `{" ".join(command)}` cannot build a program of one line: '
            'install build-essential (it brings the headers of the standard library).'
        )
    return ''


def cmake_problem() -> str:
    """Why CMake does not do, in words; empty if it does."""
    oldest = '.'.join(str(part) for part in OLDEST_CMAKE)
    path = shutil.which('cmake')
    if not path:
        return f'cmake is not on the PATH: install cmake, {oldest} or newer.'
    try:
        text = subprocess.check_output([path, '--version'], stderr=subprocess.DEVNULL).decode()
        version = text.split()[2]
        numbers = tuple(int(part) for part in version.split('.')[:2])
    except (OSError, subprocess.CalledProcessError, IndexError, ValueError) as error:
        return f'{path} does not tell its version ({error!r}): install cmake, {oldest} or newer.'
    if numbers < OLDEST_CMAKE:
        return f'cmake {version} ({path}) is too old: install cmake, {oldest} or newer.'
    return ''


def machine_problems() -> list:
    """Everything but Python's version that this machine lacks, one sentence each."""
    found = [platform_problem(platform.system(), platform.machine(), platform.libc_ver()[0])]
    package = f'python{sys.version_info[0]}.{sys.version_info[1]}'
    if not all(importlib.util.find_spec(name) for name in ('venv', 'ensurepip')):
        found.append(
            f'{sys.executable} cannot make virtual environments (no module venv or ensurepip): '
            f'install {package}-venv.'
        )
    header = os.path.join(sysconfig.get_paths()['include'], 'Python.h')
    if not os.path.isfile(header):
        found.append(f'{sys.executable} has no headers ({header} is missing): install {package}-dev.')
    found.extend(compiler_problem(*compiler) for compiler in COMPILERS)
    found.append(cmake_problem())
    if not shutil.which('make'):
        found.append('make is not on the PATH: install make.')
    return [problem for problem in found if problem]


def refuse(problems: list) -> int:
    """Say what is missing, all at once; the exit status for it."""
    lines = ['stavpr_ros cannot be set up on this machine yet. What is missing:']
    lines += [f'  * {problem}' for problem in problems]
    if shutil.which('apt-get'):
        lines.append('Packages named here are installed with: sudo apt-get install NAME ...')
    sys.stderr.write('\n'.join(lines) + '\n')
    return 2


def main(arguments: list) -> int:
    """Refuse a Python that does not do, together with all else that is missing, or do what is asked."""
    free_threaded = bool(sysconfig.get_config_var('Py_GIL_DISABLED'))
    problem = python_problem(tuple(sys.version_info), sys.implementation.name, free_threaded, sys.executable)
    if problem:
        return refuse([problem, *machine_problems()])
    from setup_main import main as set_up  # not above: older Pythons cannot read it

    return set_up(arguments, machine_problems, refuse)


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
