"""The steps in their order, colcon's part of them, and the command line behind the Makefile."""

import argparse
import fcntl
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from setup_environment import ALWAYS, GROUPS, Environment
from setup_report import Step, StepFailedError, run_logged, run_steps
from setup_stamps import digest_of, is_current, write_stamp

ROOT = Path(__file__).resolve().parent.parent
# What a package is built from, in the order of building: stavpr_ros needs stavpr_msgs.
SOURCES = {
    'stavpr_msgs': ('stavpr_msgs',),
    'stavpr_ros': ('package.xml', 'setup.py', 'setup.cfg', 'resource', 'config', 'launch', 'stavpr_ros'),
}


def remove_folder(folder: Path) -> None:
    """Remove a folder with all that is in it, if there is one."""
    if folder.exists():
        shutil.rmtree(folder)


class Workspace:
    """
    The packages of a checkout, built and installed in it by colcon.

    :param environment: what they are built with.
    """

    def __init__(self, environment: Environment) -> None:
        self.environment = environment
        self.root = environment.root
        self.install = self.root / 'install'

    def _made_from(self, package: str) -> dict[str, str]:
        sources = digest_of([self.root / name for name in SOURCES[package]], self.root)
        return {'sources': sources, 'environment': self.environment.ros_digest()}

    def _stamp(self, package: str) -> Path:
        # In the folder of what it speaks for, so that both go together.
        return self.install / package / '.stavpr_setup.json'

    def is_built(self, package: str) -> bool:
        """Whether a package is built from the sources as they are now."""
        return (self.install / 'local_setup.bash').is_file() and is_current(
            self._stamp(package), self._made_from(package)
        )

    def build(self, package: str) -> None:
        """Build and install a package from nothing: files that are no longer in the sources must go."""
        made_from = self._made_from(package)
        for folder in ('build', 'install'):
            remove_folder(self.root / folder / package)
        variables = self.environment.variables()
        # Defaults of the user's own workspaces (~/.colcon) must not change what is built here.
        variables['COLCON_HOME'] = str(self.environment.venv / 'stavpr_setup' / 'colcon')
        command = [
            str(self.environment.python),
            '-m',
            'colcon',
            '--log-base',
            'log',
            'build',
            '--base-paths',
            '.',
            'stavpr_msgs',
            '--packages-select',
            package,
            '--cmake-args',
            '-DCMAKE_BUILD_TYPE=Release',
            '-DBUILD_TESTING=OFF',
            f'-DPython3_EXECUTABLE={self.environment.python}',
        ]
        run_logged(
            command,
            self.environment.log_folder / f'{package}.log',
            variables,
            self.root,
            'If what colcon says does not help, run: make distclean, and the same command again.',
        )
        write_stamp(self._stamp(package), made_from)

    def run(self, command: list[str]) -> None:
        """Become a command that finds the built packages; it never returns."""
        setup_file = self.install / 'local_setup.bash'
        if not setup_file.is_file():
            raise StepFailedError(f'{setup_file} is missing: run `make build` first.')
        # No `set -u`: colcon's file reads variables that may be unset.
        script = 'source "$0" && exec "$@"'
        os.execvpe(
            'bash', ['bash', '--norc', '-c', script, str(setup_file), *command], self.environment.variables()
        )


def steps_of(environment: Environment, with_packages: bool) -> list[Step]:
    """
    The steps, in order.

    :param with_packages: build the checkout's packages as well.
    """
    steps = [
        Step('Virtual environment .venv', environment.is_made, environment.make),
        Step('PyTorch', environment.has_torch, environment.install_torch),
        Step(
            'ROS 2 Jazzy, build tools and Python packages',
            environment.has_packages,
            environment.install_packages,
        ),
        Step("Paths in the ROS wheels' CMake files", environment.is_relocated, environment.relocate_wheels),
    ]
    if with_packages:
        workspace = Workspace(environment)
        for package in SOURCES:

            def is_done(name: str = package) -> bool:
                return workspace.is_built(name)

            def action(name: str = package) -> None:
                workspace.build(name)

            steps.append(Step(f'colcon build of {package}', is_done, action))
    return steps


@contextmanager
def one_at_a_time(root: Path) -> Iterator[None]:
    """Let only one set-up of a checkout run; a second one waits for the first."""
    handle = os.open(root, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            print('Waiting for another set-up of this checkout ...', flush=True)
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def set_up(
    environment: Environment,
    with_packages: bool,
    machine_problems: Callable[[], list[str]],
    refuse: Callable[[list[str]], int],
) -> int:
    """Do what is not done yet."""
    with one_at_a_time(environment.root):
        steps = steps_of(environment, with_packages)
        if all(step.is_done() for step in steps):
            print('Set-up: nothing to do.', flush=True)
            return 0
        began = time.monotonic()
        # Only now: a machine where everything is built needs no compiler to run it.
        problems = machine_problems()
        if problems:
            return refuse(problems)
        # Logs of an earlier try would be taken for those of this one.
        remove_folder(environment.log_folder)
        run_steps(steps)
        print(
            f'Set up in {time.monotonic() - began:.0f} s; logs are in '
            f'{environment.log_folder.relative_to(environment.root)}/',
            flush=True,
        )
    return 0


def parse(arguments: list[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(prog='bootstrap.py', description=__doc__)
    commands = parser.add_subparsers(dest='command', required=True)
    texts = {'setup': 'make the virtual environment', 'build': 'make it, and build the packages'}
    for name, text in texts.items():
        command = commands.add_parser(name, help=text)
        extras = [group for group in GROUPS if group not in ALWAYS]
        command.add_argument(
            '--with',
            dest='extras',
            nargs='*',
            default=[],
            choices=extras,
            metavar='EXTRA',
            help=f'install these as well: {", ".join(extras)}',
        )
        command.add_argument('--torch-index', default='', metavar='URL', help='the package index for torch')
    command = commands.add_parser('run', help='run a command that finds the built packages')
    command.add_argument('argv', nargs=argparse.REMAINDER, metavar='COMMAND')
    return parser.parse_args(arguments)


def main(
    arguments: list[str], machine_problems: Callable[[], list[str]], refuse: Callable[[list[str]], int]
) -> int:
    """
    Do what the command line asks for.

    :param machine_problems: says what the machine lacks.
    :param refuse: tells the user so, and gives the exit status.
    :returns: the exit status: 0, 1 if a step failed, 2 if the machine lacks something, 130 if interrupted.
    """
    options = parse(arguments)
    try:
        if options.command == 'run':
            Workspace(Environment(ROOT)).run(options.argv)
        groups = tuple(name for name in GROUPS if name in ALWAYS or name in options.extras)
        environment = Environment(ROOT, groups, options.torch_index)
        return set_up(environment, options.command == 'build', machine_problems, refuse)
    except StepFailedError as error:
        print(f'\n{error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print('\nInterrupted: run the same command again to go on.', file=sys.stderr)
        return 130
