"""The set-up behind the Makefile: what it refuses, what it takes for done, what it changes; no network."""

import ast
import os
import re
import stat
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import bootstrap
import pytest
import setup_environment
import setup_main
from setup_environment import Environment, clean_environment, forget_torn, relocate, torch_requirement
from setup_report import Step, StepFailedError, run_logged, run_steps
from setup_stamps import digest_of, is_current, read_stamp, write_stamp

import stavpr_ros

ROOT = Path(__file__).resolve().parent.parent
REQUIREMENTS = {
    'runtime': 'torch==1.0\nnumpy==1\n',
    'ros': 'r==1\n',
    'build': 'b==1\n',
    'onnx': 'o==1\n',
    'evaluation': 'e==1\n',
    'dev': 'd==1\n',
    'constraints': 'c==1\n',
}


def write_program(path: Path, script: str) -> None:
    path.write_text(f'#!/bin/sh\n{script}\n', encoding='utf-8')
    path.chmod(path.stat().st_mode | stat.S_IXUSR)


@pytest.fixture
def bare_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The only folder on the PATH; there is nothing in it."""
    folder = tmp_path / 'bin'
    folder.mkdir()
    monkeypatch.setenv('PATH', str(folder))
    monkeypatch.delenv('CC', raising=False)
    monkeypatch.delenv('CXX', raising=False)
    return folder


class Recorder:
    """Stands for run_logged: keeps the commands, and fails where it is told to."""

    def __init__(self) -> None:
        self.commands: list[str] = []
        self.fails = False

    def __call__(self, command: list[str], *_: object) -> None:
        self.commands.append(' '.join(command))
        if self.fails:
            raise StepFailedError('told to')


@pytest.fixture
def recorder(monkeypatch: pytest.MonkeyPatch) -> Recorder:
    found = Recorder()
    monkeypatch.setattr(setup_environment, 'run_logged', found)
    return found


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    (tmp_path / 'requirements').mkdir()
    for name, text in REQUIREMENTS.items():
        (tmp_path / 'requirements' / f'{name}.txt').write_text(text, encoding='utf-8')
    return tmp_path


# What is refused


@pytest.mark.parametrize('version', [(3, 11, 0), (3, 12, 1), (3, 13, 9)])
def test_supported_python(version: tuple[int, ...]) -> None:
    assert bootstrap.python_problem(version, 'cpython', False, '/bin/python3') == ''


@pytest.mark.parametrize('version', [(2, 7, 18), (3, 6, 15), (3, 10, 13), (3, 14, 0), (4, 0, 0)])
def test_other_python_is_refused_by_name(version: tuple[int, ...]) -> None:
    text = bootstrap.python_problem(version, 'cpython', False, '/bin/odd')
    assert 'Python ' + '.'.join(map(str, version)) in text
    assert '/bin/odd' in text
    assert '3.11, 3.12 or 3.13' in text
    assert 'make demo PYTHON=' in text


def test_other_kinds_of_python_are_refused() -> None:
    assert 'pypy' in bootstrap.python_problem((3, 11, 9), 'pypy', False, 'p')
    assert 'free-threaded' in bootstrap.python_problem((3, 13, 0), 'cpython', True, 'p')


def test_old_python_can_read_the_gate() -> None:
    source = (ROOT / 'tools' / 'bootstrap.py').read_text(encoding='utf-8')
    ast.parse(source, feature_version=(3, 6))
    assert '__future__' not in source


@pytest.mark.parametrize(
    ('machine', 'named'),
    [
        (('Linux', 'x86_64', 'glibc'), ''),
        (('Linux', 'aarch64', 'glibc'), 'Linux on aarch64'),
        (('Darwin', 'x86_64', ''), 'Darwin'),
        (('Linux', 'x86_64', ''), 'without the GNU C library'),
    ],
)
def test_platform(machine: tuple[str, str, str], named: str) -> None:
    text = bootstrap.platform_problem(*machine)
    assert bool(text) == bool(named)
    assert named in text


@pytest.mark.usefixtures('bare_path')
def test_all_that_is_missing_is_said_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    assert bootstrap.refuse(bootstrap.machine_problems()) == 2
    text = capsys.readouterr().err
    for word in ('No C compiler', 'No C++ compiler', 'cmake is not on the PATH', 'make is not on the PATH'):
        assert word in text


def test_compiler_that_does_not_compile(bare_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_program(bare_path / 'cc', 'exit 1')
    assert '`cc` cannot build' in bootstrap.compiler_problem(*bootstrap.COMPILERS[0])
    write_program(bare_path / 'cc', 'exit 0')
    assert bootstrap.compiler_problem(*bootstrap.COMPILERS[0]) == ''
    monkeypatch.setenv('CC', 'no-such-compiler -m64')
    assert 'CC=no-such-compiler' in bootstrap.compiler_problem(*bootstrap.COMPILERS[0])


@pytest.mark.parametrize(
    ('script', 'named'),
    [
        ('echo cmake version 3.20.0', ''),
        ('echo cmake version 4.1.0-rc1', ''),
        ('echo cmake version 3.16.3', '3.16.3'),
        ('exit 1', 'does not tell'),
        ('echo hello', 'does not tell'),
    ],
)
def test_cmake(bare_path: Path, script: str, named: str) -> None:
    write_program(bare_path / 'cmake', script)
    text = bootstrap.cmake_problem()
    assert bool(text) == bool(named)
    assert named in text


# What is taken for done


def test_digest_knows_names_and_contents(tmp_path: Path) -> None:
    for name in ('a', 'b'):
        (tmp_path / name / 'src' / '__pycache__').mkdir(parents=True)
        (tmp_path / name / 'src' / 'x.py').write_text('1', encoding='utf-8')
    one, other = tmp_path / 'a', tmp_path / 'b'
    before = digest_of([one / 'src', one / 'none'], one)
    assert before == digest_of([other / 'src'], other)
    (one / 'src' / '__pycache__' / 'x.pyc').write_text('2', encoding='utf-8')
    assert before == digest_of([one / 'src'], one)
    (one / 'src' / 'x.py').rename(one / 'src' / 'y.py')
    assert before != digest_of([one / 'src'], one)
    (other / 'src' / 'x.py').write_text('3', encoding='utf-8')
    assert before != digest_of([other / 'src'], other)


def test_stamp(tmp_path: Path) -> None:
    stamp = tmp_path / 'deep' / 'stamp.json'
    assert not is_current(stamp, {'a': '1'})
    write_stamp(stamp, {'a': '1', 'b': '2'})
    assert is_current(stamp, {'a': '1'})
    assert not is_current(stamp, {'a': '1', 'c': '3'})
    stamp.write_text(stamp.read_text(encoding='utf-8')[:9], encoding='utf-8')
    assert read_stamp(stamp) == {}


def test_steps_stop_at_the_first_failure(capsys: pytest.CaptureFixture[str]) -> None:
    done: list[str] = []

    def fail() -> None:
        raise StepFailedError('no')

    def forbidden() -> None:
        raise AssertionError('was done before')

    steps = [
        Step('first', lambda: True, forbidden),
        Step('second', lambda: False, lambda: done.append('second')),
        Step('third', lambda: False, fail),
        Step('fourth', lambda: False, lambda: done.append('fourth')),
    ]
    with pytest.raises(StepFailedError):
        run_steps(steps)
    assert done == ['second']
    text = capsys.readouterr().out
    assert '[1/4] first ... is there' in text
    assert re.search(r'\[3/4\] third \.\.\. failed after', text)


def test_failed_command_shows_the_end_of_its_log(tmp_path: Path) -> None:
    log = tmp_path / 'logs' / 'step.log'
    command = ['sh', '-c', 'for i in $(seq 100); do echo line $i; done; echo odd >&2; exit 3']
    with pytest.raises(StepFailedError) as caught:
        run_logged(command, log, dict(os.environ), tmp_path, 'Do this.')
    lines = str(caught.value).splitlines()
    assert 'status 3' in lines[0]
    assert str(log) in lines[0]
    assert lines[-2:] == ['  | odd', 'Do this.']
    assert '  | line 100' in lines
    assert '  | line 1' not in lines


def test_half_finished_packages_are_resumed(checkout: Path, recorder: Recorder) -> None:
    Environment(checkout, ('runtime', 'dev')).install_packages()
    environment = Environment(checkout, ('runtime', 'onnx'))
    assert not environment.has_packages()
    recorder.fails = True
    with pytest.raises(StepFailedError):
        environment.install_packages()
    assert not Environment(checkout, ('runtime',)).has_packages()
    recorder.fails = False
    environment.install_packages()
    assert environment.has_packages()
    (checkout / 'requirements' / 'onnx.txt').write_text('o==2\n', encoding='utf-8')
    assert not environment.has_packages()
    assert Environment(checkout, ('runtime',)).has_packages()


def test_groups_that_are_there_stay(checkout: Path, recorder: Recorder) -> None:
    Environment(checkout, ('runtime', 'dev')).install_packages()
    Environment(checkout, ('runtime', 'onnx')).install_packages()
    assert Environment(checkout, ('runtime', 'onnx', 'dev')).has_packages()
    assert all(f'{name}.txt' in recorder.commands[-1] for name in ('runtime', 'onnx', 'dev'))


def test_torch_from_another_index(checkout: Path, recorder: Recorder) -> None:
    Environment(checkout).install_torch()
    assert '--index-url' not in recorder.commands[-1]
    other = Environment(checkout, torch_index='file:///cpu')
    assert not other.has_torch()
    other.install_torch()
    assert 'uninstall' in recorder.commands[-2]
    assert recorder.commands[-1].endswith('--index-url file:///cpu torch==1.0')
    assert other.has_torch()
    assert Environment(checkout).has_torch()


def test_environment_of_another_place_is_made_anew(checkout: Path, recorder: Recorder) -> None:
    environment = Environment(checkout)
    environment.make()
    assert '--clear' in recorder.commands[-1]
    environment.python.parent.mkdir(parents=True)
    environment.python.touch()
    assert environment.is_made()
    write_stamp(environment.venv / 'stavpr_setup' / 'venv.json', {**environment.identity(), 'folder': 'x'})
    assert not environment.is_made()
    (environment.venv / 'stavpr_setup' / 'venv.json').unlink()
    version = f'{sys.version_info.major}.{sys.version_info.minor}'
    (environment.venv / 'pyvenv.cfg').write_text(f'home = x\nversion = {version}.1\n', encoding='utf-8')
    environment.make()
    assert '--clear' not in recorder.commands[-1]


# What is changed


def test_relocation(tmp_path: Path) -> None:
    built_on = '/opt/python/cp312-cp312'
    numpy = f'{built_on}/lib/python3.12/site-packages/numpy/_core/include'
    text = f'set(A "{built_on}/include/python3.12;{numpy}")\nset(B "{built_on}/lib/other")\n'
    file = tmp_path / 'share' / 'x' / 'cmake' / 'xExport.cmake'
    file.parent.mkdir(parents=True)
    file.write_text(text, encoding='utf-8')
    shared = tmp_path / 'shared.cmake'
    os.link(file, shared)
    note = tmp_path / 'share' / 'note.txt'
    note.write_text(text, encoding='utf-8')
    assert relocate(tmp_path / 'share', r'/usr/include/python3.11', r'/venv\1/numpy') == 1
    assert file.read_text(encoding='utf-8') == (
        f'set(A "/usr/include/python3.11;/venv\\1/numpy")\nset(B "{built_on}/lib/other")\n'
    )
    assert shared.read_text(encoding='utf-8') == text
    assert note.read_text(encoding='utf-8') == text
    assert relocate(tmp_path / 'share', r'/usr/include/python3.11', r'/venv\1/numpy') == 0


def test_torn_packages_are_forgotten(tmp_path: Path) -> None:
    for name in ('torn-1.dist-info', 'whole-1.dist-info', 'torn'):
        (tmp_path / name).mkdir()
        (tmp_path / name / 'METADATA').touch()
    (tmp_path / 'whole-1.dist-info' / 'INSTALLER').touch()
    assert forget_torn(tmp_path) == ['torn-1.dist-info']
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ['torn', 'whole-1.dist-info']


def test_another_ros_does_not_leak_in() -> None:
    variables = {
        'PATH': '/opt/ros/jazzy/bin:/usr/bin:/ws/install/a/bin:/venv/bin',
        'PYTHONPATH': '/opt/ros/jazzy/lib',
        'AMENT_PREFIX_PATH': '/ws/install/a:/opt/ros/jazzy',
        'ROS_DISTRO': 'humble',
        'ROS_DOMAIN_ID': '7',
        'COLCON_PREFIX_PATH': '/ws/install',
        'MAKEFLAGS': 'j',
        'STAVPR_DATA': '/data',
        'LD_LIBRARY_PATH': '/opt/ros/jazzy/lib:/v/lib/python3.11/site-packages/ros_rcl.libs',
        '_ROS_WHEELS_BOOTSTRAP_COMPLETE': '1',
    }
    assert clean_environment(variables, Path('/venv')) == {
        'PATH': '/venv/bin:/usr/bin',
        'VIRTUAL_ENV': '/venv',
        'AMENT_PREFIX_PATH': '/venv',
        'CMAKE_PREFIX_PATH': '/venv',
        'ROS_DOMAIN_ID': '7',
        'STAVPR_DATA': '/data',
        'PIP_USER': '0',
    }


# What the files of this package say


def test_versions_agree() -> None:
    setup = re.search(r"version='([^']+)'", (ROOT / 'setup.py').read_text(encoding='utf-8'))
    assert setup is not None
    manifests = [
        ElementTree.parse(ROOT / folder / 'package.xml').findtext('version')
        for folder in ('.', 'stavpr_msgs')
    ]
    assert manifests == [setup.group(1)] * 2
    assert stavpr_ros.__version__ == setup.group(1)


def test_every_executable_has_its_module() -> None:
    setup = (ROOT / 'setup.py').read_text(encoding='utf-8')
    listed = re.search(r'^EXECUTABLES = (\(.*\))$', setup, re.MULTILINE)
    assert listed is not None
    commands = ROOT / 'stavpr_ros' / 'commands'
    names = ast.literal_eval(listed.group(1))
    assert [name for name in names if not (commands / f'{name}.py').is_file()] == []


def test_requirements_are_pinned() -> None:
    for name in (*setup_environment.GROUPS, 'constraints'):
        for line in (ROOT / 'requirements' / f'{name}.txt').read_text(encoding='utf-8').splitlines():
            pin = line.split('#')[0].strip()
            assert not pin or re.fullmatch(r'[\w.\[\]-]+==[\w.]+', pin), f'{name}.txt: {line}'
    assert torch_requirement((ROOT / 'requirements' / 'runtime.txt').read_text(encoding='utf-8'))


def test_every_source_that_is_built_from_exists() -> None:
    needed = [name for names in setup_main.SOURCES.values() for name in names]
    assert [name for name in needed if not (ROOT / name).exists()] == []
