# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the package installs, the dependencies it declares, and the command ``stavpr``."""

import ast
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys
from xml.etree import ElementTree

from interface_packages import INTERFACES
import pytest
import setuptools
import stavpr_ros
from stavpr_ros.commands import stavpr

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / 'stavpr_ros'

# Import name: distribution on PyPI, where they differ.
DISTRIBUTIONS = {
    'cv2': 'opencv-python-headless',
    'faiss': 'faiss-cpu',
    'qdrant_client': 'qdrant-client',
    'qdrant_edge': 'qdrant-edge-py',
    'PIL': 'pillow',
    'sklearn': 'scikit-learn',
    'yaml': 'PyYAML',
}
# Import name: rosdep key, of those that rosdep can install on Ubuntu 24.04.
ROSDEP_KEYS = {
    'PIL': 'python3-pil',
    'cv2': 'python3-opencv',
    'jinja2': 'python3-jinja2',
    'matplotlib': 'python3-matplotlib',
    'numba': 'python3-numba',
    'numpy': 'python3-numpy',
    'scipy': 'python3-scipy',
    'sklearn': 'python3-sklearn',
    'tqdm': 'python3-tqdm',
    'yaml': 'python3-yaml',
}
NO_ROSDEP_KEY = {
    *('evo', 'faiss', 'gtsam', 'llvmlite', 'onnx', 'onnxruntime', 'qdrant_client', 'qdrant_edge'),
    *('h5py', 'ray', 'rosbags', 'torch'),
}
ROS = re.compile(r'\w+_(msgs|srvs|interfaces)|rclpy|launch|launch_ros|ament_index_python|tf2_ros')
PACKAGES = {'tf2_ros': 'tf2_ros_py'}  # of modules of another name


@pytest.fixture(scope='module')
def setup_arguments() -> dict:
    """Return what setup.py passes to setuptools."""
    passed: dict = {}
    original, setuptools.setup = setuptools.setup, passed.update
    folder = Path.cwd()
    os.chdir(ROOT)
    try:
        source = (ROOT / 'setup.py').read_text(encoding='utf-8')
        exec(compile(source, 'setup.py', 'exec'), {'__name__': 'setup'})
    finally:
        os.chdir(folder)
        setuptools.setup = original
    return passed


def literal_import(node: ast.Call) -> set[str]:
    """Return the top-level name that a call of import_module imports, if it is a literal."""
    if not ast.unparse(node.func).endswith('import_module') or not node.args:
        return set()
    module = node.args[0]
    if not isinstance(module, ast.Constant):
        return set()
    return {str(module.value).partition('.')[0]}


def imported(folder: Path) -> set[str]:
    """Return the top-level names that the Python files of a folder import, wherever they do."""
    names = set()
    for path in folder.rglob('*.py'):
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            if isinstance(node, ast.Import):
                names |= {alias.name.partition('.')[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                names.add((node.module or '').partition('.')[0])
            elif isinstance(node, ast.Call):
                names |= literal_import(node)
    return names - set(sys.stdlib_module_names) - {'stavpr_ros', 'numba_cuda', 'cuda'}


def distribution_names(requirements: list[str]) -> set[str]:
    return {re.match(r'[\w-]+', line).group().lower() for line in requirements}


def manifest(path: Path) -> ElementTree.Element:
    return ElementTree.parse(path / 'package.xml').getroot()


def declared(*tags: str) -> set[str]:
    return {element.text for tag in tags for element in manifest(ROOT).findall(tag)}


# Dependencies


def test_every_imported_distribution_is_required(setup_arguments):
    required = distribution_names(setup_arguments['install_requires'])
    for extra in ('onnx', 'hdf5', 'faiss', 'fleet', 'ray', 'slam'):
        required |= distribution_names(setup_arguments['extras_require'][extra])
    needed = {name for name in imported(PACKAGE) if not ROS.fullmatch(name)}
    assert needed  # the search works
    assert {DISTRIBUTIONS.get(name, name).lower() for name in needed} - required == set()


def test_every_imported_ros_package_is_dependency():
    run = {name for folder in ('stavpr_ros', 'launch') for name in imported(ROOT / folder)}
    needed = {PACKAGES.get(name, name) for name in run if ROS.fullmatch(name)}
    assert 'rclpy' in needed
    assert needed - declared('exec_depend', 'depend') == set()
    tests = {name for name in imported(ROOT / 'test') if ROS.fullmatch(name)}
    tests -= INTERFACES.keys()  # built by the tests
    assert tests - declared('exec_depend', 'depend', 'test_depend') == set()


def test_every_other_import_has_rosdep_key_or_explanation():
    needed = {name for name in imported(PACKAGE) if not ROS.fullmatch(name)}
    assert needed - set(ROSDEP_KEYS) - NO_ROSDEP_KEY == set()
    keys = {ROSDEP_KEYS[name] for name in needed & set(ROSDEP_KEYS)}
    assert keys - declared('exec_depend') == set()
    text = (ROOT / 'package.xml').read_text(encoding='utf-8')
    assert [name for name in NO_ROSDEP_KEY if f'      {name} ' not in text] == []


# Versions and licenses


def test_versions_agree(setup_arguments):
    versions = [manifest(ROOT / folder).findtext('version') for folder in ('.', 'stavpr_msgs')]
    citation = (ROOT / 'CITATION.cff').read_text(encoding='utf-8')
    versions.append(re.search(r'^version: (.+)$', citation, re.MULTILINE).group(1))
    assert {*versions, setup_arguments['version']} == {stavpr_ros.__version__}


@pytest.mark.parametrize('folder', ['.', 'stavpr_msgs'])
def test_license_file_is_there(folder):
    element = manifest(ROOT / folder).find('license')
    text = (ROOT / folder / element.get('file')).read_text(encoding='utf-8')
    assert element.text == 'Apache-2.0'
    assert 'Apache License' in text
    assert (ROOT / folder / 'CHANGELOG.rst').is_file()


# What is installed


@pytest.fixture(scope='module')
def installed(tmp_path_factory) -> Path:
    """Install a copy of the sources as colcon does, and return the prefix."""
    source, prefix = (tmp_path_factory.mktemp(name) for name in ('source', 'prefix'))
    for name in ('stavpr_ros', 'scripts', 'resource', 'config', 'launch'):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns('__pycache__'))
    for name in ('setup.py', 'setup.cfg', 'package.xml'):
        shutil.copy(ROOT / name, source)
    command = [sys.executable, '-W', 'ignore', 'setup.py', '--quiet', 'install']
    command += ['--prefix', str(prefix), '--single-version-externally-managed']
    command += ['--record', str(source / 'install.log')]
    done = subprocess.run(command, cwd=source, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return prefix


def test_install_puts_one_command_on_path(installed):
    assert [path.name for path in installed.glob('**/bin/*')] == ['stavpr']


def test_install_keeps_names_of_ros2_run(installed):
    scripts = next(installed.glob('**/lib/stavpr_ros'))
    assert {path.name for path in scripts.iterdir()} == set(stavpr.COMMANDS)
    for path in scripts.iterdir():
        text = path.read_text(encoding='utf-8')
        assert os.access(path, os.X_OK)
        assert text.startswith('#!/usr/bin/env python3\n')
        assert f'from stavpr_ros.commands.{path.name} import main\n' in text
        assert (PACKAGE / 'commands' / f'{path.name}.py').is_file()


def test_install_registers_package(installed):
    share = next(installed.glob('**/share'))
    assert (share / 'ament_index/resource_index/packages/stavpr_ros').is_file()
    assert (share / 'stavpr_ros/package.xml').is_file()
    launch = {path.name for path in (share / 'stavpr_ros/launch').iterdir()}
    assert {path.name for path in (ROOT / 'launch').glob('*.launch.py')} <= launch


def test_install_contains_every_file_of_package(installed):
    package = next(installed.glob('**/*-packages/stavpr_ros'))
    wanted = {
        path.relative_to(PACKAGE)
        for path in PACKAGE.rglob('*')
        if path.is_file() and '__pycache__' not in path.parts
    }
    assert Path('py.typed') in wanted
    assert [str(path) for path in wanted if not (package / path).is_file()] == []


# The command `stavpr`


def test_stavpr_lists_every_command(capsys):
    assert stavpr.main(['--help']) == 0
    text = capsys.readouterr().out
    assert [name for name in stavpr.COMMANDS if f'  {name} ' not in text] == []
    assert stavpr.main([]) == 2


def test_stavpr_passes_arguments_and_exit_code(monkeypatch):
    received = []
    module = type(sys)('stavpr_ros.commands.build_map')
    module.main = lambda args: received.append(args) or 7
    monkeypatch.setitem(sys.modules, 'stavpr_ros.commands.build_map', module)
    assert stavpr.main(['build_map', '--input', 'a b']) == 7
    assert received == [['--input', 'a b']]


def test_stavpr_without_ros_names_missing_modules(monkeypatch, capsys):
    monkeypatch.setattr(stavpr.importlib.util, 'find_spec', lambda _: None)
    for name in ('node', 'replay', 'record', 'demo'):
        assert stavpr.main([name]) == 2
        assert re.search(r'rclpy.*setup\.bash', capsys.readouterr().err, re.DOTALL)


def test_stavpr_forgets_requirements_of_generated_scripts(monkeypatch):
    script = type(sys)('__main__')
    script.__requires__ = 'stavpr-ros'
    monkeypatch.setitem(sys.modules, '__main__', script)
    stavpr.main(['--version'])
    assert not hasattr(script, '__requires__')
